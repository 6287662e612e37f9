"""The filter: constant velocity with white acceleration, and the pseudo-linear update; many tracks at once.

States are [p; v] in the observer's odometry frame. Ranges share an error that no average removes: the range
constant's, common to all tracks of an observer, and each robot's own flux. Both enter a track's measurements
as one factor, so one consider state u ~ N(0, 1) a track stands for their sum; it is never estimated, and its
covariance with the state is carried along (Schmidt 1966). As neither is estimated, no track learns from
another's, and the filter of all tracks together falls apart into these.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.likelihood.products import invert

Array = NDArray[np.float64]

BLIND_M2 = 1e5
"""A range of a greater variance is none."""


class States(NamedTuple):
    """Of n tracks.

    Attributes
    ----------
    mean
        [p; v] in m and m/s, shape (n, 6).
    covariance
        Of its error, shape (n, 6, 6).
    common
        Covariance of its error with the consider state, shape (n, 6).
    """

    mean: Array
    covariance: Array
    common: Array


class Innovations(NamedTuple):
    """What n measurements say beyond the predictions of n tracks, along left, up and the bearing.

    Attributes
    ----------
    rows
        H, shape (n, 3, 6).
    residual_m
        z − H x, shape (n, 3).
    noise_m2
        R, shape (n, 3, 3).
    load_m
        How the consider state moves the measurement, shape (n, 3).
    """

    rows: Array
    residual_m: Array
    noise_m2: Array
    load_m: Array


def transition(after_s: float) -> Array:
    """Return F of constant velocity, shape (6, 6)."""
    matrix = np.eye(6)
    matrix[:3, 3:] = after_s * np.eye(3)
    return matrix


def process_noise(after_s: float, psd_m2_per_s3: float) -> Array:
    """Return Q of white acceleration of a power spectral density, integrated in closed form, shape (6, 6)."""
    t = abs(after_s)
    # Backwards in time position and velocity part the other way.
    cross = 0.5 * t * after_s
    noise = np.zeros((2, 3, 2, 3))
    noise[:, range(3), :, range(3)] = np.array([[t**3 / 3.0, cross], [cross, t]])
    return psd_m2_per_s3 * noise.reshape(6, 6)


def predicted(states: States, after_s: float, psd_m2_per_s3: float) -> States:
    """Predict states by a time, which may be negative."""
    step = transition(after_s)
    return States(
        states.mean @ step.T,
        step @ states.covariance @ step.T + process_noise(after_s, psd_m2_per_s3),
        states.common @ step.T,
    )


def wandered(states: States, arm_m: Array, position_m2: float, rotation_rad2: float) -> States:
    """Add what the odometry's drift, per axis, does to places at arms from the observer, shape (n, 3)."""
    covariance = states.covariance.copy()
    covariance[:, :3, :3] += _shaken(arm_m, position_m2, rotation_rad2)
    return States(states.mean, covariance, states.common)


def _shaken(arm_m: Array, position_m2: float, rotation_rad2: float) -> Array:
    across = np.sum(arm_m**2, axis=1)[:, None, None] * np.eye(3) - arm_m[:, :, None] * arm_m[:, None, :]
    return np.asarray(position_m2 * np.eye(3) + rotation_rad2 * across)


def innovation_covariance(states: States, innovations: Innovations) -> Array:
    """Return the covariance of the residuals, the consider state included, shape (n, 3, 3)."""
    rows, _, noise, load = map(np.ascontiguousarray, innovations)
    return _innovation_covariance(
        np.ascontiguousarray(states.covariance), np.ascontiguousarray(states.common), rows, noise, load
    )


@compiled
def _innovation_covariance(covariance: Array, common: Array, rows: Array, noise: Array, load: Array) -> Array:
    found, crossed, turned = noise.copy(), np.empty(3), np.empty((3, 6))
    for k in range(len(rows)):
        for a in range(3):
            crossed[a] = 0.0
            for x in range(6):
                crossed[a] += rows[k, a, x] * common[k, x]
                turned[a, x] = 0.0
                for y in range(6):
                    turned[a, x] += rows[k, a, y] * covariance[k, y, x]
        for a in range(3):
            for b in range(3):
                total = crossed[a] * load[k, b] + load[k, a] * crossed[b] + load[k, a] * load[k, b]
                for x in range(6):
                    total += turned[a, x] * rows[k, b, x]
                found[k, a, b] += total
    return found


def updated(states: States, innovations: Innovations) -> States:
    """Update each track by its measurement: Joseph's form, with the consider state.

    The gain is that of a filter that is told u; the covariance is what it then does without knowing it. The
    gain that is the best by Schmidt would choose between measurements by how far their shared errors differ
    from the state's. These are a few per cent of ranges, and differ by what noise is in the predicted ranges:
    it would follow measurements that happen to come out nearer, and be wrong about it.

    Where only the bearing counts nothing moves along it. H is turned by a bearing that is itself noisy, and
    would draw the track towards the observer by its noise, a little with each update, and call it certain;
    what parallax a moving observer has is given up for that.
    """
    columns = (states.mean, states.covariance, states.common, *innovations)
    return States(*_updated(*map(np.ascontiguousarray, columns)))


