"""Which measurement is of which track: gates, likelihoods against clutter, and the paper's cost."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.track.bank import Bank, taken_states
from perception.track.kalman import States, innovation_covariance
from perception.track.observations import LEAST_RANGE_M, Observations, innovations
from perception.track.settings import TrackerSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

RANGE_NATS = 3.4
"""Logarithm of the farthest over the nearest range of false detections, as likely at every scale."""

GATE_SIGMAS = 5.0


class Pairs(NamedTuple):
    """Pairs of tracks and measurements that may belong together, p of them.

    Attributes
    ----------
    track, measurement
        Which, shape (p,).
    gain
        Log-likelihood ratio of their being of one source over the measurement's being clutter, shape (p,).
    chi2, freedom
        Squared Mahalanobis distance, and of how many dimensions: 3, or 2 without a range; shape (p,).
    """

    track: Indices
    measurement: Indices
    gain: Array
    chi2: Array
    freedom: Indices


def gated_pairs(
    bank: Bank, seen: Observations, observer_m: Array, clutter: float, settings: TrackerSettings
) -> Pairs:
    """Return the pairs within the gate.

    Parameters
    ----------
    bank, seen
        Predicted tracks, and the measurements of the set.
    observer_m
        Where the observer is, shape (3,).
    clutter
        False measurements to be expected in a set.
    settings
        Gates and costs.
    """
    if not (len(bank.number) and len(seen.range_m)):
        nothing, none = np.zeros(0), np.zeros(0, dtype=np.int64)
        return Pairs(none, none, nothing, nothing, none)
    track, measurement = _near(bank.states, seen, observer_m)
    states, there = taken_states(bank.states, track), seen.taken(measurement)
    found = innovations(states, there)
    chi2, log_density, ranged = _likelihood(innovation_covariance(states, found), found.residual_m, there)
    far_m = np.linalg.norm(states.mean[:, :3] - there.origin_m, axis=1)
    far_m = np.maximum(np.where(ranged, there.range_m, far_m), LEAST_RANGE_M)
    gain = log_density + np.log(settings.seen_probability)
    gain -= log_clutter(far_m, ranged, clutter, settings.clutter_solid_angle_sr)
    gain -= settings.direction_weight * _turned(bank, track, there)
    inside = chi2 < settings.gate_chi2
    return Pairs(
        track[inside], measurement[inside], gain[inside], chi2[inside], np.where(ranged, 3, 2)[inside]
    )


def _near(states: States, seen: Observations, observer_m: Array) -> tuple[Indices, Indices]:
    """Return pairs with room to spare, by bearing and then by place: what is left for the exact gate."""
    columns = (
        states.mean, states.covariance, seen.origin_m, seen.axes, seen.range_m, seen.angle_rad2,
        seen.noise_m2, seen.common_m, seen.shaken_m2, seen.after_s, observer_m,
    )  # fmt: skip
    return _near_pairs(*map(np.ascontiguousarray, columns))


@compiled
def _near_pairs(
    mean: Array, covariance: Array, origin_m: Array, axes: Array, range_m: Array, angle_rad2: Array,
    noise_m2: Array, common_m: Array, shaken_m2: Array, after_s: Array, observer_m: Array,
) -> tuple[Indices, Indices]:  # fmt: skip
    tracks, seen, count = len(mean), len(range_m), 0
    found = np.empty((2, tracks * seen), dtype=np.int64)
    late_s = origins2 = shaken2 = 0.0
    noise = np.empty(seen)
    for m in range(seen):
        late_s, shaken2 = max(late_s, abs(after_s[m])), max(shaken2, shaken_m2[m])
        noise[m] = GATE_SIGMAS * math.sqrt(angle_rad2[m, 0, 0] + angle_rad2[m, 1, 1])
        origins2 = max(origins2, _length2(origin_m[m], observer_m))
    shaken_m = GATE_SIGMAS * math.sqrt(2.0 * shaken2)
    for n in range(tracks):
        far_m = max(math.sqrt(_length2(mean[n, :3], observer_m)), LEAST_RANGE_M)
        on_m2 = trace_m2 = speed2 = 0.0
        for x in range(3):
            trace_m2 += covariance[n, x, x]
            speed2 += mean[n, 3 + x] ** 2
            for y in range(3):
                on_m2 += (mean[n, x] - observer_m[x]) * covariance[n, x, y] * (mean[n, y] - observer_m[y])
        on_m2 /= far_m**2
        across_m2 = max(trace_m2 - on_m2, 0.0)
        room_m = GATE_SIGMAS * math.sqrt(across_m2) + late_s * math.sqrt(speed2)
        widest = (room_m + math.sqrt(origins2) + shaken_m) / far_m
        for m in range(seen):
            cosine = depth_m = 0.0
            for x in range(3):
                cosine += (mean[n, x] - observer_m[x]) / far_m * axes[m, 2, x]
                depth_m += (mean[n, x] - origin_m[m, x]) * axes[m, 2, x]
            if not (depth_m > 0.0 and cosine > math.cos(min(widest + noise[m], math.pi))):
                continue
            # Now from where each camera stands, and by range where there is one.
            aside_m = math.sqrt(max(_length2(mean[n, :3], origin_m[m]) - depth_m**2, 0.0))
            ranged = math.isfinite(range_m[m])
            reach_m = max(depth_m, range_m[m]) if ranged else depth_m
            if not aside_m < room_m + shaken_m + noise[m] * reach_m:
                continue
            if ranged:
                sigma_m = math.sqrt(noise_m2[m]) * max(depth_m / range_m[m], 1.0) ** 3
                deep_m = math.sqrt(on_m2 + across_m2) + sigma_m + common_m[m] + shaken_m
                if abs(depth_m - range_m[m]) > 1.5 * GATE_SIGMAS * deep_m:
                    continue
            found[0, count], found[1, count] = n, m
            count += 1
    return found[0, :count].copy(), found[1, :count].copy()


@compiled
def _length2(one: Array, other: Array) -> float:
    """Return the squared distance of two places."""
    return float((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)


def _likelihood(
    spread: Array, residual_m: Array, seen: Observations
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return χ², log density in metres (of two dimensions without a range), and which have a range."""
    a, b, c = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
    det = a * c - b * b
    x, y, z = residual_m.T
    chi2 = (c * x * x - 2.0 * b * x * y + a * y * y) / det
    log_density = -0.5 * chi2 - 0.5 * np.log(det) - np.log(2.0 * np.pi)
    # The range, given the bearing.
    p, q = spread[:, 0, 2], spread[:, 1, 2]
    u, v = (c * p - b * q) / det, (a * q - b * p) / det
    left_m2 = np.maximum(spread[:, 2, 2] - u * p - v * q, 1e-12)
    of_range = (z - u * x - v * y) ** 2 / left_m2
    ranged = np.isfinite(seen.range_m)
    chi2 = chi2 + np.where(ranged, of_range, 0.0)
    log_density += np.where(ranged, -0.5 * of_range - 0.5 * np.log(2.0 * np.pi * left_m2), 0.0)
    return chi2, log_density, ranged


