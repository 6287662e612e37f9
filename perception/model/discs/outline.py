"""The outline of a source's image: the rim of a cap of directions, through the lens, as Fourier series."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.discs.nodes import across_and_down

Array = NDArray[np.float64]

HARMONICS = 7
AROUND = 2 * HARMONICS + 2  # points of an outline
_STEPS, _SETTLED = 40, 1e-5  # Newton's, in rad: of the last one its square is left
_LEFT_OUT = 1e-5  # of an outline's radius: how large its last harmonic may be
# Of each harmonic at each of the points.
_TURNS = 2.0 * math.pi / AROUND * (np.outer(np.arange(1 + HARMONICS), np.arange(AROUND)) % AROUND)
_COSINES: Array = np.cos(_TURNS, dtype=np.float64)
_SINES: Array = np.sin(_TURNS, dtype=np.float64)


@compiled
def rims_of(direction: Array, angular_radius_rad: Array) -> tuple[Array, Array, Array]:
    """Return directions around each cap's rim, shape (caps, `AROUND`, 3), and `across_and_down` of it."""
    caps = len(direction)
    rims, across, down = np.empty((caps, AROUND, 3)), np.empty((caps, 3)), np.empty((caps, 3))
    for cap in range(caps):
        across[cap], down[cap] = across_and_down(direction[cap, 0], direction[cap, 1], direction[cap, 2])
        cosine, sine = math.cos(angular_radius_rad[cap]), math.sin(angular_radius_rad[cap])
        for at in range(AROUND):
            for axis in range(3):
                aside = _COSINES[1, at] * across[cap, axis] + _SINES[1, at] * down[cap, axis]
                rims[cap, at, axis] = cosine * direction[cap, axis] + sine * aside
    return rims, across, down


@compiled
def series_of(values: Array) -> Array:
    """Return the Fourier series through values around a circle: cosines and sines, (1 + harmonics, 2)."""
    series = np.zeros((1 + HARMONICS, 2))
    for harmonic in range(1 + HARMONICS):
        for at in range(AROUND):
            series[harmonic, 0] += values[at] * _COSINES[harmonic, at] * 2.0 / AROUND
            series[harmonic, 1] += values[at] * _SINES[harmonic, at] * 2.0 / AROUND
    series[0] *= 0.5
    return series


@compiled
def outline_of(outline_px: Array) -> tuple[Array, Array, float, float]:
    """Return u and v of an outline, shape (`AROUND`, 2), as series, and where it is highest and lowest.

    NaN are both angles of an outline that so few harmonics do not make.
    """
    of_u, of_v = series_of(outline_px[:, 0]), series_of(outline_px[:, 1])
    last = np.abs(of_u[HARMONICS]).max() + np.abs(of_v[HARMONICS]).max()
    if not last <= _LEFT_OUT * np.abs(of_v[1]).max():
        return of_u, of_v, math.nan, math.nan
    lowest = extreme(of_v, math.atan2(of_v[1, 1], of_v[1, 0]))
    return of_u, of_v, extreme(of_v, math.atan2(-of_v[1, 1], -of_v[1, 0])), lowest


@compiled
def value_at(series: Array, turn: float) -> tuple[float, float, float]:
    """Return the value of a Fourier series at an angle, and its first two derivatives."""
    cosine, sine, c, s = math.cos(turn), math.sin(turn), 1.0, 0.0
    value, slope, bend = series[0, 0], 0.0, 0.0
    for harmonic in range(1, 1 + HARMONICS):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        here = series[harmonic, 0] * c + series[harmonic, 1] * s
        value += here
        slope += harmonic * (series[harmonic, 1] * c - series[harmonic, 0] * s)
        bend -= harmonic**2 * here
    return value, slope, bend


@compiled
def extreme(series: Array, turn: float) -> float:
    """Return the angle of an extreme of a Fourier series near to one; NaN if there is none."""
    for _ in range(_STEPS):
        _, slope, bend = value_at(series, turn)
        step = slope / bend
        turn -= step
        if abs(step) < _SETTLED:
            return turn
    return math.nan


@compiled
def crossing(series: Array, level: float, above: float, below: float, turn: float) -> float:
    """Return the angle at which a Fourier series falls through a level, between one above it and one below.

    By Newton's steps, halving where these leave what is left between; NaN if there is none.
    """
    for _ in range(_STEPS):
        value, slope, _ = value_at(series, turn)
        if value > level:
            above = turn
        else:
            below = turn
        step = (value - level) / slope
        if not min(above, below) <= turn - step <= max(above, below):
            step = turn - 0.5 * (above + below)
        turn -= step
        if abs(step) < _SETTLED:
            return turn
    return math.nan
