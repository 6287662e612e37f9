"""Feeding measurements to tracks: the update, its two forms, and the re-update after a gap."""

import numpy as np
from numpy.typing import NDArray

from perception.track.bank import Bank, replaced, taken_states
from perception.track.kalman import States, predicted, updated, updated_paper
from perception.track.observations import Observations, innovations
from perception.track.settings import TrackerSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GAP_S = 0.15
"""A track that was unseen for longer may have turned meanwhile."""

SURPRISING = 0.35
"""χ² per dimension over the mean from which on it is said to have, as a share of the gate's."""

MOST_MANOEUVRE = 30.0
_VIRTUAL_STEP_S = 1.0 / 30.0


def fed(
    bank: Bank,
    tracks: Indices,
    seen: Observations,
    chi2: Array,
    time_s: float,
    settings: TrackerSettings,
    spread_rad: Array | None = None,
    alone: bool = True,
) -> Bank:
    """Update tracks, each by one measurement.

    After a gap whose end surprises, a track is updated anew from where it was last seen, along a virtual
    trajectory (OC-SORT's observation-centric re-update). There it is a straight line between both
    measurements, taken as if seen, which claims what nobody saw. Here it is the most likely path of a robot
    that manoeuvred as much as the surprise demands: the acceleration's density over the gap grows by χ² over
    its expectation. The paper's form takes the straight line.

    Parameters
    ----------
    bank
        Tracks, predicted to `time_s`.
    tracks, seen, chi2
        Which tracks, by which measurements, at what squared Mahalanobis distance, n each.
    time_s, settings
        When, and how.
    spread_rad
        Noise to be added to bearings, shape (n,), of flares that are not one source's whole light: then their
        ranges do not count. NaN where they do.
    alone
        Whether they are of no other source.
    """
    if not len(tracks):
        return bank
    states = taken_states(bank.states, tracks)
    if settings.filter == "paper":
        after = _fed_paper(bank, tracks, states, seen, time_s, settings)
    else:
        gap_s = time_s - bank.seen_s[tracks]
        turned = np.flatnonzero((gap_s > GAP_S) & (chi2 > SURPRISING * settings.gate_chi2))
        for k in turned.tolist():
            row = tracks[k : k + 1]
            more = min(float(chi2[k]) / 3.0, MOST_MANOEUVRE)
            again = predicted(
                taken_states(bank.anchors, row), float(gap_s[k]), more * settings.acceleration_psd_m2_per_s3
            )
            states = replaced(states, np.array([k]), again)
        after = updated(states, innovations(states, seen, spread_rad))
    everything = replaced(bank.states, tracks, after)
    anchors = replaced(bank.anchors, tracks, after)
    seen_s, alone_s, hits = bank.seen_s.copy(), bank.alone_s.copy(), bank.hits.copy()
    seen_s[tracks] = time_s
    hits[tracks] += 1
    if alone:
        alone_s[tracks] = time_s
    return bank.with_states(everything)._replace(
        anchor_mean=anchors.mean,
        anchor_covariance=anchors.covariance,
        anchor_common=anchors.common,
        seen_s=seen_s,
        alone_s=alone_s,
        hits=hits,
    )


def swerved(bank: Bank, tracks: Indices, time_s: float, settings: TrackerSettings) -> Bank:
    """Return tracks as they are if, when they were last seen, their velocities changed at once.

    Robots turn on the spot and stop: to a filter whose acceleration is white that is a jump.
    """
    some = bank.taken(tracks)
    covariance = some.anchor_covariance.copy()
    covariance[:, 3:, 3:] += settings.swerve_m_per_s**2 * np.eye(3)
    began = States(some.anchor_mean, covariance, some.anchor_common)
    after_s = time_s - some.seen_s
    states = [
        predicted(taken_states(began, np.array([k])), float(after_s[k]), settings.acceleration_psd_m2_per_s3)
        for k in range(len(tracks))
    ]
    columns = zip(*states, strict=True)
    return some.with_states(States(*(np.concatenate(column) for column in columns))) if states else some


def _fed_paper(
    bank: Bank, tracks: Indices, states: States, seen: Observations, time_s: float, settings: TrackerSettings
) -> States:
    """Update in the paper's form; after a gap, along measurements put on the straight line through it."""
    ranged = np.isfinite(seen.range_m)
    far_m = np.linalg.norm(states.mean[:, :3] - seen.origin_m, axis=1)
    range_m = np.where(ranged, seen.range_m, far_m)
    angle2 = 0.5 * np.trace(seen.angle_rad2, axis1=1, axis2=2)
    range_m2 = np.where(ranged, seen.noise_m2 + seen.common_m**2, far_m**2)
    place_m = seen.origin_m + range_m[:, None] * seen.bearing
    for k in np.flatnonzero(time_s - bank.seen_s[tracks] > GAP_S).tolist():
        row = tracks[k : k + 1]
        state = taken_states(bank.anchors, row)
        begin_m, gap_s = state.mean[0, :3].copy(), float(time_s - bank.seen_s[row[0]])
        steps = max(round(gap_s / _VIRTUAL_STEP_S), 1)
        for step in range(1, steps):
            state = predicted(state, gap_s / steps, settings.acceleration_psd_m2_per_s3)
            between_m = begin_m + step / steps * (place_m[k] - begin_m)
            state = _paper_step(state, between_m[None], seen, np.array([k]), angle2, range_m2, settings)
        state = predicted(state, gap_s / steps, settings.acceleration_psd_m2_per_s3)
        states = replaced(states, np.array([k]), state)
    return _paper_step(states, place_m, seen, np.arange(len(tracks)), angle2, range_m2, settings)


def _paper_step(
    states: States,
    place_m: Array,
    seen: Observations,
    rows: Indices,
    angle2: Array,
    range_m2: Array,
    settings: TrackerSettings,
) -> States:
    origin = np.concatenate([seen.origin_m[rows], np.zeros((len(rows), 3))], axis=1)
    arm_m = place_m - seen.origin_m[rows]
    range_m = np.linalg.norm(arm_m, axis=1)
    relative = States(states.mean - origin, states.covariance, states.common)
    after = updated_paper(
        relative, arm_m / range_m[:, None], range_m, angle2[rows], range_m2[rows], settings.paper_epsilon_m2
    )
    return States(after.mean + origin, after.covariance, after.common)
