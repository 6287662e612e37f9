"""Flares with a halo: the light that a wall close behind a source throws back around it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import SEEN, Structure, any_of
from perception.model.likelihood.products import dot
from perception.model.window import Camera
from perception.robust.goodness import LEAST_KNOWN, noise_e2
from perception.robust.overlap.rivals import weighed
from perception.robust.problem import Problem
from perception.robust.search.structure import joined
from perception.robust.solve import Solution, solve

Array = NDArray[np.float64]

LEAST_GAIN = 10.0
"""2 Δ ln L that a halo must bring: noise gives χ² of two or three degrees of freedom, 10 hardly ever."""

_SEEMS_SIGMAS, _SEEMS_AT_ALL = 2.4, 1.5
"""So much of a halo shows where one is tried; of one that brings `LEAST_GAIN` 3.2 σ, less of other widths."""

_HALO_SHARE, _SHAPE_SHARE = 1.0, 0.1
"""What a wall throws back of the light of a source before it, and how far that differs in shape, a priori."""

_WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
_THIRD = 2.0 ** (1.0 / 3.0)
_ROUNDS = ((1.0,), (_THIRD**-2, _THIRD**-1, 1.0, _THIRD, _THIRD**2), (_THIRD**-1, 1.0, _THIRD))
"""Of widths so many times the likeliest so far, round by round."""

_LEAST_WIDTH_PX, _LEAST_WIDTH_RADII, _MOST_WIDTH_SIDES = 1.5, 1.05, 0.6
_FINE, _PLACES = 4, 10  # parts of a pixel along an axis, and places of what moves

# (1 + x)^(-3/2) = Σ s exp(-r x): the integral of t^(1/2) exp(-t (1 + x)) / Γ(3/2) by the trapezoidal rule in
# ln t, within 5e-5 up to x = 1 000, 3e-4 up to 10⁴.
_LOG_STEP = 0.7
_RATES = np.exp(np.arange(-14.0, 3.4, _LOG_STEP))
_SHARES = _LOG_STEP * _RATES**1.5 * np.exp(-_RATES) / math.gamma(1.5)


def with_halo(flares: Mapping[int, Solution | None], camera: Camera) -> dict[int, Solution]:
    """Fit lone flares again that seem to have a halo.

    What a source hides of its halo goes by its size, and that by its range: so they are fitted once more as
    these have come out, with widths nearer to the likeliest.

    Returns
    -------
    By index those that have one, sigmas knowing of other widths of it.
    """
    found: dict[int, Solution] = {}
    plain = {index: one for index, one in flares.items() if one is not None and _seems_to_have_one(one)}
    known = {index: (one, _widths_px(one)) for index, one in plain.items()}
    for factors in _ROUNDS:
        tried, problems = [], []
        for index, (one, widths_px) in known.items():
            least_px, most_px = _bounds_px(one)
            widths_px = [factor * width_px for width_px in widths_px for factor in factors]
            widths_px = [width_px for width_px in widths_px if least_px <= width_px <= most_px]
            tried += [(index, width_px) for width_px in widths_px]
            problems += _problems(plain[index], one, widths_px)
        fits: dict[int, list[tuple[Solution, float]]] = {}
        for (index, width_px), again in zip(tried, solve(problems, camera), strict=True):
            if again is not None and plain[index].deviance - again.deviance > LEAST_GAIN:
                fits.setdefault(index, []).append((again, width_px))
        known = {}
        for index, several in fits.items():
            several.sort(key=lambda each: each[0].cost)
            likeliest, width_px = several[0]
            known[index] = likeliest, [width_px]
            found[index] = weighed(*(one for one, _ in several))
    return found


def _seems_to_have_one(solution: Solution) -> bool:
    """Tell whether what a lone flare's fit leaves over looks as if it had a halo."""
    widths_px = _widths_px(solution)
    if solution.count != 1 or not widths_px:
        return False
    window, (u_px, v_px, _) = solution.window, solution.starts[0]
    seems = halo_sigmas(
        window.image_e, window.state, solution.expected_e, solution.flares_e, window.floor_e2, window.prnu,
        (u_px - window.box.left, v_px - window.box.top), np.array(widths_px), _SEEMS_AT_ALL,
    )  # fmt: skip
    return bool(seems > _SEEMS_SIGMAS)


