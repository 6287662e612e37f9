"""Flares that are not one source's whole light, but several tracks' or a part: they feed bearings alone."""

import itertools
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
"""By so much must light of several explain a flare better than light of one: else a track that is not there
could live on in the glare of another. Those that shared the last one may explain it worse by as much."""

DOUBT_ODDS = 8.0
"""Where light of several explains a flare worse than light of one by less, its range does not count."""

DIM_CHI2, MOST_CHANCE = 14.0, 0.01

_SWERVE_SIGMAS = 2.0
_UNSURE_SPLIT = 0.03
_MOST_IN_ONE, _MOST_NEAR = 3, 6
"""Tracks in one flare, and tracks near one of which these are looked for."""


class Shared(NamedTuple):
    """One measurement for several tracks.

    Attributes
    ----------
    measurement, tracks
        Which.
    apart_rad
        How far these are apart at most.
    swerved
        Whether they are predicted so far apart that they would be seen apart: one has turned or stopped.
    total
        Where they seem to be by the flux of all, with what was known of that before.
    """

    measurement: int
    tracks: tuple[int, ...]
    apart_rad: float
    swerved: bool
    total: "Sum"


class Sum(NamedTuple):
    """Where tracks in one flare seem to be by the flux of all, the variance of that, and when."""

    range_m: float
    variance_m2: float
    time_s: float


Sums = dict[frozenset[int], Sum]
"""Of those that shared a flare a short time ago, by the tracks' numbers."""


class _Group(NamedTuple):
    """Tracks whose light one measurement may be, and by how much better that is than the assignment."""

    odds: float
    shared: Shared


def shared_flares(
    bank: Bank,
    seen: Observations,
    gain: Array,
    taken: Indices,
    time_s: float,
    clutter: float,
    before: Sums,
    settings: TrackerSettings,
) -> tuple[list[Shared], Array]:
    """Tell which measurements are the light of two tracks or three rather than what was assigned.

    Fluxes add up, so sources at r_i look like one at (Σ r_i⁻²)^−½, at the bearing that their fluxes weigh.
    How far a track *seems* by flux is known better than how far it is: the shared error of its range cancels,
    and a change by a tenth tells. Ranges and bearings count from the camera that saw the flare: two in one
    line with it are not in one with the body's origin.

    Parameters
    ----------
    bank, seen
        Predicted confirmed tracks, measurements of the set.
    gain, taken
        Of each track the gain of its own measurement (0 if none) and which it is (−1), shape (n,).
    time_s
        The set's.
    clutter, settings
        As in `gated_pairs`.
    before
        Those that shared a flare a short time ago. What their sum was it still is but for how they moved
        since: so it is known far better than by their ranges, which do not count one by one.

    Returns
    -------
    What is shared; and for each track how far the other is from it whose light may be in its flare: such a
    flare's range is not to be trusted. NaN elsewhere, shape (n,).
    """
    doubtful = np.full(len(gain), np.nan)
    if len(gain) < 2 or not len(seen.range_m):
        return [], doubtful
    arm_m = bank.mean[None, :, :3] - seen.origin_m[:, None]
    far_m = np.maximum(np.linalg.norm(arm_m, axis=2), LEAST_RANGE_M)
    along = arm_m / far_m[:, :, None]
    off2 = np.sum((along - seen.bearing[:, None]) ** 2, axis=2)
    near = np.isfinite(seen.range_m)[:, None] & (off2 < (3.0 * settings.resolution_rad) ** 2)
    groups: list[_Group] = []
    for k in np.flatnonzero(near.sum(axis=1) >= 2).tolist():
        owners = set(np.flatnonzero(taken == k).tolist())
        rows = np.flatnonzero(near[k])
        rows = np.sort(rows[np.argsort(off2[k, rows], kind="stable")[:_MOST_NEAR]])
        for size in range(2, _MOST_IN_ONE + 1):
            for chosen in itertools.combinations(rows.tolist(), size):
                if not owners.issubset(chosen):
                    continue
                numbers = frozenset(bank.number[list(chosen)].tolist())
                group = _explained(
                    bank, seen, k, chosen, far_m[k], along[k], time_s, before.get(numbers), clutter, settings
                )
                if group is None:
                    continue
                together = any(len(numbers & others) >= 2 for others in before)
                odds = group.odds + (SHARED_ODDS if together else -SHARED_ODDS)
                odds -= float(np.sum(gain[list(chosen)]))
                if odds > -DOUBT_ODDS:
                    groups.append(group._replace(odds=odds))
    found: list[Shared] = []
    tracks: set[int] = set()
    for odds, shared in sorted(groups, key=lambda group: -group.odds):
        if tracks & set(shared.tracks) or any(shared.measurement == one.measurement for one in found):
            continue
        if odds > 0.0:
            found.append(shared)
            tracks |= set(shared.tracks)
        else:
            free = [row for row in shared.tracks if np.isnan(doubtful[row])]
            doubtful[free] = shared.apart_rad
    return found, doubtful


