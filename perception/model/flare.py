"""The expected image of a source: a uniform sphere, seen through a lens and a Gaussian PSF.

A sphere of radius r at distance d fills the cap of directions within asin(r / d) of its centre, at uniform
radiance. Each direction ω of the cap gives light in proportion to cos θ · response(θ) · dΩ, θ the field
angle, and falls on the image where the lens projects it; the PSF spreads it, the pixels integrate it.
"""

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.model.bearing import direction_camera
from perception.model.lens import project, stretch
from perception.types import Calibration

Array = NDArray[np.float64]

# Quadrature nodes per ratio of image radius to smoothing: the smallest numbers, found by comparison with
# three times as many, that keep the error below 1e-4 of the peak for radii from 0 to 130 px.
_RINGS_BASE, _RINGS_SLOPE = 0.85, 1.2
_AROUND_BASE, _AROUND_SLOPE = 5.0, 4.5


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
        top = max(0, math.floor(v_px - half_px + 0.5))
        left = max(0, math.floor(u_px - half_px + 0.5))
        bottom = min(calibration.height_px, math.floor(v_px + half_px + 0.5) + 1)
        right = min(calibration.width_px, math.floor(u_px + half_px + 0.5) + 1)
        return cls(top, left, max(0, bottom - top), max(0, right - left))

    def with_margin(self, by_px: int) -> "PixelBox":
        """Return the box with a margin all around, which may reach beyond the image."""
        return PixelBox(self.top - by_px, self.left - by_px, self.height + 2 * by_px, self.width + 2 * by_px)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an image."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


