"""Frames of sources that blink, made from lights by hand: levels, stripes, parasitic light, truth, noise."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render import InputError, Scene, expected_electrons, expose, load_scene
from nir_render.camera import mean_frame as mean_frame_module
from nir_render.camera.beams import blur
from nir_render.camera.by_spectrum import group_fluxes
from nir_render.camera.diffuse_images import diffuse_image
from nir_render.camera.mean_frame import (
    Rates,
    electron_rates,
    exposed_frame,
    fully_lit_frame,
    mean_frame,
)
from nir_render.camera.render_noise import render_noise, render_variance_e2, temporal_variance_e2
from nir_render.light.light import DirectTable, Indirect, Light
from nir_render.simulation.truth import truth_of
from nir_render.truth.sources import SourceTruth
from perception import RawFrame, detect
from tests.paths import SCENES

ROWS, COLUMNS = 48, 64
CAMERA = "robots.r1.rig.cameras.front"
OWN, OTHER = "robots.r1.rig.sources.top.drive", "robots.r2.rig.sources.top.drive"
BITS = {"bits": {"pattern": "0101101111", "rate": "10 Hz"}}
SQUARE = {"square": {"frequency": "250 Hz", "duty": 0.5}}
ROLLING = {"type": "rolling", "line_time": "100 us"}


@pytest.fixture(scope="module")
def base() -> Scene:
    small = {"columns": COLUMNS, "rows": ROWS, "pixel_pitch": "75 um"}
    scene = load_scene(SCENES / "one_source.yaml")
    return scene.with_(
        {
            f"{CAMERA}.sensor": {"preset": "mt9m031", **small},
            f"{CAMERA}.filter": None,
            "render.indirect.samples": 16,
            "robots.r2.motion": [],  # it rests: a flare is drawn in one place
        }
    )


def _with(base: Scene, changes: Mapping[str, Any]) -> Scene:
    return base.with_(changes) if changes else base


def _light(both: tuple[float, float] = (1.0, 0.3), irradiance: float = 1e-6) -> Light:
    """Indirect light that differs by group and pixel; `r2.top` straight ahead, 2.6 px above the middle."""
    random = np.random.default_rng(7)
    radiance = random.uniform(0.5, 1.5, (2, 1, ROWS // 2, COLUMNS // 2)) * 1e-4
    radiance *= np.array(both)[:, None, None, None]
    direction = np.array([[0.02, -2.6 * 75e-6 / 1.8e-3, 1.0]])
    table = DirectTable(
        group=np.array([1]),
        facet=np.array([-1]),
        direction=direction / np.linalg.norm(direction),
        distance_m=np.array([5.0]),
        angular_radius_rad=np.array([0.002]),
        seen=np.ones((1, 1024), dtype=bool),
        visible_fraction=np.ones(1),
        irradiance_per_w=np.array([[irradiance]]),
        visibility_rays=1024,
    )
    mean, variance = (array.astype(np.float32) for array in (radiance, (0.01 * radiance) ** 2))
    indirect = Indirect(mean, variance, 2, 16)
    return Light("r1.front", 10.0, 1, ("r1.top", "r2.top"), (940e-9,), table, indirect)


def _of_group(light: Light, scene: Scene, group: int) -> np.ndarray:
    """Electrons per second of one group alone, by the steps themselves: response, blur, and its window."""
    camera = scene.camera("r1.front")[1]
    only = np.zeros(2)
    only[group] = group_fluxes(light, scene.at(0.0))[group]
    assert light.indirect is not None
    image = blur(camera, diffuse_image(light, light.indirect, scene.at(0.0), only))
    if group == 1:
        electron_rates(light, scene.at(0.0)).windows[0].add_into(image)
    return np.asarray(image)


def test_a_frame_is_the_weighted_sum_of_its_groups(base: Scene) -> None:
    """Bits 0.3 of the exposure lit, a square wave 0.45 of it, over a global shutter: to 1e-6."""
    scene = _with(base, {OWN: SQUARE, OTHER: BITS})
    light = _light()
    # From 0.27 s to 0.37 s: bit 2, a 0, to 0.3 s; then 1 … and 25 periods of the square wave.
    mean = mean_frame(light, scene.at(0.0), 0.1, 0.27)
    wanted = 0.1 * (0.5 * _of_group(light, scene, 0) + 0.7 * _of_group(light, scene, 1))
    np.testing.assert_allclose(mean.electrons, wanted, rtol=1e-6)
    np.testing.assert_allclose(mean.levels, [0.5, 0.7], rtol=1e-12)
    assert mean.windows[0].total == pytest.approx(0.07 * mean.rates.windows[0].total, rel=1e-12)


@pytest.mark.parametrize(
    "changes",
    [{}, {OWN: 0.25}, {OWN: 0.0, OTHER: 0.5}, {OWN: SQUARE}, {OWN: BITS, OTHER: BITS}],
)
def test_emitters_of_one_drive_share_an_image(base: Scene, changes: dict[str, Any]) -> None:
    """What is constant is one image, whatever its level; equal drives are one."""
    scene, light = _with(base, changes), _light()
    of_light = electron_rates(light, scene.at(0.0))
    assert len(of_light.drives) == (2 if changes == {OWN: SQUARE} else 1)
    assert of_light.images is not None
    assert of_light.images.shape == (len(of_light.drives), ROWS, COLUMNS)
    levels = [changes.get(one, 1.0) for one in (OWN, OTHER)]
    constant = [level if isinstance(level, float) else 1.0 for level in levels]
    wanted = sum(level * _of_group(light, base, group) for group, level in enumerate(constant))
    np.testing.assert_allclose(fully_lit_frame(of_light, 2.0).electrons, 2.0 * wanted, rtol=1e-6)


def test_electrons_are_linear_in_the_exposure(base: Scene) -> None:
    of_light = electron_rates(_light(), base.at(0.0))
    short, long = exposed_frame(of_light, 1e-4), exposed_frame(of_light, 7e-2)
    np.testing.assert_allclose(long.electrons, 700.0 * short.electrons, rtol=1e-6)
    np.testing.assert_allclose(short.electrons, fully_lit_frame(of_light, 1e-4).electrons, rtol=0.0)
    np.testing.assert_array_equal(expected_electrons(_light(), base, 1e-4), short.electrons)
    assert short.time_s == 10.0 - 0.5e-4


@pytest.mark.parametrize("shutter", [ROLLING, {"type": "global"}])
def test_stripes_of_a_square_wave(base: Scene, shutter: dict[str, Any]) -> None:
    """250 Hz, half on; rows 100 µs apart, exposures of 1 ms: 40 rows per period.

    Behind the rolling shutter row r has the level of a trapezoid: 1 to row 10, 0 from 20 to 30, 1 at 40. A
    global one has 0.5 all over, from 1.5 ms on. The flare's rows too.
    """
    scene = _with(base, {OWN: SQUARE, OTHER: SQUARE, f"{CAMERA}.shutter": shutter})
    light = _light()
    rolls = shutter is ROLLING
    mean = mean_frame(light, scene.at(0.0), 1e-3, 0.0 if rolls else 1.5e-3)
    level = np.interp(np.arange(ROWS) % 40, [0, 10, 20, 30, 40], [1.0, 1.0, 0.0, 0.0, 1.0])
    level = level if rolls else np.full(ROWS, 0.5)
    full = 1e-3 * (_of_group(light, scene, 0) + _of_group(light, scene, 1))
    np.testing.assert_allclose(mean.electrons, level[:, None] * full, rtol=1e-6, atol=1e-9 * full.max())
    window, of_rates = mean.windows[0], mean.rates.windows[0]
    rows = slice(window.row, window.row + len(window.values))
    np.testing.assert_allclose(window.values, 1e-3 * level[rows, None] * of_rates.values, atol=1e-12)
    assert window.total == pytest.approx(float(window.values.sum()), rel=1e-9)


def test_glare_is_cut_into_stripes_with_the_rest(base: Scene) -> None:
    """One source blinks, one shines, and a third of the light is glare: each row is the two groups' own sum.

    Rows see what falls on them while they expose, wherever it comes from.
    """
    glare = {"share": "30 %", "core_radius": "6 px", "exponent": 1.5}
    still = _with(base, {f"{CAMERA}.point_spread.glare": glare, f"{CAMERA}.shutter": ROLLING})
    light = _light(irradiance=1e-5)
    alone = [expected_electrons(light, _with(still, {dark: 0.0}), 1e-3) for dark in (OTHER, OWN)]
    driven = mean_frame(light, _with(still, {OTHER: SQUARE}).at(0.0), 1e-3, 0.0).electrons
    level = np.interp(np.arange(ROWS) % 40, [0, 10, 20, 30, 40], [1.0, 1.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(driven, alone[0] + level[:, None] * alone[1], rtol=2e-6)
    assert (alone[1] > 0.0).all()


def test_parasitic_light_brightens_the_rows_that_are_read_last(base: Scene) -> None:
    """PLS 1 %, 100 µs per row, 1 ms: row r has 1 + 0.001 r of an even light; 4.7 % at the bottom."""
    leaky = {"type": "global", "line_time": "100 us", "parasitic_light_sensitivity": "1 %"}
    light = _light()
    ratio = expected_electrons(light, _with(base, {f"{CAMERA}.shutter": leaky}), 1e-3)
    ratio /= expected_electrons(light, base, 1e-3)
    np.testing.assert_allclose(ratio, np.tile(1.0 + 1e-3 * np.arange(ROWS)[:, None], COLUMNS), rtol=1e-6)


def test_the_windows_part_beyond_the_frame_counts_as_its_centre_does(base: Scene) -> None:
    """A source 0.4 px above the upper edge: most of its light is beyond; bits leave 0.3 of all."""
    light = _light()
    direction = np.array([[0.0, -24.4 * 75e-6 / 1.8e-3, 1.0]])
    table = dataclasses.replace(light.direct, direction=direction / np.linalg.norm(direction))
    light = dataclasses.replace(light, direct=table)
    mean = mean_frame(light, _with(base, {OTHER: BITS}).at(0.0), 0.1, 0.03)
    full = mean.rates.windows[0]
    assert 0.1 < full.values.sum() / full.total < 0.6
    assert mean.windows[0].total == pytest.approx(0.1 * 0.3 * full.total, rel=1e-9)


def _truth(scene: Scene, light: Light, exposure_s: float, time_s: float) -> SourceTruth:
    mean = mean_frame(light, scene.at(0.0), exposure_s, time_s)
    (row,) = truth_of(mean, expose(light, scene, exposure_s, time_s=time_s))
    return row


def test_truth_speaks_of_the_frame_as_driven(base: Scene) -> None:
    """Bits over 30 ms from 0.08 s on: 2/3 in the last 20 ms of bit 0, dark; 1/3 lit. All its light is a third."""
    light = _light()
    lit = _truth(base, light, 0.03, 0.0)
    third = _truth(_with(base, {OTHER: BITS}), light, 0.03, 0.08)
    assert lit.on_fraction == 1.0
    assert third.on_fraction == pytest.approx(1.0 / 3.0, rel=1e-9)
    assert third.direct_e == pytest.approx(lit.direct_e / 3.0, rel=1e-9)
    assert third.scattered_e == pytest.approx(lit.scattered_e / 3.0, rel=1e-6)
    full = electron_rates(light, base.at(0.0)).windows[0]
    place = np.s_[full.row : full.row + len(full.values), full.column : full.column + full.values.shape[1]]
    indirect = _of_group(light, base, 1)[place] - full.values
    scattered_e = 0.03 * indirect[full.values > 0.01 * full.values.max()].sum()
    assert lit.scattered_e == pytest.approx(scattered_e, rel=1e-6)
    assert scattered_e > 10.0
    dark = _truth(_with(base, {OTHER: BITS}), light, 0.03, 0.01)
    assert (dark.on_fraction, dark.direct_e, dark.scattered_e, dark.peak_snr) == (0.0, 0.0, 0.0, 0.0)
    # In a dark frame the rest of the light is still there; it is asked for only where a flare is.
    assert dark.background_e == 0.0


def test_on_fraction_is_that_of_the_centres_row(base: Scene) -> None:
    """Rows 100 µs apart, 1 ms; the flare's centre, v = 20.9, is in row 21: 2.1 ms to 3.1 ms of the square wave."""
    scene = _with(base, {OTHER: SQUARE, f"{CAMERA}.shutter": ROLLING})
    row = _truth(scene, _light(), 1e-3, -1.2e-3)
    # From −1.2 ms + 2.1 ms = 0.9 ms to 1.9 ms: all lit; half a millisecond later 0.6 of it.
    assert row.v_px == pytest.approx(20.9, abs=0.01)
    assert row.on_fraction == pytest.approx(1.0)
    assert _truth(scene, _light(), 1e-3, -0.7e-3).on_fraction == pytest.approx(0.6, rel=1e-9)


