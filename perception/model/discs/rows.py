"""The image of a source in rows: strips along u, each spread over pixels in closed form.

What a point spread and pixels make of a straight strip is known in closed form (`normal.strip_shares`), so
that only across the strips there is something to integrate: as many of them as points lie along a diameter,
where points (`nodes`) fill a disc. Where strips end follows from the outline, the cap's rim seen through the
lens, as a Fourier series of the angle around it; light along a strip is taken for a parabola. The images of
which this cannot be said, beside a lens's fold or the horizon, or where a table of the response bends, are of
points.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.bearing import angle_from_axis_rad, pixel_turn
from perception.model.discs.nodes import DiscNodes, along_lines, disc_nodes, fineness_of
from perception.model.discs.outline import AROUND, crossing, outline_of, rims_of, value_at
from perception.model.lens import distortion_of, project
from perception.types import Calibration

Array = NDArray[np.float64]

# Rows per ratio of image radius to smoothing, in which a pixel counts for less than its variance: so few that
# the error, found by comparison with points, stays below 1e-4 of the peak for radii from 0 to 130 px, and
# below 5e-4 where an image has grown by 15 %.
_ROWS_BASE, _ROWS_SLOPE, _OF_PIXEL_PX2 = 1.45, 2.0, 0.01
_EVENED, _EVENED_FROM = 0.03, 4
_SMOOTH_RAD, _MOST_PARTS = 0.05, 8  # half of a strip on the axis along which light is as in a parabola
_TIMES_MOVED = 2
_PLACES = 5  # of a strip where light is looked at: its ends, its middle, and two between to try the parabola
_MOST_OFF, _MOST_RATIO = 2e-4, 4.0  # of the greatest light; of that to the least
_MOST_BENT = 1e-3  # of the response: how far a table's bend may change it over the radius
# Strips of half so many widths of the point spread are even: where their light's middle is says all.
_SHORT = 0.5


def disc_rows(
    u_px: Array,
    v_px: Array,
    direction: Array,
    angular_radius_rad: Array,
    calibration: Calibration,
    moved_px: Array | None = None,
    finer: Array | None = None,
) -> DiscNodes:
    """Return strips over the caps of spheres, as many for each as its image needs.

    The arguments are as for `nodes.disc_nodes`, which says the same in points.
    """
    smooth_px, fineness = fineness_of(direction, angular_radius_rad, calibration, finer)
    rims, across, down = rims_of(direction, angular_radius_rad)
    outlines_px = project(rims.reshape(-1, 3), calibration).reshape(-1, AROUND, 2)
    outlines_px -= np.stack([u_px, v_px], axis=1)[:, None, :]
    is_disc = angular_radius_rad > 0.0
    slope = _ROWS_SLOPE * smooth_px / math.sqrt(calibration.psf_sigma_px**2 + _OF_PIXEL_PX2)
    rows = np.where(is_disc, np.ceil(_ROWS_BASE + slope * fineness), 1.0).astype(np.int64)
    parts = parts_of_rows(direction, angular_radius_rad)
    first = np.cumsum([0, *(rows * parts).tolist()])
    strip_v_px, share, omega, is_known = _strips(
        first, rows, parts, outlines_px, direction, across, down, angular_radius_rad
    )
    of = np.repeat(np.arange(len(u_px)), np.diff(first))
    with np.errstate(invalid="ignore", divide="ignore"):  # beyond a fold nothing is known
        at_px = project(omega.reshape(-1, 3), calibration).reshape(-1, _PLACES, 2)
        if calibration.lens_model != "rectilinear":
            # Through other lenses what lies straight between both ends is not quite on the row.
            turn = pixel_turn(np.stack([u_px, v_px], axis=1), calibration)[of, 1]
            for _ in range(_TIMES_MOVED):
                off_px = at_px[:, :, 1] - (strip_v_px + v_px[of])[:, None]
                omega -= off_px[:, :, None] * turn[:, None, :]
                at_px = project(omega.reshape(-1, 3), calibration).reshape(-1, _PLACES, 2)
        light, psf_px = light_from(omega, calibration), calibration.psf_sigma_px
        strips, is_so = _shaded(first, at_px[:, :, 0] - u_px[of][:, None], strip_v_px, share, light, psf_px)
    is_known &= is_so & ~_is_bent(direction, angular_radius_rad, calibration)
    if not is_known.all():
        strips = _with_points(strips, is_known, u_px, v_px, direction, angular_radius_rad, calibration, finer)
    return strips if moved_px is None else along_lines(strips, moved_px / smooth_px)


def parts_of_rows(direction: Array, angular_radius_rad: Array) -> NDArray[np.int64]:
    """Return in how many parts, along each of which light is a parabola, rows of each cap are laid out."""
    # cos⁴ θ, as light falls off, bends so much more away from the axis.
    bend = np.sqrt(3.0 / direction[:, 2] ** 2 - 2.0)
    parts = np.clip(np.ceil(angular_radius_rad * bend / _SMOOTH_RAD), 1.0, _MOST_PARTS)
    return np.asarray(parts.astype(np.int64))


def light_from(omega: Array, calibration: Calibration) -> Array:
    """Return the light that falls on an area of the image from directions, shape (..., 3)."""
    angle_rad = angle_from_axis_rad(omega)
    response = np.interp(angle_rad, calibration.response_angle_rad, calibration.response_relative)
    return np.asarray(distortion_of(calibration).solid_angle_sr(omega) * np.cos(angle_rad) * response)


def _is_bent(direction: Array, angular_radius_rad: Array, calibration: Calibration) -> NDArray[np.bool_]:
    """Tell over which caps the table of the response, linear between its angles, bends by too much."""
    knots_rad = np.asarray(calibration.response_angle_rad, dtype=np.float64)
    relative = np.asarray(calibration.response_relative, dtype=np.float64)
    if np.ptp(relative) == 0.0:
        return np.zeros(len(direction), dtype=np.bool_)
    slopes = np.concatenate([[0.0], np.diff(relative) / np.diff(knots_rad), [0.0]])  # held beyond its ends
    bends = np.abs(np.diff(slopes))
    if knots_rad[0] <= 0.0:
        bends[0] *= 2.0  # on the axis it falls to all sides
    angle_rad = angle_from_axis_rad(direction)
    within = np.abs(knots_rad - angle_rad[:, None]) < angular_radius_rad[:, None]
    most = np.max(np.where(within, bends, 0.0), axis=1)
    least = _MOST_BENT * np.interp(angle_rad, knots_rad, relative)
    return np.asarray(most * angular_radius_rad > least)


@compiled
def _strips(
    first: NDArray[np.int64], rows: NDArray[np.int64], parts: NDArray[np.int64], outlines_px: Array,
    direction: Array, across: Array, down: Array, angular_radius_rad: Array,
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:  # fmt: skip
    """Lay strips between outlines: rows, each in so many parts one after another.

    Rows lie at equal steps of an angle φ, x = (cos φ + a cos 3φ) / (1 + a) of half the height from its
    middle: their lengths, which end like √(1-x²), are smooth along it. With a = 0 these are Chebyshev's
    places of the second kind; a little of the third harmonic lets them lie more evenly, so that fewer do (as
    maps do for Gauss's places: Hale & Trefethen, SIAM J. Numer. Anal. 46, 930, 2008).

    Returns
    -------
    Of each strip its v and its row's share of the height, shape (strips,); directions of `_PLACES` along it,
    ends included, shape (strips, places, 3); and of which sources all that is known, shape (sources,).
    """
    v_px, share, omega = np.zeros(first[-1]), np.ones(first[-1]), np.empty((first[-1], _PLACES, 3))
    is_known, ends = np.ones(len(rows), dtype=np.bool_), np.empty((2, 3))
    for cap in range(len(rows)):
        omega[first[cap] : first[cap + 1]] = direction[cap]
        if angular_radius_rad[cap] == 0.0:
            continue
        of_u, of_v, highest, lowest = outline_of(outlines_px[cap])
        is_known[cap] = math.isfinite(highest + lowest)
        if not is_known[cap]:
            continue
        bottom, top = value_at(of_v, lowest)[0], value_at(of_v, highest)[0]
        one_way = (highest - lowest) % (2.0 * math.pi)
        other_way = one_way - 2.0 * math.pi
        cosine, sine = math.cos(angular_radius_rad[cap]), math.sin(angular_radius_rad[cap])
        is_mirrored = False
        third = _EVENED * max(1.0 - _EVENED_FROM / rows[cap], 0.0)
        for row in range(rows[cap]):
            angle = math.pi * (row + 1) / (rows[cap] + 1)
            height = (math.cos(angle) + third * math.cos(3.0 * angle)) / (1.0 + third)
            way = math.acos(height) / math.pi
            at_v = 0.5 * (top + bottom) + 0.5 * (bottom - top) * height
            left = crossing(of_v, at_v, lowest, lowest + one_way, lowest + way * one_way)
            right = crossing(of_v, at_v, lowest, lowest + other_way, lowest + way * other_way)
            if row == 0:  # one way around is to the left of the other in all of them
                is_mirrored = value_at(of_u, left)[0] > value_at(of_u, right)[0]
            if is_mirrored:
                left, right = right, left
            is_known[cap] &= math.isfinite(left) and math.isfinite(right)
            for axis in range(3):
                ahead, aside, below = direction[cap, axis], across[cap, axis], down[cap, axis]
                ends[0, axis] = cosine * ahead + sine * (math.cos(left) * aside + math.sin(left) * below)
                ends[1, axis] = cosine * ahead + sine * (math.cos(right) * aside + math.sin(right) * below)
            for part in range(parts[cap]):
                strip = first[cap] + row * parts[cap] + part
                v_px[strip], share[strip] = at_v, math.sin(angle) + 3.0 * third * math.sin(3.0 * angle)
                for place in range(_PLACES):
                    along = (part + place / (_PLACES - 1)) / parts[cap]
                    x, y, z = (
                        (1.0 - along) * ends[0, 0] + along * ends[1, 0],
                        (1.0 - along) * ends[0, 1] + along * ends[1, 1],
                        (1.0 - along) * ends[0, 2] + along * ends[1, 2],
                    )
                    length = math.sqrt(x * x + y * y + z * z)
                    here = omega[strip, place]
                    here[0], here[1], here[2] = x / length, y / length, z / length
    return v_px, share, omega, is_known


def _shaded(
    first: NDArray[np.int64], places_px: Array, v_px: Array, share: Array, light: Array, psf_px: float
) -> tuple[DiscNodes, NDArray[np.bool_]]:
    """Return strips in rows of such v and shares of the height, and of which sources light is so.

    Of places along them, ends and nearly the middle among these, are given u and the light, shape
    (strips, `_PLACES`). Light is as in the parabola through ends and middle, if the others agree.
    """
    (left, _, centre, _, right), (one, _, two, _, three) = places_px.T, light.T
    middle_px, half_px = 0.5 * (left + right), 0.5 * (right - left)
    length_px = np.where(half_px > 0.0, half_px, 1.0)
    off = (centre - middle_px) / length_px
    ends, rise = 0.5 * (one + three), 0.5 * (three - one)
    bend = (ends - two + rise * off) / (1.0 - off**2)
    mean = ends - bend / 1.5
    along = (places_px - middle_px[:, None]) / length_px[:, None]
    differs = np.abs(light - (ends - bend)[:, None] - (rise + bend * along.T).T * along).max(axis=1)
    most = np.maximum.reduceat(light.max(axis=1), first[:-1])
    least = np.minimum.reduceat(light.min(axis=1), first[:-1])
    # Where a strip is shorter than the point spread is wide, how its light lies along it hardly matters.
    most_off = np.maximum.reduceat(differs * np.minimum(0.5 * half_px / psf_px, 1.0), first[:-1])
    is_so = (most_off <= _MOST_OFF * most) & (most <= _MOST_RATIO * least) & (least > 0.0)
    weight = share * length_px * mean
    total = np.repeat(np.add.reduceat(weight, first[:-1]), np.diff(first))
    tilt, is_short = rise / mean, half_px < _SHORT * psf_px
    strips = DiscNodes(
        first,
        np.where(is_short, middle_px + tilt * half_px / 3.0, middle_px),
        v_px,
        half_px,
        np.where(is_short, 0.0, tilt),
        np.where(is_short, 0.0, bend / mean),
        np.zeros(len(weight)),
        weight / total,
    )
    return strips, np.asarray(is_so)


def _with_points(
    strips: DiscNodes, is_known: NDArray[np.bool_], u_px: Array, v_px: Array, direction: Array,
    angular_radius_rad: Array, calibration: Calibration, finer: Array | None,
) -> DiscNodes:  # fmt: skip
    """Return images of which some, that are not known in strips, are of points."""
    other = ~is_known
    points = disc_nodes(
        u_px[other], v_px[other], direction[other], angular_radius_rad[other], calibration,
        finer=None if finer is None else finer[other],
    )  # fmt: skip
    number = np.cumsum(other) - 1
    return DiscNodes.joined(
        [strips.of(at) if known else points.of(number[at]) for at, known in enumerate(is_known.tolist())]
    )
