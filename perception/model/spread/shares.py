"""Shares of a point's and of a strip's light in the pixels of a row, and how they change, in closed form."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.spread.edges import LANES, REACH_SIGMAS, Blur, fall_at, whole_lanes

Array = NDArray[np.float64]


@compiled
def _reached(at_px: float, half_px: float, count: int, blur: Blur) -> tuple[int, int]:
    """Return the first pixel that a strip of half such a length reaches, the one after the last; or 0, 0."""
    reach_px = REACH_SIGMAS * blur.sigma_px + half_px
    if not (-reach_px - 0.5 < at_px < count - 0.5 + reach_px):
        return 0, 0
    return max(0, math.ceil(at_px - reach_px - 0.5)), min(count, math.floor(at_px + reach_px + 0.5) + 1)


@compiled
def shares(at_px: float, count: int, blur: Blur, into: Array) -> tuple[int, int]:
    """Spread a point along a row of pixels.

    Writes each pixel's share of a Gaussian, its derivative by place and that by ln σ, into rows 0, 1 and 2 of
    `into`, and returns the first pixel reached and the one after the last. `into` has room for
    `whole_lanes(count)` pixels; beside those reached some are written, too, from a whole number of `LANES` to
    another, with what falls there: nothing.
    """
    first, end = _reached(at_px, 0.0, count, blur)
    if first == end:
        return 0, 0
    left = first // LANES * LANES
    pixels = whole_lanes(end) - left
    begin = fall_at(at_px + 0.5, blur, left, pixels, 0)
    below, slope = blur.falls[0, begin:], blur.falls[1, begin:]
    share, by_place, wider = into[0, left:], into[1, left:], into[2, left:]
    per_variance, x = 1.0 / blur.sigma_px**2, left - 0.5 - at_px
    for pixel in range(pixels):
        share[pixel] = below[pixel + 1] - below[pixel]
    for pixel in range(pixels):
        by_place[pixel] = per_variance * (slope[pixel] - slope[pixel + 1])
    for pixel in range(pixels):
        wider[pixel] = per_variance * ((x + pixel) * slope[pixel] - (x + pixel + 1) * slope[pixel + 1])
    return first, end


@compiled
def strip_shares(
    at_px: float, half_px: float, shading: tuple[float, float], off_px: float, count: int, blur: Blur,
    into: Array,
) -> tuple[int, int]:  # fmt: skip
    """Spread a strip along a row of pixels, as `shares` does a point.

    Its light is 1 + a t + b (t² - 1/3) with `shading` (a, b), t from -1 at its left end to 1 at its right.
    Rows 0 to 2 of `into` become as there, row 3 the derivative by ln size as the strip and `off_px`, how far
    its middle lies from the point that it grows about, grow in proportion. Much shorter strips than the point
    spread is wide are to be even: their shading would be lost in differences.
    """
    first, end = _reached(at_px, half_px, count, blur)
    if first == end:
        return 0, 0
    left = first // LANES * LANES
    pixels = whole_lanes(end) - left
    begin_a = fall_at(at_px - half_px + 0.5, blur, left, pixels, 0)
    begin_b = fall_at(at_px + half_px + 0.5, blur, left, pixels, 1)
    below_a, slope_a = blur.falls[0, begin_a:], blur.falls[1, begin_a:]
    below_b, slope_b = blur.falls[2, begin_b:], blur.falls[3, begin_b:]
    h, h2, h3, variance = half_px, half_px**2, half_px**3, blur.sigma_px**2
    even, tilt, bend = 0.5 * (1.0 - shading[1] / 3.0) / h, 0.5 * shading[0] / h2, 0.5 * shading[1] / h3
    # From the strip's middle; u runs along it from -h to h. ∫ N(x - u) du and ∫ u N du, by parts; ∫ Φ du; σ²
    # times the slope of the first. ∫ uⁿ⁺¹ N du = x ∫ uⁿ N du + σ² times the slope of that; ∫ uⁿ Φ du by
    # parts. Each sum has a loop of its own, which the processor makes at many edges at once.
    x_left, sums, edges = left - 0.5 - at_px, blur.sums, pixels + 1
    for edge in range(edges):
        x = x_left + edge
        zeroth, ends = below_a[edge] - below_b[edge], slope_a[edge] - slope_b[edge]
        first_moment = x * zeroth + ends
        second_moment = x * first_moment + (variance * zeroth - h * (slope_a[edge] + slope_b[edge]))
        third_moment = x * second_moment + (2.0 * variance * first_moment + h2 * ends)
        below = below_a[edge] + below_b[edge]
        sums[edge] = (
            even * (h * below + first_moment)
            + 0.5 * tilt * (second_moment - h2 * zeroth)
            + bend / 3.0 * (h3 * below + third_moment)
        )
    share = into[0, left:]
    for pixel in range(pixels):
        share[pixel] = sums[pixel + 1] - sums[pixel]
    for edge in range(edges):
        zeroth, ends = below_a[edge] - below_b[edge], slope_a[edge] - slope_b[edge]
        slope_1 = variance * zeroth - h * (slope_a[edge] + slope_b[edge])
        slope_2 = 2.0 * variance * ((x_left + edge) * zeroth + ends) + h2 * ends
        sums[edge] = even * ends + tilt * slope_1 + bend * slope_2
    wider = into[2, left:]
    for pixel in range(pixels):
        wider[pixel] = sums[pixel + 1] - sums[pixel]
    for edge in range(edges):
        x = x_left + edge
        zeroth, ends = below_a[edge] - below_b[edge], slope_a[edge] - slope_b[edge]
        first_moment = x * zeroth + ends
        second_moment = x * first_moment + (variance * zeroth - h * (slope_a[edge] + slope_b[edge]))
        sums[edge] = even * zeroth + tilt * first_moment + bend * second_moment
    by_place = into[1, left:]
    for pixel in range(pixels):
        by_place[pixel] = sums[pixel] - sums[pixel + 1]
    for edge in range(edges):
        x = x_left + edge
        zeroth, ends = below_a[edge] - below_b[edge], slope_a[edge] - slope_b[edge]
        first_moment = x * zeroth + ends
        second_moment = x * first_moment + (variance * zeroth - h * (slope_a[edge] + slope_b[edge]))
        third_moment = x * second_moment + (2.0 * variance * first_moment + h2 * ends)
        sums[edge] = even * first_moment + tilt * second_moment + bend * third_moment + off_px * sums[edge]
    larger = into[3, left:]
    for pixel in range(pixels):
        larger[pixel] = sums[pixel] - sums[pixel + 1]
    return first, end
