"""How many samples a pilot asks for: lights made by hand, counts by closed form.

A camera of 1280 × 960, 10 e read noise, without a filter; two sources of 0.2 W; a film of 2 × 2 sensor pixels.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import DirectTable, Indirect, Light, Scene, load_scene
from nir_render.camera.optics.lens import aperture_area_m2
from nir_render.light.enlarge import Enlargement, without_edges
from nir_render.light.light import Edges, Multiple
from nir_render.transport.indirect.sample_plan import (
    flare_blocks,
    flare_pixels,
    planned_exposure_s,
    samples_map,
)
from tests.paths import SCENES

FILM = (480, 640)
RADIANCE, EXPOSURE_S = 1e-2, 1e-3
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    base = load_scene(SCENES / "one_source.yaml")
    return base.with_(
        {"robots.r1.rig.cameras.front.filter": None, "robots.r1.rig.cameras.front.exposure": "1 ms"}
    )


def _table(directions: list[list[float]]) -> DirectTable:
    n = len(directions)
    return DirectTable(
        group=np.ones(n, dtype=np.int64), facet=np.full(n, -1), direction=np.array(directions).reshape(n, 3),
        distance_m=np.full(n, 5.0), angular_radius_rad=np.zeros(n), seen=np.ones((n, 64), dtype=bool),
        visible_fraction=np.ones(n), irradiance_per_w=np.full((n, 1), 1e-30), visibility_rays=64,
    )  # fmt: skip


def _light(variance: Array, samples: int, directions: list[list[float]] | None = None) -> Light:
    arrays = [
        np.stack([part, part])[:, None].astype(np.float32)
        for part in (np.full(variance.shape, RADIANCE), variance)
    ]
    indirect = Indirect(arrays[0], arrays[1], 8, samples)
    return Light("r1.front", 0.0, 1, ("r1.top", "r2.top"), (940e-9,), _table(directions or []), indirect)


def _counts(
    scene: Scene,
    variance: Array,
    share: float,
    flares: Array | None = None,
    directions: list[list[float]] | None = None,
    how: Enlargement | None = None,
) -> NDArray[np.int64]:
    return np.asarray(_plan(scene, variance, share, flares, directions, how)[0])


def _plan(
    scene: Scene,
    variance: Array,
    share: float,
    flares: Array | None = None,
    directions: list[list[float]] | None = None,
    how: Enlargement | None = None,
    averaged: float = 0.0,
    alone: slice = slice(0),
) -> NDArray[np.int64]:
    """The counts given and wanted; of `flares` the variance in each block, and in each pixel of the patch.

    `averaged` is the share of the variance that is averaged over blocks, but for the rows `alone` of the film.
    """
    pilot = _light(variance, 16, directions)
    if averaged:
        assert pilot.indirect is not None
        known = pilot.indirect.variance
        surface = np.zeros(FILM, dtype=np.int32)
        surface[alone] = -1
        multiple = Multiple(known, np.float32(averaged) * known, np.zeros_like(known), surface)
        pilot = replace(pilot, indirect=replace(pilot.indirect, multiple=multiple))
    how = how or without_edges(960, 1280)
    blocks = flare_blocks(pilot, scene.camera("r1.front")[1], 2, how)
    of_flares = np.zeros(1) if flares is None else flares
    light = _light(np.broadcast_to(of_flares, (1, blocks.size)), 64, directions)
    assert light.indirect is not None
    patch = np.broadcast_to(of_flares, (2, 1, how.patch.size)).astype(np.float32)
    indirect = replace(light.indirect, scale=2, edges=Edges(how, patch, patch))
    return samples_map(pilot, replace(light, indirect=indirect), scene.at(0.0), share, FILM)


def _per_radiance(scene: Scene) -> float:
    """Electrons of a pixel on the axis for 1 W/(m² sr): A_ap (pitch/f)² C t, C of 940 nm."""
    c = 0.9 * 0.15 * 940e-9 / (6.62607015e-34 * 299_792_458.0)
    return aperture_area_m2(scene.camera("r1.front")[1]) * (3.75e-6 / 1.8e-3) ** 2 * c * EXPOSURE_S


def _variance_for(scene: Scene, need: float, share: float) -> float:
    """The variance of the mean of 16 samples that asks for a count on the axis: 2 (0.2 k)² 16 v 1.1 = need · share · T."""
    k = _per_radiance(scene)
    temporal_e2 = 0.4 * k * RADIANCE + 100.0
    return need * share * temporal_e2 / (1.1 * 16.0 * 2.0 * (0.2 * k) ** 2)


@pytest.mark.parametrize(("need", "count"), [(60.0, 64), (66.0, 128), (3.0, 8), (1e6, 4096)])
def test_the_count_on_the_axis_is_the_next_power_of_two(scene: Scene, need: float, count: int) -> None:
    counts = _counts(scene, _even_need(scene, need), 0.05)
    assert counts.shape == FILM
    assert (counts[230:250, 310:330] == count).all()


def test_a_tighter_target_takes_proportionally_more(scene: Scene) -> None:
    variance = _even_need(scene, 60.0)
    few, more = (_counts(scene, variance, share)[240, 320] for share in (0.05, 0.0125))
    assert (few, more) == (64, 256)


def test_dim_corners_take_fewer(scene: Scene) -> None:
    """45° off, 480 px from the axis, radiance gives cos⁴ = a quarter: a sixteenth of the variance."""
    counts = _counts(scene, np.full((120, 160), _variance_for(scene, 1600.0, 0.05)), 0.05)
    k = _per_radiance(scene)
    ratio = (0.4 * k * RADIANCE + 100.0) / (0.1 * k * RADIANCE + 100.0) / 16.0
    assert counts[240, 560] == 2 ** int(np.ceil(np.log2(1600.0 * ratio)))


@pytest.mark.parametrize(
    ("rise", "count"),
    [
        (1.8, 32),  # its own need is 27
        # More than 4 times the frame's: 60; to bring the sum over 2 × 2 px to a quarter 54 would do.
        (4.5, 64),
        (8.0, 128),  # that sum brought to a quarter of the variance: 2² · 8 · 15 / 5 = 96
        (1e2, 2048),  # 1200
        (1e4, 4096),
    ],
)
def test_a_noisy_patch_gets_its_own_need_within_bounds(scene: Scene, rise: float, count: int) -> None:
    """The frame's need is 15 in every pixel; a patch of the pilot is `rise` times noisier.

    It is 8 × 8 of 120 × 160 places of the pilot, with the mean over 5 × 5 12 × 12: 0.75 % of the frame, which
    4096 in each bring to 3 times its samples.
    """
    variance = _even_need(scene, 15.0)
    variance[56:64, 76:84] *= rise
    given, wanted = _plan(scene, variance, 0.05)
    assert given[240, 320] == count
    need = 15.0 * max(rise, rise * 4 / 5)
    assert wanted[240, 320] == 2 ** np.ceil(np.log2(need))
    assert (given < wanted).any() == (rise > 4.0)
    assert given[10, 10] == wanted[10, 10] == 16


def test_where_light_of_many_turns_is_averaged_less_is_enough_but_not_where_blocks_stand_alone(
    scene: Scene,
) -> None:
    """Of a variance v that asks for 640 samples the part that is averaged is 0.9 v: of that a nineteenth is left.

    Its weights are those of a Gaussian of 1.4 blocks over 5 × 5. What stands alone has half of the frame here.
    """
    row = np.exp(-0.5 * (np.arange(-2, 3) / 1.4) ** 2)
    squares = float((row**2).sum() / row.sum() ** 2) ** 2
    variance = np.full((60, 80), _variance_for(scene, 640.0, 0.05))
    given = _plan(scene, variance, 0.05, averaged=0.9, alone=slice(FILM[0] // 2))[0]
    below, above = given[FILM[0] // 2 + 20, FILM[1] // 2], given[FILM[0] // 2 - 20, FILM[1] // 2]
    needed = 640.0 * (0.1 + 0.9 * squares)
    assert below == 2 ** np.ceil(np.log2(needed))
    assert above > 3 * below


def test_noise_everywhere_is_cut_to_the_budget(scene: Scene) -> None:
    """A tenth of the frame wants 3750 samples in each pixel, the rest 15.

    Without care for what looks like flares these are 60 and 15, 19.5 on average; the budget is 4 times that,
    78. With 512 in that tenth the mean is 65, with 1024 it is 116.
    """
    variance = _even_need(scene, 15.0)
    variance[:12] *= 250.0
    given, wanted = _plan(scene, variance, 0.05)
    assert given[10, 320] == 512
    assert wanted[10, 320] == 4096
    assert 0.1 * given.size < (given < wanted).sum() < 0.13 * given.size


def test_what_no_light_reaches_does_not_count(scene: Scene) -> None:
    """Light in a third of the frame, which needs 240 samples: it gets them, though the median pixel is dark."""
    variance = _even_need(scene, 240.0)
    variance[40:] = 0.0
    given = _counts(scene, variance, 0.05)
    assert given[60, 320] == 256
    assert given[400, 320] == 8


def _even_need(scene: Scene, need: float) -> Array:
    """The variance that asks for the same count everywhere: temporal variance and cos⁸ taken out."""
    x, y = (np.arange(160) * 8 - 635.5) / 480.0, (np.arange(120) * 8 - 475.5) / 480.0
    cos4 = (1.0 + x**2 + y[:, None] ** 2) ** -2
    signal_e = 0.4 * _per_radiance(scene) * RADIANCE
    even = (signal_e * cos4 + 100.0) / (signal_e + 100.0) / cos4**2
    return np.asarray(_variance_for(scene, need, 0.05) * even)


def _flare() -> list[float]:
    """A flare whose middle is the corner of four sensor pixels that make one pixel of the film: (640.5, 480.5)."""
    towards = [640.5 - 639.5, 480.5 - 479.5, 480.0]
    return list((np.array(towards) / np.linalg.norm(towards)).tolist())


def test_an_aperture_gets_what_its_sum_needs(scene: Scene) -> None:
    """Within 3 px lie 32 sensor pixels, in 3 × 3 pixels of the film, made of these and the 12 beside them.

    With c what each counts in the sum, by enlarging images of one block, counts of λ c bring Σ c² v / (λ c) to
    the share: λ = v Σ c / (share · 32 T); two standard errors on top: 1 + 2 √Σ c² / Σ c.
    """
    need = 64.0
    quiet = np.full((120, 160), _variance_for(scene, need, 0.05) / 1000.0)
    beside = np.array(_variance_for(scene, need, 0.05) / 4.0)  # of 64 samples
    counts = _counts(scene, quiet, 0.05, beside, [_flare()])
    single = np.eye(64).reshape(64, 8, 8)
    disc = np.hypot(*(np.mgrid[:16, :16] - 6.5)) <= 3.0  # (6.5, 6.5) is the middle of block (3, 3)
    assert disc.sum() == 32
    sums = np.array([cv2.resize(one, (16, 16), interpolation=cv2.INTER_LINEAR)[disc].sum() for one in single])
    assert (sums > 0).sum() == 9 + 12
    rate = need / 1.1 / 32 * (sums.sum() + 2.0 * np.sqrt((sums**2).sum()))
    wanted = 2 ** np.ceil(np.log2(np.maximum(rate * sums, 8.0))).reshape(8, 8)
    np.testing.assert_array_equal(counts[237:245, 317:325], wanted)
    assert wanted.max() >= 128
    counts[237:245, 317:325] = 8
    assert (counts == 8).all()


def test_pixels_rendered_one_by_one_count_in_the_sum(scene: Scene) -> None:
    """Where all 32 are, nothing of the blocks counts: 4 in the middle, 4 and 3 around it, in 3 × 3 blocks.

    A block counts by √4 or √3 what a pixel counts.
    """
    camera = scene.camera("r1.front")[1]
    need = 64.0
    pixels = np.sort(flare_pixels(_light(np.zeros((1, 1)), 1, [_flare()]), camera))
    assert pixels.size == 32
    how = replace(without_edges(960, 1280), patch=pixels.astype(np.int32))
    quiet = np.full((120, 160), _variance_for(scene, need, 0.05) / 1000.0)
    beside = np.array(_variance_for(scene, need, 0.05) / 4.0)
    counts = _counts(scene, quiet, 0.05, beside, [_flare()], how)
    size = np.sqrt(np.array([[3, 4, 3], [4, 4, 4], [3, 4, 3]]))
    rate = need / 1.1 / 32 * (size.sum() + 2.0 * np.sqrt((size**2).sum()))
    np.testing.assert_array_equal(counts[239:242, 319:322], 2 ** np.ceil(np.log2(rate * size)))
    counts[239:242, 319:322] = 8
    assert (counts == 8).all()


def test_an_automatic_exposure_is_that_of_the_brightest_pixel(scene: Scene) -> None:
    """Target 0.7 of the range up to saturation, within the limits; of a bracket the longest."""
    auto = {"target": 0.7, "shortest": "20 us", "longest": "2 ms"}
    front = "robots.r1.rig.cameras.front"
    # This ADC clips before the well is full.
    sensor = {"preset": "mt9m031", "full_well": "6000 e", "system_gain": "0.74 DN/e"}
    scene = scene.with_({f"{front}.sensor": sensor})
    camera = scene.with_({f"{front}.auto_exposure": auto}).camera("r1.front")[1]
    range_e = (4095.0 - 64.0) / 0.74
    assert planned_exposure_s(camera, 1e7) == pytest.approx(0.7 * range_e / 1e7)
    assert planned_exposure_s(camera, 1e12) == pytest.approx(20e-6)
    assert planned_exposure_s(camera, 0.0) == pytest.approx(2e-3)
    fixed = scene.camera("r1.front")[1]
    assert planned_exposure_s(fixed, 1e6) == fixed.exposure_s
    bracket = scene.with_({f"{front}.bracket": ["50 us", "0.8 ms", "0.2 ms"]}).camera("r1.front")[1]
    assert planned_exposure_s(bracket, 1e6) == pytest.approx(8e-4)


def test_a_plan_is_for_sources_that_are_fully_lit(scene: Scene) -> None:
    """One of two sources is dark at the light's time, and for good: the counts are those of both lit."""
    blinking = {"bits": {"pattern": "0", "rate": "1 Hz", "start": "-0.5 s", "repeat": "forever"}}
    dark = scene.with_({"robots.r2.rig.sources.top.drive": blinking})
    lit, unlit = (_counts(one, _even_need(scene, 60.0), 0.05) for one in (scene, dark))
    np.testing.assert_array_equal(unlit, lit)
    assert lit.max() == 64