def log_clutter(range_m: Array, ranged: NDArray[np.bool_], clutter: float, solid_angle_sr: float) -> Array:
    """Return the logarithm of the density of false measurements at ranges, per m³, or per m² without one.

    They are spread evenly over the solid angle and the logarithm of range.
    """
    density_m2 = clutter / (solid_angle_sr * range_m**2)
    return np.asarray(np.log(np.where(ranged, density_m2 / (RANGE_NATS * range_m), density_m2)))


def _turned(bank: Bank, track: Indices, seen: Observations) -> Array:
    """Return the turn against the direction so far, as a share of 180 degrees, where both are significant."""
    velocity = bank.anchor_mean[track, 3:]
    moved_m = np.nan_to_num(seen.place_m - bank.anchor_mean[track, :3])
    speed2, way2 = np.sum(velocity**2, axis=1), np.sum(moved_m**2, axis=1)
    slack2 = np.trace(bank.anchor_covariance[track, 3:, 3:], axis1=1, axis2=2)
    noise_m2 = np.trace(bank.anchor_covariance[track, :3, :3], axis1=1, axis2=2) + seen.noise_m2
    cosine = np.sum(velocity * moved_m, axis=1) / np.sqrt(np.maximum(speed2 * way2, 1e-300))
    significant = speed2 / (speed2 + slack2 + 1e-12) * way2 / (way2 + noise_m2 + 1e-12)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi * significant)


def assigned(pairs: Pairs) -> Indices:
    """Return the pairs, as indices, of the assignment of the greatest total gain; each gains by itself."""
    from scipy.optimize import linear_sum_assignment  # loads slowly

    gains = np.flatnonzero(pairs.gain > 0.0)
    if not len(gains):
        return gains
    tracks, rows = np.unique(pairs.track[gains], return_inverse=True)
    measurements, columns = np.unique(pairs.measurement[gains], return_inverse=True)
    table = np.zeros((len(tracks), len(measurements)))
    which = np.full(table.shape, -1, dtype=np.int64)
    table[rows, columns] = pairs.gain[gains]
    which[rows, columns] = gains
    chosen = which[linear_sum_assignment(table, maximize=True)]
    return chosen[chosen >= 0]


def paper_pairs(bank: Bank, seen: Observations, settings: TrackerSettings) -> Pairs:
    """Return all pairs whose boxes overlap, with the paper's cost: gain = most − C.

    C = C_IoU + C_θ + w_d (1 − exp(−|Δd|)). A box is a square about the bearing, of `paper_box_rad`; C_θ is
    the turn against the track's direction as a share of 180 degrees.
    """
    # A bearing counts from its camera, so each measurement sees the tracks from there.
    arm_m = bank.mean[:, None, :3] - seen.origin_m
    far_m = np.maximum(np.linalg.norm(arm_m, axis=2), LEAST_RANGE_M)
    off = np.einsum("mij,nmj->nmi", seen.axes, arm_m / far_m[:, :, None])
    side = settings.paper_box_rad
    shared = np.prod(np.maximum(side - np.abs(off[:, :, :2]), 0.0), axis=2) * (off[:, :, 2] > 0.0)
    overlap = shared / (2.0 * side**2 - shared)
    track, measurement = np.nonzero(overlap > 0.0)
    there = seen.taken(measurement)
    depth_m = np.nan_to_num(np.abs(there.range_m - far_m[track, measurement]), nan=np.inf)
    cost = (
        1.0
        - overlap[track, measurement]
        + _turned(bank, track, there)
        + settings.paper_depth_weight * (1.0 - np.exp(-depth_m))
    )
    most = 2.0 + settings.paper_depth_weight
    return Pairs(track, measurement, most - cost, np.zeros(len(track)), np.full(len(track), 3))
