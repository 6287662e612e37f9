"""Lone flares beside the highlight that a glossy surface shows of them: a mirror image without an outline.

Paint, plastic and polished floors mirror a source in facets that all lean a little otherwise. Where they
lean as GGX says (Walter et al., Eurographics Symp. Rendering 2007, eq. 33), the mirror image of a source h
before a wall of roughness α is a spot that falls off from its middle as (1 + ρ²/w²)^-2, w = 2 α h f / d
pixels: it is narrow where h is. It lies where a mirror's image would, not around the flare as a halo does; a
few flares add up to it, too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import SEEN
from perception.model.likelihood.products import dot
from perception.model.window import Camera
from perception.robust.around.edge import gain_around, leaves_something
from perception.robust.around.turns import (
    Feature,
    fit_in_turns,
    free_of_flares,
    places_px,
    sharp_px,
)
from perception.robust.goodness import MODEL_ERROR
from perception.robust.overlap.deblend import LEAST_GAIN, gain
from perception.robust.overlap.free_fits import of_free_width
from perception.robust.overlap.rivals import weighed
from perception.robust.problem import Problem, Window
from perception.robust.solve import Solution, solve

Array = NDArray[np.float64]

MOST_HIGHLIGHTS = 2
"""So many one window has at most: in walls that meet; and a halo looks like one in the flare's place."""

_LEAST_WIDTHS = 2.0  # of what is sharp: a point's image is half as wide
_LAGUERRE_AT, _LAGUERRE_WEIGHT = np.polynomial.laguerre.laggauss(8)
_WIDER = (1.0, 2.0, 4.0)  # first guesses
_REACH_PX = 12.0  # from a flare, beyond its disc, of first guesses
_STEPS = 2.0  # a width
_LEAST_AROUND = (
    20.0  # of 2 Δ ln L where the flare does not reach: within it, what is not as taken looks like one
)
_SEEMS_WIDE, _SEEMS_LIT = 9.0, 15.0  # 2 Δ ln L to first order, from which one is tried
_EACH_SEEMS_WIDE = 4.0  # likewise of any, where one is divided into several
_FARTHEST = 10.0  # 1 + ρ²/w² of what counts in first guesses: a hundredth of the light there
_LEAST_KEPT = 0.02  # of a highlight's power, beside what flares and an even background may take of it


@dataclass(frozen=True)
class Highlight(Feature):
    """A spot of light that falls off as (1 + ρ²/w²)^-2 from x = `first`, y = `second`; w is `width_px`."""

    IS_GROUND = False
    PRIOR = (1.0, 4.0, 4.0, 0.7)
    MOST_STEPS = (1.0, 1.0, 0.3)
    LOG_WIDTHS = (0.0, math.log(8.0))

    @staticmethod
    def farthest(shape: tuple[int, int]) -> tuple[float, float]:
        """Return the greatest of where it lies, in a window of that shape."""
        return 0.5 * shape[1], 0.5 * shape[0]

    def slopes(self, x_px: Array, y_px: Array) -> Array:
        """Return its profile of height 1, and derivatives by `first`, `second` and ln width, (4, places)."""
        of_spread_px2 = (self.usual_px / _LEAST_WIDTHS) ** 2
        return _slopes(x_px - self.first, y_px - self.second, self.width_px, of_spread_px2)


@compiled
def _slopes(right_px: Array, down_px: Array, width_px: float, of_spread_px2: float) -> Array:
    """Return a spot's profile of height 1, and derivatives by its place and ln width, (4, places).

    As seen through the point spread, by (1 + x)^-2 = ∫ t e^-t e^-tx dt, a sum of normal distributions.
    """
    slopes = np.zeros((4, len(right_px)))
    for node in range(len(_LAGUERRE_AT)):
        variance = 0.5 * width_px**2 / _LAGUERRE_AT[node]
        seen = variance + of_spread_px2
        height = _LAGUERRE_WEIGHT[node] * _LAGUERRE_AT[node] * variance / seen
        for place in range(len(right_px)):
            right, down = right_px[place], down_px[place]
            squared = right**2 + down**2
            light = height * math.exp(-0.5 * squared / seen)
            slopes[0, place] += light
            slopes[1, place] += light * right / seen
            slopes[2, place] += light * down / seen
            slopes[3, place] += light * (squared * variance / seen + 2.0 * of_spread_px2) / seen
    return slopes