def test_render_noise_is_that_of_the_frame_as_driven(base: Scene) -> None:
    """Variances go with the squares of the levels: 0.5 and 0.7 of both groups."""
    scene, light = _with(base, {OWN: SQUARE, OTHER: BITS}), _light(irradiance=0.0)
    mean = mean_frame(light, scene.at(0.0), 0.1, 0.27)
    of_both = [render_variance_e2(light, scene.at(0.0), 0.1, np.eye(2)[group]) for group in (0, 1)]
    noise_e2 = 0.5**2 * of_both[0] + 0.7**2 * of_both[1]
    np.testing.assert_allclose(
        render_variance_e2(light, scene.at(0.0), 0.1, mean.levels), noise_e2, rtol=1e-9
    )
    sensor_e2 = temporal_variance_e2(mean)
    assert render_noise(mean).mean_share == pytest.approx(noise_e2.sum() / sensor_e2.sum(), rel=1e-6)
    dark = _with(base, {OWN: 0.0, OTHER: BITS})
    assert render_noise(mean_frame(light, dark.at(0.0), 0.05, 0.02)).reached == 0.0


def test_render_noise_behind_a_rolling_shutter_goes_with_the_squares_of_rows(base: Scene) -> None:
    """A square wave that few rows see: the variance of a row goes with its level's square, whose mean over the
    rows is three times and more the square of the mean level.
    """
    flashes = {"square": {"frequency": "250 Hz", "duty": 0.1}}
    scene = _with(base, {OWN: flashes, OTHER: flashes, f"{CAMERA}.shutter": ROLLING})
    light = _light(irradiance=0.0)
    mean = mean_frame(light, scene.at(0.0), 1e-4, 0.0)
    (levels,) = mean.profiles
    assert (levels**2).mean() > 3.0 * levels.mean() ** 2
    noise_e2 = render_variance_e2(light, scene.at(0.0), 1e-4) * levels[:, None] ** 2
    sensor_e2 = temporal_variance_e2(mean)
    noise = render_noise(mean)
    lit = noise_e2 > 0.0
    assert noise.mean_share == pytest.approx(noise_e2[lit].sum() / sensor_e2[lit].sum(), rel=1e-6)
    assert noise.largest_share == pytest.approx((noise_e2 / sensor_e2).max(), rel=1e-6)