def _explained(
    bank: Bank,
    seen: Observations,
    k: int,
    tracks: tuple[int, ...],
    far_m: Array,
    along: Array,
    time_s: float,
    then: Sum | None,
    clutter: float,
    settings: TrackerSettings,
) -> _Group | None:
    """Return how well measurement `k` is the sum of tracks' light, against clutter; None if it cannot be."""
    rows = list(tracks)
    far_m, along = far_m[rows], along[rows]
    turned_rad2 = (settings.swerve_m_per_s * (time_s - bank.seen_s[rows]) / far_m) ** 2
    apart = list(itertools.combinations(range(len(rows)), 2))
    apart_rad = [float(np.linalg.norm(along[a] - along[b])) for a, b in apart]
    slack_rad = [_SWERVE_SIGMAS * math.sqrt(turned_rad2[a] + turned_rad2[b]) for a, b in apart]
    if any(way > settings.resolution_rad + most for way, most in zip(apart_rad, slack_rad, strict=True)):
        return None
    swerved = max(apart_rad) > settings.resolution_rad
    widest_rad = 0.5 * settings.resolution_rad if swerved else max(apart_rad)
    place = bank.covariance[rows, :3, :3]
    on_m2 = np.einsum("ni,nij,nj->n", along, place, along)
    across_rad2 = (np.trace(place, axis1=1, axis2=2) - on_m2) / (2.0 * far_m**2)
    if swerved:
        across_rad2 += turned_rad2
    seems_m = float(np.sum(far_m**-2.0) ** -0.5)
    share = seems_m**2 / far_m**2
    angle2 = float(np.sum((seen.bearing[k] - share @ along) ** 2))
    load = seen.common_m[k] / seen.range_m[k] * far_m
    crossed = np.einsum("ni,ni->n", along, bank.common[rows, :3])
    relative2 = np.maximum(on_m2 + 2.0 * load * crossed + load**2, 0.0) / far_m**2
    range2 = seen.noise_m2[k] + seems_m**2 * float(share**2 @ relative2)
    measured_m, noise_m2 = float(seen.range_m[k]), float(seen.noise_m2[k])
    off_m, total = measured_m - seems_m, Sum(measured_m, noise_m2, time_s)
    if then is not None:
        # ∂s/∂r_i = (s / r_i)³
        slope, after_s = (seems_m / far_m) ** 3, time_s - then.time_s
        speed = float(slope @ np.einsum("ni,ni->n", along, bank.mean[rows, 3:]))
        speed2 = float(slope**2 @ np.einsum("ni,nij,nj->n", along, bank.covariance[rows, 3:, 3:], along))
        now_m, now_m2 = then.range_m + speed * after_s, then.variance_m2 + speed2 * after_s**2
        if noise_m2 + now_m2 < range2:
            range2, off_m = noise_m2 + now_m2, measured_m - now_m
        weight = now_m2 / (now_m2 + noise_m2)
        total = Sum(now_m + weight * (measured_m - now_m), (1.0 - weight) * now_m2, time_s)
    lateral2 = (
        float(share**2 @ across_rad2) + 0.5 * float(np.trace(seen.angle_rad2[k])) + (0.2 * widest_rad) ** 2
    ) * seems_m**2
    chi2 = angle2 * seems_m**2 / lateral2 + off_m**2 / range2
    if chi2 > settings.gate_chi2:
        return None
    odds = -0.5 * chi2 - math.log(lateral2) - 0.5 * math.log(range2) - 1.5 * math.log(2.0 * math.pi)
    odds += math.log(settings.seen_probability) + FLAGGED_ODDS * bool(seen.merged[k])
    by_chance = log_clutter(
        seen.range_m[k : k + 1], np.array([True]), clutter, settings.clutter_solid_angle_sr
    )
    return _Group(odds - float(by_chance[0]), Shared(k, tracks, widest_rad, swerved, total))


def split_in_doubt(seen: Observations, settings: TrackerSettings) -> NDArray[np.bool_]:
    """Return which measurements are half of a flare that was taken apart, and hardly could be, shape (m,).

    How its light is shared out among the two is uncertain, and as only what looks like two is taken apart, it
    comes out uneven more often than not: such a range does not count.
    """
    close = seen.bearing @ seen.bearing.T > math.cos(0.5 * settings.resolution_rad)
    np.fill_diagonal(close, val=False)
    unsure = ~(seen.noise_m2 < (_UNSURE_SPLIT * seen.range_m) ** 2)
    return np.asarray(close.any(axis=1) & unsure)


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
