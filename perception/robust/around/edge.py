"""Flares before a straight edge: where a wall ends, a door frame, a horizon.

What lies on both sides of an edge is as bright as it may be; the edge itself is seen through the point
spread. A fit that does not know of it takes the step for the flare's own light, and leans by several of its
σ. Where it lies, how it runs, how high and how wide the step is, are unknowns of the fit beside the flares.
"""

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.window import Camera
from perception.robust.around.turns import Feature, fit_in_turns, free_of_flares, share_explained, sharp_px
from perception.robust.overlap.deblend import LEAST_GAIN, RESIDUAL_SIGMAS, asks_for_more, gain
from perception.robust.solve import Solution

Array = NDArray[np.float64]

MOST_EDGES = 2
"""So many edges one window has at most: a bar has two."""

_ANGLES, _STEP_PX = 18, 1.0
_PER_WIDTH, _REACH = 8, 32  # steps across an edge: of its width, and to where it is all
_LEAST_KEPT = 0.02  # of an edge's power, beside what flares and an even background may take of it
_SEEMS_SIGMAS, _SEEMS_GAIN = 3.0, 12.0
_LEAST_SHARE, _LEAST_SHARE_OF_ONE = 0.1, 0.2
"""Of what is left over, that an edge explains in its first turn, and that one of two explains at least.

In a thousand windows that edges explain it was 0.16 and more, and 0.28; in crowds 0.19 at most.
"""


@dataclass(frozen=True)
class Edge(Feature):
    """A straight edge in a window.

    Beyond it x cos θ + y sin θ > c the background is higher by `height_e`; c is `first`, θ `second`, in rad,
    `width_px` the σ of the normal distribution across it, that of a sharp edge the usual one.
    """

    IS_GROUND = True
    PRIOR = (1.0, 5.0, 1.0, 0.3)
    MOST_STEPS = (1.0, 0.15, 0.3)
    LOG_WIDTHS = (-0.1, math.log(4.0))

    @staticmethod
    def farthest(shape: tuple[int, int]) -> tuple[float, float]:
        """Return the greatest of where it lies, in a window of that shape."""
        return 0.5 * math.hypot(*shape), math.inf

    def slopes(self, x_px: Array, y_px: Array) -> Array:
        """Return its profile of height 1, and derivatives by `first`, `second` and ln width, (4, places)."""
        from scipy.special import ndtr

        cosine, sine = math.cos(self.second), math.sin(self.second)
        across = (x_px * cosine + y_px * sine - self.first) / self.width_px
        slope = np.exp(-0.5 * across**2) / (math.sqrt(2.0 * math.pi) * self.width_px)
        turned = slope * (y_px * cosine - x_px * sine)
        return np.stack([ndtr(across), -slope, turned, -slope * across * self.width_px])


def with_edges(
    flares: Mapping[int, Solution], on_structure: Container[int], camera: Camera
) -> dict[int, Solution]:
    """Fit flares again whose windows seem to have an edge.

    Edges are added one by one, each where what is left over asks for it most, as long as the likelihood gains
    more than noise or a wrong point spread could give it.

    Parameters
    ----------
    flares
        What explains windows so far.
    on_structure
        Indices of those on backgrounds with structure: there an edge is tried where hardly anything asks for
        it, as a flare takes up much of an edge that it stands on.
    camera
        The frame's camera.

    Returns
    -------
    By index those that have one, sigmas knowing of how it may lie.
    """
    found: dict[int, Solution] = {}
    known: dict[int, list[Edge]] = {index: [] for index in flares}
    going = {
        index: one
        for index, one in flares.items()
        if leaves_something(one) or (index in on_structure and one.left_over.peak_sigmas > _SEEMS_SIGMAS)
    }
    for _ in range(MOST_EDGES):
        tried: dict[int, list[Edge]] = {}
        for index, one in going.items():
            edge = likeliest_edge_of(one)
            if edge is not None:
                tried[index] = [*known[index], edge]
        best = fit_in_turns(tried, {index: going[index] for index in tried}, flares, camera, _LEAST_SHARE)
        going = {}
        for index, (one, edges) in best.items():
            if gain(found.get(index, flares[index]), one) < LEAST_GAIN:
                continue
            found[index], known[index] = one, edges
            if leaves_something(one) and share_explained(flares[index], one) > _LEAST_SHARE_OF_ONE:
                going[index] = one
    return found