def with_highlights(flares: Mapping[int, Solution], camera: Camera) -> dict[int, Solution]:
    """Fit lone flares again beside highlights, one after another as long as something is left over.

    Parameters
    ----------
    flares
        Lone flares.
    camera
        The frame's camera.

    Returns
    -------
    By index those that gain more by it than noise or a wrong point spread could give; with flares in the
    place of highlights where these explain nearly as much: what may be a robot is one.
    """
    found: dict[int, Solution] = {}
    known: dict[int, list[Highlight]] = {index: [] for index in flares}
    going = dict(flares)
    for _ in range(MOST_HIGHLIGHTS):
        tried = {
            index: [*known[index], highlight]
            for index, one in going.items()
            if (highlight := likeliest_highlight_of(one)[1]) is not None
        }
        best = fit_in_turns(tried, {index: going[index] for index in tried}, flares, camera)
        going = {}
        for index, (one, highlights) in best.items():
            before = found.get(index, flares[index])
            if gain(before, one) < LEAST_GAIN or gain_around(before, one) < _LEAST_AROUND:
                continue
            if min(spot.height_e for spot in highlights) <= 0.0:
                continue
            found[index], known[index] = one, highlights
            if leaves_something(one):
                going[index] = one
    wider = of_free_width([flares[index] for index in found], camera)
    for index, other in zip(list(found), wider, strict=True):
        if other is not None and gain(other, found[index]) < LEAST_GAIN:
            del found[index], known[index]
    return found | _with_flares({index: (one, known[index]) for index, one in found.items()}, flares, camera)


def _with_flares(
    highlit: Mapping[int, tuple[Solution, list[Highlight]]], flares: Mapping[int, Solution], camera: Camera
) -> dict[int, Solution]:
    """Return by index flares that explain nearly as much in the place of all highlights, or of one of two."""
    tried: list[tuple[int, list[Highlight], Solution]] = []
    problems = []
    for index, (one, highlights) in highlit.items():
        for left in ([], *([spot] for spot in highlights if len(highlights) > 1)):
            taken = [spot for spot in highlights if spot not in left]
            tried.append((index, left, one))
            problems.append(_as_flares(one, flares[index].window, taken))
    fits = list(zip(tried, solve(problems, camera), strict=True))
    beside = {k: (left, fit) for k, ((_, left, _), fit) in enumerate(fits) if left and fit is not None}
    of_both = fit_in_turns(
        {k: left for k, (left, _) in beside.items()},
        {k: fit for k, (_, fit) in beside.items()},
        {k: fit for k, (_, fit) in beside.items()},
        camera,
    )
    likeliest: dict[int, Solution] = {}
    for k, ((index, left, one), alone) in enumerate(fits):
        fit = alone
        if left:
            fit, spots = of_both.get(k, (None, []))
            if any(spot.height_e <= 0.0 for spot in spots):
                continue
        if fit is None or gain(fit, one) >= LEAST_GAIN:
            continue
        if index not in likeliest or fit.cost < likeliest[index].cost:
            likeliest[index] = fit
    return {index: weighed(several, highlit[index][0]) for index, several in likeliest.items()}


def _as_flares(one: Solution, plain: Window, highlights: Sequence[Highlight]) -> Problem:
    """Return the problem of a flare in the place of each highlight."""
    (x_px, y_px), (u_px, v_px, log_range) = places_px(one), one.starts[0]
    starts = [(u_px, v_px, log_range)]
    for spot in highlights:
        flux_e = spot.height_e * math.pi * spot.width_px**2
        place = u_px + spot.first - float(x_px[0]), v_px + spot.second - float(y_px[0])
        starts.append((*place, log_range + 0.5 * math.log(float(one.flux_e[0]) / flux_e)))
    return Problem(plain, starts, one.background_e)


def seems_highlit(one: Solution, held: Solution | None) -> bool:
    """Tell whether a window looks as if there were a highlight in it, by what explains it so far.

    Fainter flares that had better be wider than points, also several that add up to one (of highlights the
    widest of these brings 7.7 and more, in crowds 1.3 at most); light that is left over. If nothing explains
    it, by what the lone flare leaves.
    """
    if held is None or held.count == 1:
        return likeliest_highlight_of(held or one)[0] > _SEEMS_LIT
    least = _SEEMS_WIDE if held.count == 2 else _EACH_SEEMS_WIDE
    fainter = np.argsort(held.flux_e)[: held.count - 1]
    return any(_gain_if_wider(held, int(index)) > least for index in fainter)


def _gain_if_wider(one: Solution, index: int) -> float:
    """Return what a wider image of a faint flare would bring, in 2 Δ ln L, beside errors of all others."""
    window, width_px = one.window, math.hypot(sharp_px(one), 0.5 * float(one.image_radius_px[index]))
    place = float(one.u_px[index]) - window.box.left, float(one.v_px[index]) - window.box.top
    return _gained_if_wider(
        one.residual_e, window.state, one.flares_e, one.variance_e2(MODEL_ERROR), place, width_px
    )


