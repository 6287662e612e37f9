"""A radial function under unlike pixels, rows and columns, fitted as a mixed model.

z = f(θ) (1 + ρ_row + κ_column + ε_pixel) + f(θ) (a x + b y) + noise. f is a cubic spline in θ²; ρ, κ and ε
are normal, of variances that the residuals show (analysis of variance); a and b are a tilt. The normal
equations are Henderson's (Biometrics 31, 423, 1975): rows are eliminated, columns solved for beside f.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_INTERVALS = 9
_DEGREE = 3
_TILTS = 2
_PASSES = 3
_BAND_ROWS = 64
_LEAST_VARIANCE = 1e-14
_DEFECT_SIGMAS = 6.0


@dataclass(frozen=True)
class Spreads:
    """Variances of pixels, rows and columns, and the σ of the root of their sum."""

    pixels: float = 0.0
    rows: float = 0.0
    columns: float = 0.0
    root_sigma: float = 0.0

    @property
    def total(self) -> float:
        """Variance over all pixels."""
        return self.pixels + self.rows + self.columns


@dataclass(frozen=True, eq=False)
class RadialFit:
    """The fit: the spline's coefficients and their covariance, the pixels' spread, the tilt, the residuals.

    `left` is what is left of the frame over f, tilt taken off, `noise` its variance in each pixel, `kept` the
    pixels that count, shape (rows, columns).
    """

    last_rad: float
    coefficients: Array
    covariance: Array
    spreads: Spreads
    tilt: float
    left: Array
    noise: Array
    kept: NDArray[np.bool_]

    def at(self, angle_rad: Array) -> Array:
        """Return f at angles of any shape."""
        return _radial(self.coefficients, angle_rad, self.last_rad)

    def relative(self, angle_rad: Array) -> Array:
        """Return f relative to the axis at angles, shape (n,)."""
        return np.asarray(self.at(angle_rad) / self.at(np.zeros(1)))

    def relative_sigma(self, angle_rad: Array) -> Array:
        """Return the σ of `relative`, shape (n,)."""
        basis = _basis(np.append(angle_rad, 0.0), self.last_rad)
        on_axis = float(basis[-1] @ self.coefficients)
        slope = (basis[:-1] - self.relative(angle_rad)[:, None] * basis[-1]) / on_axis
        return np.asarray(np.sqrt(np.maximum(((slope @ self.covariance) * slope).sum(axis=1), 0.0)))

    @property
    def axis_sigma(self) -> float:
        """Relative σ of f on the axis: by it the mean of those pixels passes for another than that of all."""
        basis = _basis(np.zeros(1), self.last_rad)[0]
        return math.sqrt(float(basis @ self.covariance @ basis)) / float(basis @ self.coefficients)

    def pixel_response(self) -> tuple[Array, float]:
        """Return 1 + ρ + κ + ε of each pixel as far as the frame tells, and the spread of what it does not.

        The best linear prediction: a mean counts as far as its own variance goes beyond that of its noise.
        Pixels that were left out are taken as any other of their row and column.
        """
        pixels, left = self.spreads.pixels, self.left
        weight = self.kept / (pixels + self.noise)
        of_row, of_column = np.zeros((left.shape[0], 1)), np.zeros((1, left.shape[1]))
        row_precision, column_precision = (
            1.0 / max(one, _LEAST_VARIANCE) for one in (self.spreads.rows, self.spreads.columns)
        )
        for _ in range(_PASSES):
            free = weight * (left - of_column)
            of_row = free.sum(axis=1, keepdims=True) / (weight.sum(axis=1, keepdims=True) + row_precision)
            free = weight * (left - of_row)
            of_column = free.sum(axis=0, keepdims=True) / (
                weight.sum(axis=0, keepdims=True) + column_precision
            )
        shown = self.kept * pixels / (pixels + self.noise)
        response = 1.0 + of_row + of_column + shown * (left - of_row - of_column)
        return response, math.sqrt(float(np.mean(((1.0 - shown) * pixels)[self.kept])))


def fit_radial(
    ratio: Array,
    electrons: Array,
    angle_rad: Array,
    usable: NDArray[np.bool_],
    floor_e2: float,
    like: RadialFit | None = None,
) -> RadialFit:
    """Fit a radial function to a frame.

    Parameters
    ----------
    ratio
        z, shape (rows, columns).
    electrons
        How many a ratio of 1 stands for, same shape: so much shot noise it has.
    angle_rad
        θ of each pixel.
    usable
        Pixels that count; those that stand out by more than 6 σ are left out besides.
    floor_e2
        Variance of the electrons of a dark pixel.
    like
        A fit to much the same frame: one pass from there is enough.
    """
    last_rad = float(angle_rad[usable].max())
    kept, spreads = usable, Spreads()
    shape = np.full(ratio.shape, float(np.median(ratio[usable])))
    if like is not None:
        spreads, shape = like.spreads, like.at(angle_rad)
    for _ in range(_PASSES if like is None else 1):
        expected_e = shape * electrons
        noise = np.where(usable, (expected_e + floor_e2) / expected_e**2, 1.0)
        weight = kept / (shape**2 * (spreads.pixels + noise))
        values, covariance = _solution(ratio, shape, weight, angle_rad, last_rad, spreads)
        coefficients = values[:-_TILTS]
        shape = np.maximum(_radial(coefficients, angle_rad, last_rad), 1e-12)
        left = ratio / shape - 1.0
        left -= values[-2] * _across(ratio.shape[1]) + values[-1] * _across(ratio.shape[0])[:, None]
        spreads = _spreads(left, kept, noise)
        kept = usable & (np.abs(left) < _DEFECT_SIGMAS * np.sqrt(spreads.total + noise))
    tilt = math.hypot(*values[-_TILTS:].tolist())
    of_radial = covariance[:-_TILTS, :-_TILTS]
    return RadialFit(last_rad, coefficients, of_radial, spreads, tilt, left, noise, kept)


def _radial(coefficients: Array, angle_rad: Array, last_rad: float) -> Array:
    """Return f at angles of any shape."""
    from scipy.interpolate import BSpline

    place = np.clip(angle_rad / last_rad, 0.0, 1.0) ** 2
    return np.asarray(BSpline(_knots(), coefficients, _DEGREE)(place))


def _knots() -> Array:
    return np.concatenate([np.zeros(_DEGREE), np.linspace(0.0, 1.0, _INTERVALS + 1), np.ones(_DEGREE)])


def _basis(angle_rad: Array, last_rad: float) -> Array:
    """Return the splines at angles, shape (n, splines)."""
    from scipy.interpolate import BSpline

    place = np.clip(angle_rad / last_rad, 0.0, 1.0) ** 2
    return np.asarray(BSpline.design_matrix(place, _knots(), _DEGREE).toarray())


def _across(pixels: int) -> Array:
    """Return places along an axis, from −½ to ½."""
    return np.linspace(-0.5, 0.5, pixels)


def _fixed(shape: Array, angle_rad: Array, last_rad: float) -> Iterator[tuple[slice, Array]]:
    """Yield bands of rows, and what f and tilt are made of there, shape (unknowns, rows, columns)."""
    rows, columns = shape.shape
    for top in range(0, rows, _BAND_ROWS):
        band = slice(top, min(top + _BAND_ROWS, rows))
        splines = _basis(angle_rad[band].ravel(), last_rad).T.reshape(-1, *shape[band].shape)
        tilts = shape[band] * np.stack([
            np.broadcast_to(_across(columns), shape[band].shape),
            np.broadcast_to(_across(rows)[band, None], shape[band].shape),
        ])  # fmt: skip
        yield band, np.concatenate([splines, tilts])


def _solution(
    ratio: Array, shape: Array, weight: Array, angle_rad: Array, last_rad: float, spreads: Spreads
) -> tuple[Array, Array]:
    """Return f's coefficients and the tilts, and their covariance."""
    rows, columns = ratio.shape
    count = _INTERVALS + _DEGREE + _TILTS
    own, slope = np.zeros((count, count)), np.zeros(count)
    by_row, by_column = np.zeros((count, rows)), np.zeros((count, columns))
    for band, parts in _fixed(shape, angle_rad, last_rad):
        flat, of_band = parts.reshape(count, -1), weight[band]
        own += (flat * of_band.ravel()) @ flat.T
        slope += flat @ (of_band * ratio[band]).ravel()
        weighted = parts * (of_band * shape[band])
        by_row[:, band] = weighted.sum(axis=2)
        by_column += weighted.sum(axis=1)
    both = weight * shape**2
    seen = weight * shape * ratio
    of_row = both.sum(axis=1) + 1.0 / max(spreads.rows, _LEAST_VARIANCE)
    of_column = both.sum(axis=0) + 1.0 / max(spreads.columns, _LEAST_VARIANCE)
    # Rows are told apart by columns alone, so their block is diagonal: it is eliminated.
    matrix = np.block([[own, by_column], [by_column.T, np.diag(of_column)]])
    mixed = np.concatenate([by_row, both.T])
    matrix -= (mixed / of_row) @ mixed.T
    right = np.concatenate([slope, seen.sum(axis=0)]) - mixed @ (seen.sum(axis=1) / of_row)
    scale = 1.0 / np.sqrt(np.diagonal(matrix))
    wanted = np.zeros((len(scale), count + 1))
    wanted[:count, :count] = np.diag(scale[:count])
    wanted[:, count] = scale * right
    solved = scale[:, None] * np.linalg.solve(matrix * np.outer(scale, scale), wanted)
    return solved[:count, count], solved[:count, :count]


