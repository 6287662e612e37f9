"""How many samples a pilot asks for: lights made by hand, counts by closed form.

A camera of 1280 × 960, 10 e read noise, without a filter; two sources of 0.2 W; a film of 2 × 2 sensor pixels.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import DirectTable, Indirect, Light, Scene, load_scene
from nir_render.camera.lens import aperture_area_m2
from nir_render.transport.noise import flare_pixels, samples_map, settled_exposure_s

FILM = (480, 640)
RADIANCE, EXPOSURE_S = 1e-2, 1e-3
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Scene:
    base = load_scene(Path(__file__).parents[3] / "scenes" / "one_source.yaml")
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
) -> NDArray[np.int64]:
    pilot = _light(variance, 16, directions)
    pixels = flare_pixels(pilot, scene.camera("r1.front")[1], FILM)
    of_flares = np.zeros((1, pixels.size)) if flares is None else np.broadcast_to(flares, (1, pixels.size))
    return samples_map(pilot, _light(of_flares, 64, directions), scene, share, FILM)


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
        (
            4.5,
            64,
        ),  # more than 4 times the frame's: 60; to bring the sum over 2 × 2 px to a quarter 54 would do
        (8.0, 128),  # that sum brought to a quarter of the variance: 2² · 8 · 15 / 5 = 96
        (1e4, 256),  # 16 times the frame's: 240
    ],
)
def test_a_noisy_patch_gets_its_own_need_within_bounds(scene: Scene, rise: float, count: int) -> None:
    """The frame's need is 15 in every pixel; a patch of the pilot is `rise` times noisier."""
    variance = _even_need(scene, 15.0)
    variance[50:70, 70:90] *= rise
    assert _counts(scene, variance, 0.05)[240, 320] == count


def _even_need(scene: Scene, need: float) -> Array:
    """The variance that asks for the same count everywhere: temporal variance and cos⁸ taken out."""
    x, y = (np.arange(160) * 8 - 635.5) / 480.0, (np.arange(120) * 8 - 475.5) / 480.0
    cos4 = (1.0 + x**2 + y[:, None] ** 2) ** -2
    signal_e = 0.4 * _per_radiance(scene) * RADIANCE
    even = (signal_e * cos4 + 100.0) / (signal_e + 100.0) / cos4**2
    return np.asarray(_variance_for(scene, need, 0.05) * even)


def test_an_aperture_gets_what_its_sum_needs(scene: Scene) -> None:
    """A flare whose middle is the corner of four sensor pixels that make one pixel of the film.

    Within 3 px of it lie 32 sensor pixels, in 3 × 3 pixels of the film: 4 in the middle, 4 in each of its
    neighbours, 3 in each at the corners. The sum's variance is (5 · 4² + 4 · 3²) = 116 times that of one sensor
    pixel, its temporal variance 32 T; at equal variance it needs 116/32 = 3.625 times what a pixel would.
    """
    need = 16.0
    quiet = np.full((120, 160), _variance_for(scene, need, 0.05) / 100.0)
    beside = np.array([[_variance_for(scene, need, 0.05) / 4.0]])  # of 64 samples
    towards = [-0.5 + 1.0 - 639.5 + 640.0, -0.5 + 1.0 - 479.5 + 480.0, 480.0]  # pixel (640.5, 480.5)
    direction = (np.array(towards) / np.linalg.norm(towards)).tolist()
    counts = _counts(scene, quiet, 0.05, beside, [direction])
    assert (counts[239:242, 319:322] == 64).all()  # 58 rounded up
    counts[239:242, 319:322] = 8
    assert (counts == 8).all()


def test_an_automatic_exposure_is_that_of_the_brightest_pixel(scene: Scene) -> None:
    """Target 0.7 of the range up to saturation, within the limits."""
    auto = {"target": 0.7, "shortest": "20 us", "longest": "2 ms"}
    camera = scene.with_({"robots.r1.rig.cameras.front.auto_exposure": auto}).camera("r1.front")[1]
    range_e = (4095.0 - 64.0) / 0.74  # this ADC clips before the well is full
    assert settled_exposure_s(camera, 1e7) == pytest.approx(0.7 * range_e / 1e7)
    assert settled_exposure_s(camera, 1e12) == pytest.approx(20e-6)
    assert settled_exposure_s(camera, 0.0) == pytest.approx(2e-3)
    fixed = scene.camera("r1.front")[1]
    assert settled_exposure_s(fixed, 1e6) == fixed.exposure_s