@compiled
def _updated(
    mean: Array, covariance: Array, common: Array, rows: Array, residual: Array, noise: Array, load: Array
) -> tuple[Array, Array, Array]:
    after, spread, kept = mean.copy(), np.empty_like(covariance), np.empty_like(common)
    known, carried, left = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    crossed, gain, weighed = np.empty((6, 3)), np.empty((6, 3)), np.empty((6, 3))
    inverse, pushed = np.empty((3, 3)), np.empty(6)
    for k in range(len(rows)):
        for x in range(6):
            for y in range(6):
                known[x, y] = covariance[k, x, y] - common[k, x] * common[k, y]
        _times_turned_into(crossed, known, rows[k])
        for a in range(3):
            for b in range(3):
                inverse[a, b] = noise[k, a, b]
                for x in range(6):
                    inverse[a, b] += rows[k, a, x] * crossed[x, b]
        invert(inverse)
        _times_turned_into(gain, crossed, inverse.T)
        if noise[k, 2, 2] > BLIND_M2:
            for half in (0, 3):
                for b in range(3):
                    moved = 0.0
                    for x in range(3):
                        moved += rows[k, 2, x] * gain[half + x, b]
                    for x in range(3):
                        gain[half + x, b] -= rows[k, 2, x] * moved
        for x in range(6):
            pushed[x] = 0.0
            for b in range(3):
                after[k, x] += gain[x, b] * residual[k, b]
                pushed[x] += gain[x, b] * load[k, b]
            for y in range(6):
                left[x, y] = 1.0 if x == y else 0.0
                for b in range(3):
                    left[x, y] -= gain[x, b] * rows[k, b, y]
        _times_turned_into(weighed, gain, noise[k].T)
        _times_turned_into(carried, left, covariance[k].T)
        for x in range(6):
            kept[k, x] = 0.0
            for y in range(6):
                kept[k, x] += left[x, y] * common[k, y]
        for x in range(6):
            for y in range(x + 1):
                total = pushed[x] * pushed[y] - kept[k, x] * pushed[y] - pushed[x] * kept[k, y]
                for z in range(6):
                    total += carried[x, z] * left[y, z]
                for b in range(3):
                    total += weighed[x, b] * gain[y, b]
                spread[k, x, y] = spread[k, y, x] = total
        for x in range(6):
            kept[k, x] -= pushed[x]
    return after, spread, kept


@compiled
def _times_turned_into(product: Array, one: Array, other: Array) -> None:
    """Write one · otherᵀ."""
    for x in range(one.shape[0]):
        for y in range(other.shape[0]):
            product[x, y] = 0.0
            for z in range(one.shape[1]):
                product[x, y] += one[x, z] * other[y, z]


def updated_paper(
    states: States, bearing: Array, range_m: Array, angle_rad2: Array, range_m2: Array, epsilon_m2: float
) -> States:
    """Update as the paper says: its H, its z from the measured range, its R plus ε I.

    Parameters
    ----------
    states
        Of n tracks, relative to the point that bearing and range count from.
    bearing, range_m
        ĝ and r̂, shape (n, 3) and (n,).
    angle_rad2, range_m2
        σ_μ² and σ_w², shape (n,).
    epsilon_m2
        ε; without it R has no inverse, nor has the innovation's covariance in general.
    """
    n = len(bearing)
    along = bearing[:, :, None] * bearing[:, None, :]
    across = np.eye(3) - along
    rows = np.zeros((n, 6, 6))
    rows[:, :3, :3], rows[:, 3:, :3] = across, np.eye(3)
    noise = np.zeros((n, 6, 6))
    noise[:, :3, :3] = (range_m**2 * angle_rad2)[:, None, None] * across
    noise[:, 3:, 3:] = range_m2[:, None, None] * along
    noise += epsilon_m2 * np.eye(6)
    seen = np.concatenate([np.zeros((n, 3)), range_m[:, None] * bearing], axis=1)
    spread = rows @ states.covariance @ rows.transpose(0, 2, 1) + noise
    gain = np.linalg.solve(spread, rows @ states.covariance).transpose(0, 2, 1)
    mean = states.mean + np.einsum("nij,nj->ni", gain, seen - np.einsum("nij,nj->ni", rows, states.mean))
    covariance = (np.eye(6) - gain @ rows) @ states.covariance
    return States(mean, 0.5 * (covariance + covariance.transpose(0, 2, 1)), states.common)
