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
from perception.model.normal import shares, strip_shares
from perception.model.spread import LEAST_STRIP

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
    has_slack, moves, tie = known.tie_spread > 0.0, known.motion_px > 0.0, known.tie_spread
    step = 3 + has_slack + 2 * moves
    width = len(flux) * step
    rows, columns = view.image_e.shape
    lit, slopes = expected.reshape(rows, columns), jacobian.reshape(-1, rows, columns)
    across, down = np.empty((4, columns)), np.empty((3, rows))
    for piece in range(len(seen.disc)):
        disc, v_px = seen.disc[piece], seen.v_px[piece]
        begin_px, end_px = seen.ends_px[piece]
        top, bottom = shares(v_px - view.top, rows, sigma_px, down)
        half_px, middle_px = 0.5 * (end_px - begin_px), 0.5 * (begin_px + end_px) - view.left
        if half_px > LEAST_STRIP * sigma_px:
            first, middle, last = seen.density[piece]
            # The parabola through all three, 1 + tilt t + bend (t² - 1/3) times its mean.
            mean = (first + 4.0 * middle + last) / 6.0
            shading = 0.5 * (last - first) / mean, (0.5 * (first + last) - middle) / mean
            left, right = strip_shares(middle_px, half_px, shading, 0.0, columns, sigma_px, across)
            light_e = flux[disc] * 2.0 * half_px * mean
            for row in range(top, bottom):
                light, wider = light_e * down[0, row], known.width_spread * light_e * down[2, row]
                for column in range(left, right):
                    lit[row, column] += light * across[0, column]
                if has_slack:
                    # Of a larger image of as much flux light is spread over more, and changes at its limb.
                    for column in range(left, right):
                        slopes[disc * step + 3, row, column] -= 2.0 * tie * light * across[0, column]
                if known.width_spread > 0.0:
                    for column in range(left, right):
                        by_width = known.width_spread * light * across[2, column] + wider * across[0, column]
                        slopes[width, row, column] += by_width
        for end in range(2):
            limb = seen.limb[piece, end]
            if limb == NO_LIMB:
                continue
            at_px = seen.ends_px[piece, end]
            by_u = flux[disc] * seen.density[piece, 2 * end] * (2.0 * end - 1.0)
            left, right = shares(at_px - view.left, columns, sigma_px, across)
            if limb == EDGE:
                cosine, sine = math.cos(seen.edge[2]), math.sin(seen.edge[2])
                beside_px = (v_px - seen.edge[1]) * cosine - (at_px - seen.edge[0]) * sine
                for row in range(top, bottom):
                    for column in range(left, right):
                        light = by_u / cosine * down[0, row] * across[0, column]
                        slopes[-2, row, column] -= beside_px * light
                        slopes[-1, row, column] += light
                continue
            # The limb's place on the row, as its sphere goes aside, down, or grows.
            own = limb * step
            by_v = -by_u * seen.slope[piece, end]
            grown = by_u * (at_px - places[limb, 0]) + by_v * (v_px - places[limb, 1])
            for row in range(top, bottom):
                for column in range(left, right):
                    share = down[0, row] * across[0, column]
                    slopes[own, row, column] += by_u * share
                    slopes[own + 1, row, column] += by_v * share
                    slopes[own + 2, row, column] -= grown * share
                    if has_slack:
                        slopes[own + 3, row, column] += tie * grown * share
                    if moves:
                        slopes[own + step - 2, row, column] += along * by_u * share
                        slopes[own + step - 1, row, column] += along * by_v * share
