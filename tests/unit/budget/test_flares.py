"""Electrons, the brightest pixel and the range of saturation, by sums that share no code with the budget."""

import math
from typing import Any

import numpy as np
import pytest

from nir_render import calibration, load_scene
from nir_render.budget.budget import Budget, photon_budget
from nir_render.budget.curves import Curve
from tests.paths import SCENES

PHOTONS_PER_J_M = 1.0 / (6.62607015e-34 * 299_792_458.0)
CAMERA = "robots.r1.rig.cameras.front"


def _budget(changes: dict[str, Any] | None = None, time_s: float = 0.0) -> Budget:
    return photon_budget(load_scene(SCENES / "one_source.yaml").with_(changes or {}), time_s)


def _on_axis(budget: Budget) -> Curve:
    return budget.cameras[0].sources[0].curves[0]


def _by_the_data_sheet() -> tuple[float, float]:
    """Share of the LED's flux that the filter passes, and electrons per joule: rings of equal area of the f/2 cone."""
    nm = np.linspace(800.0, 1080.0, 28001)
    sigma_nm = 42.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))
    led = np.exp(-0.5 * ((nm - 940.0) / sigma_nm) ** 2) / (sigma_nm * math.sqrt(2.0 * math.pi))
    tan2 = (np.arange(400) + 0.5) / 400 / 16.0
    centre_nm = 940.0 * np.sqrt(1.0 - tan2 / (1.0 + tan2) / 4.0)
    passed = np.mean([np.maximum(0.92 / (1.0 + ((nm - one) / 5.0) ** 6), 1e-4) for one in centre_nm], axis=0)
    share = float((led * passed).sum() * 0.01)
    return share, 0.9 * 0.15 * float((led * passed * nm).sum() * 0.01) * 1e-9 * PHOTONS_PER_J_M


def test_electrons_of_the_papers_source_at_3_m() -> None:
    """Φ/4π d² · π f²/4 N² · C(0) · t of 0.2 W, f 1.8 mm, f/2, 0.2 ms."""
    share, electrons_per_j = _by_the_data_sheet()
    budget = _budget()
    source, curve = budget.cameras[0].sources[0], _on_axis(budget)
    assert source.in_band_share == pytest.approx(share, rel=1e-3)
    assert source.electrons_per_j == pytest.approx(electrons_per_j, rel=1e-3)
    expected_e = 0.2 / (4.0 * math.pi * 9.0) * math.pi * 0.9e-3**2 / 4.0 * electrons_per_j * 2e-4
    assert curve.electrons_e[curve.range_m.index(3.0)] == pytest.approx(expected_e, rel=1e-3)


def test_in_view_is_what_stands_where_it_does() -> None:
    """r2 at 4 s: its lamp 5 m ahead, 1 m aside, 8 cm above the camera; cos θ and the same closed form."""
    (row,) = _budget(time_s=4.0).cameras[0].in_view
    ahead_m, aside_m, above_m = 5.06 - 0.06, 1.0, 0.08
    range_m = math.hypot(ahead_m, aside_m, above_m)
    assert row.range_m == pytest.approx(range_m, rel=1e-9)
    assert row.field_angle_rad == pytest.approx(math.acos(ahead_m / range_m), rel=1e-9)
    assert (row.u_px, row.v_px) == pytest.approx((639.5 - 480.0 * 0.2, 479.5 - 480.0 * 0.016), abs=1e-6)
    _, electrons_per_j = _by_the_data_sheet()
    expected_e = 0.2 / (4.0 * math.pi * range_m**2) * math.pi * 0.9e-3**2 / 4.0 * electrons_per_j * 2e-4
    # 11° from the axis the chief ray is 1.2° off: 0.1 % of the response.
    assert row.electrons_e == pytest.approx(expected_e * ahead_m / range_m, rel=2e-3)


