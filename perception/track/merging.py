"""Flares that are not one source's whole light: of two tracks, or a part of one; they feed bearings alone."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.track.association import log_clutter
from perception.track.bank import Bank, taken_states
from perception.track.kalman import innovation_covariance
from perception.track.observations import LEAST_RANGE_M, Observations, innovations
from perception.track.settings import TrackerSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FLAGGED_ODDS = 2.0
"""What it adds that the estimator itself took a flare for several."""

SHARED_ODDS = 3.0
"""By so much must light of both explain a flare better than light of one: else a track that is not there
could live on in the glare of another. Two that shared the last one may explain it worse by as much."""

DOUBT_ODDS = 8.0
"""Where light of both explains a flare worse than light of one by less, its range does not count."""

DIM_CHI2, MOST_CHANCE = 14.0, 0.01


class Shared(NamedTuple):
    """One measurement for two tracks: which, and how far these are apart."""

    measurement: int
    tracks: tuple[int, int]
    apart_rad: float


def shared_flares(
    bank: Bank,
    seen: Observations,
    observer_m: Array,
    gain: Array,
    taken: Indices,
    clutter: float,
    before: frozenset[tuple[int, int]],
    settings: TrackerSettings,
) -> tuple[list[Shared], Array]:
    """Tell which measurements are the light of two tracks rather than what was assigned.

    Fluxes add up, so two at r_a and r_b look like one at (r_a⁻² + r_b⁻²)^−½, at the bearing that their fluxes
    weigh. How far a track *seems* by flux is known better than how far it is: the shared error of its range
    cancels, and a change by a tenth tells.

    Parameters
    ----------
    bank, seen, observer_m
        Predicted confirmed tracks, measurements of the set, where the observer is.
    gain, taken
        Of each track the gain of its own measurement (0 if none) and which it is (−1), shape (n,).
    clutter, settings
        As in `gated_pairs`.
    before
        Numbers of those that shared a flare when they were last seen.

    Returns
    -------
    What is shared; and for each track how far the other is from it whose light may be in its flare: such a
    flare's range is not to be trusted. NaN elsewhere, shape (n,).
    """
    arm_m = bank.mean[:, :3] - observer_m
    far_m = np.maximum(np.linalg.norm(arm_m, axis=1), LEAST_RANGE_M)
    along = arm_m / far_m[:, None]
    close = along @ along.T > math.cos(settings.resolution_rad)
    firsts, seconds = np.nonzero(np.triu(close, 1))
    found: list[Shared] = []
    doubtful = np.full(len(far_m), np.nan)
    if not (len(firsts) and len(seen.range_m)):
        return found, doubtful
    place = bank.covariance[:, :3, :3]
    on_m2 = np.einsum("ni,nij,nj->n", along, place, along)
    across_rad2 = (np.trace(place, axis1=1, axis2=2) - on_m2) / (2.0 * far_m**2)
    used: set[int] = set()
    busy: set[int] = set()
    for a, b in zip(firsts.tolist(), seconds.tolist(), strict=True):
        pair = [a, b]
        if used & {a, b}:
            continue
        seems_m = float(np.sum(far_m[pair] ** -2.0) ** -0.5)
        share = seems_m**2 / far_m[pair] ** 2
        bearing = share @ along[pair]
        angle2 = np.sum((seen.bearing - bearing) ** 2, axis=1)
        near = np.flatnonzero(np.isfinite(seen.range_m) & (angle2 < (3.0 * settings.resolution_rad) ** 2))
        others = np.setdiff1d(taken, taken[pair])
        for k in near.tolist():
            if k in others or k in busy:
                continue
            load = seen.common_m[k] / seen.range_m[k] * far_m[pair]
            crossed = np.einsum("ni,ni->n", along[pair], bank.common[pair, :3])
            relative2 = np.maximum(on_m2[pair] + 2.0 * load * crossed + load**2, 0.0) / far_m[pair] ** 2
            apart_rad = float(np.linalg.norm(along[a] - along[b]))
            range2 = seen.noise_m2[k] + seems_m**2 * float(share**2 @ relative2)
            lateral2 = (
                float(share**2 @ across_rad2[pair])
                + 0.5 * float(np.trace(seen.angle_rad2[k]))
                + (0.2 * apart_rad) ** 2
            ) * seems_m**2
            chi2 = angle2[k] * seems_m**2 / lateral2 + (seen.range_m[k] - seems_m) ** 2 / range2
            if chi2 > settings.gate_chi2:
                continue
            both = -0.5 * chi2 - math.log(lateral2) - 0.5 * math.log(range2) - 1.5 * math.log(2.0 * math.pi)
            both += math.log(settings.seen_probability)
            both += FLAGGED_ODDS * bool(seen.merged[k])
            both += SHARED_ODDS if (bank.number[a], bank.number[b]) in before else -SHARED_ODDS
            both -= float(
                log_clutter(
                    seen.range_m[k : k + 1], np.array([True]), clutter, settings.clutter_solid_angle_sr
                )[0]
            )
            alone = float(np.sum(gain[pair]))
            if both < alone and both > alone - DOUBT_ODDS:
                doubtful[pair] = apart_rad
            if both > alone:
                found.append(Shared(k, (a, b), apart_rad))
                used |= {a, b}
                busy.add(k)
                break
    return found, doubtful


def dimmed(
    bank: Bank, seen: Observations, taken: Indices, clutter: float, settings: TrackerSettings
) -> tuple[Indices, Indices]:
    """Return tracks that no measurement was of, and measurements of none that are their light, only dimmer.

    An exposure across an edge of a bit catches a part of it, and a body's edge may hide a part: at the
    track's bearing, but seemingly farther. Where frames keep step with bits, such would pass for a robot
    behind.
    """
    lost = np.flatnonzero(taken < 0)
    free = np.setdiff1d(np.flatnonzero(np.isfinite(seen.range_m)), taken)
    if not (len(lost) and len(free)):
        return lost[:0], free[:0]
    rows, columns = (grid.ravel() for grid in np.meshgrid(lost, free, indexing="ij"))
    states, there = taken_states(bank.states, rows), seen.taken(columns)
    apart_m = np.sum((states.mean[:, :3] - there.origin_m) * there.bearing, axis=1)
    near = np.flatnonzero((apart_m > 0.0) & (there.range_m > apart_m))
    rows, columns = rows[near], columns[near]
    states, there = taken_states(states, near), there.taken(near)
    found = innovations(states, there, np.zeros(len(near)))
    spread = innovation_covariance(states, found)[:, :2, :2]
    off = found.residual_m[:, :2]
    chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    across_rad2 = np.sqrt(np.maximum(np.linalg.det(spread), 0.0)) / apart_m[near] ** 2
    by_chance = clutter / settings.clutter_solid_angle_sr * math.pi * DIM_CHI2 * across_rad2
    # Where the place itself is hardly known, a bearing says little of whose light it is.
    good = (chi2 < DIM_CHI2) & (across_rad2 < settings.resolution_rad**2) & (by_chance < MOST_CHANCE)
    order = np.flatnonzero(good)[np.argsort(chi2[good])]
    tracks: list[int] = []
    measurements: list[int] = []
    for k in order.tolist():
        if rows[k] not in tracks and columns[k] not in measurements:
            tracks.append(int(rows[k]))
            measurements.append(int(columns[k]))
    return np.array(tracks, dtype=np.int64), np.array(measurements, dtype=np.int64)
