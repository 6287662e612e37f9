"""Which flares are one robot, which source each of them is, and how the robot stands."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.rig.frame_sets import Exposed
from perception.rig.moving import OneTime
from perception.rig.pose.gates import GATE_CHI2, HEADINGS, Places, fitting
from perception.rig.pose.partings import Candidate, told_apart
from perception.rig.pose.posterior import LEAST_ODDS, Posterior, evidence_alone, posterior
from perception.rig.pose.sights import Sights, carried, sights_of, symmetries
from perception.types import Calibration, Detection, Layout, Measurement, PoseHypothesis, RobotPose

Array = NDArray[np.float64]

SEEN = 0.9
"""How probable it is, beforehand, that a source of a robot is seen: it may be off, or behind its body."""

PER_M3 = 0.1
"""How densely robots, and other sources, are taken to stand."""

_LEAST_ACROSS_M = 1e-3  # of sources from each other, level: less tells no heading

MOST_FLARES = 40
MOST_TRIED = 720


@dataclass(frozen=True, eq=False)
class _Seen:
    """Measurements, the nearest first, with the rows of their sightings, and where they are."""

    measurements: tuple[Measurement, ...]
    rows: tuple[tuple[int, ...], ...]
    places: Places
    sights: Sights


def told_robots(
    known: OneTime,
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    measurements: Sequence[Measurement],
) -> tuple[RobotPose, ...]:
    """Return the robots with several sources that a set of measurements shows.

    A robot is told from two of its flares on, at least one of them with a range and its σ; mirror images are
    none. Flares that no layout explains together are left alone, and so are sources straight above each
    other, which tell no heading.

    Parameters
    ----------
    known
        What the detections say, at one time.
    frames, detections, calibrations
        As for `measure_set`. Layouts are those that any camera of the set knows, by their kind.
    measurements
        Made of the detections.
    """
    cameras = dict.fromkeys(frame.camera for frame in frames)
    of_kind = {each.kind: each for camera in cameras for each in calibrations[camera].layouts}
    layouts = [each for each in of_kind.values() if _tells_heading(each)]
    claimed = any(math.isfinite(hit.range_sigma_m) for each in detections for hit in each)
    if not layouts or not claimed or len(measurements) < 2:
        return ()
    seen = _seen(measurements, sights_of(known, frames, detections, calibrations), known)
    candidates = _candidates(seen, layouts)
    alone = [_alone(rows, seen.sights) for rows in seen.rows]
    return tuple(_robot(chosen, odds, seen, known.time_s) for chosen, odds in told_apart(candidates, alone))


def _tells_heading(layout: Layout) -> bool:
    across_m = np.ptp(np.array(layout.places_body_m)[:, :2], axis=0)
    return bool(across_m.max() > _LEAST_ACROSS_M)


def _seen(measurements: Sequence[Measurement], sights: Sights, known: OneTime) -> _Seen:
    """Return the measurements that may be sources of robots, and where they are."""
    row_of = {key: row for row, key in enumerate(known.sightings.keys)}
    told = [each for each in measurements if each.ghost != "yes"]
    rows = [tuple(row_of[key] for key in each.detections) for each in told]
    sizes = sights.size.tolist()
    noise = sights.own[:, 2, 2].tolist()
    best = np.array([min(some, key=noise.__getitem__) for some in rows], dtype=np.int64)
    range_m = np.exp(sights.log_range[best])
    range_m = np.where(np.isfinite(range_m), range_m, [each.range_m for each in told])
    axes = sights.axes[best]
    place_m = sights.origin_m[best] + range_m[:, None] * axes[:, 2]
    noise_m2 = range_m[:, None, None] ** 2 * (np.swapaxes(axes, 1, 2) @ sights.own[best] @ axes)
    order = np.argsort((place_m**2).sum(axis=1), kind="stable")[:MOST_FLARES]
    return _Seen(
        tuple(told[k] for k in order),
        tuple((*rows[k], *(sizes[row] for row in rows[k] if sizes[row] >= 0)) for k in order),
        Places(best[order], place_m[order], noise_m2[order]),
        sights,
    )


def _candidates(seen: _Seen, layouts: Sequence[Layout]) -> list[Candidate]:
    """Return all groups of flares that may be a robot."""
    candidates = []
    for layout in layouts:
        fits = _fitting_pairs(seen, layout)
        groups = _cliques(len(seen.rows), fits, len(layout.places_body_m))
        whole: set[int] = set()
        for members in reversed(groups):
            # Of flares that stand by themselves as one robot does no part is looked at.
            if whole.issuperset(members):
                continue
            candidate = _candidate(members, seen, layout, fits)
            if candidate is None:
                continue
            candidates.append(candidate)
            if not any(len({*pair} & {*members}) == 1 for pair in fits):
                whole.update(members)
    return candidates


Pairs = dict[tuple[int, int], dict[tuple[int, int], NDArray[np.bool_]]]
"""By two flares, the smaller number first: which two sources of a layout they may be, at which headings."""


def _fitting_pairs(seen: _Seen, layout: Layout) -> Pairs:
    """Tell which two flares may be which two sources, by how they stand apart."""
    headings = fitting(seen.places, seen.sights, carried(layout))
    fits: Pairs = {}
    for i, j, a, b in np.argwhere(headings.any(axis=-1)).tolist():
        fits.setdefault((i, j), {})[a, b] = headings[i, j, a, b]
    return fits


def _cliques(count: int, fits: Pairs, most: int) -> list[tuple[int, ...]]:
    """Return groups of two to `most` flares of which every two may be of one robot."""
    groups: list[tuple[int, ...]] = list(fits)
    groups.sort()
    found = list(groups)
    for _ in range(most - 2):
        groups = [
            (*group, k)
            for group in groups
            for k in range(group[-1] + 1, count)
            if all((member, k) in fits for member in group)
        ]
        found += groups
    return found


def _candidate(members: tuple[int, ...], seen: _Seen, layout: Layout, fits: Pairs) -> Candidate | None:
    sources = len(layout.places_body_m)
    hidden = sources - len(members)
    rows = np.array([row for k in members for row in seen.rows[k]])
    if not np.isfinite(seen.sights.log_range[rows]).any():
        return None
    counts = [len(seen.rows[k]) for k in members]
    body, ways = carried(layout), []
    turns = symmetries(layout)
    known: dict[tuple[int, ...], Posterior | None] = {}
    for way, headings in _ways(members, sources, fits):
        if way not in known:
            shown = np.repeat(np.array(way), counts)
            known[way] = posterior(seen.sights, rows, body, shown, headings, GATE_CHI2 + 3 * len(rows))
            for turn_rad, onto in turns:  # the same said otherwise
                again = known[way]
                known[tuple(onto[source] for source in way)] = (
                    None if again is None else again.turned(turn_rad)
                )
        found = known[way]
        if found is not None:
            log_prior = len(members) * math.log(SEEN) + hidden * math.log(1.0 - SEEN)
            ways.append((way, found, found.log_evidence + log_prior + math.log(PER_M3)))
    if not ways:
        return None
    logs = np.array([log for _, _, log in ways])
    return Candidate(members, layout, tuple(ways), float(np.logaddexp.reduce(logs)))


def _ways(
    members: tuple[int, ...], sources: int, fits: Pairs
) -> list[tuple[tuple[int, ...], NDArray[np.bool_]]]:
    """Return which source each flare may be, with the headings at which every two fit."""
    ways: list[tuple[tuple[int, ...], NDArray[np.bool_]]] = [
        ((source,), np.ones(HEADINGS, dtype=np.bool_)) for source in range(sources)
    ]
    for n, k in enumerate(members[1:], 1):
        longer = []
        for way, headings in ways:
            for source in range(sources):
                pairs = [fits[members[m], k].get((way[m], source)) for m in range(n)]
                if source in way or any(each is None for each in pairs):
                    continue
                left = np.logical_and.reduce([headings, *(each for each in pairs if each is not None)])
                if left.any():
                    longer.append(((*way, source), left))
        ways = longer[:MOST_TRIED]
    return ways


def _alone(rows: tuple[int, ...], sights: Sights) -> float:
    """Return the logarithm of the evidence that a flare is a source by itself."""
    if not np.isfinite(sights.log_range[list(rows)]).any():
        return math.log(PER_M3)
    return evidence_alone(sights, rows) + math.log(PER_M3)


def _robot(chosen: Candidate, odds: float, seen: _Seen, time_s: float) -> RobotPose:
    hypotheses = []
    for way, found, log in chosen.ways:
        share = math.exp(log - chosen.log_evidence)
        for mode in found.modes:
            if share * mode.share > LEAST_ODDS:
                x, y, z = mode.position_m.tolist()
                hypotheses.append(
                    PoseHypothesis(share * mode.share, (x, y, z), mode.heading_rad, mode.covariance, way)
                )
    members = [seen.measurements[k] for k in chosen.members]
    return RobotPose(
        robot=members[0].robot,
        time_s=time_s if math.isfinite(time_s) else float(np.mean([each.time_s for each in members])),
        kind=chosen.layout.kind,
        flares=tuple(each.detections[0] for each in members),
        group_odds=odds,
        hypotheses=tuple(sorted(hypotheses, key=lambda each: -each.odds)),
    )
