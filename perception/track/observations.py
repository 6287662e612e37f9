"""Measurements of a set as arrays in the observer's odometry frame, and what they say beyond predictions."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.odometry import Poses
from perception.track.kalman import Innovations, States
from perception.track.settings import TrackerSettings
from perception.types import Measurement, bearing_axes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

NO_RANGE_M = 1e3
"""Standard deviation of a range that is not known."""

LEAST_RANGE_M = 0.05
"""Nearer than this no source is taken to be, where noise is put by the predicted range."""

MOST_CORRELATION = 0.95
MOST_GROWTH = 4.0
KNOWN_RANGE = 0.3
_SLOWER = 1.05


class Beat(NamedTuple):
    """When sets came last, and how long they are apart where nothing is missing."""

    last_s: float
    period_s: float


def beaten(rhythm: Mapping[str, Beat], names: Iterable[str], time_s: float) -> dict[str, Beat]:
    """Return the rhythm after a set in which `names` were seen to see.

    A time without any is no slower rhythm: the shortest way between two counts, and is forgotten slowly.
    """
    now = dict(rhythm)
    for name in names:
        if name not in now:
            now[name] = Beat(time_s, np.inf)
        elif time_s > now[name].last_s:
            last_s, period_s = now[name]
            now[name] = Beat(time_s, min(time_s - last_s, _SLOWER * period_s))
    return now


def _period_s(cameras: Sequence[str], rhythm: Mapping[str, Beat]) -> float:
    """Return the period of the fastest of some cameras; 0 where none is known."""
    fastest_s = min((rhythm[name].period_s for name in cameras if name in rhythm), default=math.inf)
    return fastest_s if math.isfinite(fastest_s) else 0.0


class Observations(NamedTuple):
    """Measurements of one set, m of them, in the odometry frame.

    Attributes
    ----------
    origin_m, axes
        What bearings count from, shape (m, 3); left, up and along the bearing as rows, shape (m, 3, 3).
    range_m
        NaN where it is not known, shape (m,).
    angle_rad2
        Covariance of the angles to the left and upwards, the observer's tilt included, shape (m, 2, 2).
    skew_m
        Covariance of these with the range, in rad m, shape (m, 2).
    noise_m2
        Variance of the range by what is not shared, shape (m,).
    common_m
        The shared part of its σ, shape (m,).
    shaken_m2
        Variance of the observer's place, per axis, shape (m,).
    after_s
        Time after the set's, shape (m,).
    period_s
        How long ago its camera could have seen it before: cameras may take turns, shape (m,).
    merged, saturated
        As measured, shape (m,).
    ghost
        Probability of being a mirror image, shape (m,).
    """

    origin_m: Array
    axes: Array
    range_m: Array
    angle_rad2: Array
    skew_m: Array
    noise_m2: Array
    common_m: Array
    shaken_m2: Array
    after_s: Array
    period_s: Array
    merged: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    ghost: Array

    @property
    def bearing(self) -> Array:
        """Unit vectors, shape (m, 3)."""
        return self.axes[:, 2]

    @property
    def place_m(self) -> Array:
        """Where they say their sources are, shape (m, 3); NaN without a range."""
        return self.origin_m + self.range_m[:, None] * self.axes[:, 2]

    def taken(self, rows: Indices) -> "Observations":
        """Return some of them."""
        return Observations._make(column[rows] for column in self)


def usable(measurements: Sequence[Measurement]) -> list[int]:
    """Return which measurements say where something is: finite times, places and bearings."""
    return [
        k
        for k, one in enumerate(measurements)
        if all(map(math.isfinite, (one.time_s, *one.origin_body_m, *one.bearing_body)))
    ]


def observed(
    measurements: Sequence[Measurement],
    poses: Poses,
    time_s: float,
    settings: TrackerSettings,
    rhythm: Mapping[str, Beat] | None = None,
) -> Observations:
    """Turn measurements, each by the observer's pose at its time, into the odometry frame.

    Places and bearings must be finite (`usable`). `rhythm` has how often each camera sees (`beaten`).
    """
    m = len(measurements)
    origin_m = np.array([one.origin_body_m for one in measurements]).reshape(m, 3)
    bearing = np.array([one.bearing_body for one in measurements]).reshape(m, 3)
    covariance = np.array([one.covariance for one in measurements]).reshape(m, 3, 3)
    range_m = np.array([one.range_m for one in measurements], dtype=float)
    common_m = np.array([one.range_sigma_common_m for one in measurements], dtype=float)
    angle = covariance[:, :2, :2].copy()
    angle[~np.isfinite(angle).all(axis=(1, 2))] = settings.bearing_sigma_rad**2 * np.eye(2)
    angle += (poses.rotation_sigma_rad**2)[:, None, None] * np.eye(2)
    claimed = np.isfinite(covariance[:, 2, 2])
    common_m = np.where(claimed, np.nan_to_num(common_m), settings.range_common_relative * range_m)
    noise = np.where(
        claimed, covariance[:, 2, 2] - common_m**2, (settings.range_sigma_relative * range_m) ** 2
    )
    least = 1e-8 + 1e-4 * np.where(claimed, covariance[:, 2, 2], 0.0)
    return Observations(
        origin_m=np.einsum("mij,mj->mi", poses.rotation, origin_m) + poses.position_m,
        axes=np.einsum("mij,mkj->mki", poses.rotation, bearing_axes(bearing)),
        range_m=range_m,
        angle_rad2=angle,
        skew_m=np.nan_to_num(covariance[:, :2, 2]),
        noise_m2=np.where(np.isfinite(range_m), np.maximum(noise, least), NO_RANGE_M**2),
        common_m=np.nan_to_num(common_m),
        shaken_m2=poses.position_sigma_m**2,
        after_s=np.array([one.time_s for one in measurements], dtype=float) - time_s,
        period_s=np.array([_period_s(one.cameras, rhythm or {}) for one in measurements], dtype=float),
        merged=np.array([one.merged for one in measurements], dtype=bool),
        saturated=np.array([one.saturated for one in measurements], dtype=bool),
        ghost=np.array([one.ghost_probability for one in measurements], dtype=float),
    )


def innovations(states: States, seen: Observations, spread_rad: Array | None = None) -> Innovations:
    """Return what measurement k says beyond the prediction of track k: z = r g, H = [I, τ I], both rotated.

    R = r² Σ_g + σ_w² g gᵀ has full rank. r is the *predicted* range, and σ_w is put there, as r³ (flux of a
    given noise): with the measured range a flux that came out too high would also count as the more precise.
    Where the prediction itself is open to more than 30 %, r is the measured range all the same.
    The bias of a range by flux, E[r̂] = r (1 + ⅜ (σ_F/F)²), is taken off. A range that is not known gets a σ
    of 1 km, and only the bearing counts; so where `spread_rad`, shape (n,), is no NaN: it adds to the noise.
    """
    spread_rad = np.full(len(seen.range_m), np.nan) if spread_rad is None else spread_rad
    columns = (
        states.mean, states.covariance, seen.origin_m, seen.axes, seen.range_m, seen.angle_rad2, seen.skew_m,
        seen.noise_m2, seen.common_m, seen.shaken_m2, seen.after_s, spread_rad,
    )  # fmt: skip
    return Innovations(*_innovations(*map(np.ascontiguousarray, columns)))


@compiled
def _innovations(
    mean: Array, covariance: Array, origin_m: Array, axes: Array, range_m: Array, angle_rad2: Array,
    skew_m: Array, noise_m2: Array, common_m: Array, shaken_m2: Array, after_s: Array, spread_rad: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    n = len(range_m)
    rows, noise = np.zeros((n, 3, 6)), np.zeros((n, 3, 3))
    residual_m, load = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        far2, along_m2 = 0.0, 0.0
        for a in range(3):
            for x in range(3):
                rows[k, a, x], rows[k, a, 3 + x] = axes[k, a, x], after_s[k] * axes[k, a, x]
                there_m = mean[k, x] + after_s[k] * mean[k, 3 + x] - origin_m[k, x]
                residual_m[k, a] -= axes[k, a, x] * there_m
                along_m2 += axes[k, 2, a] * covariance[k, a, x] * axes[k, 2, x]
            far2 += residual_m[k, a] ** 2
        far_m = max(math.sqrt(far2), LEAST_RANGE_M)
        ranged = math.isfinite(range_m[k]) and math.isnan(spread_rad[k])
        if ranged and along_m2 > (KNOWN_RANGE * far_m) ** 2:
            far_m = range_m[k]
        sigma_m, skewed = NO_RANGE_M, 0.0
        if ranged:
            growth = min(max(far_m / range_m[k], 1.0 / MOST_GROWTH), MOST_GROWTH)
            # δr = ½ r δF/F grows as r³ where F ∝ r⁻² has a noise that does not depend on it.
            skewed = growth**3
            sigma_m = math.sqrt(noise_m2[k]) * skewed
            bias_m = 1.5 * sigma_m**2 / far_m  # ⅜ (2 σ_w / r)² r
            residual_m[k, 2] += range_m[k] - min(bias_m, 0.5 * sigma_m)
            load[k, 2] = common_m[k] * growth
        else:
            residual_m[k, 2] = 0.0
        for a in range(2):
            for b in range(2):
                noise[k, a, b] = angle_rad2[k, a, b] * far_m**2
            if not math.isnan(spread_rad[k]):
                noise[k, a, a] += spread_rad[k] ** 2 * far_m**2
            most_m2 = MOST_CORRELATION * math.sqrt(0.5 * noise[k, a, a] * noise_m2[k]) if ranged else 0.0
            noise[k, a, 2] = noise[k, 2, a] = min(max(skew_m[k, a] * far_m, -most_m2), most_m2) * skewed
        noise[k, 2, 2] = sigma_m**2
        for a in range(3):
            noise[k, a, a] += shaken_m2[k]
    return rows, residual_m, noise, load