def test_thirty_exposures_of_one_light_show_the_bits(base: Scene) -> None:
    """0101101111 at 10 Hz from 0.012 s on, 30 frames per second of 20 ms each, counted in raw frames.

    The flare's counts above black, over those when lit, are the mean of the bits over the exposure: edges at
    whole tenths + 0.012 s fall inside some. A disc of 3.6 px radius: noise is below 0.6 % of it lit, the
    pixels' unlike responses below 0.3 %.
    """
    bits = {"pattern": "0101101111", "rate": "10 Hz", "start": "12 ms"}
    scene = _with(base, {OTHER: {"bits": bits}})
    light = _light(irradiance=7.5e-5)
    table = dataclasses.replace(light.direct, angular_radius_rad=np.array([0.15]))
    light = dataclasses.replace(light, direct=table, indirect=None)
    camera = scene.camera("r1.front")[1]
    edges = np.array([0.012 + 0.1 * number for number in range(11)])
    levels = np.array([0, 1, 0, 1, 1, 0, 1, 1, 1, 1])
    full = mean_frame(light, base.at(0.0), 0.02)
    assert 2000.0 < full.electrons.max() < 4000.0
    window = full.windows[0]
    place = np.s_[
        window.row : window.row + window.values.shape[0],
        window.column : window.column + window.values.shape[1],
    ]
    lit_dn = float(full.electrons[place].sum()) * camera.sensor.system_gain_dn_per_e
    between = 0
    for index in range(30):
        start_s = index / 30.0
        overlap = np.clip(edges[1:], start_s, start_s + 0.02) - np.clip(edges[:-1], start_s, start_s + 0.02)
        level = 1.0 - float(overlap.sum()) / 0.02 + float(overlap @ levels) / 0.02
        between += 0.01 < level < 0.99
        frame = expose(light, scene, 0.02, index=index, time_s=start_s)
        assert (frame.time_s, frame.exposure_s, frame.index) == (start_s, 0.02, index)
        found = float((frame.data_dn[place] - frame.black_level_dn).sum()) / lit_dn
        sigma = _sigma_dn(camera.sensor, window.values.size, level * lit_dn) / lit_dn
        assert found == pytest.approx(level, abs=4.0 * sigma + 0.003 * level)
        assert sigma < 0.006
    assert between >= 5


