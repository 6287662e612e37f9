"""One beam, or one radiance image, to mean electrons in pixels: aperture, response, point spread."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.gaussian import gaussian_blur
from nir_render.camera.optics.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.optics.otf import core_of
from nir_render.camera.optics.psf import Window, source_window
from nir_render.camera.optics.response import Response, response_map
from nir_render.camera.optics.veil import veil
from nir_render.camera.optics.waves import convolve
from nir_render.light.enlarge import enlarge
from nir_render.scene.documents.camera import Camera
from nir_render.scene.emission import Emitter
from nir_render.spectra.nodes import ONE_NODE, Node

_TRUNCATE = 6.0  # of a Gaussian, in σ


@dataclass(frozen=True, eq=False)
class Beam:
    """The light of one small source that comes to the lens in straight lines.

    `direction` is the unit vector to its centre in camera axes, shape (3,); `angular_radius_rad` half the
    angle that it fills; `irradiance_w_per_m2` what falls on a plane across its direction at the lens. Of a
    partly hidden source, `seen` holds unit directions that cover the visible part evenly, shape (n, 3).
    `distance_m`, straight to the centre, is what the lens focuses by.
    """

    direction: NDArray[np.float64]
    angular_radius_rad: float
    irradiance_w_per_m2: float
    response: Response
    seen: NDArray[np.float64] | None = None
    distance_m: float = math.inf


def beam_window(camera: Camera, beam: Beam, exposure_s: float) -> Window:
    """Return the expected electrons of one beam: what the core of the point spread brings; in all, all.

    A beam from field angle θ gives E · A_ap cos θ · C(θ) · t electrons in all: the aperture is seen tilted.
    E is L ∫ cos ψ dΩ over the angles ψ from the source's centre, and each of its directions is weighted with
    its own cos θ, which holds that cos ψ already; so L Ω = 2 E / (1 + cos α) is what is spread over the disc.
    The cos⁴ θ of the irradiance of an extended image behind a rectilinear lens is this cos θ and the cos³ θ
    by which the solid angle of a pixel shrinks, which the projection of the directions brings about.
    """
    obliquity = 0.5 * (1.0 + np.cos(beam.angular_radius_rad))
    collected_j = beam.irradiance_w_per_m2 / obliquity * aperture_area_m2(camera) * exposure_s

    def electrons(cos_angle: NDArray[np.float64]) -> NDArray[np.float64]:
        angle_rad = np.arccos(np.clip(cos_angle, -1.0, 1.0))
        return np.asarray(collected_j * cos_angle * beam.response(angle_rad))

    window = source_window(
        intrinsics_of(camera),
        core_of(camera, _focal_distance_m(camera, beam)),
        beam.direction,
        beam.angular_radius_rad,
        electrons,
        beam.seen,
    )
    share = camera.point_spread.core_share
    return window if share == 1.0 else replace(window, values=share * window.values)


def _focal_distance_m(camera: Camera, beam: Beam) -> float:
    """Return the distance that focus goes by: a rectilinear lens focuses planes, a fisheye spheres.

    The sun at 90° from the axis is still infinitely far.
    """
    if camera.lens.model == "fisheye" or math.isinf(beam.distance_m):
        return beam.distance_m
    return beam.distance_m * max(float(beam.direction[2]), 0.0)


def diffuse_electrons(
    camera: Camera,
    radiance_w_per_m2_sr: NDArray[np.float64],
    emitter: Emitter,
    exposure_s: float,
    node: Node = ONE_NODE,
) -> NDArray[np.float64]:
    """Return the expected electrons, before the blur, of light of one spectrum from everywhere.

    A pixel that sees the solid angle Ω gets L · A_ap cos θ · Ω · C(θ) · t electrons.

    Parameters
    ----------
    radiance_w_per_m2_sr
        Mean radiance, shape (rows, columns), or (rows / scale, columns / scale): then it is interpolated.
    emitter
        Whose spectrum the light has.
    node
        At which wavelength node it was carried.

    Returns
    -------
    Electrons, shape (rows, columns).
    """
    radiance = enlarge(radiance_w_per_m2_sr, camera.sensor.rows, camera.sensor.columns)
    electrons = np.multiply(radiance, _collected_per_radiance(camera) * exposure_s, dtype=np.float64)
    electrons *= response_map(camera, emitter, node)
    return electrons


def electrons_per_radiance(
    camera: Camera, emitter: Emitter, exposure_s: float, node: Node = ONE_NODE
) -> NDArray[np.float64]:
    """Return what `diffuse_electrons` gives of one W/m²/sr in all pixels, shape (rows, columns)."""
    return response_map(camera, emitter, node) * (_collected_per_radiance(camera) * exposure_s)


def blur(camera: Camera, image_e: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an image spread by the core of the point spread, the edge pixels continued outside.

    Extended light has no distance here: it is as far out of focus as what is infinitely far.
    """
    core, share = core_of(camera), camera.point_spread.core_share
    sigma_px = core.gaussian_px
    if sigma_px is None:
        return share * convolve(core, image_e)
    blurred_e = gaussian_blur(image_e, sigma_px, _TRUNCATE)
    return blurred_e if share == 1.0 else share * blurred_e


def blur_reach_px(camera: Camera) -> int | None:
    """Return how far `blur` takes light; None where that is not cut off."""
    sigma_px = core_of(camera).gaussian_px
    return None if sigma_px is None else math.ceil(_TRUNCATE * sigma_px) + 1


def _collected_per_radiance(camera: Camera) -> float:
    """Return aperture area × solid angle of the pixel on the axis, in m² sr."""
    return aperture_area_m2(camera) * (camera.sensor.pixel_pitch_m / camera.lens.focal_length_m) ** 2


def beam_electrons(camera: Camera, beams: Sequence[Beam], exposure_s: float) -> NDArray[np.float64]:
    """Return the mean number of photoelectrons in each pixel, shape (rows, columns)."""
    image = np.zeros((camera.sensor.rows, camera.sensor.columns))
    for beam in beams:
        beam_window(camera, beam, exposure_s).add_into(image)
    return image + veil(camera, image) if camera.point_spread.core_share < 1.0 else image
