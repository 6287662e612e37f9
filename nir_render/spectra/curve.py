"""Sampled curves over wavelength that know where they hold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nir_render.errors import InputError


@dataclass(frozen=True, eq=False)
class Curve:
    """A piecewise linear curve over wavelength, valid between its first and last sample only.

    `wavelength_m` increases, shape (n,); `value`, shape (n,); `name` is what errors call the curve.
    """

    wavelength_m: NDArray[np.float64]
    value: NDArray[np.float64]
    name: str

    @property
    def low_m(self) -> float:
        """Shortest wavelength of the curve."""
        return float(self.wavelength_m[0])

    @property
    def high_m(self) -> float:
        """Longest wavelength of the curve."""
        return float(self.wavelength_m[-1])

    def range_nm(self) -> str:
        """Return the range that the curve covers, as text."""
        return range_nm(self.low_m, self.high_m)

    def __call__(self, wavelength_m: ArrayLike) -> NDArray[np.float64]:
        """Return the curve at wavelengths of any shape.

        Raises
        ------
        InputError
            A wavelength lies outside the range that the curve covers: data are never extrapolated.
        """
        asked = np.asarray(wavelength_m, dtype=np.float64)
        slack_m = 1e-15
        if asked.min() < self.low_m - slack_m or asked.max() > self.high_m + slack_m:
            raise InputError(
                f"{self.name} covers {self.range_nm()}, but is needed from "
                f"{asked.min() * 1e9:.4g} to {asked.max() * 1e9:.4g} nm; give data for the whole range"
            )
        return np.interp(asked, self.wavelength_m, self.value)

    def integral(self) -> float:
        """Return the integral over the curve's range, per metre of wavelength."""
        return float(np.trapezoid(self.value, self.wavelength_m))

    def normalised(self) -> "Curve":
        """Return the curve scaled to an integral of 1."""
        total = self.integral()
        if total <= 0:
            raise InputError(f"{self.name} is zero everywhere")
        return Curve(self.wavelength_m, self.value / total, self.name)


def curve_from_points(points: tuple[tuple[float, float], ...], name: str) -> Curve:
    """Return the curve through (wavelength_m, value) points."""
    wavelength_m, value = np.array(points, dtype=np.float64).T
    return Curve(wavelength_m, value, name)


def range_nm(low_m: float, high_m: float) -> str:
    """Return a range of wavelengths as text."""
    return f"{low_m * 1e9:.4g} to {high_m * 1e9:.4g} nm"


def constant_curve(value: float, low_m: float, high_m: float, name: str) -> Curve:
    """Return a curve that has one value from `low_m` to `high_m`."""
    return Curve(np.array([low_m, high_m]), np.array([value, value]), name)