def _sigma_dn(sensor: Any, pixels: int, signal_dn: float) -> float:
    """Read noise, fixed offsets and rounding of all pixels, and shot noise."""
    gain = sensor.system_gain_dn_per_e
    return float(
        np.sqrt(
            pixels * (gain**2 * (sensor.read_noise_e**2 + sensor.dsnu.total_e**2) + 1 / 12) + gain * signal_dn
        )
    )


def test_frames_say_how_they_were_taken(base: Scene) -> None:
    light = _light()
    own = _with(base, {f"{CAMERA}.gain": 4, f"{CAMERA}.shutter": ROLLING, f"{CAMERA}.exposure": "0.3 ms"})
    frame = expose(light, own)
    assert frame.gain == 4.0
    assert [frame.exposure_s, frame.line_time_s] == pytest.approx([3e-4, 1e-4])
    # The light's time is mid-exposure of the middle row.
    assert frame.time_s == pytest.approx(10.0 - 1.5e-4 - 0.5 * 47 * 1e-4, abs=1e-12)
    frame = expose(light, own, exposure_s=1e-3, gain=2.0, time_s=3.0)
    assert (frame.gain, frame.exposure_s, frame.time_s) == (2.0, 1e-3, 3.0)
    bracket = _with(base, {f"{CAMERA}.bracket": ["50 us", "200 us", "0.8 ms"]})
    exposures_s = [expose(light, bracket, index=index).exposure_s for index in range(5)]
    assert exposures_s == pytest.approx([5e-5, 2e-4, 8e-4, 5e-5, 2e-4])
    for gain in (0.5, 65.0, float("nan")):
        with pytest.raises(InputError, match="wanted a factor from 1 to 64"):
            expose(light, base, gain=gain)
    with pytest.raises(InputError, match="time_s is nan"):
        expose(light, base, time_s=float("nan"))


