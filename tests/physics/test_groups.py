"""Each light group, and their sum, against Mitsuba's own `path` and `volpath`.

Set up: six rooms (rooms.py) seen by a small camera without a filter, once through `render`, all groups apart,
once by Mitsuba's own integrators, all groups on and then one by one: as `stock_rooms.npz` keeps them, and one
room anew.

Why: whatever the integrator of light groups and the direct table between them lose, gain, count twice or give
to the wrong group shows here. Expected: whole frames, straight light and mirror images included, agree within
Monte Carlo noise on 16 × 16 tiles and over the frame (Welch's t, Holm's correction, the significance shared
by all comparisons of this file); one per cent more in one group's array is seen.

Frames are compared in the radiance of each group per watt, times cos⁴ of the field angle, blurred as the
camera blurs. With sources in view the straight light outshines all else and its noise, in Mitsuba's render,
with it; so the frames are compared once more without the surroundings of the sources' images.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import render
from nir_render.transport.backend.variant import backend
from tests.physics.rooms import ROOMS, groups, load_room, plain
from tests.physics.stock_rooms import (
    CAMERA,
    StockRoom,
    both_parts,
    render_room,
    stock_room,
    straight,
    weighted,
)
from tests.statistics import Comparison, Parts, compare_parts

pytestmark = pytest.mark.mitsuba

Array = NDArray[np.float64]

SEEDS = 24
EVERY_TIME = ("diffuse room", "glossy corridor")
COMPARISONS = 60  # of this file, rounded up: together they raise a false alarm once in a thousand
SAMPLES = {
    "diffuse room": 64, "glossy corridor": 32, "mirror room": 256, "occluders": 64, "thin fog": 128, "dense fog": 64,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Case:
    """One room through both programs.

    `ours` has shape (seeds, groups, rows, columns), `direct`, the straight part of it, (groups, rows, columns).
    """

    stock: StockRoom
    ours: Array
    direct: Array


def _marks(room: str) -> list[pytest.MarkDecorator]:
    """Thin fog takes as long as all other rooms, and has nothing that dense fog has not."""
    return [pytest.mark.verify, *([pytest.mark.at_length] if room == "thin fog" else [])]


@pytest.fixture(
    scope="module",
    params=[pytest.param(room, marks=_marks(room)) for room in ROOMS],
)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    if not backend().vectorised:
        pytest.skip("without LLVM light groups are rendered by Mitsuba's own path tracer")
    room = request.param
    scene = load_room(room, tmp_path_factory.mktemp("groups"), SAMPLES[room])
    lights = [render(scene, CAMERA, seed=seed) for seed in range(SEEDS)]
    assert list(lights[0].groups) == groups(plain(room))
    direct = straight(scene, lights[0])
    stock = stock_room(room)
    assert not (direct > 0.0)[:, stock.aside].any()
    indirect = [light.indirect.radiance_per_w[:, 0] for light in lights if light.indirect is not None]
    return Case(stock, weighted(np.stack(indirect).astype(np.float64)) + direct, direct)


def _compare(case: Case, ours: Array, stock: tuple[Parts, Parts]) -> list[Comparison]:
    """Compare whole frames, then what is away from the sources' images."""
    significance = 1e-3 / COMPARISONS
    mine = both_parts(ours, case.stock.aside)
    return [compare_parts(*sides, significance=significance) for sides in zip(mine, stock, strict=True)]


def test_the_sum_of_the_groups_is_mitsubas_frame(case: Case) -> None:
    whole, aside = _compare(case, case.ours.sum(axis=1), case.stock.together)
    assert whole.same, whole
    assert aside.same, aside
    # What the test could have seen.
    assert aside.frame_drift < 0.005, aside


def test_each_group_is_the_scene_with_that_group_alone(case: Case) -> None:
    results = [_compare(case, case.ours[:, group], stock) for group, stock in enumerate(case.stock.alone)]
    assert all(comparison.same for both in results for comparison in both), results


def test_one_per_cent_more_in_one_array_is_seen(case: Case) -> None:
    for group, stock in enumerate(case.stock.alone):
        faulty = 1.01 * case.ours[:, group] - 0.01 * case.direct[group]
        whole, aside = _compare(case, faulty, stock)
        assert not (whole.same and aside.same), (group, whole, aside)


@pytest.mark.verify
@pytest.mark.vectorised
@pytest.mark.parametrize(
    "room", [pytest.param(room, marks=() if room in EVERY_TIME else pytest.mark.at_length) for room in ROOMS]
)
def test_what_is_kept_of_mitsuba_is_what_it_renders(room: str) -> None:
    """Rooms anew, with another seed: the file is of these rooms."""
    kept, anew = stock_room(room), render_room(room, seed=2)
    pairs = zip((kept.together, *kept.alone), (anew.together, *anew.alone), strict=True)
    results = [
        compare_parts(*sides, significance=1e-3 / 10) for both in pairs for sides in zip(*both, strict=True)
    ]
    assert all(comparison.same for comparison in results), results
