"""What pixels expect of spheres that hide parts of each other, or are partly behind an edge: compiled.

What is seen of each is laid out in pieces of rows (`model.discs.visible`); it changes where these end, with
the sphere whose limb that is, or the edge.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.discs.visible import EDGE, NO_LIMB, Seen
from perception.model.layout import Known, View
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.image import LEAST_STRIP
from perception.model.spread.shares import shares, strip_shares

Array = NDArray[np.float64]


@compiled
def add_seen(
    flux: Array, places: Array, along: float, seen: Seen, sigma_px: float, view: View, known: Known,
    expected: Array, jacobian: Array,
) -> None:  # fmt: skip
    """Add the light of spheres, some of them before others, to λ, and its derivatives.

    Parameters
    ----------
    flux, places
        Of each sphere, were it whole, and where it is, shapes (sources,) and (sources, 2).
    along
        By what part of its motion each is off its place, where they move.
    seen
        What is seen of each.
    sigma_px
        Width of the point spread.
    view, known
        The window, and what is known of the camera.
    expected, jacobian
        Shapes (pixels,) and (unknowns, pixels): added to. The unknowns are in the order of `layout.Layout`;
        where there is an edge its direction and how far it lies that way come last.
    """
    rows, columns = view.image_e.shape
    lit, slopes = expected.reshape(rows, columns), jacobian.reshape(-1, rows, columns)
    across, down = np.empty((4, whole_lanes(columns))), np.empty((3, whole_lanes(rows)))
    blur = blur_of(sigma_px, max(rows, columns))
    for piece in range(len(seen.disc)):
        disc, v_px = seen.disc[piece], seen.v_px[piece]
        top, bottom = shares(v_px - view.top, rows, blur, down)
        begin_px, end_px = seen.ends_px[piece]
        half_px, middle_px = 0.5 * (end_px - begin_px), 0.5 * (begin_px + end_px) - view.left
        if half_px > LEAST_STRIP * sigma_px:
            first, middle, last = seen.density[piece]
            # The parabola through all three, 1 + tilt t + bend (t² - 1/3) times its mean.
            mean = (first + 4.0 * middle + last) / 6.0
            shading = 0.5 * (last - first) / mean, (0.5 * (first + last) - middle) / mean
            left, right = strip_shares(middle_px, half_px, shading, 0.0, columns, blur, across)
            light_e = flux[disc] * 2.0 * half_px * mean
            _add_strip(
                light_e, disc, len(flux), known, down[:, top:bottom], across[:, left:right],
                lit[top:bottom, left:right], slopes[:, top:bottom, left:right],
            )  # fmt: skip
        for end in range(2):
            limb = seen.limb[piece, end]
            if limb == NO_LIMB:
                continue
            at_px = seen.ends_px[piece, end]
            edge_e = flux[disc] * seen.density[piece, 2 * end] * (2.0 * end - 1.0)
            left, right = shares(at_px - view.left, columns, blur, across)
            by_end = slopes[:, top:bottom, left:right]
            if limb == EDGE:
                cosine, sine = math.cos(seen.edge[2]), math.sin(seen.edge[2])
                beside_px = (v_px - seen.edge[1]) * cosine - (at_px - seen.edge[0]) * sine
                for row in range(bottom - top):
                    for column in range(right - left):
                        light = edge_e / cosine * down[0, top + row] * across[0, left + column]
                        by_end[-2, row, column] -= beside_px * light
                        by_end[-1, row, column] += light
                continue
            by_v = -edge_e * seen.slope[piece, end]
            grown = edge_e * (at_px - places[limb, 0]) + by_v * (v_px - places[limb, 1])
            _add_end(
                (edge_e, by_v, grown), along, limb, known, down[0, top:bottom], across[0, left:right], by_end
            )


@compiled
def _add_strip(
    light_e: float, disc: int, discs: int, known: Known, down: Array, across: Array, lit: Array, slopes: Array
) -> None:
    """Add the light of a strip, of a disc, to pixels that it reaches, and how it changes with no limb of it.

    With the width of the point spread, and as a larger image of as much flux is spread over more.
    """
    has_slack, moves = known.tie_spread > 0.0, known.motion_px > 0.0
    step = 3 + has_slack + 2 * moves
    for row in range(lit.shape[0]):
        light, wider = light_e * down[0, row], known.width_spread * light_e * down[2, row]
        for column in range(lit.shape[1]):
            lit[row, column] += light * across[0, column]
        if has_slack:
            for column in range(lit.shape[1]):
                slopes[disc * step + 3, row, column] -= 2.0 * known.tie_spread * light * across[0, column]
        if known.width_spread > 0.0:
            for column in range(lit.shape[1]):
                by_width = known.width_spread * light * across[2, column] + wider * across[0, column]
                slopes[discs * step, row, column] += by_width


@compiled
def _add_end(
    changes_e: tuple[float, float, float], along: float, limb: int, known: Known, down: Array, across: Array,
    slopes: Array,
) -> None:  # fmt: skip
    """Add how light at the end of a strip changes as the sphere whose limb it is goes aside, down, or grows.

    By so much in all, `changes_e`, of which pixels get their shares.
    """
    has_slack, moves = known.tie_spread > 0.0, known.motion_px > 0.0
    step = 3 + has_slack + 2 * moves
    own, (by_u, by_v, grown) = limb * step, changes_e
    for row in range(len(down)):
        for column in range(len(across)):
            share = down[row] * across[column]
            slopes[own, row, column] += by_u * share
            slopes[own + 1, row, column] += by_v * share
            slopes[own + 2, row, column] -= grown * share
            if has_slack:
                slopes[own + 3, row, column] += known.tie_spread * grown * share
            if moves:
                slopes[own + step - 2, row, column] += along * by_u * share
                slopes[own + step - 1, row, column] += along * by_v * share
