"""Flocking laws, by hand."""

import numpy as np
import pytest

from nir_render.experiments.loop.controllers import Neighbour, neighbours_of, reynolds, springs
from perception.types import Track

FAST = 10.0  # m/s: nothing is clipped


def _at(x_m: float, y_m: float = 0.0, vx: float = 0.0, vy: float = 0.0) -> Neighbour:
    return Neighbour(np.array([x_m, y_m]), np.array([vx, vy]))


@pytest.mark.parametrize(
    ("distance_m", "m_per_s"),
    [
        (0.7, -0.3),  # pushes are not bounded
        (1.0, 0.0),
        (1.1, 0.1),
        (1.2, 0.2),
        (1.25, 0.5 * 0.2),  # half way between 1.2 and 1.3: half the weight of a pull of at most 0.2 m
        (1.4, 0.0),
    ],
)
def test_springs_rest_at_the_wished_spacing(distance_m: float, m_per_s: float) -> None:
    """Two neighbours abreast; of each the pull along its own direction, so that only x is left."""
    along = distance_m / np.sqrt(2.0)
    pair = [_at(along, along), _at(along, -along)]
    gathered = 0.05 / np.sqrt(2.0) if distance_m > 1.2 else 0.0  # towards the nearest of those outside
    velocity = springs(pair, 1.0, FAST)
    assert velocity[0] == pytest.approx(2.0 * m_per_s / np.sqrt(2.0) + gathered, abs=1e-12)
    assert velocity[1] == pytest.approx(gathered, abs=1e-12)


def test_springs_go_along_with_their_neighbours() -> None:
    pair = [_at(0.0, 1.0, vx=0.04), _at(1.25, 0.0, vx=0.01)]  # weights 1 and 1/2
    velocity = springs(pair, 1.0, FAST)
    assert velocity == pytest.approx([(0.04 + 0.005) / 1.5 + 0.5 * 0.2 + 0.05, 0.0])


def test_the_paper_s_law() -> None:
    """1/d − 1/0.8 away, the mean velocity within 1.3 m times 0.8, 3 (d − 1.3 m) towards those beyond."""
    seen = [_at(0.5, 0.0, vy=0.02), _at(0.0, 1.2, vy=0.06), _at(-2.0, 0.0, vy=1.0), _at(0.0, -3.5)]
    velocity = reynolds(seen, 1.0, FAST)
    assert velocity == pytest.approx([-(2.0 - 1.25) - 3.0 * 0.7, 0.8 * 0.04])


def test_no_law_asks_for_more_than_the_base_can() -> None:
    for law in (springs, reynolds):
        velocity = law([_at(0.1, 0.1), _at(0.2, 0.1)], 1.0, 0.1)
        assert np.hypot(*velocity) == pytest.approx(0.1)


def test_mirror_images_and_the_long_unseen_are_no_neighbours() -> None:
    def track(number: int, **changes: object) -> Track:
        known = {"robot": "a", "time_s": 0.0, "track": number, "position_body_m": np.array([number, 2.0, 0.1]),
                 "velocity_body_m_per_s": np.zeros(3), "covariance": np.eye(6)}  # fmt: skip
        return Track(**{**known, **changes})  # type: ignore[arg-type]

    kept = neighbours_of(
        [track(1), track(2, ghost="yes"), track(3, unseen_s=2.5), track(4, ghost="possible")]
    )
    assert [one.place_m.tolist() for one in kept] == [[1.0, 2.0], [4.0, 2.0]]
