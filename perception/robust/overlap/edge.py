"""Flares before a straight edge: where a wall ends, a door frame, a horizon.

What lies on both sides of an edge is as bright as it may be; the edge itself is seen through the point
spread. A fit that does not know of it takes the step for the flare's own light, and leans by several of its
σ. Where it lies, how it runs, how high and how wide the step is, are unknowns of the fit beside the flares.
"""

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import SEEN, Structure
from perception.model.window import Camera
from perception.robust.goodness import noise_e2
from perception.robust.overlap.deblend import LEAST_GAIN, RESIDUAL_SIGMAS, asks_for_more, gain
from perception.robust.problem import Window
from perception.robust.solve import Solution, solve

Array = NDArray[np.float64]

MOST_EDGES = 2
"""So many edges one window has at most: a bar has two."""

_ANGLES, _STEP_PX = 18, 1.0
_LEAST_KEPT = 0.02  # of an edge's power, beside what flares and an even background may take of it
_ROUNDS, _CLIMBS = 3, 16
_SEEMS_SIGMAS, _SEEMS_GAIN = 3.0, 12.0
_LEAST_HEIGHT_E = 0.1
_SETTLED = 0.01  # of χ²
_MOST_STEPS = (1.0, 0.15, 0.3)  # px, rad, ln width
_WIDEST = 4.0  # widths of a sharp one
_PRIOR = (1.0, 5.0, 1.0, 0.3)  # σ of height over itself, of place in px, of angle in rad, of ln width


@dataclass(frozen=True)
class Edge:
    """A straight edge in a window.

    Beyond it x cos θ + y sin θ > c the background is higher by `height_e`; x and y from the window's middle,
    θ `angle_rad`, c `offset_px`, `width_px` the σ of the normal distribution across it.
    """

    height_e: float
    offset_px: float
    angle_rad: float
    width_px: float


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
        best = fit_in_turns(tried, {index: going[index] for index in tried}, flares, camera)
        going = {}
        for index, (one, edges) in best.items():
            if gain(found.get(index, flares[index]), one) < LEAST_GAIN:
                continue
            found[index], known[index] = one, edges
            if leaves_something(one):
                going[index] = one
    return found


def is_beyond_doubt(one: Solution, before: Solution) -> bool:
    """Tell whether edges explain all that is seen, and bring much where no flare reaches.

    Other flares, or halos, may be taken for an edge near to a flare; they reach no farther.
    """
    variance = np.where(one.flares_e**2 < one.variance_e2(0.0), one.variance_e2(0.0), math.inf)
    gain_around = float(np.sum((before.residual_e**2 - one.residual_e**2) / variance))
    return not leaves_something(one) and gain_around >= LEAST_GAIN


def leaves_something(one: Solution) -> bool:
    """Tell whether a fit leaves over what an edge may explain, on the flares or around them."""
    return not one.left_over.is_nothing or asks_for_more(one)


def surely_leaves_something(one: Solution) -> bool:
    """Tell whether a fit leaves over what noise hardly does: too large a χ², or a peak as of a flare."""
    return not one.left_over.is_nothing or one.left_over.peak_sigmas > RESIDUAL_SIGMAS


def fit_in_turns(
    tried: Mapping[int, list[Edge]],
    solutions: Mapping[int, Solution],
    plain: Mapping[int, Solution],
    camera: Camera,
) -> dict[int, tuple[Solution, list[Edge]]]:
    """Fit flares and edges in turns: each together with how the other may be off, to first order."""
    known = dict(tried)
    best: dict[int, tuple[Solution, list[Edge]]] = {}
    current = dict(solutions)
    for _ in range(_ROUNDS):
        for index in known:
            known[index] = _climbed(current[index], plain[index].window, known[index])
        windows = {
            index: replace(plain[index].window, edges=_structure(edges, current[index]))
            for index, edges in known.items()
        }
        problems = [current[index].again(windows[index]) for index in known]
        for index, again in zip(list(known), solve(problems, camera), strict=True):
            if again is None:
                del known[index]
                continue
            current[index] = again
            if index not in best or again.deviance < best[index][0].deviance:
                best[index] = again, known[index]
    return best


