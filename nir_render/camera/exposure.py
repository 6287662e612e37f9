"""Light at the lens to expected electrons in pixels, before any noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.psf import Window, source_window
from nir_render.camera.response import Response
from nir_render.scene.devices import Camera


@dataclass(frozen=True, eq=False)
class Beam:
    """The light of one small source that comes straight to the lens.

    `direction` is the unit vector to its centre in camera axes, shape (3,); `angular_radius_rad` half the
    angle that it fills; `irradiance_w_per_m2` what falls on a plane across its direction at the lens.
    """

    direction: NDArray[np.float64]
    angular_radius_rad: float
    irradiance_w_per_m2: float
    response: Response


def beam_window(camera: Camera, beam: Beam, exposure_s: float) -> Window:
    """Return the expected electrons of one beam.

    A beam from field angle θ gives E · A_ap cos θ · C(θ) · t electrons in all: the aperture is seen tilted.
    The cos⁴ θ of the irradiance of an extended image is this cos θ and the cos³ θ by which the solid angle
    of a pixel shrinks, which the projection of the directions brings about.
    """
    collected_j = beam.irradiance_w_per_m2 * aperture_area_m2(camera) * exposure_s

    def electrons(cos_angle: NDArray[np.float64]) -> NDArray[np.float64]:
        angle_rad = np.arccos(np.clip(cos_angle, -1.0, 1.0))
        return collected_j * cos_angle * beam.response(angle_rad)

    sigma_px = camera.point_spread.sigma_px
    return source_window(intrinsics_of(camera), sigma_px, beam.direction, beam.angular_radius_rad, electrons)


def expected_electrons(camera: Camera, beams: Sequence[Beam], exposure_s: float) -> NDArray[np.float64]:
    """Return the mean number of photoelectrons in each pixel, shape (rows, columns)."""
    image = np.zeros((camera.sensor.rows, camera.sensor.columns))
    for beam in beams:
        beam_window(camera, beam, exposure_s).add_to(image)
    return image
