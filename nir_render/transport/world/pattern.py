"""Emission patterns as tables: relative radiant intensity over the directions of a source."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.scene.documents.emitters import PatternDocument, Source

Array = NDArray[np.float64]

_POLAR_STEPS = 180
_AZIMUTH_STEPS = 360


@dataclass(frozen=True, eq=False)
class Pattern:
    """Relative intensity 4π I(ω)/Φ, bilinear in the angles between the points of an even grid.

    `values` has shape (n_polar, n_azimuth): polar angle from 0 to π inclusive, azimuth from 0 on, periodic
    over 2π; one column where it is the same all around. Its mean over the sphere is 1.
    """

    values: Array


def pattern_of(source: Source) -> Pattern | None:
    """Return a source's pattern in steps of 1 deg; None where it shines the same in all directions.

    Raises
    ------
    InputError
        The pattern is so narrow that it falls between the steps.
    """
    if source.pattern is None:
        return None
    values = _sampled(source.pattern)
    mean = float(_polar_weights(len(values)) @ values.mean(axis=1))
    if mean <= 0.0:
        raise InputError("an emission pattern is 0 at every whole degree; widen it to more than 1 deg")
    return Pattern(values / mean)


def relative_intensity(pattern: Pattern, direction: Array) -> Array:
    """Return 4π I/Φ in unit directions of the source's own axes, shape (…, 3) → (…)."""
    polar_steps, columns = len(pattern.values) - 1, pattern.values.shape[1]
    polar_rad = np.arctan2(np.hypot(direction[..., 0], direction[..., 1]), direction[..., 2])
    row, down = _cell(polar_rad / np.pi * polar_steps, polar_steps)
    turn = np.arctan2(direction[..., 1], direction[..., 0]) / (2.0 * np.pi) % 1.0
    column, across = _cell(turn * columns, columns)
    left, right = column, (column + 1) % columns
    upper = (1.0 - across) * pattern.values[row, left] + across * pattern.values[row, right]
    lower = (1.0 - across) * pattern.values[row + 1, left] + across * pattern.values[row + 1, right]
    return np.asarray((1.0 - down) * upper + down * lower)


def _cell(place: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    """Return the cell of a place on an axis of `count` cells, and how far within it."""
    cell = np.clip(np.floor(place).astype(np.int64), 0, count - 1)
    return cell, place - cell


def _polar_weights(count: int) -> Array:
    """Return weights of rows at even polar angles: the mean over the sphere of what is linear between them.

    ½ ∫ hat(θ) sin θ dθ: sin θ_i (1 − cos h)/h within, ½ (1 − sin h / h) at the poles; the sum is 1.
    """
    step_rad = np.pi / (count - 1)
    weights = np.sin(step_rad * np.arange(count)) * 2.0 * np.sin(0.5 * step_rad) ** 2 / step_rad
    weights[[0, -1]] = 0.5 * (1.0 - np.sin(step_rad) / step_rad)
    return np.asarray(weights)


def _sampled(document: PatternDocument) -> Array:
    """Return a document's values on the even grid, linear between its own points."""
    even_rad = np.linspace(0.0, np.pi, _POLAR_STEPS + 1)
    if document.points is not None:
        polar_rad, value = np.array(document.points).T
        return np.asarray(np.interp(even_rad, polar_rad, value)[:, None])
    grid = document.grid
    assert grid is not None  # the model admits no third form
    turn_rad = 2.0 * np.pi * np.arange(_AZIMUTH_STEPS) / _AZIMUTH_STEPS
    around = np.stack([np.interp(turn_rad, grid.azimuth_rad, row, period=2.0 * np.pi) for row in grid.values])
    around[[0, -1]] = around[[0, -1]].mean(axis=1, keepdims=True)  # there all azimuths are one direction
    polar_rad = np.array(grid.polar_rad)
    return np.stack([np.interp(even_rad, polar_rad, column) for column in around.T], axis=1)
