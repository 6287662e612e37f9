"""Each light group, and their sum, against Mitsuba's own `path` and `volpath`.

Set up: six rooms (rooms.py) seen by a small camera without a filter, once through `render`, all groups apart,
once by Mitsuba's own integrators (stock.py), all groups on and then one by one.

Why: whatever the integrator of light groups and the direct table between them lose, gain, count twice or give
to the wrong group shows here. Expected: whole frames, straight light and mirror images included, agree within
Monte Carlo noise on 16 × 16 tiles and over the frame (Welch's t, Holm's correction, the significance shared
by all comparisons of this file); one per cent more in one group's array is seen.

Frames are compared in the radiance of each group per watt, times cos⁴ of the field angle, blurred as the
camera blurs. With sources in view the straight light outshines all else and its noise, in Mitsuba's render,
with it; so the frames are compared once more without the surroundings of the sources' images.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from nir_render import Light, Scene, expected_electrons, load_scene, render
from nir_render.transport.backend.variant import backend
from tests.physics.rooms import FOCAL_PX, HEIGHT_PX, ROOMS, SIGMA_PX, WIDTH_PX, groups, plain
from tests.physics.stock import stock_radiance
from tests.statistics import Comparison, compare_batches

pytestmark = pytest.mark.mitsuba

Array = NDArray[np.float64]

CAMERA = "r1.c"
EXPOSURE_S = 1e-3
COMPARISONS = 50  # of this file, rounded up: together they raise a false alarm once in a thousand


@dataclass(frozen=True)
class Sampling:
    """Samples per pixel of each batch and number of batches: Mitsuba's, then ours."""

    stock: int
    stock_batches: int
    ours: int
    seeds: int = 24


# So much that one per cent of any one group is nine standard errors or more of the frame's mean away from the images
# of sources, and seven in thin fog, which is dear. At this significance, so many tiles and so few batches it takes
# six to seven.
SAMPLING = {
    "diffuse room": Sampling(4, 32, 64),
    "glossy corridor": Sampling(8, 32, 32),
    "mirror room": Sampling(128, 32, 256),
    "occluders": Sampling(64, 48, 64),
    # Mitsuba meets the lamp in the fog by chance alone: its tiles are skewed, and 48 batches may hold none of the
    # bright ones (a tile 4.5 % darker than 144 others had it).
    "thin fog": Sampling(64, 96, 128),
    "dense fog": Sampling(32, 64, 64),
}


@dataclass(frozen=True, eq=False)
class Case:
    """One room through both programs; `aside` tells the pixels away from the images of sources.

    `stock_sum` has shape (batches, rows, columns), the others (batches, groups, rows, columns);
    `direct`, the straight part of `ours`, (groups, rows, columns).
    """

    stock_sum: Array
    stock_groups: Array
    ours: Array
    direct: Array
    aside: NDArray[np.bool_]


def _direct(scene: Scene, light: Light) -> Array:
    """Return the straight light of each group as the camera places it, in the unit of `_weighted`.

    Electrons of an even radiance give the scale; without a filter it is the same at every angle.
    """
    arrays = light.indirect
    assert arrays is not None
    frames = []
    for group in range(len(light.groups)):
        even, irradiance = np.zeros_like(arrays.radiance_per_w), light.direct.irradiance_per_w
        even[group] = 1.0
        mine = np.where((light.direct.group == group)[:, None], irradiance, 0.0)
        parts = [(np.zeros_like(irradiance), even), (mine, np.zeros_like(even))]
        scale, straight = (
            expected_electrons(
                replace(
                    light,
                    direct=replace(light.direct, irradiance_per_w=table),
                    indirect=replace(arrays, radiance_per_w=radiance),
                ),
                scene,
                EXPOSURE_S,
            )
            for table, radiance in parts
        )
        scale /= _weighted(np.ones(scale.shape))
        assert np.ptp(scale) < 1e-4 * scale.max()
        frames.append(straight / scale.mean())
    return np.stack(frames)


