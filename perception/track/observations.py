"""Measurements of a set as arrays in the observer's odometry frame, and what they say beyond predictions."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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

_MOST_CORRELATION = 0.95
_MOST_GROWTH = 4.0
_KNOWN_RANGE = 0.3
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
    fastest_s = min((rhythm[name].period_s for name in cameras if name in rhythm), default=np.inf)
    return fastest_s if np.isfinite(fastest_s) else 0.0


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
        if np.isfinite([one.time_s, *one.origin_body_m, *one.bearing_body]).all()
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
    n = len(seen.range_m)
    rows = np.zeros((n, 3, 6))
    rows[:, :, :3], rows[:, :, 3:] = seen.axes, seen.after_s[:, None, None] * seen.axes
    apart_m = (rows @ states.mean[:, :, None])[:, :, 0] - np.einsum("nij,nj->ni", seen.axes, seen.origin_m)
    far_m = np.maximum(np.linalg.norm(apart_m, axis=1), LEAST_RANGE_M)
    ranged = np.isfinite(seen.range_m)
    if spread_rad is not None:
        ranged &= np.isnan(spread_rad)
    along_m2 = np.einsum("ni,nij,nj->n", seen.bearing, states.covariance[:, :3, :3], seen.bearing)
    far_m = np.where(ranged & (along_m2 > (_KNOWN_RANGE * far_m) ** 2), seen.range_m, far_m)
    range_m = np.where(ranged, seen.range_m, far_m)
    growth = np.clip(far_m / range_m, 1.0 / _MOST_GROWTH, _MOST_GROWTH)
    # δr = ½ r δF/F grows as r³ where F ∝ r⁻² has a noise that does not depend on it.
    sigma_m = np.where(ranged, np.sqrt(seen.noise_m2) * growth**3, NO_RANGE_M)
    bias_m = np.where(ranged, 1.5 * sigma_m**2 / far_m, 0.0)  # ⅜ (2 σ_w / r)² r
    residual_m = -apart_m
    residual_m[:, 2] += np.where(ranged, range_m - np.minimum(bias_m, 0.5 * sigma_m), apart_m[:, 2])
    noise = np.zeros((n, 3, 3))
    noise[:, :2, :2] = seen.angle_rad2
    if spread_rad is not None:
        noise[:, :2, :2] += (np.nan_to_num(spread_rad) ** 2)[:, None, None] * np.eye(2)
    noise[:, :2, :2] *= (far_m**2)[:, None, None]
    noise[:, 2, 2] = sigma_m**2
    most_m2 = (
        _MOST_CORRELATION
        / np.sqrt(2.0)
        * np.sqrt(noise[:, [0, 1], [0, 1]] * np.where(ranged, seen.noise_m2, 0.0)[:, None])
    )
    skew = np.clip(seen.skew_m * far_m[:, None], -most_m2, most_m2)
    skew *= np.where(ranged, sigma_m / np.sqrt(seen.noise_m2), 0.0)[:, None]
    noise[:, :2, 2] = noise[:, 2, :2] = skew
    noise += seen.shaken_m2[:, None, None] * np.eye(3)
    load = np.zeros((n, 3))
    load[:, 2] = np.where(ranged, seen.common_m * growth, 0.0)
    return Innovations(rows, residual_m, noise, load)