def is_beyond_doubt(one: Solution, before: Solution) -> bool:
    """Tell whether edges explain all that is seen, and bring much where no flare reaches.

    Other flares, or halos, may be taken for an edge near to a flare; they reach no farther.
    """
    return not leaves_something(one) and gain_around(before, one) >= LEAST_GAIN


def gain_around(before: Solution, one: Solution) -> float:
    """Return by how much another fit explains better what no flare reaches, as 2 Δ ln L."""
    variance = np.where(one.flares_e**2 < one.variance_e2(0.0), one.variance_e2(0.0), math.inf)
    return float(np.sum((before.residual_e**2 - one.residual_e**2) / variance))


def leaves_something(one: Solution) -> bool:
    """Tell whether a fit leaves over what an edge may explain, on the flares or around them."""
    return not one.left_over.is_nothing or asks_for_more(one)


def surely_leaves_something(one: Solution) -> bool:
    """Tell whether a fit leaves over what noise hardly does: too large a χ², or a peak as of a flare."""
    return not one.left_over.is_nothing or one.left_over.peak_sigmas > RESIDUAL_SIGMAS


def likeliest_edge_of(one: Solution) -> Edge | None:
    """Return the edge that what is left over asks for most; None where there is none."""
    window, width_px = one.window, sharp_px(one)
    height_e, offset_px, angle_rad = _likeliest_edge(
        window.image_e, window.state, one.expected_e, one.flares_e, window.floor_e2, window.prnu, width_px,
        0.0 if surely_leaves_something(one) else _SEEMS_GAIN,
    )  # fmt: skip
    return None if height_e == 0.0 else Edge(height_e, offset_px, angle_rad, width_px, width_px)


@compiled
def _likeliest_edge(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array,
    floor_e2: float, prnu: float, width_px: float, least_gain: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return height, place and angle of the edge that brings most, beside flares that may all be off.

    What an error of the flares' light, place and width, and of the even background, looks like is taken away
    from the residual and from each edge. The height is 0 where none brings `least_gain`, in 2 Δ ln L.
    """
    parts, weights, at = free_of_flares(image_e, state, expected_e, flares_e, floor_e2, prnu)
    count = len(weights)
    # The normal distribution at steps of an eighth, within 1 %: the logistic function of 1.702 times that.
    rise = np.empty(2 * _REACH + 1)
    for step in range(len(rise)):
        rise[step] = 1.0 / (1.0 + math.exp(-1.702 * (step - _REACH) / _PER_WIDTH))
    most, height_e, offset_px, angle_rad = least_gain, 0.0, 0.0, 0.0
    rows, columns = image_e.shape
    reach_px = math.hypot(0.5 * (columns - 1), 0.5 * (rows - 1))
    per_px, far = _PER_WIDTH / width_px, int(reach_px * _PER_WIDTH / width_px) + 1
    between = max(int(_STEP_PX * per_px), 1)
    # Along an angle, what lies at each distance from the middle, and what lies at it or beyond.
    there, beyond = np.empty((2 * far + 1, 7)), np.empty(7)
    sums = np.empty(7)
    for turn in range(_ANGLES):
        angle = math.pi * turn / _ANGLES
        cosine, sine = math.cos(angle) * per_px, math.sin(angle) * per_px
        there[:] = 0.0
        for pixel in range(count):
            place = math.floor(at[0, pixel] * cosine + at[1, pixel] * sine + 0.5) + far
            weight = weights[pixel]
            there[place, 6] += weight * weight
            for part in range(6):
                there[place, part] += weight * parts[part, pixel]
        beyond[:] = 0.0
        end = 2 * far + 1
        for offset in range(far, -far - 1, -between):
            first, last = max(offset + far - _REACH, 0), min(offset + far + _REACH + 1, 2 * far + 1)
            while end > last:
                end -= 1
                for part in range(7):
                    beyond[part] += there[end, part]
            sums[:] = beyond
            for place in range(first, last):
                profile = rise[place - offset - far + _REACH]
                for part in range(6):
                    sums[part] += profile * there[place, part]
                sums[6] += profile * profile * there[place, 6]
            power = sums[6] - (sums[:5] ** 2).sum()
            if power > _LEAST_KEPT * sums[6] and sums[5] ** 2 > most * power:
                most, height_e = sums[5] ** 2 / power, sums[5] / power
                offset_px, angle_rad = offset / per_px, angle
    return height_e, offset_px, angle_rad