def _peak_share(range_m: float) -> float:
    """Share of a 10 mm sphere's image in the pixel at its middle: a disc of points, each a Gaussian of 0.7 px."""
    radius_px = 480.0 * 0.01 / range_m
    grid = (np.arange(120) + 0.5) / 60.0 - 1.0
    x, y = np.meshgrid(grid, grid)
    inside = x**2 + y**2 <= 1.0

    scale = 0.7 * math.sqrt(2.0)
    across = np.array(
        [0.5 * (math.erf((at + 0.5) / scale) - math.erf((at - 0.5) / scale)) for at in radius_px * grid]
    )
    return float((across[None, :] * across[:, None])[inside].mean())


def test_saturation_range() -> None:
    """In 1 ms the brightest pixel meets the count that perception calls clipped where the hand's sum says."""
    _, electrons_per_j = _by_the_data_sheet()
    known = calibration(load_scene(SCENES / "one_source.yaml"), "r1.front")
    clip_e = (known.saturation_dn - 64.0) / 0.69
    at_1_m_e = 0.2 / (4.0 * math.pi) * math.pi * 0.9e-3**2 / 4.0 * electrons_per_j * 1e-3
    near_m, far_m = 1.0, 30.0
    for _ in range(40):
        middle_m = math.sqrt(near_m * far_m)
        beyond = at_1_m_e / middle_m**2 * _peak_share(middle_m) + 20.0 * 1e-3 >= clip_e
        near_m, far_m = (middle_m, far_m) if beyond else (near_m, middle_m)
    found = _on_axis(_budget({f"{CAMERA}.exposure": "1 ms"})).saturation
    assert found.when == "nearer"
    assert found.range_m == pytest.approx(near_m, rel=2e-3)


def test_a_resolved_source_is_no_brighter_nearer() -> None:
    """In 0.2 ms a disc's pixels hold π L/4 N² · A_px · C · t = 3700 e, below clipping, so nothing ever clips."""
    _, electrons_per_j = _by_the_data_sheet()
    curve = _on_axis(_budget())
    radiance = 0.2 / (4.0 * math.pi**2 * 0.01**2)
    pixel_e = math.pi * radiance / 16.0 * 3.75e-6**2 * electrons_per_j * 2e-4
    assert (curve.saturation.when, curve.saturation.range_m) == ("never", None)
    assert curve.brightest_pixel_e[curve.range_m.index(0.1)] == pytest.approx(pixel_e, rel=2e-3)
    assert not any(curve.saturated)


def test_a_bracket_has_a_curve_for_each_exposure() -> None:
    budget = _budget({f"{CAMERA}.bracket": ["0.05 ms", "0.4 ms"]})
    curves = [curve for curve in budget.cameras[0].sources[0].curves if curve.place.name == "axis"]
    assert [curve.exposure for curve in curves] == ["0.05 ms", "0.4 ms"]
    assert np.divide(curves[1].electrons_e, curves[0].electrons_e) == pytest.approx(8.0)


def test_automatic_exposure_brings_the_brightest_pixel_to_its_target() -> None:
    """0.7 of the range up to clipping, as long as the limits of the exposure allow it."""
    auto = {"target": 0.7, "shortest": "0.1 ms", "longest": "2 ms"}
    camera = _budget({f"{CAMERA}.auto_exposure": auto}).cameras[0]
    curve = camera.sources[0].curves[0]
    free = [
        peak_e
        for peak_e, exposure_s in zip(curve.brightest_pixel_e, curve.exposure_s, strict=True)
        if 1e-4 < exposure_s < 2e-3
    ]
    assert len(free) > 8
    assert free == pytest.approx([0.7 * camera.clip_e[0]] * len(free), rel=1e-9)
    assert max(curve.exposure_s) == 2e-3


