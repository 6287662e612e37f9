"""Placing small sources on pixels: the weighted disc of directions, blurred, integrated over each pixel.

A sphere of uniform radiance fills a cone of directions evenly. The power that the tilted aperture takes from
each is weighted cos θ · response(θ) · dΩ. The cone is represented by quadrature nodes in *direction*, so any
projection serves; each node is a point. Its image under a Gaussian is integrated over pixels exactly, by
error functions; nothing is truncated but the tail beyond 8 sigma (1e-15 of the light). Under any other core
it is made from the core's transfer function, which loses no light and moves none (`camera/waves.py`). Discs
that would need too many nodes are split into inside and edge (`camera/large_disc.py`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.gaussian import pixel_shares
from nir_render.camera.optics.large_disc import Disc, image_of_large_disc
from nir_render.camera.optics.lens import Intrinsics
from nir_render.camera.optics.otf import Core
from nir_render.camera.optics.waves import image_of_points
from nir_render.geometry import cone_directions, cone_versine, legendre

_TAIL_SIGMAS = 8.0
_WAVES_PER_SIGMA = 0.84
_MOST_RINGS = 128
_RINGS_OUT_OF_VIEW = 8  # where only the total counts: to 1e-3, as the response bends at the corner
_BEYOND_PX = 64.0
_SMALL_PX = 40.0  # a disc of which most would be edge


def cone_nodes(
    direction: NDArray[np.float64], angular_radius_rad: float, rings: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit directions that cover a cone, shape (n, 3), and their shares of its solid angle, (n,).

    Gauss–Legendre in 1 − cos ψ (solid angle is even in it), evenly spaced in azimuth: exact for polynomials
    of degree 2·rings − 1 in the plane.
    """
    nodes, weights = legendre(rings)
    spokes = 4 * rings
    versine = 0.5 * (nodes + 1.0) * cone_versine(angular_radius_rad)
    azimuth_rad = 2.0 * np.pi * (np.arange(spokes) + 0.5) / spokes
    directions = cone_directions(direction, *np.meshgrid(versine, azimuth_rad, indexing="ij"))
    shares = np.broadcast_to((0.5 * weights / spokes)[:, None], (rings, spokes))
    return directions.reshape(-1, 3), shares.ravel()


@dataclass(frozen=True, eq=False)
class Window:
    """A part of an image: its values, shape (rows, columns), and where its first pixel lies.

    `total` is the sum over the whole image of the source, what falls beyond the sensor included.
    """

    values: NDArray[np.float64]
    row: int
    column: int
    total: float

    def add_into(self, image: NDArray[np.float64]) -> None:
        """Add the values to the image, in place."""
        rows, columns = self.values.shape
        image[self.row : self.row + rows, self.column : self.column + columns] += self.values


def place_of(window: Window) -> tuple[slice, slice]:
    """Return the rows and the columns of pixels that a window lies on."""
    rows, columns = window.values.shape
    return slice(window.row, window.row + rows), slice(window.column, window.column + columns)


