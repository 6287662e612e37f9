"""The flux of a source in a noise-free frame, as photometry measures it.

Set up: one source of the preset `infra_swarm` before a camera of that preset, the noise-free frame in
electrons, and perception's aperture photometry about its brightest pixel, which knows nothing of how the frame
was made.

Why: everything that ranges by light stands on the inverse square law and on the absolute scale.
"""

import math

import numpy as np
import pytest
from scipy.integrate import dblquad, quad

from nir_render import expected_electrons, render
from perception.robust.large.aperture import aperture_flux
from tests.physics.conftest import SceneMaker, source_at

pytestmark = pytest.mark.mitsuba

_RANGES_M = np.geomspace(1.0, 10.0, 7)


def _measured_flux_e(scene_with: SceneMaker, changes: dict[str, object], exposure_s: float) -> float:
    scene = scene_with(changes)
    image_e = expected_electrons(render(scene, "r1.front"), scene, exposure_s)
    v_px, u_px = np.unravel_index(int(image_e.argmax()), image_e.shape)
    # Wide enough for the largest image (6 × 9 px at 40° and 1 m) and the blur: no light on the rim.
    return aperture_flux(image_e, float(u_px), float(v_px), 20.0, 20.0, 30.0).flux


@pytest.mark.parametrize(("radius", "kind"), [("10 mm", "resolved at 1 m, 4.8 px"), ("0.1 mm", "unresolved")])
@pytest.mark.parametrize("angle_deg", [0.0, 40.0])
def test_flux_falls_as_the_square_of_the_range(
    scene_with: SceneMaker, radius: str, kind: str, angle_deg: float
) -> None:
    """log F against log d has the slope −2.000 ± 0.005 from 1 to 10 m, however large the image is."""
    flux_e = [
        _measured_flux_e(
            scene_with, {"robots.r2.rig.sources.top.radius": radius, **source_at(range_m, angle_deg)}, 1e-3
        )
        for range_m in _RANGES_M
    ]
    slope, _ = np.polyfit(np.log(_RANGES_M), np.log(flux_e), 1)
    assert slope == pytest.approx(-2.0, abs=0.005), kind


def _electrons_per_joule_from_the_data_sheet(chief_ray_angle_rad: float) -> float:
    """∫ S τ η λ/(hc) dλ by adaptive quadrature, from the figures of the presets, written out here again.

    LED: Gaussian, 940 nm, FWHM 42 nm. Filter: 10 nm wide three-cavity bandpass of peak 0.92 and effective
    index 2, behind the lens, averaged over the cone of an f/2 lens. Lens 0.9, quantum efficiency 0.15.
    """
    sigma_nm = 42.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))

    def spectrum(nm: float) -> float:
        return math.exp(-0.5 * ((nm - 940.0) / sigma_nm) ** 2) / (sigma_nm * math.sqrt(2.0 * math.pi))

    def passed(sin_squared: float) -> float:
        centre_nm = 940.0 * math.sqrt(1.0 - sin_squared / 4.0)

        def integrand(nm: float) -> float:
            photons_per_j = nm * 1e-9 / (6.62607015e-34 * 299792458.0)
            filtered = max(0.92 / (1.0 + ((nm - centre_nm) / 5.0) ** 6), 1e-4)
            return spectrum(nm) * filtered * photons_per_j

        near, _ = quad(integrand, centre_nm - 40.0, centre_nm + 40.0, epsrel=1e-8, limit=200)
        below, _ = quad(integrand, 820.0, centre_nm - 40.0, epsrel=1e-6)
        above, _ = quad(integrand, centre_nm + 40.0, 1060.0, epsrel=1e-6)
        return near + below + above

    def over_pupil(radius: float, turn: float) -> float:
        x = math.tan(chief_ray_angle_rad) + radius * math.cos(turn)
        y = radius * math.sin(turn)
        tangent_squared = x * x + y * y
        return radius * passed(tangent_squared / (1.0 + tangent_squared))

    total, _ = dblquad(over_pupil, 0.0, math.pi, 0.0, 0.25, epsrel=1e-4)
    return 0.9 * 0.15 * total / (math.pi / 2.0 * 0.25**2)


@pytest.mark.parametrize("angle_deg", [0.0, 40.0])
def test_flux_in_electrons_agrees_with_the_data_sheet(scene_with: SceneMaker, angle_deg: float) -> None:
    """F = Φ/(4π d²) · π f²/(4 N²) · cos θ · C(θ) · t, every figure from the data sheet: within 0.5 %."""
    angle = math.radians(angle_deg)
    corner_tangent = math.hypot(640.0, 480.0) * 3.75e-3 / 1.8
    chief_ray_angle = math.radians(12.0) * math.tan(angle) / corner_tangent
    irradiance_w_per_m2 = 0.2 / (4.0 * math.pi * 3.0**2)
    aperture_m2 = math.pi * (1.8e-3 / 2.0) ** 2 / 4.0
    expected_e = (
        irradiance_w_per_m2
        * aperture_m2
        * math.cos(angle)
        * _electrons_per_joule_from_the_data_sheet(chief_ray_angle)
        * 1e-3
    )
    measured_e = _measured_flux_e(scene_with, source_at(3.0, angle_deg), 1e-3)
    assert measured_e == pytest.approx(expected_e, rel=2e-4)
