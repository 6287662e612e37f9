"""Light that goes back to where it came from: coefficients of retroreflection, as standards state them.

CIE 54.2 and ASTM E810: of a sample of area A under the illuminance E⊥ (on a plane that faces the light) the
luminous intensity towards an observer is R_A E⊥ A. R_A depends on the observation angle α, between the
directions of light and observer, and on the entrance angle β, between light and normal.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FAINT = 0.01  # of the last stated coefficient: less than this is nothing
_MOST_ANGLE_RAD = math.radians(15.0)
_ALPHAS, _BETAS = 1024, 180
_ENTRANCES, _TURNS = 46, 16


@dataclass(frozen=True, eq=False)
class Coefficients:
    """R_A over observation and entrance angle, and what is assumed where no figure is stated.

    Between stated angles its logarithm is linear in both. Below the least of either it is held; beyond the
    largest observation angle it falls on as it did last, and ends where it is 1 % of the last; beyond the
    largest entrance angle it falls on likewise, and not slower than the cosines of both directions.

    Attributes
    ----------
    observation_rad, entrance_rad
        The stated angles, shape (m,) and (n,).
    values_cd_per_lx_m2
        Shape (m, n).
    """

    observation_rad: Array
    entrance_rad: Array
    values_cd_per_lx_m2: Array

    @property
    def end_rad(self) -> float:
        """The observation angle beyond which nothing goes back."""
        if len(self.observation_rad) == 1:
            return min(2.0 * float(self.observation_rad[0]), _MOST_ANGLE_RAD)
        steepness = -float(self._last_slopes().max())
        reach = -math.log(_FAINT) / max(steepness, 1e-9)
        return min(float(self.observation_rad[-1]) + reach, _MOST_ANGLE_RAD)

    def at(self, observation_rad: Array, entrance_rad: Array) -> Array:
        """Return R_A in cd/(lx m²), without the cosines' share of its fall, of broadcast angles."""
        alpha, beta = np.broadcast_arrays(observation_rad, entrance_rad)
        stated = np.log(self.values_cd_per_lx_m2)
        columns = np.stack([self._over_observation(alpha, column) for column in stated.T], axis=-1)
        place = np.interp(beta, self.entrance_rad, np.arange(len(self.entrance_rad)))
        low = np.minimum(place.astype(int), max(len(self.entrance_rad) - 2, 0))
        share = place - low
        high = np.minimum(low + 1, len(self.entrance_rad) - 1)
        first, second = (np.take_along_axis(columns, one[..., None], -1)[..., 0] for one in (low, high))
        value = first + share * (second - first)
        if len(self.entrance_rad) > 1:
            step = self.entrance_rad[-1] - self.entrance_rad[-2]
            slope = np.minimum((columns[..., -1] - columns[..., -2]) / step, 0.0)
            value = value + slope * np.maximum(beta - self.entrance_rad[-1], 0.0)
        return np.where(alpha < self.end_rad, np.exp(value), 0.0)

    def _over_observation(self, alpha: Array, column: Array) -> Array:
        value = np.interp(alpha, self.observation_rad, column)
        if len(self.observation_rad) == 1:
            return value
        slope = (column[-1] - column[-2]) / (self.observation_rad[-1] - self.observation_rad[-2])
        return np.asarray(value + slope * np.maximum(alpha - self.observation_rad[-1], 0.0))

    def _last_slopes(self) -> Array:
        last = np.log(self.values_cd_per_lx_m2[-2:])
        return np.asarray((last[1] - last[0]) / (self.observation_rad[-1] - self.observation_rad[-2]))


@dataclass(frozen=True, eq=False)
class Lobe:
    """A lobe back to the light, tabulated: R_A over α = end (i/N)² and β = i/M · 90°, shape (M + 1, N + 1).

    Beyond `roll_off_rad` of entrance the cosines of both directions lower it.
    """

    end_rad: float
    roll_off_rad: float
    values_cd_per_lx_m2: Array

    @property
    def observation_rad(self) -> Array:
        """The observation angles of the table."""
        count = self.values_cd_per_lx_m2.shape[1] - 1
        return np.asarray(self.end_rad * (np.arange(count + 1) / count) ** 2)


