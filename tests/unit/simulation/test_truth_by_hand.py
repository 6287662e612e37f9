"""Truth and calibration of a robot that is turned, with a camera off its middle, worked out by hand.

The observer stands at (1, 2, 0) m, turned 90° to the left (+y of the world is ahead). Its left camera sits at
(0, 0.06, 0.2) m on it and looks along its +y, the world's −x. The source is 3 m along that, 0.5 m up, 0.4 m to
the world's +y.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import nir_render as nr
from nir_render import Scene, load_scene, simulate
from nir_render.evaluate.metrics import source_limits
from nir_render.truth.sources import SourceTruth
from perception.types import RawFrame
from tests.paths import SCENES
from tests.unit.perception import simulation

pytestmark = pytest.mark.mitsuba

EXPOSURE_S = 4e-4
GAIN_DN_PER_E = 0.69
APERTURE_M2 = math.pi * 0.9e-3**2 / 4.0
SOURCE_M = (0.4, -0.5, 3.0)  # in camera axes: right, down, ahead


@pytest.fixture(scope="module")
def scene() -> Scene:
    base = load_scene(SCENES / "one_source.yaml")
    return base.with_(
        {
            "observe": ["r1.left"],
            "clock": {"frames": 1, "frame_rate": "1 Hz"},
            "robots.r1": {"rig": "infra_swarm", "position": "[1, 2, 0] m", "orientation": {"yaw": "90 deg"}},
            # Camera in the world: (1 − 0.06, 2, 0.2). Source: 3 m along −x, 0.4 m along y, 0.5 m up.
            "robots.r2": {"rig": "infra_swarm", "position": "[-2.06, 2.4, 0.42] m"},
            "robots.r1.rig.cameras.left.exposure": "0.4 ms",
            # Without a filter C(θ) is the same everywhere: 0.9 · 0.15 photons that 1 J of the LED's light holds.
            "robots.r1.rig.cameras.left.filter": None,
            "robots.r1.rig.sources.top.flux": "5 W",  # its own source must not matter
        }
    )


@pytest.fixture(scope="module")
def shot(scene: Scene) -> tuple[RawFrame, SourceTruth]:
    (only,) = simulate(scene)
    (truth,) = only.truth
    return only.frame, truth


def _electrons_per_j() -> float:
    """0.9 · 0.15 · mean wavelength / (h c); the mean wavelength of the LED is its centroid, 940 nm."""
    return 0.9 * 0.15 * 940e-9 / (6.62607015e-34 * 299_792_458.0)


def _flux_e(flux_w: float, exposure_s: float, place_m: tuple[float, float, float] = SOURCE_M) -> float:
    """Φ/(4π d²) · A_ap · cos θ · C · t of a source at a place in camera axes."""
    range2_m2 = sum(along_m**2 for along_m in place_m)
    per_j = APERTURE_M2 * place_m[2] / math.sqrt(range2_m2) * _electrons_per_j()
    return flux_w / (4.0 * math.pi * range2_m2) * per_j * exposure_s


def _image_e(place_m: tuple[float, float, float], flux_w: float, exposure_s: float) -> NDArray[np.float64]:
    """The mean electrons of a source of 10 mm by brute force: a disc, a Gaussian of 0.7 px, pixels."""
    x, y, z = place_m
    constant = APERTURE_M2 * _electrons_per_j() * flux_w / (4.0 * math.pi)
    camera = simulation.calibration(system_gain_dn_per_e=1.0, range_constant_dn_m2_per_s=constant)
    source = (639.5 + 480.0 * x / z, 479.5 + 480.0 * y / z, math.hypot(x, y, z))
    return simulation.expected_e(camera, [source], exposure_s)


def test_geometry(shot: tuple[RawFrame, SourceTruth]) -> None:
    _, truth = shot
    range_m = math.sqrt(3.0**2 + 0.4**2 + 0.5**2)
    assert truth.range_m == pytest.approx(range_m, rel=1e-12)
    assert truth.depth_z_m == pytest.approx(3.0, rel=1e-12)
    # The camera looks along the world's −x; its right is the world's +y, its down −z.
    assert truth.bearing_camera == pytest.approx((0.4 / range_m, -0.5 / range_m, 3.0 / range_m), rel=1e-9)
    assert truth.u_px == pytest.approx(639.5 + 480.0 * 0.4 / 3.0, abs=1e-9)
    assert truth.v_px == pytest.approx(479.5 - 480.0 * 0.5 / 3.0, abs=1e-9)
    # Body axes: x is the world's +y, y the world's −x.
    assert truth.bearing_body == pytest.approx((0.4 / range_m, 3.0 / range_m, 0.5 / range_m), rel=1e-9)
    assert truth.position_body_m == pytest.approx((0.4, 3.06, 0.7), rel=1e-9)
    assert (truth.camera, truth.robot, truth.source) == ("r1.left", "r2", "top")


def test_photometry(shot: tuple[RawFrame, SourceTruth]) -> None:
    """F = Φ/(4π d²) · A_ap · cos θ · C · t, and the peak over its noise for a disc of 1.6 px radius.

    The peak is that of the light, also where the well is full, as here.
    """
    frame, truth = shot
    assert truth.direct_e == pytest.approx(_flux_e(0.2, EXPOSURE_S), rel=1e-4)
    assert (truth.visible_fraction, truth.on_fraction, truth.scattered_e, truth.background_e) == (
        1.0,
        1.0,
        0.0,
        0.0,
    )
    peak_e = _image_e(SOURCE_M, 0.2, EXPOSURE_S).max()
    assert truth.peak_snr == pytest.approx(peak_e / math.sqrt(peak_e + 100.0 + 20.0 * EXPOSURE_S), rel=3e-4)
    assert truth.dark_e == pytest.approx(20.0 * EXPOSURE_S, rel=1e-9)
    assert (truth.gain, frame.time_s, frame.exposure_s) == (1.0, 0.0, EXPOSURE_S)


def test_light_of_another_source_is_background(scene: Scene) -> None:
    """A second source 4 m ahead, 3 px beside the first in the image: its skirt lies over the first one's flare.

    Background is its mean over the pixels that hold 1 % of the first one's peak; its shot noise counts in the
    peak's SNR. Both fluxes are a hundredth, so that read noise counts too.
    """
    other_m = (0.4 / 3.0 * 4.0 + 3.0 * 4.0 / 480.0, -0.5 / 3.0 * 4.0, 4.0)
    x, y, z = other_m[2], other_m[0], -other_m[1]
    position = f"[{1.0 - 0.06 - x}, {2.0 + y}, {0.2 + z - 0.28}] m"
    dim = {"preset": "infra_swarm", "sources": {"top": {"flux": "2 mW"}}}
    changes = {"robots.r2.rig": dim, "robots.r3": {"rig": dim, "position": position}}
    (only,) = simulate(scene.with_(changes))
    truth = next(row for row in only.truth if row.robot == "r2")
    own_e, other_e = (_image_e(place_m, 2e-3, EXPOSURE_S) for place_m in (SOURCE_M, other_m))
    background_e = other_e[own_e > 0.01 * own_e.max()].mean()
    assert background_e > 10.0
    assert truth.background_e == pytest.approx(background_e, rel=1e-4)
    snr = (own_e / np.sqrt(own_e + other_e + 100.0 + 20.0 * EXPOSURE_S)).max()
    assert truth.peak_snr == pytest.approx(snr, rel=3e-4)


def test_a_hot_sensor_lowers_the_peak_and_the_limit(scene: Scene) -> None:
    """At 353 K, 54.85 K above the data sheet's, 20 e/s have doubled every 7 K: 45.7 e in 10 ms.

    They are Poisson, and a mean that the fit must find: the limit of a faint source rises with the noise of a
    dark pixel, √(163.6 e² / 117.9 e²) = 1.178 (read noise 10 e, DSNU 4.22 e, rounding 0.21 e).
    """
    camera = "robots.r1.rig.cameras.left"
    faint = scene.with_(
        {"robots.r2.rig": {"preset": "infra_swarm", "sources": {"top": {"flux": "0.0004 mW"}}}}
    )
    limits_m = []
    for temperature_k in (298.15, 353.0):
        changes = {f"{camera}.exposure": "10 ms", f"{camera}.gain": 2.0}
        changes[f"{camera}.sensor.temperature"] = f"{temperature_k} K"
        (only,) = simulate(faint.with_(changes))
        (truth,) = only.truth
        dark_e = 20.0 * 2.0 ** ((temperature_k - 298.15) / 7.0) * 0.01
        assert truth.dark_e == pytest.approx(dark_e, rel=1e-9)
        assert truth.gain == 2.0
        peak_e = _image_e(SOURCE_M, 4e-7, 0.01).max()
        assert truth.peak_snr == pytest.approx(peak_e / math.sqrt(peak_e + 100.0 + dark_e), rel=3e-4)
        limits_m.append(source_limits(truth, nr.calibration(scene, "r1.left"))[0])
    assert limits_m[1] / limits_m[0] == pytest.approx(1.178, rel=2e-3)


def test_calibration(scene: Scene) -> None:
    """Everything that perception is told, from the data sheets alone; the other robots' sources set K."""
    calibration = nr.calibration(scene, "r1.left")
    constant = GAIN_DN_PER_E * APERTURE_M2 * _electrons_per_j() * 0.2 / (4.0 * math.pi)
    assert calibration.range_constant_dn_m2_per_s == pytest.approx(constant, rel=1e-4)
    assert calibration.sigma == {}
    assert calibration.position_body_m == pytest.approx([0.0, 0.06, 0.2])
    # Columns: the camera's right, down and ahead in body axes.
    np.testing.assert_allclose(
        calibration.rotation_body_camera, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-15
    )
    np.testing.assert_allclose(calibration.response_relative, 1.0, rtol=1e-12)
    assert (calibration.fx_px, calibration.fy_px) == pytest.approx((480.0, 480.0))
    assert (calibration.cx_px, calibration.cy_px) == (639.5, 479.5)
    assert (calibration.width_px, calibration.height_px, calibration.bit_depth) == (1280, 960, 12)
    assert (calibration.system_gain_dn_per_e, calibration.read_noise_e, calibration.black_level_dn) == (
        0.69,
        10,
        64,
    )
    assert (calibration.psf_sigma_px, calibration.source_radius_m) == (0.7, 0.01)
    assert calibration.wavelength_m == 940e-9
    # A capacity of 5500 e is a full well of 5748 e; read noise and offsets, √(10² + 4.22²) e, may show it up to
    # 4 σ lower.
    assert calibration.saturation_dn == math.floor(64 + 0.69 * (5748.3 - 4.0 * 10.854))


