"""Beams to electrons: the flux of a sphere, however near."""

import numpy as np
import pytest

from nir_render.camera.exposure import Beam, beam_window
from nir_render.camera.lens import aperture_area_m2
from nir_render.camera.response import response
from nir_render.scene.devices import Source
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