def _weighted(radiance: Array) -> Array:
    """Weight plain radiance, shape (..., rows, columns), with cos⁴ of the field angle and blur it."""
    x = (np.arange(WIDTH_PX) - 0.5 * (WIDTH_PX - 1)) / FOCAL_PX
    y = (np.arange(HEIGHT_PX) - 0.5 * (HEIGHT_PX - 1)) / FOCAL_PX
    weighted = radiance * (1.0 + x**2 + y[:, None] ** 2) ** -2
    sigma_px = (*(0.0 for _ in radiance.shape[:-2]), SIGMA_PX, SIGMA_PX)
    return np.asarray(gaussian_filter(weighted, sigma_px, mode="nearest", truncate=6.0))


def _stock(room: str, emitting: list[list[str]], batches: int) -> Array:
    samples = SAMPLING[room].stock
    variant = backend().variant
    return _weighted(stock_radiance(plain(room), emitting, samples=samples, batches=batches, variant=variant))


@pytest.fixture(
    scope="module",
    params=[pytest.param(room, marks=pytest.mark.verify) for room in ROOMS],
)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    if not backend().vectorised:
        pytest.skip("without LLVM light groups are rendered by Mitsuba's own path tracer")
    room, sampling = request.param, SAMPLING[request.param]
    path = tmp_path_factory.mktemp("groups") / "room.yaml"
    path.write_text(yaml.safe_dump(plain(room), sort_keys=False))
    scene = load_scene(path, {"render.indirect.samples": sampling.ours})
    names = groups(plain(room))
    lights = [render(scene, CAMERA, seed=seed) for seed in range(sampling.seeds)]
    assert list(lights[0].groups) == names
    whole = _stock(room, [names], sampling.stock_batches // 2)
    alone = _stock(room, [[name] for name in names], sampling.stock_batches)
    direct = _direct(scene, lights[0])
    indirect = [light.indirect.radiance_per_w[:, 0] for light in lights if light.indirect is not None]
    return Case(
        stock_sum=whole[0],
        stock_groups=alone.swapaxes(0, 1),
        ours=_weighted(np.stack(indirect).astype(np.float64)) + direct,
        direct=direct,
        aside=np.asarray(~(direct > 0.0).any(axis=0)),
    )


def _pooled(case: Case, frames: Array) -> Array:
    """Spread what is in the surroundings of each source's image evenly over them, (batches, rows, columns).

    Mitsuba's image of a source is sampled on pixels before it is blurred; only its sum is as exact as ours.
    """
    places, count = label(~case.aside)
    for number in range(1, count + 1):
        frames = np.where(places == number, frames[:, places == number].mean(axis=1)[:, None, None], frames)
    return frames


def _compare(case: Case, ours: Array, stock: Array) -> list[Comparison]:
    """Compare whole frames, then what is away from the sources' images."""
    significance = 1e-3 / COMPARISONS
    return [
        compare_batches(_pooled(case, ours), _pooled(case, stock), significance=significance),
        compare_batches(ours * case.aside, stock * case.aside, significance=significance),
    ]


def test_the_sum_of_the_groups_is_mitsubas_frame(case: Case) -> None:
    whole, aside = _compare(case, case.ours.sum(axis=1), case.stock_sum)
    assert whole.same, whole
    assert aside.same, aside
    # What the test could have seen.
    assert aside.frame_drift < 0.005, aside


def test_each_group_is_the_scene_with_that_group_alone(case: Case) -> None:
    results = [_compare(case, case.ours[:, g], case.stock_groups[:, g]) for g in range(case.ours.shape[1])]
    assert all(comparison.same for both in results for comparison in both), results


def test_one_per_cent_more_in_one_array_is_seen(case: Case) -> None:
    for group in range(case.ours.shape[1]):
        faulty = 1.01 * case.ours[:, group] - 0.01 * case.direct[group]
        whole, aside = _compare(case, faulty, case.stock_groups[:, group])
        assert not (whole.same and aside.same), (group, whole, aside)