def likeliest_edge_of(one: Solution) -> Edge | None:
    """Return the edge that what is left over asks for most; None where there is none."""
    window, width_px = one.window, _sharp_px(one)
    height_e, offset_px, angle_rad = _likeliest_edge(
        window.image_e, window.state, one.expected_e, one.flares_e, window.floor_e2, window.prnu, width_px,
        0.0 if surely_leaves_something(one) else _SEEMS_GAIN,
    )  # fmt: skip
    return None if height_e == 0.0 else Edge(height_e, offset_px, angle_rad, width_px)


def _sharp_px(one: Solution) -> float:
    """Return the width of a sharp edge: point spread and pixel."""
    return math.hypot(one.psf_sigma_px, math.sqrt(1.0 / 12.0))


def _slopes(edge: Edge, shape: tuple[int, int]) -> Array:
    """Return an edge's profile, of height 1, and its derivatives by place, angle and ln width."""
    from scipy.special import ndtr

    rows, columns = shape
    y, x = np.mgrid[:rows, :columns] - np.reshape([0.5 * (rows - 1), 0.5 * (columns - 1)], (2, 1, 1))
    cosine, sine = math.cos(edge.angle_rad), math.sin(edge.angle_rad)
    across = (x * cosine + y * sine - edge.offset_px) / edge.width_px
    slope = np.exp(-0.5 * across**2) / (math.sqrt(2.0 * math.pi) * edge.width_px)
    turned = slope * (y * cosine - x * sine)
    return np.stack([ndtr(across), -slope, turned, -slope * across * edge.width_px])


def _climbed(one: Solution, window: Window, edges: list[Edge]) -> list[Edge]:
    """Return edges moved to where they explain best what flares leave, as these have come out.

    Levenberg's steps; heights, and the even background, are linear and follow.
    """
    usable = window.state == SEEN
    shape, sharp_px = window.image_e.shape, _sharp_px(one)
    weight = 1.0 / np.sqrt(one.variance_e2(0.0)[usable])
    known_e = 0.0 if window.known_e is None else window.known_e
    left = (window.image_e - one.flares_e - known_e)[usable] * weight
    # Place, angle, and ln width over that of a sharp edge.
    now = np.array([[edge.offset_px, edge.angle_rad, math.log(edge.width_px / sharp_px)] for edge in edges])
    most = np.array([0.5 * math.hypot(*shape), math.inf, math.log(_WIDEST)])

    def fitted(values: Array) -> tuple[list[Edge], float, Array]:
        """Return edges, how badly they fit, and the slopes of what is left by their unknowns."""
        rows = [Edge(0.0, place, angle, sharp_px * math.exp(width)) for place, angle, width in values]
        profiles = [_slopes(edge, shape)[:, usable] * weight for edge in rows]
        linear = np.stack([weight, *(profile[0] for profile in profiles)], axis=1)
        heights, *_ = np.linalg.lstsq(linear, left, rcond=None)
        after = left - linear @ heights
        slopes = [heights[1 + k] * profile[1:] for k, profile in enumerate(profiles)]
        whole = np.concatenate([linear.T, *slopes])
        edges = [
            replace(edge, height_e=float(height)) for edge, height in zip(rows, heights[1:], strict=True)
        ]
        return (
            edges,
            float(after @ after + ((values[:, 2] / _PRIOR[3]) ** 2).sum()),
            np.vstack([whole, after]),
        )

    best, cost, design = fitted(now)
    damping, count = 1e-3, len(edges)
    of_width = np.arange(count) * 3 + 2 + 1 + count
    for _ in range(_CLIMBS):
        normal = design[:-1] @ design[:-1].T
        force = design[:-1] @ design[-1]
        normal[of_width, of_width] += _PRIOR[3] ** -2
        force[of_width] -= now[:, 2] / _PRIOR[3] ** 2
        diagonal = normal.diagonal().copy()
        diagonal[: 1 + count] = 0.0
        step = np.linalg.lstsq(normal + np.diag(damping * diagonal), force, rcond=None)[0][1 + count :]
        moved = now + np.clip(step.reshape(-1, 3), -np.array(_MOST_STEPS), _MOST_STEPS)
        moved = np.clip(moved, [-most[0], -math.inf, -0.1], most)
        there, cost_there, design_there = fitted(moved)
        if cost_there < cost:
            settled = cost - cost_there < _SETTLED
            now, best, cost, design, damping = moved, there, cost_there, design_there, 0.2 * damping
            if settled:
                break
        else:
            damping *= 10.0
    return best


