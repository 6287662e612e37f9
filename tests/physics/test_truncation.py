"""What the longest paths leave out, and how long they are where a scene does not say it."""

import numpy as np
import pytest

from nir_render import Scene, render
from nir_render.camera.mean_frame import mean_frame
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.truncation import Truncation, _shares, truncation
from tests.physics.conftest import Loader
from tests.physics.documents import (
    camera_document,
    group_radiance,
    rectangle_document,
    scene_document,
    source_document,
)

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

SIDES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
FOG = {"extinction": "0.1 /m", "phase": {"type": "henyey_greenstein", "g": 0.8}}


def _measured(scene: Scene) -> Truncation:
    left_out = truncation(mean_frame(render(scene, "eye.c", seed=3), scene.at(0.0), 1e-3))
    assert not isinstance(left_out, str)
    return left_out


def test_what_a_white_room_leaves_out(make: Loader) -> None:
    """A cube of 2 m with walls of reflectance 0.8 and two sources, paths of at most 5 stretches: four bounces.

    Each bounce leaves 0.8 of the light, wherever it goes in a closed room: somewhat less than 0.8⁴ = 41 % is left
    out, as the sources swallow some and the camera sees first bounces near by. Expected: the share by renders of
    other random numbers at depths 5 and 64, within 4 standard errors, of which the stated one is below 0.5 %.
    """
    walls = {
        f"side{index}": rectangle_document(side, (2, 2), tuple(-n for n in side), "white")
        for index, side in enumerate(SIDES)
    }
    document = scene_document(
        {"c": camera_document(32, 24, 12.0)},
        {"r": source_document((0.2, 0.4, 0.1), 0.05), "q": source_document((0.3, -0.5, -0.2), 0.05)},
        samples=64, max_depth=5, materials={"white": {"type": "diffuse", "reflectance": 0.8}}, shapes=walls,
    )  # fmt: skip
    document["robots"]["eye"]["position"] = "[-0.6, 0, 0] m"
    scene = make(document)
    left_out = _measured(scene)
    assert left_out.max_depth == 5
    kept, whole = (
        np.stack([group_radiance(one, seed).sum() for seed in seeds])
        for one, seeds in ((scene, range(8)), (scene.with_({"render.indirect.max_depth": 64}), range(50, 58)))
    )
    error = np.hypot(*(one.std(ddof=1) / one.mean() / len(one) ** 0.5 for one in (kept, whole)))
    assert left_out.standard_error < 0.005
    assert error < 0.002
    assert abs(left_out.share - (1.0 - kept.mean() / whole.mean())) < 4.0 * np.hypot(
        error, left_out.standard_error
    )
    assert 0.34 < left_out.share < 0.8**4
    assert set(left_out.of_groups) == {"r.s", "q.s"}
    assert np.mean(list(left_out.of_groups.values())) == pytest.approx(left_out.share, rel=0.02)


def test_a_wall_alone_leaves_nothing_out(make: Loader) -> None:
    """Light that a wall has scattered meets nothing more: nothing is left out, not even by noise."""
    scene = make(
        scene_document(
            {"c": camera_document(16, 12, 12.0)}, {"r": source_document((1.0, 0.3, 0.0), 0.02)}, samples=16,
            max_depth=3, materials={"white": {"type": "diffuse", "reflectance": 0.8}},
            shapes={"wall": rectangle_document((2, 0, 0), (9, 9), (-1, 0, 0), "white")},
        )
    )  # fmt: skip
    left_out = _measured(scene)
    assert left_out.share == left_out.standard_error == 0.0


@pytest.mark.parametrize(
    ("extinction", "depth"),
    [("0 /m", 8), ("0.01 /m", 12), ("0.1 /m", 12 + 4), ("1 /m", 12 + 48), ("2 /m", 64)],
)
def test_the_default_depth_follows_the_optical_depth(make: Loader, extinction: str, depth: int) -> None:
    """Three stretches more for each optical depth across what bodies and robots fill below the fog's top.

    That is 12 m × 9 m and 6 m of the 8 m up, whose diagonal is 16.16 m: 1.6 at 0.1 /m. A depth that the scene
    says stays.
    """
    document = scene_document(
        {"c": camera_document(16, 12)}, {"r": source_document((2.0, 0.0, 8.0), 0.02)}, samples=16, max_depth=8,
        materials={"white": {"type": "diffuse", "reflectance": 0.8}},
        shapes={"floor": rectangle_document((5, 0, 0), (12, 9), (0, 0, 1), "white")},
        fog=FOG | {"extinction": extinction, "top": "6 m"},
    )  # fmt: skip
    del document["render"]["indirect"]["max_depth"]
    scene = make(document)
    for said, wanted in ((scene, depth), (scene.with_({"render.indirect.max_depth": 9}), 9)):
        assert groups.world_on_device(said.at(0.0), np.ones(1)).max_depth == wanted


def test_the_default_depth_leaves_out_less_than_half_a_percent(make: Loader) -> None:
    """Fog of 0.12 per m and g 0.8 under the sun, which a depth of 8 leaves 1 to 4 % of: the default takes it in."""
    document = scene_document(
        {"c": camera_document(32, 24, 16.0)}, {}, samples=16, max_depth=8,
        sun={"azimuth": "60 deg", "elevation": "40 deg", "irradiance": "0.287 W/m^2/nm"},
        materials={"grey": {"type": "diffuse", "reflectance": 0.3}},
        shapes={"floor": rectangle_document((5, 0, -1), (40, 40), (0, 0, 1), "grey")},
        fog=FOG | {"extinction": "0.12 /m", "top": "2 m"},
    )  # fmt: skip
    short = _measured(make(document))
    del document["render"]["indirect"]["max_depth"]
    default = _measured(make(document))
    assert short.share > 0.005 + 2.0 * short.standard_error
    assert default.max_depth > 48
    assert default.share - 2.0 * default.standard_error < 0.005
    assert default.share < 0.4 * short.share


def test_shares_are_of_electrons() -> None:
    """Two groups of weights 3 and 1: 3 · 2 + 1 · 10 of 3 · 20 + 1 · 20 are left out, and 10 % and 50 % of each."""
    whole = np.array([[15.0, 5.0], [10.0, 10.0]], dtype=np.float32)
    kept = np.array([[13.5, 4.5], [5.0, 5.0]], dtype=np.float32)
    left_out = _shares(("a", "b"), 6, np.array([3.0, 1.0]), whole, kept)
    assert left_out.share == pytest.approx(16.0 / 80.0, rel=1e-6)
    assert left_out.of_groups == pytest.approx({"a": 0.1, "b": 0.5}, rel=1e-6)
    # The pixels leave out 9.5 and 6.5 of 55 and 25: 1.5 less and 1.5 more than a fifth.
    assert left_out.standard_error == pytest.approx(1.5 * 2**0.5 / 80.0, rel=1e-6)
