"""Light to electrons with lights made by hand: what a known radiance, and a known variance of it, become."""

import dataclasses

import cv2
import numpy as np
import pytest

from nir_render import InputError, Scene, load_scene
from nir_render.camera.beams import blur
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.optics.lens import aperture_area_m2
from nir_render.camera.render_noise import (
    RenderNoise,
    render_noise,
    render_variance_e2,
    share_of_target,
    temporal_variance_e2,
)
from nir_render.light.light import NO_SOURCES, DirectTable, Indirect, Light
from nir_render.run.manifest import (
    group_noise_facts,
    group_noise_warning,
    noise_facts,
    noise_warning,
    truncation_warning,
)
from nir_render.simulation.clock import expected_electrons
from tests.paths import SCENES


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Without a filter and with a flat efficiency, C is 0.9 · 0.15 photons per joule of 940 nm."""
    base = load_scene(SCENES / "one_source.yaml")
    return base.with_({"robots.r1.rig.cameras.front.filter": None})


def _light(radiance: float, variance: float, scale: int = 2) -> Light:
    shape = (2, 1, 960 // scale, 1280 // scale)
    none = DirectTable(
        group=np.empty(0, dtype=np.int64), facet=np.empty(0, dtype=np.int64), seen=np.empty((0, 1024), dtype=bool), direction=np.empty((0, 3)), distance_m=np.empty(0),
        angular_radius_rad=np.empty(0), visible_fraction=np.empty(0), irradiance_per_w=np.empty((0, 1)),
        visibility_rays=1024,
    )  # fmt: skip
    arrays = [np.full(shape, value, dtype=np.float32) for value in (radiance, variance)]
    return Light(
        "r1.front", 0.0, 1, ("r1.top", "r2.top"), (940e-9,), none, Indirect(arrays[0], arrays[1], scale, 16)
    )


def _electrons_on_axis(radiance_w: float, exposure_s: float) -> float:
    """L · A_ap · (pitch/f)² · C · t."""
    electrons_per_j = 0.9 * 0.15 * 940e-9 / (6.62607015e-34 * 299_792_458.0)
    aperture_m2 = np.pi * 0.9e-3**2 / 4.0
    return float(radiance_w * aperture_m2 * (3.75e-6 / 1.8e-3) ** 2 * electrons_per_j * exposure_s)


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_an_even_radiance_falls_with_the_fourth_power_of_the_cosine(scene: Scene, scale: int) -> None:
    """Two groups of 0.2 W at 1e-2 per watt: on axis the closed form, 45° off (480 px) a quarter of it."""
    image_e = expected_electrons(_light(1e-2, 0.0, scale), scene, 1e-3)
    on_axis_e = _electrons_on_axis(2 * 0.2 * 1e-2, 1e-3)
    assert image_e[479:481, 639:641].mean() == pytest.approx(on_axis_e, rel=2e-4)
    assert image_e[479:481, 1119:1121].mean() == pytest.approx(on_axis_e / 4.0, rel=1e-3)
    assert aperture_area_m2(scene.camera("r1.front")[1]) == pytest.approx(np.pi * 0.9e-3**2 / 4.0)


def test_each_group_has_its_own_flux(scene: Scene) -> None:
    dim = scene.with_({"robots.r2.rig.sources.top.flux": "0.05 W"})
    mean = mean_frame(_light(1e-2, 0.0), dim.at(0.0), 1e-3)
    parts = [1e-3 * mean.rates.group_image(group)[480, 640] for group in (0, 1)]
    assert parts[0] / parts[1] == pytest.approx(4.0, rel=1e-6)
    assert sum(parts) == pytest.approx(mean.electrons[480, 640], rel=1e-6)


def test_the_share_of_render_noise_in_the_frame(scene: Scene) -> None:
    """Two groups whose radiances have σ = 1e-3 per watt: variance 2 (0.2 k σ)², over signal + read noise.

    The median pixel is where cos⁴ θ has its median; there both signal and σ are that much smaller. Where no
    light is, nothing is counted.
    """
    light = _light(1e-2, 1e-6, 1)
    noise = render_noise(mean_frame(light, scene.at(0.0), 1e-3))
    share = noise.median_share
    assert noise.reached == 1.0
    assert share < noise.share_of_99_percent < noise.largest_share
    columns, rows = (np.arange(1280) - 639.5) / 480.0, (np.arange(960) - 479.5) / 480.0
    cos4 = (1.0 + columns**2 + rows[:, None] ** 2) ** -2
    signal_e = _electrons_on_axis(0.4 * 1e-2, 1e-3) * cos4
    noise_e2 = 2.0 * (_electrons_on_axis(0.2 * 1e-3, 1e-3) * cos4) ** 2
    assert share == pytest.approx(float(np.median(noise_e2 / (signal_e + 100.0))), rel=0.005)
    assert noise.mean_share == pytest.approx(noise_e2.sum() / (signal_e + 100.0).sum(), rel=0.005)
    # A blur of σ = 0.7 px leaves the sum of its squared weights of a pixel's variance, away from the rim.
    point = np.zeros((25, 25))
    point[12, 12] = 1.0
    left = (blur(scene.camera("r1.front")[1], point) ** 2).sum()
    assert noise.share_behind_lens == pytest.approx(left * noise.mean_share, rel=0.02)
    light = _light(1e-2, 1e-6, 1)
    assert light.indirect is not None
    arrays = [light.indirect.radiance_per_w.copy(), light.indirect.variance.copy()]
    for array in arrays:
        array[..., 320:, :] = 0.0
    light = dataclasses.replace(light, indirect=Indirect(arrays[0], arrays[1], 1, 16))
    noise = render_noise(mean_frame(light, scene.at(0.0), 1e-3))
    assert noise.reached == pytest.approx(1.0 / 3.0)
    upper = (noise_e2 / (signal_e + 100.0))[:320]
    assert noise.median_share == pytest.approx(float(np.median(upper)), rel=0.005)
    told = share_of_target(mean_frame(light, scene.at(0.0), 1e-3))
    assert told == pytest.approx(float(np.median(upper[3::7])), rel=0.005)
    # Light in few rows, none of which is one of those: all are looked at.
    variance = np.zeros_like(arrays[1])
    variance[..., 326:328, :] = 1e-6
    few = dataclasses.replace(light, indirect=Indirect(arrays[0], variance, 1, 16))
    mean = mean_frame(few, scene.at(0.0), 1e-3)
    assert share_of_target(mean) == render_noise(mean).median_share > 0.0
    none = mean_frame(_light(0.0, 0.0), scene.at(0.0), 1e-3)
    assert (render_noise(none), share_of_target(none)) == (RenderNoise(), 0.0)


def test_a_target_is_kept_by_frame_and_flares() -> None:
    noises = [RenderNoise(median_share=0.04, largest_share=3.0), RenderNoise(0.01, aperture_share=0.06)]
    assert [noise.keeps(0.05) for noise in noises] == [True, False]
    by_frame = {"r1.front 0": noises[0], "r1.front 1": noises[1]}
    facts = noise_facts(0.05, by_frame)
    assert (facts["target_reached"], facts["frames_above_target"]) == (False, ["r1.front 1"])
    assert (facts["largest_share_in_a_pixel"], facts["largest_share_in_apertures"]) == (3.0, 0.06)
    warning = noise_warning(facts, 2)
    assert warning is not None
    assert "0.05 of temporal variance is not kept in 1 of 2 frames" in warning
    reached = noise_facts(0.05, {"r1.front 0": noises[0]})
    assert reached["target_reached"] is True
    assert noise_warning(reached, 1) is None
    without = noise_facts(None, by_frame)
    assert without["target_reached"] is None
    assert noise_warning(without, 2) is None


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_the_share_of_render_noise_in_a_flare(scene: Scene, scale: int) -> None:
    """A flare on the axis: the sum over its 32 pixels, each made of the four blocks around it."""
    light = _light(1e-2, 1e-6, scale)
    table = dataclasses.replace(
        light.direct, group=np.array([1]), facet=np.array([-1]), seen=np.ones((1, 1024), dtype=bool), direction=np.array([[0.0, 0.0, 1.0]]),
        distance_m=np.array([5.0]), angular_radius_rad=np.zeros(1), visible_fraction=np.ones(1), irradiance_per_w=np.array([[1e-3]]),
    )  # fmt: skip
    mean = mean_frame(dataclasses.replace(light, direct=table), scene.at(0.0), 1e-3)
    flare_e = mean.windows[0].values.sum()
    assert flare_e > 1000.0
    # Within 3 px of the middle, 2.1 px being 3 σ, lies all of it but exp(−9/2/0.7²).
    temporal_e2 = flare_e * (1.0 - np.exp(-0.5 * 9.0 / 0.49)) + 32 * (
        _electrons_on_axis(0.4 * 1e-2, 1e-3) + 100.0
    )
    disc = np.hypot(*(np.mgrid[:32, :32] - 15.5)) <= 3.0
    assert disc.sum() == 32
    single = np.eye((32 // scale) ** 2).reshape(-1, 32 // scale, 32 // scale)
    counts = [cv2.resize(block, (32, 32), interpolation=cv2.INTER_LINEAR)[disc].sum() for block in single]
    noise_e2 = np.square(counts).sum() * 2.0 * _electrons_on_axis(0.2 * 1e-3, 1e-3) ** 2
    noise = render_noise(mean)
    assert noise.aperture_share == pytest.approx(noise_e2 / temporal_e2, rel=0.005)
    # What a target bounds is the larger one, the median that of each seventh row.
    some = np.s_[3::7]
    of_rows_e2 = render_variance_e2(mean.light, scene.at(0.0), 1e-3)[some] / temporal_variance_e2(mean)[some]
    larger = max(noise.aperture_share, float(np.median(of_rows_e2)))
    assert share_of_target(mean) == pytest.approx(larger, rel=1e-6)
    assert np.median(of_rows_e2) == pytest.approx(noise.median_share, rel=0.005)
    bare = mean_frame(light, scene.at(0.0), 1e-3)
    assert render_noise(bare).aperture_share == 0.0
    of_rows_e2 = render_variance_e2(light, scene.at(0.0), 1e-3)[some] / temporal_variance_e2(bare)[some]
    assert share_of_target(bare) == pytest.approx(float(np.median(of_rows_e2)), rel=1e-6)


def test_the_share_of_some_rows_goes_with_what_these_rows_see(scene: Scene) -> None:
    """A source blinks behind a rolling shutter, the other does not: each row has levels of its own."""
    rolling = scene.with_(
        {
            "robots.r1.rig.cameras.front.shutter": {"type": "rolling", "line_time": "50 us"},
            "robots.r2.rig.sources.top.drive": {"square": {"frequency": "40 Hz", "duty": 0.5}},
        }
    )
    world = rolling.at(0.0)
    mean = mean_frame(_light(1e-2, 1e-6), world, 1e-3, 0.0)
    assert len(mean.profiles) == 2
    assert np.ptp(mean.profiles[1]) == 1.0
    noise_e2 = sum(
        render_variance_e2(mean.light, world, 1e-3, np.eye(2)[group]) * mean.profiles[drive][:, None] ** 2
        for group, drive in enumerate(mean.rates.drive)
    )
    share = (noise_e2 / temporal_variance_e2(mean))[3::7]
    assert share_of_target(mean) == pytest.approx(float(np.median(share)), rel=1e-6)


@pytest.mark.parametrize("exposure_s", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_exposures_are_refused(scene: Scene, exposure_s: float) -> None:
    with pytest.raises(InputError, match="wanted seconds greater than 0"):
        expected_electrons(_light(1e-2, 0.0), scene, exposure_s)


def test_exposing_changes_nothing_of_the_light(scene: Scene) -> None:
    light = _light(1e-2, 1e-6)
    assert light.indirect is not None
    before = light.indirect.radiance_per_w.copy()
    expected_electrons(light, scene, 1e-3)
    expected_electrons(dataclasses.replace(light, time_s=3.0), scene, 2e-3)
    np.testing.assert_array_equal(light.indirect.radiance_per_w, before)


def test_how_well_each_group_is_known() -> None:
    """100 pixels of 2 ± 0.2: 1 % of the sum, by 100 pixels alike; one of them alone brings 99.0 % of the second's."""
    variance = np.full((2, 1, 10, 10), 0.04, dtype=np.float32)
    variance[1, 0, 3, 4] = 400.0
    radiance = np.full((3, 1, 10, 10), 2.0, dtype=np.float32)
    radiance[2] = 0.0
    indirect = Indirect(radiance, np.concatenate([variance, 0.0 * variance[:1]]), 1, 16)
    light = Light("c", 0.0, 1, ("a", "b", "dark"), (940e-9,), NO_SOURCES, indirect)
    facts = group_noise_facts(light)
    assert facts["a"] == {"error": pytest.approx(2.0 / 200.0), "uncertainty": pytest.approx(0.1)}
    assert facts["b"]["error"] == pytest.approx((403.96**0.5) / 200.0, abs=1e-6)
    assert facts["b"]["uncertainty"] == pytest.approx(400.0 / 403.96, rel=1e-3)
    assert facts["dark"] == {"error": None, "uncertainty": None}
    assert group_noise_warning({"r.c": {name: facts[name] for name in ("a", "dark")}}) is None
    told = group_noise_warning({"r.c": facts})
    assert told is not None
    assert "b in r.c hangs" in told


def test_what_is_left_out_is_told_above_half_a_percent() -> None:
    facts = {"max_depth": 8, "share": 0.0049, "standard_error": 0.0004}
    nothing = {"max_depth": None, "share": None, "reason": "no indirect light"}
    assert truncation_warning({}) is None
    assert truncation_warning({"r.c": facts, "r.d": nothing}) is None
    told = truncation_warning({"r.c": facts, "r.d": facts | {"share": 0.034}})
    assert told is not None
    assert "more than 8 stretches would bring 3.4 ± 0.04 % of the indirect light of r.d" in told