def _bounds_px(solution: Solution) -> tuple[float, float]:
    """Return how wide a halo may be: wider than its ball, narrower than its window."""
    least_px = max(_LEAST_WIDTH_PX, _LEAST_WIDTH_RADII * float(solution.radius_at_rest_px[0]))
    return least_px, _MOST_WIDTH_SIDES * min(solution.window.image_e.shape)


def _widths_px(solution: Solution) -> list[float]:
    least_px, most_px = _bounds_px(solution)
    return [least_px * factor for factor in _WIDTHS if least_px * factor <= most_px]


def _problems(plain: Solution, known: Solution, widths_px: Sequence[float]) -> list[Problem]:
    """Return the problems of a flare with halos of such widths; what hides of them is its known image."""
    problems = []
    for halo in _halos(known, widths_px):
        window = replace(plain.window, structure=joined(plain.window.structure, halo))
        problems.append(Problem(window, known.starts, known.background_e, known.motions))
    return problems


def _halos(flare: Solution, widths_px: Sequence[float]) -> list[Structure]:
    """Return the light that a wall close behind a source throws back around its flare, for some widths of it.

    A wall at a distance h behind an isotropic source is lit as (1 + ρ²/h²)^(-3/2), ρ from the foot of the
    source: seen from the front that is a halo of width f h / d, wider than the source's image by h / r. What
    is behind the source is not seen. A white wall throws back as much as twice the flare's own light, over a
    hemisphere. The second part is what another width changes.
    """
    box, sigma_px = flare.window.box, flare.psf_sigma_px
    (u_px, v_px, _), variance_px2 = flare.starts[0], sigma_px**2 + 1.0 / 12.0
    right2_px2 = (np.arange(box.left, box.left + box.width) - u_px) ** 2
    down2_px2 = (np.arange(box.top, box.top + box.height) - v_px) ** 2
    distance2_px2 = down2_px2[:, None] + right2_px2
    behind, (of_rows, of_columns), covered, covered2_px2 = _covered(flare)
    precision = np.diag([_HALO_SHARE**-2, _SHAPE_SHARE**-2]) / float(flare.flux_e[0]) ** 2
    halos = []
    for width_px in widths_px:
        # As seen through point spread and pixel: a sum of normal distributions, which are separable.
        own_px2 = width_px**2 / (2.0 * _RATES)
        seen_px2 = own_px2 + variance_px2
        across = np.exp(-0.5 * right2_px2 / seen_px2[:, None])
        down = np.exp(-0.5 * down2_px2 / seen_px2[:, None])
        height = _SHARES * own_px2 / seen_px2
        image = (down.T * height) @ across
        wider = (down.T * (2.0 * height * variance_px2 / seen_px2)) @ across
        wider += distance2_px2 * ((down.T * (height * own_px2 / seen_px2**2)) @ across)
        squared = covered2_px2 / width_px**2
        hidden = covered * (1.0 + squared) ** -1.5
        image[behind] -= of_rows @ hidden @ of_columns.T
        wider[behind] -= of_rows @ (3.0 * squared / (1.0 + squared) * hidden) @ of_columns.T
        columns = np.stack([image.ravel(), (wider - 2.0 * image).ravel()]) / (2.0 * np.pi * width_px**2)
        halos.append(any_of(columns, precision))
    return halos


