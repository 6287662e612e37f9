"""How much fog lies on straight ways: within its box, and by its density over height."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.fog import Fog

Array = NDArray[np.float64]

_LEVEL = 1e-6  # of a profile's height: ways that rise less are level, and differences would lose their digits


@dataclass(frozen=True, eq=False)
class HeightProfile:
    """The density of fog over height, over that of its `extinction`: linear between points, even beyond.

    Attributes
    ----------
    height_m, density
        The points, shape (n,) each, n ≥ 2, heights increasing.
    """

    height_m: Array
    density: Array

    @cached_property
    def column_m(self) -> Array:
        """∫ of the density from the lowest point to each, shape (n,)."""
        steps_m = 0.5 * (self.density[1:] + self.density[:-1]) * np.diff(self.height_m)
        return np.concatenate([[0.0], np.cumsum(steps_m)])

    def at(self, height_m: Array) -> Array:
        """Return the density at heights."""
        return np.asarray(np.interp(height_m, self.height_m, self.density))

    def mean(self, low_m: Array, high_m: Array) -> Array:
        """Return the mean density between heights, in whichever order, same shape."""
        rise_m = high_m - low_m
        level = np.abs(rise_m) <= _LEVEL * (self.height_m[-1] - self.height_m[0])
        columns_m = self._column_to(high_m) - self._column_to(low_m)
        return np.where(level, self.at(0.5 * (low_m + high_m)), columns_m / np.where(level, 1.0, rise_m))

    def _column_to(self, height_m: Array) -> Array:
        within_m = np.clip(height_m, self.height_m[0], self.height_m[-1])
        cell = np.clip(np.searchsorted(self.height_m, within_m, "right") - 1, 0, len(self.height_m) - 2)
        step_m = within_m - self.height_m[cell]
        slope_per_m = np.diff(self.density) / np.diff(self.height_m)
        column_m = self.column_m[cell] + step_m * (self.density[cell] + 0.5 * slope_per_m[cell] * step_m)
        beyond = np.where(height_m < within_m, self.density[0], self.density[-1])
        return np.asarray(column_m + beyond * (height_m - within_m))


def height_profile(fog: Fog) -> HeightProfile | None:
    """Return the density of a fog over height, None where it is the same at every height."""
    if fog.profile is None:
        return None
    height_m, density = np.array(fog.profile).T
    return HeightProfile(height_m, density)


def optical_depth(fog: Fog, start_m: Array, direction: Array, length_m: Array) -> Array:
    """Return the optical depth of fog on straight ways, shape (n,).

    Parameters
    ----------
    start_m, direction
        Where ways begin and whereto they go, unit vectors, shape (n, 3) each.
    length_m
        Their lengths, shape (n,); may be infinite where the fog ends.
    """
    enter_m, leave_m = _within_box_m(start_m, direction, length_m, *fog.region_m())
    fog_m = np.maximum(leave_m - enter_m, 0.0)
    profile = height_profile(fog)
    if profile is None:
        return np.asarray(fog.extinction_per_m * fog_m)
    rises = (fog_m > 0.0) & (direction[:, 2] != 0.0)  # endless level ways have a height
    ends_m = [start_m[:, 2] + direction[:, 2] * np.where(rises, at_m, 0.0) for at_m in (enter_m, leave_m)]
    return np.asarray(fog.extinction_per_m * profile.mean(*ends_m) * fog_m)


def _within_box_m(
    start_m: Array, direction: Array, length_m: Array, low_m: Array, high_m: Array
) -> tuple[Array, Array]:
    """Return where along rays a box begins and ends, shape (n,) each; nowhere if the end is not beyond."""
    still = direction == 0.0
    outside = still & ((start_m < low_m) | (start_m > high_m))
    safe = np.where(still, 1.0, direction)
    one, other = (low_m - start_m) / safe, (high_m - start_m) / safe
    enter_m = np.where(still, -np.inf, np.minimum(one, other)).max(axis=1)
    leave_m = np.where(still, np.inf, np.maximum(one, other)).min(axis=1)
    enter_m = np.maximum(enter_m, 0.0)
    return enter_m, np.where(outside.any(axis=1), enter_m, np.minimum(leave_m, length_m))