def _spreads(left: Array, kept: NDArray[np.bool_], noise: Array) -> Spreads:
    """Return the variances of pixels, rows and columns that residuals show, less those of their noise."""
    of_noise, total = float(noise[kept].mean()), float(np.var(left[kept]))
    lines = []
    for axis in (1, 0):
        counts = kept.sum(axis=axis)
        full = counts > 0
        means = np.where(kept, left, 0.0).sum(axis=axis)[full] / counts[full]
        lines.append((float(np.var(means)), float(np.mean(1.0 / counts[full])), int(full.sum())))
    rows = columns = 0.0
    for _ in range(3):
        # A row's mean holds its own effect, and what pixels, noise and columns leave in the mean.
        rows = max(lines[0][0] - (total - rows) * lines[0][1], 0.0)
        columns = max(lines[1][0] - (total - columns) * lines[1][1], 0.0)
    pixels = max(total - of_noise - rows - columns, 0.0)
    of_sum = math.sqrt(
        2.0 * (total**2 / max(int(kept.sum()), 1) + rows**2 / lines[0][2] + columns**2 / lines[1][2])
    )
    root = math.sqrt(pixels + rows + columns)
    return Spreads(pixels, rows, columns, 0.5 * of_sum / root if root > 0.0 else 0.0)
