"""The expected image of a source: a uniform sphere, seen through a lens and a Gaussian PSF.

A sphere of radius r at distance d fills the cap of directions within asin(r / d) of its centre, at uniform
radiance. Each direction ω of the cap gives light in proportion to cos θ · response(θ) · dΩ, θ the field
angle, and falls on the image where the lens projects it; the PSF spreads it, the pixels integrate it.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.model.bearing import direction_camera
from perception.model.discs.nodes import disc_nodes
from perception.model.layout import Sources
from perception.model.lens import stretch
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.image import spread_nodes
from perception.types import Calibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelBox:
    """A rectangle of whole pixels: first row and column, height and width."""

    top: int
    left: int
    height: int
    width: int

    @classmethod
    def around(cls, u_px: float, v_px: float, half_px: float, calibration: Calibration) -> Self:
        """All pixels of the sensor within `half_px` of (u, v) in each axis; it may be empty."""
        top, left = math.floor(v_px - half_px + 0.5), math.floor(u_px - half_px + 0.5)
        bottom, right = math.floor(v_px + half_px + 0.5) + 1, math.floor(u_px + half_px + 0.5) + 1
        return cls(top, left, bottom - top, right - left).inside(
            (calibration.height_px, calibration.width_px)
        )

    def inside(self, shape: tuple[int, int]) -> Self:
        """Return the part of the box that lies in a frame of so many rows and columns; it may be empty."""
        return self.overlap(PixelBox(0, 0, *shape))

    def seen_from(self, corner: "PixelBox") -> Self:
        """Return the box with its place counted from the corner of another."""
        return type(self)(self.top - corner.top, self.left - corner.left, self.height, self.width)

    def overlap(self, other: "PixelBox") -> Self:
        """Return the part of the box that lies in another; it may be empty."""
        top, left = max(self.top, other.top), max(self.left, other.left)
        bottom = min(self.top + self.height, other.top + other.height)
        right = min(self.left + self.width, other.left + other.width)
        return type(self)(top, left, max(bottom - top, 0), max(right - left, 0))

    def with_margin(self, by_px: int) -> "PixelBox":
        """Return the box with a margin all around, which may reach beyond the image."""
        return PixelBox(self.top - by_px, self.left - by_px, self.height + 2 * by_px, self.width + 2 * by_px)

    def touches_border(self, shape: tuple[int, int]) -> bool:
        """Tell whether the box, which lies in a frame of so many rows and columns, reaches its border."""
        height, width = shape
        ends = self.top + self.height == height or self.left + self.width == width
        return self.top == 0 or self.left == 0 or ends

    @property
    def corner_and_size(self) -> tuple[int, int, int, int]:
        """Top, left, height and width, as compiled loops take a box."""
        return self.top, self.left, self.height, self.width

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an image."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


@dataclass(frozen=True, eq=False)
class FlareImage:
    """Fraction of the flux in each pixel of a window, and its change as the image moves.

    Attributes
    ----------
    fraction
        Share of the source's whole image (also of what falls outside the window), shape (height, width).
    d_du, d_dv
        Derivative of `fraction` as the image is moved along u and v, per px, same shape.
    d_dgrowth
        Derivative of `fraction` as the image grows about its place, by the logarithm of its size, same shape.
    d_dspread
        Derivative of `fraction` by the logarithm of the point spread's width, same shape.
    """

    fraction: Array
    d_du: Array
    d_dv: Array
    d_dgrowth: Array
    d_dspread: Array


def image_radius_px(
    u_px: ArrayLike, v_px: ArrayLike, angular_radius_rad: ArrayLike, calibration: Calibration
) -> Array:
    """Larger half axis of spheres' images before the PSF, to first order in the angular radius.

    f · ρ / cos² θ for a rectilinear lens, which stretches radially by 1 / cos² θ. Numbers or arrays of one
    shape.
    """
    places = np.stack(np.broadcast_arrays(u_px, v_px), axis=-1).astype(np.float64)
    direction = direction_camera(places.reshape(-1, 2), calibration)
    stretched = stretch(direction, calibration).reshape(places.shape[:-1])
    return np.asarray(stretched * np.tan(angular_radius_rad))


def has_image(
    u_px: ArrayLike, v_px: ArrayLike, angular_radius_rad: ArrayLike, calibration: Calibration
) -> NDArray[np.bool_]:
    """Tell which spheres lie within 90° of the axis, and so have an image. Numbers or arrays of one shape."""
    places = np.stack(np.broadcast_arrays(u_px, v_px), axis=-1).astype(np.float64)
    direction = direction_camera(places.reshape(-1, 2), calibration).reshape(*places.shape[:-1], 3)
    return is_before(direction, np.asarray(angular_radius_rad, dtype=np.float64))


def is_before(direction: Array, angular_radius_rad: Array) -> NDArray[np.bool_]:
    """Tell which spheres in some unit directions lie within 90° of the axis, shape (..., 3) → (...)."""
    # A middle without a direction (NaN) does not.
    reach_rad = np.arccos(np.clip(direction[..., 2], -1.0, 1.0)) + angular_radius_rad
    return np.asarray(reach_rad < 0.5 * np.pi)


def flare_image(
    u_px: float, v_px: float, angular_radius_rad: float, window: PixelBox, calibration: Calibration
) -> FlareImage:
    """Compute the expected image of a sphere: the fraction of its flux in each pixel of a window.

    The cap of directions is integrated by quadrature (Gauss–Legendre in solid angle, equal steps around),
    each node is spread by the PSF and integrated over the square pixels exactly (products of error
    functions). The number of nodes follows the ratio of image radius to PSF width; the error stays below
    1e-4 of the brightest pixel (usually 1e-6).

    With a flat response and a rectilinear lens the flux centroid is exactly the projection of the sphere's
    centre, because ∫ cos θ (ω_x / ω_z) dΩ = ∫ ω_x dΩ; the image itself is an ellipse whose middle lies
    elsewhere. Beyond the last angle of its table the response is held: the edge of a cap may reach beyond the
    image's corner.

    Parameters
    ----------
    u_px, v_px
        Projection of the sphere's centre.
    angular_radius_rad
        asin(radius / distance of the centre).
    window
        The pixels wanted.
    calibration
        Intrinsics, PSF and response.

    Returns
    -------
    FlareImage
        The derivatives are those of the image moved or grown as it is: how the ellipse and its shading change
        from one pixel to the next is left out.

    Raises
    ------
    ValueError
        If the angular radius is negative, or the cap reaches 90° from the optical axis.
    """
    if not (angular_radius_rad >= 0.0 and has_image(u_px, v_px, angular_radius_rad, calibration)):
        raise ValueError(
            f"a sphere of angular radius {angular_radius_rad} rad at the pixel ({u_px:.1f}, {v_px:.1f}) "
            "has no image; the radius must be ≥ 0 and the sphere within 90° of the axis"
        )
    u, v, radius = (np.array([value], dtype=np.float64) for value in (u_px, v_px, angular_radius_rad))
    direction = direction_camera(np.stack([u, v], axis=1), calibration)
    nodes = disc_nodes(u, v, direction, radius, calibration)
    image = np.zeros((5, window.height, whole_lanes(window.width)))
    blur = blur_of(calibration.psf_sigma_px, max(window.height, window.width))
    source = Sources.of(nodes, np.zeros(1), np.zeros(1))
    place = (float(u_px) - window.left, float(v_px) - window.top)
    spread_nodes(source, 0, place, 1.0, (0.0, 0.0), blur, window.width, image)
    return FlareImage(*np.ascontiguousarray(image[:, :, : window.width]))