@dataclass(frozen=True, eq=False)
class FlareImage:
    """Fraction of the flux in each pixel of a window, and its change as the image moves.

    Of several flares each array has one more axis in front.

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


@dataclass(frozen=True, eq=False)
class DiscNodes:
    """Quadrature nodes of the images of some sources.

    Attributes
    ----------
    u_px, v_px
        Where they are, relative to the source's place, shape (sources, nodes); infinite beyond the lens's
        fold.
    weight
        Share of the light, sum 1 for each source, same shape.
    """

    u_px: Array
    v_px: Array
    weight: Array


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
    along = direction_camera(places.reshape(-1, 2), calibration)[:, 2].reshape(places.shape[:-1])
    # A middle without a direction (NaN) has none.
    reach_rad = np.arccos(np.clip(along, -1.0, 1.0)) + np.asarray(angular_radius_rad, dtype=np.float64)
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
    images = images_of_nodes(
        disc_nodes(u, v, radius, calibration),
        u - window.left,
        v - window.top,
        np.ones(1),
        np.full(1, calibration.psf_sigma_px),
        (window.height, window.width),
    )
    return FlareImage(*(getattr(images, field.name)[0] for field in fields(FlareImage)))


def disc_nodes(u_px: Array, v_px: Array, angular_radius_rad: Array, calibration: Calibration) -> DiscNodes:
    """Return quadrature nodes over the caps of spheres, as many for each as the largest image needs.

    Parameters
    ----------
    u_px, v_px, angular_radius_rad
        Places and sizes, shape (sources,); spheres that have an image (`has_image`).
    calibration
        Intrinsics, PSF and response.
    """
    centre = direction_camera(np.stack([u_px, v_px], axis=1), calibration)
    # The pixel smooths like a box of variance 1/12 px², on top of the PSF.
    smooth_px = math.sqrt(calibration.psf_sigma_px**2 + 1.0 / 12.0)
    radius_px = stretch(centre, calibration) * np.tan(angular_radius_rad)
    share_h, phi, ring_weight = _cap_rule(math.ceil(2.0 * float(radius_px.max()) / smooth_px))

    # dΩ = dh dφ with h = 1 - cos α: uniform in h.
    h = share_h * (2.0 * np.sin(0.5 * angular_radius_rad) ** 2)[:, None]
    sin_alpha = np.sqrt(h * (2.0 - h))
    across, down = _tangents(centre)
    omega = (
        (1.0 - h)[..., None] * centre[:, None]
        + (sin_alpha * np.cos(phi))[..., None] * across[:, None]
        + (sin_alpha * np.sin(phi))[..., None] * down[:, None]
    )
    theta = np.arctan2(np.hypot(omega[..., 0], omega[..., 1]), omega[..., 2])
    response = np.interp(theta, calibration.response_angle_rad, calibration.response_relative)
    weight = ring_weight * omega[..., 2] * response  # cos θ · response(θ) · dΩ
    # What lies beyond the lens's fold has no image: its light counts, and falls on no pixel.
    at_px = np.nan_to_num(project(omega.reshape(-1, 3), calibration), nan=np.inf).reshape(*h.shape, 2)
    return DiscNodes(
        u_px=at_px[..., 0] - u_px[:, None],
        v_px=at_px[..., 1] - v_px[:, None],
        weight=weight / weight.sum(axis=1, keepdims=True),
    )


def images_of_nodes(
    nodes: DiscNodes, u_px: Array, v_px: Array, growth: Array, sigma_px: Array, shape: tuple[int, int]
) -> FlareImage:
    """Spread quadrature nodes by the PSF and integrate them over the pixels of windows, one for each source.

    Parameters
    ----------
    nodes
        As of `disc_nodes`.
    u_px, v_px
        Where each source is in its window, counted from the middle of its first pixel, shape (sources,).
    growth
        Factor on the size at which the nodes were made, shape (sources,).
    sigma_px
        Width of each source's PSF, shape (sources,).
    shape
        Rows and columns of each window.

    Returns
    -------
    FlareImage
        Its arrays have shape (sources, rows, columns).
    """
    out_u, out_v = nodes.u_px * growth[:, None], nodes.v_px * growth[:, None]
    in_u, slope_u, wider_u = _pixel_shares(u_px[:, None] + out_u, shape[1], sigma_px)
    in_v, slope_v, wider_v = _pixel_shares(v_px[:, None] + out_v, shape[0], sigma_px)
    # What falls on no pixel stays there.
    out_u, out_v = (np.where(np.isfinite(out), out, 0.0)[:, None] for out in (out_u, out_v))
    weight = nodes.weight[:, None]
    in_v, slope_v, wider_v = in_v * weight, slope_v * weight, wider_v * weight
    in_u_t, slope_u_t = in_u.transpose(0, 2, 1), slope_u.transpose(0, 2, 1)
    return FlareImage(
        fraction=in_v @ in_u_t,
        d_du=in_v @ slope_u_t,
        d_dv=slope_v @ in_u_t,
        d_dgrowth=(in_v * out_u) @ slope_u_t + (slope_v * out_v) @ in_u_t,
        d_dspread=in_v @ wider_u.transpose(0, 2, 1) + wider_v @ in_u_t,
    )


@lru_cache(maxsize=256)
def _cap_rule(twice_fineness: int) -> tuple[Array, Array, Array]:
    """Return nodes over a cap, as shares of its height and angles around, and their weights (sum 1).

    For images of up to half that many times the width of what smooths them.
    """
    fineness = 0.5 * twice_fineness
    rings = math.ceil(_RINGS_BASE + _RINGS_SLOPE * fineness)
    node, ring_weight = np.polynomial.legendre.leggauss(rings)
    share_h = 0.5 * (node + 1.0)
    around = np.ceil(_AROUND_BASE + _AROUND_SLOPE * fineness * np.sqrt(share_h)).astype(int)
    ring = np.repeat(np.arange(rings), around)
    step = np.arange(len(ring)) - np.repeat(np.cumsum(around) - around, around)
    # The golden angle turns each ring against the last, so that their errors do not line up.
    phi = 2.0 * math.pi * (step / around[ring]) + ring * 2.399963
    return share_h[ring], phi, (0.5 * ring_weight / around)[ring]


def _tangents(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete each direction (not along x) to an orthonormal frame."""
    down = np.cross(direction, [1.0, 0.0, 0.0])
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    return np.cross(down, direction), down


def _pixel_shares(at_px: Array, count: int, sigma_px: Array) -> tuple[Array, Array, Array]:
    """Share of a Gaussian at each node in each pixel of a row, and its slopes by place and by ln σ.

    `at_px` has shape (sources, nodes), counted from the first pixel's middle; results (sources, count,
    nodes).
    """
    from scipy.special import erf

    edges = np.arange(count + 1) - 0.5
    # Nodes on no pixel stand so far off that nothing of them is left.
    away = np.clip(edges[:, None] - at_px[:, None, :], -1e6, 1e6) / sigma_px[:, None, None]
    share = 0.5 * np.diff(erf(away * math.sqrt(0.5)), axis=1)
    density = np.exp(-0.5 * away**2) / math.sqrt(2.0 * math.pi)
    return share, -np.diff(density, axis=1) / sigma_px[:, None, None], -np.diff(away * density, axis=1)
