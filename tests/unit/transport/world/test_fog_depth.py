"""How much fog lies on straight ways, against sums by hand and by quadrature."""

import math

import numpy as np
import pytest

from nir_render.scene.documents.fog import Fog
from nir_render.transport.world.fog_depth import optical_depth

INF = math.inf
POINTS = [(0.5, 1.0), (1.0, 0.5), (1.2, 0.0), (2.0, 2.0), (2.5, 0.25)]
PROFILE = [[f"{height_m} m", density] for height_m, density in POINTS]


def of_box(low: list[float], high: list[float]) -> Fog:
    """Return a fog of 1/m in a box, or below a height."""
    document: dict[str, object] = {"extinction": "1 /m"}
    if all(map(math.isfinite, low)):
        document["center"] = f"{[0.5 * (a + b) for a, b in zip(low, high, strict=True)]} m"
        document["size"] = f"{[b - a for a, b in zip(low, high, strict=True)]} m"
    elif math.isfinite(high[2]):
        document["top"] = f"{high[2]} m"
    return Fog.model_validate(document)


@pytest.mark.parametrize(
    ("start", "direction", "length_m", "low", "high", "inside_m"),
    [
        ([0, 0, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 2.0),
        ([0, 0, 0], [1, 0, 0], 2.5, [1, -1, -1], [3, 1, 1], 1.5),  # ends within
        ([2, 0, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 1.0),  # starts within
        ([0, 0, 0], [-1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 0.0),  # leads away
        ([0, 2, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 0.0),  # passes beside
        ([0, 1, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 2.0),  # along its face
        ([0, 0, 0], [0.6, 0.8, 0], 5.0, [-INF, -INF, -INF], [INF, INF, INF], 5.0),
        ([0, 0, 0], [0.6, 0, 0.8], 5.0, [-INF, -INF, -INF], [INF, INF, 2.0], 2.5),
        ([0, 0, 0], [0.6, 0, 0.8], INF, [-INF, -INF, -INF], [INF, INF, 2.0], 2.5),  # to the sun
        ([0, 0, 3], [0.6, 0, 0.8], INF, [-INF, -INF, -INF], [INF, INF, 2.0], 0.0),
        ([0, 0, 3], [1, 0, 0], INF, [-INF, -INF, -INF], [INF, INF, 2.0], 0.0),
        ([0, 0, 0], [0.6, 0.8, 0], 9.0, [1.2, 0, -1], [3, 2, 1], 0.5),  # enters at x = 1.2, leaves at y = 2
    ],
)
def test_how_much_of_a_ray_lies_in_a_box(
    start: list[float],
    direction: list[float],
    length_m: float,
    low: list[float],
    high: list[float],
    inside_m: float,
) -> None:
    ray = (np.array([start], dtype=float), np.array([direction], dtype=float), np.array([length_m]))
    assert optical_depth(of_box(low, high), *ray) == pytest.approx([inside_m])


def test_a_profile_adds_up_as_small_steps_do() -> None:
    """Rays in all directions, level ones too, within and beyond a profile's points, against 2·10⁵ steps."""
    fog = Fog.model_validate({"extinction": "0.4 /m", "top": "2.4 m", "profile": PROFILE})
    random = np.random.default_rng(1)
    start_m = random.uniform([-5, -5, -1], [5, 5, 4], (60, 3))
    direction = random.normal(size=(60, 3))
    direction[:20, 2] *= 1e-3
    direction[:5, 2] = 0.0
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length_m = random.uniform(0.1, 8, 60)
    steps = (np.arange(200_000) + 0.5) / 200_000
    height_m, density = np.array(POINTS).T
    expected = []
    for place_m, slope, far_m in zip(start_m[:, 2], direction[:, 2], length_m, strict=True):
        at_m = place_m + slope * far_m * steps
        expected.append(0.4 * far_m * np.mean(np.interp(at_m, height_m, density) * (at_m < 2.4)))
    assert optical_depth(fog, start_m, direction, length_m) == pytest.approx(expected, rel=2e-5, abs=1e-6)


def test_fog_ends_where_its_profile_ends_at_nothing() -> None:
    """So the sun's light comes from endlessly far: 1 m to the top at half the density in the mean, 30° high."""
    fog = Fog.model_validate({"extinction": "0.3 /m", "profile": [["0 m", 1.0], ["1 m", 0.0]]})
    to_sun = np.array([[math.sqrt(0.75), 0.0, 0.5]])
    assert optical_depth(fog, np.zeros((1, 3)), to_sun, np.array([INF])) == pytest.approx([0.3])
    assert fog.region_m()[0].tolist() == [-INF, -INF, -INF]


@pytest.mark.parametrize(
    ("profile", "says"),
    [
        ([["0 m", 1.0]], "at least two points"),
        ([["0 m", 0.0], ["1 m", 0.0]], "below 1e-06 at every height"),
        ([["1 m", 1.0], ["0 m", 0.5]], "increasing height"),
        ([["0 m", -1.0], ["1 m", 0.5]], "negative"),
        ([["0 m", 1e11], ["1 m", 0.5]], "beyond"),
        ([[f"{k} m", 1.0] for k in range(64)], "63 at most"),
        ("thick", "no list"),
    ],
)
def test_what_is_no_profile_is_refused(profile: object, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Fog.model_validate({"extinction": "0.3 /m", "profile": profile})
