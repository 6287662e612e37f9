"""Nodes of a source's image, points and strips, become shares of its light in pixels."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import Sources
from perception.model.spread.edges import LANES, Blur, whole_lanes
from perception.model.spread.shares import shares, strip_shares

Array = NDArray[np.float64]

LEAST_STRIP = 3e-3
"""Half the length of what is no point, over the width of the point spread."""


@compiled
def spread_nodes(
    sources: Sources, source: int, place: tuple[float, float], growth: float, motion: tuple[float, float],
    blur: Blur, columns: int, image: Array,
) -> None:  # fmt: skip
    """Integrate one source's image over the pixels of a window.

    Parameters
    ----------
    sources, source, place
        Which one, and its column and row in the window.
    growth, motion
        Factor on the size for which it is laid out, and how far it moves along columns and rows during the
        exposure, evenly, half of it before `place`.
    blur, columns
        The point spread, made for as many pixels as the window has columns or rows; and its columns.
    image
        Zeros of shape (planes, rows, `whole_lanes(columns)`), to which is added: in one plane the share of
        its flux in each pixel; in four also that share's derivatives by column, row and ln size; in five also
        that by ln width of the point spread; in seven also those by both parts of its motion. What is beyond
        the columns does not count.
    """
    planes, rows, width = image.shape
    across, down = np.zeros((4, width)), np.empty((3, whole_lanes(rows)))
    # Indices without a sign: of others each would be asked whether it counts from the end.
    flat, size = image.reshape(-1), np.uint64(rows * width)
    for node in range(sources.first_node[source], sources.first_node[source + 1]):
        out_u, out_v = growth * sources.node_u_px[node], growth * sources.node_v_px[node]
        if not (math.isfinite(out_u) and math.isfinite(out_v)):
            continue
        along = sources.node_along[node]
        at_px, half_px = place[0] + (out_u + along * motion[0]), growth * sources.half_px[node]
        if half_px > LEAST_STRIP * blur.sigma_px:
            left, right = strip_shares(
                at_px, half_px, (sources.tilt[node], sources.bend[node]), out_u, columns, blur, across
            )
        else:
            left, right = shares(at_px, columns, blur, across)
            for column in range(width):
                across[3, column] = out_u * across[1, column]
        if left == right:
            continue
        top, bottom = shares(place[1] + (out_v + along * motion[1]), rows, blur, down)
        left = left // LANES * LANES
        lit = np.uint64(whole_lanes(right) - left)
        in_u, by_u, wider_u, larger_u = across[0, left:], across[1, left:], across[2, left:], across[3, left:]
        weight = sources.weight[node]
        for row in range(top, bottom):
            in_v, by_v, wider_v = weight * down[0, row], weight * down[1, row], weight * down[2, row]
            at = np.uint64(row * width + left)
            for column in range(lit):
                flat[at + column] += in_v * in_u[column]
            if planes == 1:
                continue
            at, larger_v = at + size, out_v * by_v
            for column in range(lit):
                flat[at + column] += in_v * by_u[column]
            at += size
            for column in range(lit):
                flat[at + column] += by_v * in_u[column]
            at += size
            for column in range(lit):
                flat[at + column] += in_v * larger_u[column] + larger_v * in_u[column]
            if planes == 4:
                continue
            at += size
            for column in range(lit):
                flat[at + column] += in_v * wider_u[column] + wider_v * in_u[column]
            if planes == 5:
                continue
            at, along_by_u, along_by_v = at + size, along * in_v, along * by_v
            for column in range(lit):
                flat[at + column] += along_by_u * by_u[column]
            at += size
            for column in range(lit):
                flat[at + column] += along_by_v * in_u[column]
