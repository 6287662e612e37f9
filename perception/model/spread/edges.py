"""A Gaussian at the edges of a row of pixels, wherever its middle lies between two of them.

All of a row's edges lie one pixel apart. So for each of some places between two edges the Gaussian is
tabulated at all edges that it reaches; of any place between these the fifth-order polynomials are taken that
meet values, slopes and curvatures at both: the same for all edges, which the processor reckons side by side.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]

REACH_SIGMAS = 6.0
"""Beyond this nothing of a point's light counts: 10⁻⁹ on either side."""

LANES = 8
"""Edges and pixels of a row are reckoned so many at a time."""

_STEP = 1.0 / 32.0  # σ
_PLACES_PER_SIGMA = 6.0  # off by 10⁻⁹ between them
_NARROWEST_PX, _WIDEST_PX = 0.006, 200.0


def _table() -> Array:
    """Return cubics for Φ and φ between steps, from two steps before `REACH_SIGMAS` on, shape (steps, 8).

    Four coefficients each, of the part of a step. They meet both functions and their slopes at each step, and
    miss them by 3·10⁻⁹ at most between. What lies beyond the reach is made up for, so that no light is lost;
    the density is less by that at the reach, so that it begins there.
    """
    x = np.arange(-REACH_SIGMAS - 2.0 * _STEP, REACH_SIGMAS + 2.0 * _STEP, _STEP)
    density = np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)
    below = np.array([0.5 * math.erfc(-at * math.sqrt(0.5)) for at in x.tolist()])
    beyond = 0.5 * math.erfc(REACH_SIGMAS * math.sqrt(0.5))
    share = (below - beyond) / (1.0 - 2.0 * beyond)
    lifted = density - math.exp(-0.5 * REACH_SIGMAS**2) / math.sqrt(2.0 * math.pi)
    cubics = []
    for value, slope in ((share, density), (lifted, -x * density)):
        rise, first, last = np.diff(value), _STEP * slope[:-1], _STEP * slope[1:]
        cubics += [value[:-1], first, 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise]
    return np.ascontiguousarray(np.stack(cubics, axis=1))


NORMAL = _table()


class Blur(NamedTuple):
    """A Gaussian point spread at the edges of pixels, and room for sums along a row of them.

    Attributes
    ----------
    sigma_px
        Its width.
    before
        How many edges of those it reaches lie before the last that is not beyond its middle.
    below, density
        Share of it below each edge that it reaches, and σ times its density there, shape (places + 1, edges):
        for its middle in so many places from one edge to the next.
    falls
        Both of these along a row, for each end of a strip, shape (4, 2 × room + edges): those of the edges
        reached are written from `room` on, 0 stands before them, 1 or 0 after.
    sums
        Of a strip up to each edge, shape (room,).
    """

    sigma_px: float
    before: int
    below: Array
    density: Array
    falls: Array
    sums: Array


@compiled
def whole_lanes(count: int) -> int:
    """Return how many pixels of a row are reckoned where so many are wanted."""
    return (count + LANES - 1) // LANES * LANES


@compiled
def blur_of(sigma_px: float, count: int) -> Blur:
    """Return a Gaussian of a width, 0.006 to 200 px or the nearest of these, for rows of so many pixels."""
    sigma = min(max(sigma_px, _NARROWEST_PX), _WIDEST_PX)
    places = math.ceil(_PLACES_PER_SIGMA / sigma)
    before = int(REACH_SIGMAS * sigma)
    edges = whole_lanes(2 * before + 2)
    below, density = np.empty((places + 1, edges)), np.empty((places + 1, edges))
    flat_below, flat_density = below.ravel(), density.ravel()
    for place in range(places + 1):
        middle = before + place / places
        for edge in range(edges):
            away = min(max((edge - middle) / sigma, -REACH_SIGMAS), REACH_SIGMAS)
            at = (away + (REACH_SIGMAS + 2.0 * _STEP)) / _STEP
            step = np.uint32(at)
            t, here = at - step, place * edges + edge
            flat_below[here] = NORMAL[step, 0] + t * (
                NORMAL[step, 1] + t * (NORMAL[step, 2] + t * NORMAL[step, 3])
            )
            flat_density[here] = NORMAL[step, 4] + t * (
                NORMAL[step, 5] + t * (NORMAL[step, 6] + t * NORMAL[step, 7])
            )
    room = whole_lanes(count) + LANES
    falls = np.zeros((4, 2 * room + edges))
    falls[0, room + edges :] = falls[2, room + edges :] = 1.0
    return Blur(sigma, before, below, density, falls, np.empty(room))


@compiled
def fall_at(middle: float, blur: Blur, first: int, count: int, end: int) -> int:
    """Reckon a Gaussian at the edges of pixels along a row; return where the first of these stands.

    Parameters
    ----------
    middle
        Where it has its middle, in pixels from the left edge of the row's first.
    blur
        Its width: of rows `2 end` and `2 end + 1` of `falls`, from what is returned on, `count` + 1 become
        the share below each edge and σ² times the density there.
    first, count
        The first edge wanted, and how many there are beyond it: as many as `whole_lanes` of the pixels that
        `blur` is for, at most.
    end
        0 or 1.
    """
    places, edges = len(blur.below) - 1, blur.below.shape[1]
    room = (blur.falls.shape[1] - edges) // 2
    sigma, whole = blur.sigma_px, math.floor(middle)
    part = (middle - whole) * places
    place = min(int(part), places - 1)
    # From one place to the next every edge lies so much farther below the middle, of which t is covered.
    step, t = 1.0 / (places * sigma), part - place
    s = 1.0 - t
    value_0, value_1 = s**3 * (1.0 + 3.0 * t + 6.0 * t * t), t**3 * (1.0 + 3.0 * s + 6.0 * s * s)
    slope_0, slope_1 = -step * t * s**3 * (1.0 + 3.0 * t), step * s * t**3 * (1.0 + 3.0 * s)
    bend_0, bend_1 = 0.5 * (step * t) ** 2 * s**3, 0.5 * (step * s) ** 2 * t**3
    below_0, below_1 = blur.below[place], blur.below[place + 1]
    density_0, density_1 = blur.density[place], blur.density[place + 1]
    below, slope = blur.falls[2 * end, room:], blur.falls[2 * end + 1, room:]
    begin, per_px = -(blur.before + place / places) / sigma, 1.0 / sigma
    for edge in range(edges):
        z = begin + edge * per_px
        # Φ' = φ, Φ'' = -z φ.
        below[edge] = (
            value_0 * below_0[edge]
            + value_1 * below_1[edge]
            + density_0[edge] * (slope_0 - bend_0 * z)
            + density_1[edge] * (slope_1 - bend_1 * (z - step))
        )
    for edge in range(edges):
        z = begin + edge * per_px
        y = z - step
        # φ' = -z φ, φ'' = (z² - 1) φ.
        slope[edge] = sigma * (
            density_0[edge] * (value_0 - slope_0 * z + bend_0 * (z * z - 1.0))
            + density_1[edge] * (value_1 - slope_1 * y + bend_1 * (y * y - 1.0))
        )
    return int(room - min(max(whole - blur.before - first, -edges), count + 1))