def test_the_papers_constant_is_the_slope_of_its_regression(scene: Scene) -> None:
    """On its own rail, 1 m, the paper's estimator with its own K must come near: within 15 % of 1 m.

    Its slope is set by the nearest ranges, where m = (N − N̄)/t is largest.
    """
    from nir_render import expose, render
    from perception import detect

    near = scene.with_(
        {"robots.r2.position": "[-0.06, 2.0, -0.08] m", "robots.r1.rig.cameras.left.exposure": "0.05 ms"}
    )
    (found,) = detect(expose(render(near, "r1.left"), near), nr.calibration(near, "r1.left"), "paper")
    assert found.range_m == pytest.approx(1.0, rel=0.15)


def test_sources_that_differ_show_in_the_sigma(scene: Scene) -> None:
    """A third robot with half the flux: K is the mean of both, its σ half their difference."""
    dim = {"rig": {"preset": "infra_swarm", "sources": {"top": {"flux": "0.1 W"}}}, "position": "[9, 9, 9] m"}
    both = nr.calibration(scene.with_({"robots.r3": dim}), "r1.left")
    one = nr.calibration(scene, "r1.left").range_constant_dn_m2_per_s
    assert both.range_constant_dn_m2_per_s == pytest.approx(0.75 * one, rel=1e-9)
    assert both.sigma["range_constant_dn_m2_per_s"] == pytest.approx(0.25 * one, rel=1e-9)