def source_window(
    intrinsics: Intrinsics,
    core: Core,
    direction: NDArray[np.float64],
    angular_radius_rad: float,
    power_at: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    seen: NDArray[np.float64] | None = None,
) -> Window:
    """Return the image of a source, in the unit of `power_at`, as far as it falls on the sensor.

    Parameters
    ----------
    core
        What a point at the source's distance becomes.
    direction
        Unit vector to the source's centre in camera axes, shape (3,).
    angular_radius_rad
        Half the angle that the source fills; 0 for a point.
    power_at
        What the whole source would give were it all at field angle θ, as a function of cos θ, shape (n,).
        Directions behind the aperture plane give nothing.
    seen
        Unit directions of equal power, shape (n, 3), of which the image of a partly hidden source is made;
        None where it is in full view. They are points: they show as a grain where they lie more than 1.8
        sigma apart, in images of a radius above 1.8 sigma √(n/π).
    """
    directions, shares = direction[None, :], np.ones(1)
    is_large, out_of_view = False, _is_out_of_view(intrinsics, core, direction, angular_radius_rad)
    if seen is not None:
        directions, shares = seen, np.full(len(seen), 1.0 / len(seen))
    elif angular_radius_rad > 0.0 and out_of_view:
        directions, shares = cone_nodes(direction, angular_radius_rad, _RINGS_OUT_OF_VIEW)
    elif angular_radius_rad > 0.0:
        radius_px = intrinsics.image_radius_px(direction, angular_radius_rad)
        rings = _rings(radius_px, _finest_px(core))
        is_large = rings > _MOST_RINGS and radius_px > _SMALL_PX
        directions, shares = cone_nodes(direction, angular_radius_rad, _MOST_RINGS if is_large else rings)
    in_front = directions[:, 2] > 1e-6
    if not in_front.any():
        return Window(np.empty((0, 0)), 0, 0, 0.0)
    directions, shares = directions[in_front], shares[in_front]
    power = shares * power_at(directions[:, 2])
    total = float(power.sum())
    if out_of_view:
        return Window(np.empty((0, 0)), 0, 0, total)
    if is_large:
        disc = Disc(direction, angular_radius_rad, power_at, total, _finest_px(core))
        return Window(*image_of_large_disc(intrinsics, core, disc), total)
    pixels = intrinsics.project(directions)
    sigma_px = core.gaussian_px
    if sigma_px is None:
        values, row, column = image_of_points(core, pixels, power, intrinsics.height_px, intrinsics.width_px)
        return Window(values, row, column, total)
    u_shares, column = _pixel_shares(pixels[:, 0], sigma_px, intrinsics.width_px)
    v_shares, row = _pixel_shares(pixels[:, 1], sigma_px, intrinsics.height_px)
    return Window((v_shares * power[:, None]).T @ u_shares, row, column, total)


def _is_out_of_view(
    intrinsics: Intrinsics, core: Core, direction: NDArray[np.float64], angular_radius_rad: float
) -> bool:
    """Tell whether a cone lies so far beyond the frame's corners that nothing of it can fall on the sensor.

    To one side of the lens its image is larger than the frame, and cost most where it shows nothing.
    """
    margin_px = core.reach_px + _BEYOND_PX
    farthest_rad = intrinsics.corner_angle_rad_beyond(margin_px)
    angle_rad = math.acos(min(max(float(direction[2]), -1.0), 1.0))
    return farthest_rad < 0.5 * math.pi and angle_rad - angular_radius_rad > farthest_rad


def _finest_px(core: Core) -> float:
    """Return the σ of the Gaussian that passes as fine waves as a core, to 1e-6 of their contrast."""
    sigma_px = core.gaussian_px
    return _WAVES_PER_SIGMA / core.highest_frequency if sigma_px is None else sigma_px


def _rings(radius_px: float, sigma_px: float) -> int:
    """Return how many rings resolve a disc's image against the blur: error below 1e-6 of the flux."""
    return 6 + math.ceil(1.5 * radius_px / sigma_px)


def _pixel_shares(
    centre_px: NDArray[np.float64], sigma_px: float, count: int
) -> tuple[NDArray[np.float64], int]:
    """Return each node's shares in the pixels along an axis, shape (nodes, pixels), and the first pixel.

    The share of pixel i is Φ((i + ½ − c)/σ) − Φ((i − ½ − c)/σ). Pixels beyond the image are left out.
    """
    reach_px = _TAIL_SIGMAS * sigma_px + 1.0
    start = max(math.floor(float(centre_px.min()) - reach_px), 0)
    stop = min(math.ceil(float(centre_px.max()) + reach_px) + 1, count)
    if start >= stop:
        return np.empty((centre_px.size, 0)), 0
    edges = np.arange(start, stop + 1) - 0.5
    return pixel_shares(edges - centre_px[:, None], sigma_px), start