@compiled
def _gained_if_wider(
    residual_e: Array, state: NDArray[np.uint8], flares_e: Array, variance_e2: Array,
    place: tuple[float, float], width_px: float,
) -> float:  # fmt: skip
    """Return χ² that more width of a normal distribution at (column, row) takes of a residual.

    Beside what an even ground, more light of all flares, and the same of this one there and beside, take.
    """
    parts, count = np.empty((7, state.size)), 0
    for row in range(state.shape[0]):
        for column in range(state.shape[1]):
            if state[row, column] != SEEN:
                continue
            weight = 1.0 / math.sqrt(variance_e2[row, column])
            right, down = column - place[0], row - place[1]
            squared = (right * right + down * down) / (width_px * width_px)
            image = weight * math.exp(-0.5 * squared)
            parts[0, count], parts[1, count] = weight, weight * flares_e[row, column]
            parts[2, count], parts[3, count], parts[4, count] = image, image * right, image * down
            parts[5, count], parts[6, count] = image * (squared - 2.0), weight * residual_e[row, column]
            count += 1
    free = np.ascontiguousarray(parts[:, :count])
    for one in range(6):
        power = dot(free[one], free[one])
        if one == 5:
            score = dot(free[5], free[6])
            return score * score / power if score > 0.0 and power > 0.0 else 0.0
        for other in range(one + 1, 7):
            share = dot(free[one], free[other]) / power if power > 0.0 else 0.0
            for pixel in range(count):
                free[other, pixel] -= share * free[one, pixel]
    return 0.0


def likelier_beside_highlights(
    highlit: Mapping[int, Solution], chosen: Sequence[Solution | None], parted: Mapping[int, Solution]
) -> dict[int, Solution]:
    """Return by index what `with_highlights` has found where that explains all, better than what did so far.

    What a single flare more explains nearly as well is one; flares are taken in place of more of them.
    """
    likelier = {}
    for index, one in highlit.items():
        held = parted.get(index, chosen[index])
        if held is not None and one.cost >= held.cost:
            continue
        if one.count > 1 and (held is None or held.count <= one.count):
            continue
        if one.count == 1 and held is not None and held.count == 2 and gain(held, one) < LEAST_GAIN:
            continue
        likelier[index] = one if held is None else weighed(one, held)
    return likelier


def likeliest_highlight_of(one: Solution) -> tuple[float, Highlight | None]:
    """Return the highlight that what is left over asks for most, and what it brings at least, in 2 Δ ln L.

    That is what it brings where it is first guessed to be; 0 and None where there is none.
    """
    window, least_px = one.window, _LEAST_WIDTHS * sharp_px(one)
    x_px, y_px = places_px(one)
    reach_px = _REACH_PX + float(one.image_radius_px[0])
    brings, height_e, first, second, width_px = _likeliest_highlight(
        window.image_e, window.state, one.expected_e, one.flares_e, window.floor_e2, window.prnu,
        (float(x_px[0]), float(y_px[0])), reach_px, least_px * np.array(_WIDER),
    )  # fmt: skip
    return brings, Highlight(height_e, first, second, width_px, least_px) if brings > 0.0 else None


@compiled
def _likeliest_highlight(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array, floor_e2: float,
    prnu: float, middle: tuple[float, float], reach_px: float, widths_px: Array,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Return what the highlight brings that brings most, its height, x, y and width.

    Beside flares that may all be off; of places within `reach_px` of `middle`.
    """
    parts, weights, at = free_of_flares(image_e, state, expected_e, flares_e, floor_e2, prnu)
    rows, columns = image_e.shape
    middle_x, middle_y = 0.5 * (columns - 1), 0.5 * (rows - 1)
    of_pixel = np.zeros((rows, columns, 7))  # of those that are not seen nothing
    for pixel in range(len(weights)):
        here = of_pixel[round(at[1, pixel] + middle_y), round(at[0, pixel] + middle_x)]
        here[:6], here[6] = parts[:, pixel], weights[pixel]
    most, height_e, x_px, y_px, wide_px = 0.0, 0.0, 0.0, 0.0, 0.0
    for width_px in widths_px:
        steps, far2_px2 = int(_STEPS * reach_px / width_px), (_FARTHEST - 1.0) * width_px**2
        far_px, per_px2 = math.sqrt(far2_px2), 1.0 / width_px**2
        for down in range(-steps, steps + 1):
            y = middle[1] + down * width_px / _STEPS
            top = max(math.ceil(y + middle_y - far_px), 0)
            bottom = min(math.floor(y + middle_y + far_px) + 1, rows)
            for right in range(-steps, steps + 1):
                x = middle[0] + right * width_px / _STEPS
                first = max(math.ceil(x + middle_x - far_px), 0)
                end = min(math.floor(x + middle_x + far_px) + 1, columns)
                whole, a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for row in range(top, bottom):
                    for column in range(first, end):
                        squared = (column - middle_x - x) ** 2 + (row - middle_y - y) ** 2
                        if squared < far2_px2:
                            here, spread = of_pixel[row, column], 1.0 + squared * per_px2
                            profile = here[6] / (spread * spread)
                            whole += profile * profile
                            a, b, c = a + profile * here[0], b + profile * here[1], c + profile * here[2]
                            d, e, f = d + profile * here[3], e + profile * here[4], f + profile * here[5]
                power = whole - (a * a + b * b + c * c + d * d + e * e)
                if power > _LEAST_KEPT * whole and f > 0.0 and f * f > most * power:
                    most, height_e = f * f / power, f / power
                    x_px, y_px, wide_px = x, y, width_px
    return most, height_e, x_px, y_px, wide_px