def lobe_of(coefficients: Coefficients) -> Lobe:
    """Return the table of a lobe."""
    alpha = coefficients.end_rad * (np.arange(_ALPHAS + 1) / _ALPHAS) ** 2
    beta = np.linspace(0.0, 0.5 * np.pi, _BETAS + 1)
    values = coefficients.at(alpha[None, :], beta[:, None])
    return Lobe(coefficients.end_rad, float(coefficients.entrance_rad[-1]), values)


def reflected_share(coefficients: Coefficients) -> float:
    """Return the largest share of light from any direction that goes back, its directional reflectance.

    Of a light at the angle θ_i to the normal, f = R_A min(1, cos θ_i cos θ_o / cos² β_last)/(cos θ_i cos θ_o)
    times cos θ_o is summed over the directions θ_o around it; β is the larger of both angles.
    """
    theta = np.linspace(0.0, math.radians(89.9), _ENTRANCES)[:, None, None]
    edges = coefficients.end_rad * (np.arange(129) / 128) ** 2
    alpha = 0.5 * (edges[1:] + edges[:-1])[None, :, None]
    turn = ((np.arange(_TURNS) + 0.5) / _TURNS * 2.0 * np.pi)[None, None, :]
    cos_in = np.cos(theta)
    cos_out = cos_in * np.cos(alpha) + np.sin(theta) * np.sin(alpha) * np.cos(turn)
    above = cos_out > 0.0
    cos_out = np.where(above, cos_out, 1.0)
    value = coefficients.at(alpha, np.maximum(theta, np.arccos(np.clip(cos_out, -1.0, 1.0))))
    last = math.cos(float(coefficients.entrance_rad[-1])) ** 2
    value = np.where(above, value * np.minimum(1.0, cos_in * cos_out / last) / cos_in, 0.0)
    solid = 2.0 * np.pi * np.diff(-np.cos(edges))[None, :]
    return float((value.mean(axis=2) * solid).sum(axis=1).max())


def check_coefficients(
    observation_rad: Sequence[float], entrance_rad: Sequence[float], rows: Sequence[Sequence[float]]
) -> None:
    """Raise ValueError where angles do not increase, or coefficients are not those of such angles."""
    for name, angles, most in (
        ("observation", observation_rad, 10.0),
        ("entrance", entrance_rad, 85.0),
    ):
        if not angles or any(b <= a for a, b in itertools.pairwise(angles)):
            raise ValueError(f"{name}: wanted increasing angles, such as '[0.2, 1] deg'")
        if not 0.0 <= angles[0] <= angles[-1] <= math.radians(most):
            raise ValueError(f"{name}: wanted angles from 0 to {most:g} deg")
    if entrance_rad[0] < observation_rad[-1]:
        raise ValueError(
            "entrance: the observer of ASTM E810 is between light and normal: wanted angles of at least "
            f"{math.degrees(observation_rad[-1]):g} deg, the largest of 'observation'; 5 deg is usual"
        )
    if observation_rad[0] <= 0.0 and len(observation_rad) == 1:
        raise ValueError("observation: one angle alone must be above 0; write such as '[0.2, 1] deg'")
    if len(rows) != len(observation_rad) or {len(row) for row in rows} != {len(entrance_rad)}:
        raise ValueError(
            f"coefficients: wanted {len(observation_rad)} rows of {len(entrance_rad)} values: one row for "
            "each observation angle, one value for each entrance angle"
        )
    if not all(0.0 < value <= 1e6 for row in rows for value in row):
        raise ValueError("coefficients: wanted numbers above 0 and at most 1e6 cd/(lx m²)")
    if any(low[k] <= high[k] for low, high in itertools.pairwise(rows) for k in range(len(entrance_rad))):
        raise ValueError(
            "coefficients: wanted values that fall with the observation angle: each row below the one before"
        )


def parse_rows(rows: Any) -> tuple[tuple[float, ...], ...]:
    """Read rows of numbers; raise ValueError where they are none."""
    if isinstance(rows, str) or not isinstance(rows, Sequence):
        raise ValueError("wanted a list of rows of numbers, such as [[330, 180], [25, 12]]")
    found = []
    for row in rows:
        if isinstance(row, str) or not isinstance(row, Sequence):
            raise ValueError("wanted each row as a list of numbers, such as [330, 180]")
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in row):
            raise ValueError("wanted numbers in each row, such as [330, 180]")
        try:
            found.append(tuple(float(value) for value in row))
        except OverflowError:
            raise ValueError("wanted numbers of at most 1e6 in each row, such as [330, 180]") from None
    return tuple(found)