def _structure(edges: list[Edge], one: Solution) -> Structure:
    """Return what edges may add to a window: their heights, and what else is not known of them.

    Each counts from its level at the flares, so that the even background is that which they stand on.
    """
    from scipy.special import ndtr

    columns: list[Array] = []
    sigma: list[float] = []
    box = one.window.box
    middle_u, middle_v = box.left + 0.5 * (box.width - 1), box.top + 0.5 * (box.height - 1)
    for edge in edges:
        profile, *slopes = _slopes(edge, one.window.image_e.shape)
        along_u, along_v = math.cos(edge.angle_rad), math.sin(edge.angle_rad)
        beyond_px = (one.u_px - middle_u) * along_u + (one.v_px - middle_v) * along_v - edge.offset_px
        columns += [(profile - float(ndtr(beyond_px / edge.width_px).mean())).ravel(), *map(np.ravel, slopes)]
        sigma += [max(abs(edge.height_e), _LEAST_HEIGHT_E) * prior for prior in _PRIOR]
    return Structure(np.array(columns), np.diag(1.0 / np.square(sigma)))


@compiled
def _likeliest_edge(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array,
    floor_e2: float, prnu: float, width_px: float, least_gain: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return height, place and angle of the edge that brings most, beside flares that may all be off.

    What an error of the flares' light, place and width, and of the even background, looks like is taken away
    from the residual and from each edge. The height is 0 where none brings `least_gain`, in 2 Δ ln L.
    """
    rows, columns = image_e.shape
    middle_x, middle_y = 0.5 * (columns - 1), 0.5 * (rows - 1)
    parts, at = np.empty((6, rows * columns)), np.empty((2, rows * columns))
    weights, count = np.empty(rows * columns), 0
    for row in range(rows):
        for column in range(columns):
            if state[row, column] != SEEN:
                continue
            weight = 1.0 / math.sqrt(noise_e2(expected_e[row, column], floor_e2, prnu))
            here = flares_e[row, column]
            left, right = flares_e[row, max(column - 1, 0)], flares_e[row, min(column + 1, columns - 1)]
            above, below = flares_e[max(row - 1, 0), column], flares_e[min(row + 1, rows - 1), column]
            parts[0, count] = weight
            parts[1, count] = weight * here
            parts[2, count] = weight * (right - left)
            parts[3, count] = weight * (below - above)
            parts[4, count] = weight * (left + right + above + below - 4.0 * here)
            parts[5, count] = weight * (image_e[row, column] - expected_e[row, column])
            at[0, count], at[1, count] = column - middle_x, row - middle_y
            weights[count] = weight
            count += 1
    parts = parts[:, :count].copy()
    for one in range(5):
        power = (parts[one] ** 2).sum()
        parts[one] *= 1.0 / math.sqrt(power) if power > 0.0 else 0.0
        for other in range(one + 1, 6):
            parts[other] -= (parts[one] * parts[other]).sum() * parts[one]
    # The normal distribution at steps of a sixteenth, within 1 %: the logistic function of 1.702 times that.
    rise = np.empty(129)
    for step in range(129):
        rise[step] = 1.0 / (1.0 + math.exp(-1.702 * (step / 16.0 - 4.0)))
    most, height_e, offset_px, angle_rad = least_gain, 0.0, 0.0, 0.0
    reach_px = math.hypot(middle_x, middle_y)
    for turn in range(_ANGLES):
        angle = math.pi * turn / _ANGLES
        cosine, sine = 16.0 * math.cos(angle) / width_px, 16.0 * math.sin(angle) / width_px
        for step in range(int(2.0 * reach_px / _STEP_PX) + 1):
            offset = -reach_px + step * _STEP_PX
            whole, score, by_0, by_1, by_2, by_3, by_4 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for pixel in range(count):
                across = at[0, pixel] * cosine + at[1, pixel] * sine - 16.0 * offset / width_px
                profile = weights[pixel] * rise[int(min(max(across + 64.5, 0.0), 128.0))]
                whole += profile**2
                score += profile * parts[5, pixel]
                by_0 += profile * parts[0, pixel]
                by_1 += profile * parts[1, pixel]
                by_2 += profile * parts[2, pixel]
                by_3 += profile * parts[3, pixel]
                by_4 += profile * parts[4, pixel]
            power = whole - by_0**2 - by_1**2 - by_2**2 - by_3**2 - by_4**2
            if power > _LEAST_KEPT * whole and score**2 > most * power:
                most, height_e, offset_px, angle_rad = score**2 / power, score / power, offset, angle
    return height_e, offset_px, angle_rad