def test_cameras_that_are_exposed_by_turns_keep_their_rates(
    base: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are kept by the light itself: so its arrays cannot be changed."""
    lights, computed = [_light() for _ in range(4)], []

    def counted(light: Light, snapshot: nr.Snapshot) -> Rates:
        computed.append(light)
        return electron_rates(light, snapshot)

    monkeypatch.setattr(mean_frame_module, "electron_rates", counted)
    for index in range(3):
        for light in lights:
            expose(light, base, index=index)
    assert computed == lights
    assert lights[0].indirect is not None
    for array in (lights[0].indirect.radiance_per_w, lights[0].direct.distance_m):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_gain_multiplies_counts_above_black(base: Scene) -> None:
    """Gain 4 and 1 of the same light, 40 frames each: mean counts of the dim ground are as 4 to 1, to 1 %."""
    light, sums = dataclasses.replace(_light()), []
    for gain in (1.0, 4.0):
        frames = [expose(light, base, 5e-3, index=index, gain=gain).data_dn for index in range(40)]
        sums.append(float(np.mean(frames)) - 64.0)
    assert sums[0] > 5.0
    assert sums[1] / sums[0] == pytest.approx(4.0, rel=0.01)


def test_lights_that_are_not_finite_are_refused(base: Scene) -> None:
    light = _light()
    assert light.indirect is not None
    radiance = light.indirect.radiance_per_w.copy()
    radiance[0, 0, 3, 3] = np.nan
    light = dataclasses.replace(light, indirect=dataclasses.replace(light.indirect, radiance_per_w=radiance))
    with pytest.raises(InputError, match="is not finite"):
        electron_rates(light, base.at(0.0))


@pytest.mark.parametrize(("gain", "black"), [(1.0, "64 DN"), (4.0, "64 DN"), (16.0, "700 DN")])
def test_ranges_are_unbiased_at_any_gain(gain: float, black: str) -> None:
    """A source on 3 m, 25 frames at gain 1 to 16, equal counts, through raw counts and `robust`.

    The mean of the ranges is within 4 standard errors of 3 m. Fixed patterns are off, which bias a place; at
    gain 16 the black level is raised to 6 σ of the noise: 64 DN would cut half of the noise off.
    """
    sensor = f"{CAMERA}.sensor"
    scene = load_scene(SCENES / "one_source.yaml").with_(
        {
            f"{sensor}.dsnu": "0 e",
            f"{sensor}.prnu": 0.0,
            f"{sensor}.black_level": black,
            f"{sensor}.system_gain": "0.74 DN/e",
            f"{sensor}.full_well": "5500 e",
        }
    )
    light = _at_three_metres(_light())
    calibration = nr.calibration(scene, "r1.front")
    found_m = []
    for index in range(25):
        frame: RawFrame = expose(light, scene, 1.5e-4 / gain, index=index, gain=gain)
        (hit,) = detect(frame, calibration, "robust")
        assert not hit.saturated
        found_m.append(hit.range_m)
    error_m = float(np.std(found_m, ddof=1)) / 5.0
    assert error_m < 0.01 * gain**0.5
    assert np.mean(found_m) == pytest.approx(3.0, abs=4.0 * error_m)


def _at_three_metres(light: Light) -> Light:
    direction = np.array([[0.01, -0.02, 1.0]]) / np.linalg.norm([0.01, -0.02, 1.0])
    radius_m = 0.01
    table = dataclasses.replace(
        light.direct,
        direction=direction,
        distance_m=np.array([3.0]),
        angular_radius_rad=np.array([np.arcsin(radius_m / 3.0)]),
        irradiance_per_w=np.array([[1.0 / (4.0 * np.pi * 9.0)]]),
    )
    return dataclasses.replace(light, direct=table, indirect=None)