def test_a_lobe_counts_towards_the_camera() -> None:
    """A VSMY2940 that looks back at the camera has its data sheet's 145 mW/sr there, not its mean of 1.6."""
    source = {"preset": "vsmy2940", "position": "[0, 0, 0.2] m", "orientation": {"pitch": "-90 deg"}}
    changes = {
        "robots.r2.motion": [],
        "robots.r2.position": "[3.06, 0, 0] m",
        "robots.r2.rig.sources": {"top": source},
    }
    camera = _budget(changes).cameras[0]
    (row,) = camera.in_view
    assert row.relative_intensity * camera.sources[0].intensity_w_per_sr == pytest.approx(0.145, rel=0.01)
    curve = camera.sources[0].curves[0]
    mean_e = curve.electrons_e[curve.range_m.index(3.0)]
    assert row.electrons_e == pytest.approx(row.relative_intensity * mean_e, rel=1e-4)


def test_fog_dims_along_the_whole_way() -> None:
    """e^(−0.1 d) up to the source's surface, and a range by flux that is too long by the half of it."""
    changes = {"fog": {"extinction": "0.1 /m"}}
    clear, foggy = _budget(time_s=4.0), _budget(changes, time_s=4.0)
    (row,) = foggy.cameras[0].in_view
    assert row.fog_transmittance == pytest.approx(math.exp(-0.1 * (row.range_m - 0.01)), rel=1e-9)
    assert row.fog_bias_m == pytest.approx(row.range_m * math.expm1(0.05 * (row.range_m - 0.01)), rel=1e-9)
    index = _on_axis(clear).range_m.index(5.0)
    passed = _on_axis(foggy).electrons_e[index] / _on_axis(clear).electrons_e[index]
    assert passed == pytest.approx(math.exp(-0.5), rel=1e-9)


def test_a_source_clips_farther_off_on_its_bright_side() -> None:
    """An LED's lens sends 4π · 550 mW/sr/55 mW = 126 times the mean along its axis: √126 times as far, as a point."""
    changes = {"robots.r2.rig.sources.top": {"preset": "sfh_4545"}, f"{CAMERA}.exposure": "20 ms"}
    budget = _budget(changes)
    source, curve = budget.cameras[0].sources[0], _on_axis(budget)
    times = source.largest_intensity_w_per_sr / source.intensity_w_per_sr
    assert times == pytest.approx(4.0 * math.pi * 0.55 / 0.055, rel=5e-3)
    mean_m, bright_m = curve.saturation.range_m, curve.saturation_at_largest_intensity.range_m
    assert mean_m is not None
    assert bright_m is not None
    assert bright_m / mean_m == pytest.approx(math.sqrt(times), rel=0.02)


def test_an_automatic_exposure_is_not_ruled_by_a_strobe() -> None:
    """Lit a twentieth of the time at 30 Hz: most exposures miss it. At 1 MHz each has a twentieth of it."""
    beacon = {
        "preset": "infra_swarm",
        "position": "[1.5, 0.3, 0.3] m",
        "flux": "20 W",
        "drive": {"square": {"frequency": "30 Hz", "duty": 0.05}},
    }
    automatic = {
        f"{CAMERA}.auto_exposure": {"shortest": "1 us", "longest": "20 ms"},
    }

    def exposure_s(changes: dict[str, Any]) -> float:
        return _budget({**automatic, **changes}).cameras[0].in_view[0].exposure_s

    alone_s, strobe_s = exposure_s({}), exposure_s({"beacons": {"flash": beacon}})
    assert strobe_s == pytest.approx(alone_s, rel=1e-2)  # the wall that it lights is of its mean
    fast = {**beacon, "drive": {"square": {"frequency": "1 MHz", "duty": 0.05}}}
    steady = {**beacon, "flux": "1 W", "drive": 1.0}
    found_s = exposure_s({"beacons": {"flash": fast}})
    assert found_s == pytest.approx(exposure_s({"beacons": {"flash": steady}}), rel=0.05)
    assert found_s < 0.5 * alone_s
