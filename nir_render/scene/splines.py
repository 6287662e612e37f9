"""A smooth way through knots: a cubic spline of positions, and one of angular velocity for orientations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STILL = 1e-6
"""Of an interval, how long one of no turn is: as small a share of the rate is left at an end."""


@dataclass(frozen=True, eq=False)
class Spline:
    """A way from one time to another; before and after it stands where it begins and ends."""

    begin_s: float
    end_s: float
    _positions: Any
    _rotations: Any

    def positions_m(self, times_s: Array) -> Array:
        """Return positions at times, shape (n,), shape (n, 3)."""
        return np.asarray(self._positions(np.clip(times_s, self.begin_s, self.end_s)))

    def rotations(self, times_s: Array) -> Array:
        """Return rotation matrices at times, shape (n,), shape (n, 3, 3)."""
        since_s = np.clip(times_s, self.begin_s, self.end_s) - self.begin_s
        return np.asarray(self._rotations(since_s).as_matrix())


def spline_of(times_s: Array, positions_m: Array, rotations: Array, *, rests: bool) -> Spline:
    """Return the spline through knots, shape (n,), (n, 3) and (n, 3, 3); one knot is a place to stand.

    Positions are twice continuously differentiable; `rests` makes the velocity 0 at both ends, else the
    acceleration is (a natural spline). Orientations have continuous angular acceleration (scipy's
    RotationSpline), and come to rest likewise: it begins and ends at the mean rate of its first and last
    interval, so one of no turn, far shorter than the others, is set before and after them.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(times_s) == 1:  # a knot between two holds, or a hold at an end
        times_s = np.array([times_s[0], times_s[0] + 1.0])
        positions_m, rotations = np.repeat(positions_m, 2, axis=0), np.repeat(rotations, 2, axis=0)
        end_s = float(times_s[0])
    else:
        end_s = float(times_s[-1])
    since_s, turned = times_s - times_s[0], rotations
    if rests:
        still_s = _STILL * np.diff(times_s)
        since_s = np.concatenate([[-still_s[0]], since_s, [since_s[-1] + still_s[-1]]])
        turned = np.concatenate([rotations[:1], rotations, rotations[-1:]])
    return Spline(
        float(times_s[0]),
        end_s,
        CubicSpline(times_s, positions_m, bc_type="clamped" if rests else "natural"),
        RotationSpline(since_s, Rotation.from_matrix(turned)),
    )


def along(splines: tuple[Spline, ...], times_s: Array) -> NDArray[np.int64]:
    """Return which spline holds at each time, shape (n,): the last that has begun, else the first."""
    begins_s = np.array([spline.begin_s for spline in splines])
    return np.maximum(np.searchsorted(begins_s, times_s, side="right") - 1, 0)
