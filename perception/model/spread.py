"""Nodes of a source's image, points and strips, become shares of its light in pixels."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import Sources
from perception.model.normal import shares, strip_shares

Array = NDArray[np.float64]

LEAST_STRIP = 3e-3
"""Half the length of what is no point, over the width of the point spread."""


@compiled
def spread_nodes(
    sources: Sources, source: int, place: tuple[float, float], growth: float, motion: tuple[float, float],
    sigma_px: float, image: Array,
) -> None:  # fmt: skip
    """Integrate one source's image over the pixels of a window.

    Parameters
    ----------
    sources, source, place
        Which one, and its column and row in the window.
    growth, motion
        Factor on the size for which it is laid out, and how far it moves along columns and rows during the
        exposure, evenly, half of it before `place`.
    sigma_px
        Width of the point spread.
    image
        Zeros of shape (1, 5 or 7, rows, columns): the share of its flux in each pixel is added, and that
        share's derivatives by column, row, ln size and ln width of the point spread, and by both parts of its
        motion.
    """
    planes, rows, columns = image.shape
    across, down = np.empty((4, columns)), np.empty((3, rows))
    for node in range(sources.first_node[source], sources.first_node[source + 1]):
        out_u, out_v = growth * sources.node_u_px[node], growth * sources.node_v_px[node]
        if not (math.isfinite(out_u) and math.isfinite(out_v)):
            continue
        along = sources.node_along[node]
        at_px, half_px = place[0] + (out_u + along * motion[0]), growth * sources.half_px[node]
        if half_px > LEAST_STRIP * sigma_px:
            left, right = strip_shares(
                at_px, half_px, (sources.tilt[node], sources.bend[node]), out_u, columns, sigma_px, across
            )
        else:
            left, right = shares(at_px, columns, sigma_px, across)
            for column in range(left, right):
                across[3, column] = out_u * across[1, column]
        top, bottom = shares(place[1] + (out_v + along * motion[1]), rows, sigma_px, down)
        weight = sources.weight[node]
        in_u, by_u = across[0, left:right], across[1, left:right]
        wider_u, larger_u = across[2, left:right], across[3, left:right]
        for row in range(top, bottom):
            in_v, by_v, wider_v = weight * down[0, row], weight * down[1, row], weight * down[2, row]
            line = image[:, row, left:right]
            if planes == 1:
                for column in range(right - left):
                    line[0, column] += in_v * in_u[column]
                continue
            for column in range(right - left):
                by_u_here, by_v_here = in_v * by_u[column], by_v * in_u[column]
                line[0, column] += in_v * in_u[column]
                line[1, column] += by_u_here
                line[2, column] += by_v_here
                line[3, column] += in_v * larger_u[column] + out_v * by_v_here
                line[4, column] += in_v * wider_u[column] + wider_v * in_u[column]
                if planes == 7:
                    line[5, column] += along * by_u_here
                    line[6, column] += along * by_v_here