def _covered(flare: Solution) -> tuple[tuple[slice, slice], tuple[Array, Array], Array, Array]:
    """Return where in a window a source hides what is behind it, and how much, on parts of pixels.

    The rows and columns; what share of the light of each part along an axis the pixels there get, shapes
    (pixels, parts); and for parts `_FINE` times finer than pixels what share of each is hidden, of the time
    where it moves, and the square of its distance from the middle of the flare.
    """
    from scipy.special import ndtr

    (u_px, v_px, _), box, radius_px = flare.starts[0], flare.window.box, float(flare.radius_at_rest_px[0])
    sigma_px = flare.psf_sigma_px
    reach_px = math.ceil(radius_px + 0.5 * flare.most_motion_px + 4.0 * sigma_px) + 1
    there, offsets_px, shares = [], [], []
    for at_px, first, count in ((v_px, box.top, box.height), (u_px, box.left, box.width)):
        middle = round(at_px) - first
        low = min(max(middle - reach_px, 0), count - 1)
        high = max(min(middle + reach_px + 1, count), low + 1)
        there.append(slice(low, high))
        parts = np.arange((middle - reach_px) * _FINE, (middle + reach_px + 1) * _FINE)
        parts_px = (parts + 0.5) / _FINE - 0.5
        borders = ndtr((np.arange(low, high + 1)[:, None] - 0.5 - parts_px) / sigma_px)
        shares.append((borders[1:] - borders[:-1]) / _FINE)
        offsets_px.append(first + parts_px - at_px)
    down, across = offsets_px[0][:, None], offsets_px[1]
    motions = [(0.0, 0.0)]
    if flare.motion_px is not None:
        motions = [tuple(share * flare.motion_px[0]) for share in np.linspace(-0.45, 0.45, _PLACES)]
    covered = np.zeros((down.size, across.size))
    for along_u, along_v in motions:
        inside_px = radius_px - np.hypot(across - along_u, down - along_v)
        covered += np.clip(inside_px * _FINE + 0.5, 0.0, 1.0) / len(motions)
    return (there[0], there[1]), (shares[0], shares[1]), covered, down**2 + across**2


@compiled
def halo_sigmas(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array, floor_e2: float,
    prnu: float, place: tuple[float, float], widths_px: Array, least: float,
) -> float:  # fmt: skip
    """Return by how many standard deviations light around a flare shows in what its fit leaves.

    Light that falls off as (1 + ρ²/w²)^(-3/2) from the flare's column and row in the window, `place`, for
    each width w; of it only what even ground, flux and place do not take up. Widths of which all shows by
    `least` or less are not looked at so closely; 0 where that is so of all. The rest is as for
    `goodness.left_over`.
    """
    rows, columns = image_e.shape
    weight, distance2, seen, count = np.empty(image_e.size), np.empty(image_e.size), np.empty(image_e.size), 0
    for row in range(rows):
        for column in range(columns):
            if state[row, column] == SEEN:
                weight[count] = 1.0 / math.sqrt(noise_e2(expected_e[row, column], floor_e2, prnu))
                seen[count] = weight[count] * (image_e[row, column] - expected_e[row, column])
                distance2[count] = (column - place[0]) ** 2 + (row - place[1]) ** 2
                count += 1
    halo, seen, taken_up, most = np.empty(count), seen[:count], np.empty((0, count)), 0.0
    for width in widths_px:
        for pixel in range(count):
            spread = 1.0 + distance2[pixel] / width**2
            halo[pixel] = weight[pixel] / (spread * math.sqrt(spread))
        power = dot(halo, halo)
        if not dot(halo, seen) > least * math.sqrt(power):
            continue
        if len(taken_up) == 0:
            taken_up = _taken_up(state, flares_e, weight[:count])
        _take_off(halo, taken_up, len(taken_up))
        left_power = dot(halo, halo)
        if left_power > LEAST_KNOWN * power:
            most = max(most, dot(halo, seen) / math.sqrt(left_power))
    return most


@compiled
def _taken_up(state: NDArray[np.uint8], flares_e: Array, weight: Array) -> Array:
    """Return what even ground, flux and place change in the pixels seen, orthogonal to each other, (4, n)."""
    (rows, columns), taken_up, at = state.shape, np.empty((4, len(weight))), 0
    for row in range(rows):
        for column in range(columns):
            if state[row, column] != SEEN:
                continue
            left, right = max(column - 1, 0), min(column + 1, columns - 1)
            above, below = max(row - 1, 0), min(row + 1, rows - 1)
            taken_up[0, at] = weight[at]
            taken_up[1, at] = weight[at] * flares_e[row, column]
            taken_up[2, at] = weight[at] * (flares_e[row, right] - flares_e[row, left])
            taken_up[3, at] = weight[at] * (flares_e[below, column] - flares_e[above, column])
            at += 1
    for one in range(1, len(taken_up)):
        _take_off(taken_up[one], taken_up, one)
    return taken_up


@compiled
def _take_off(one: Array, others: Array, count: int) -> None:
    """Take off what the first of some other columns, orthogonal to each other, can explain of one."""
    for other in range(count):
        column = others[other]
        power = dot(column, column)
        if power > 0.0:
            share = dot(column, one) / power
            for at in range(len(one)):
                one[at] -= share * column[at]
