"""Beams to electrons: the flux of a sphere, however near."""

import numpy as np
import pytest

from nir_render.camera.beams import Beam, beam_window
from nir_render.camera.optics.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.optics.response import response
from nir_render.scene.documents.emitters import Source
from tests.unit.camera.conftest import CameraMaker


@pytest.mark.parametrize("distance_m", [10.0, 1.0, 0.1, 0.05, 0.03])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_a_sphere_gives_the_same_flux_as_a_point(
    camera_with: CameraMaker, source: Source, distance_m: float, angle_deg: float
) -> None:
    """A uniform sphere's irradiance is Φ/(4π d²) at every distance: F = E · A_ap cos θ · C · t, to 1e-6.

    Without a filter, so that C is the same over the disc; at 3 cm it is 39° wide.
    """
    camera = camera_with(filter=None)
    angle = np.radians(angle_deg)
    irradiance = 0.2 / (4.0 * np.pi * distance_m**2)
    direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
    beam = Beam(
        direction, float(np.arcsin(source.radius_m / distance_m)), irradiance, response(camera, source)
    )
    expected_e = irradiance * aperture_area_m2(camera) * np.cos(angle) * float(beam.response(0.0)) * 1e-3
    assert beam_window(camera, beam, 1e-3).total == pytest.approx(expected_e, rel=1e-6)


@pytest.mark.parametrize("z", [0.0, 1e-3, -1e-3])
def test_the_sun_at_a_right_angle_of_a_focused_lens(
    camera_with: CameraMaker, source: Source, z: float
) -> None:
    """Infinitely far at depth 0: half of its disc is in front, none of it on the sensor, and nothing is NaN."""
    camera = camera_with(lens={"focus_distance": "2 m"})
    direction = np.array([np.sqrt(1.0 - z**2), 0.0, z])
    window = beam_window(camera, Beam(direction, 0.00465, 1.0, response(camera, source)), 1e-3)
    assert np.isfinite(window.total)
    assert window.values.sum() == pytest.approx(0.0, abs=1e-12 * max(window.total, 1.0))


@pytest.mark.parametrize(
    ("model", "distance_m"),
    [("rectilinear", 2.0 * 2**0.5), ("brown_conrady", 2.0 * 2**0.5), ("fisheye", 2.0)],
)
def test_what_a_lens_focuses_on(
    camera_with: CameraMaker, source: Source, model: str, distance_m: float
) -> None:
    """Focused at 2 m, at 45°: a plane's point is 2.83 m away, a sphere's 2 m. There it is sharpest: the second
    moment is that of σ and the pixel alone. At half that distance it has D²/16 more, D = 9.6 px: f²/(N pitch d_f)."""
    numbers = {"rectilinear": [], "brown_conrady": [-0.02, 0, 0, 0], "fisheye": [0, 0, 0, 0]}[model]
    camera = camera_with(
        lens={
            "model": model, "distortion": numbers, "focal_length": "6 mm", "f_number": 0.5,
            "focus_distance": "2 m", "principal_point": "[-1000, 479.5] px",
        },
        filter=None,
    )  # fmt: skip
    lens = intrinsics_of(camera)
    direction = np.array([0.5**0.5, 0.0, 0.5**0.5])
    assert lens.contains(*lens.project(direction))

    def spread_px2(at_m: float) -> float:
        beam = Beam(direction, 0.0, 1e-6, response(camera, source), distance_m=at_m)
        window = beam_window(camera, beam, 1e-3)
        share = window.values.sum(axis=1) / window.values.sum()
        row = np.arange(share.size)
        return float(share @ (row - share @ row) ** 2)

    sharp_px2 = spread_px2(distance_m)
    assert sharp_px2 == pytest.approx(0.49 + 1.0 / 12.0, rel=1e-3)
    circle_px = 0.006**2 / (0.5 * 3.75e-6 * 1.994)
    assert spread_px2(0.5 * distance_m) - sharp_px2 == pytest.approx(circle_px**2 / 16.0, rel=2e-3)
