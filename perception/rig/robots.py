"""Which flares are one robot, which source each of them is, and how the robot stands."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from perception.rig.frame_sets import Exposed
from perception.rig.pose.layout import LEAST_ODDS, PoseModel, Posterior, Sights
from perception.rig.rays import UNKNOWN_RANGE
from perception.rig.sightings import CAMERAS_MOST, CAMERAS_SHARE, LEAST_NOISE, UNCLAIMED_RANGE, sightings_of
from perception.types import Calibration, Detection, Layout, Measurement, PoseHypothesis, RobotPose

Array = NDArray[np.float64]

SEEN = 0.9
"""How probable it is, beforehand, that a source of a robot is seen: it may be off, or behind its body."""

PER_M3 = 0.1
"""How densely robots, and other sources, are taken to stand."""

GATE_CHI2 = 30.0
"""More χ² than this beyond its degrees of freedom is another robot: less than once in a million."""

MOST_FLARES = 40
MOST_TRIED = 720
MOST_TOGETHER = 10

_GATE_HEADINGS = np.arange(72) * (2.0 * math.pi / 72.0)
_GATE_SLACK = 0.05  # of the distance between two sources: half a step of the headings above


@dataclass(frozen=True, eq=False)
class _Flare:
    """A measurement, its sightings' rows, roughly where it is, and its noise in m², shape (3, 3)."""

    measurement: Measurement
    rows: tuple[int, ...]
    place_m: Array
    noise_m2: Array


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Some flares as one robot: posteriors by which source each is; the logarithm of its evidence."""

    members: tuple[int, ...]
    layout: Layout
    ways: tuple[tuple[tuple[int, ...], Posterior, float], ...]
    log_evidence: float


def told_robots(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    measurements: Sequence[Measurement],
) -> tuple[RobotPose, ...]:
    """Return the robots with several sources that a set of measurements shows.

    A robot is told from two of its flares on, at least one of them with a range; mirror images are none.
    Flares that no layout explains together are left alone.

    Parameters
    ----------
    frames, detections, calibrations
        As for `measure_set`. The layouts are those of the first frame's camera.
    measurements
        Made of the detections.
    """
    if len(measurements) < 2:
        return ()
    layouts = [each for each in calibrations[frames[0].camera].layouts if len(each.places_body_m) > 1]
    if not layouts:
        return ()
    sights, keys = sights_of(frames, detections, calibrations)
    row_of = {key: row for row, key in enumerate(keys)}
    flares = [
        _flare(each, tuple(row_of[key] for key in each.detections), sights)
        for each in measurements
        if each.ghost != "yes"
    ]
    flares = sorted(flares, key=lambda flare: float(np.linalg.norm(flare.place_m)))[:MOST_FLARES]
    candidates = _candidates(flares, sights, layouts)
    robots = []
    for chosen, odds in _told_apart(candidates, [_alone(flare, sights) for flare in flares]):
        robots.append(_robot(chosen, odds, flares))
    return tuple(robots)


def sights_of(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
) -> tuple[Sights, tuple[tuple[str, int, int], ...]]:
    """Return what detections say, with the errors that they share told from their own; and which they are."""
    exact = {
        name: replace(
            each,
            sigma={
                field: value
                for field, value in each.sigma.items()
                if field not in ("rotation_body_camera", "position_body_m")
            },
        )
        for name, each in calibrations.items()
    }
    found = sightings_of(frames, detections, exact)
    rays, n = found.rays, len(found.keys)
    hits = [hit for each in detections for hit in each]
    cameras = [key[0] for key in found.keys]
    names = list(dict.fromkeys(cameras))
    own, constant, by_flux = np.zeros((n, 3, 3)), np.zeros(n), np.ones(n)
    shared = np.zeros((n, 3, 7 * len(names)))
    own[:, :2, :2] = rays.angular_rad2
    for k, hit in enumerate(hits):
        calibration = calibrations[hit.camera]
        at_m = rays.range_m[k]
        first = 7 * names.index(hit.camera)
        if math.isnan(at_m):
            own[k, 2, 2] = UNKNOWN_RANGE**2
            at_m = 1.0
        elif not math.isfinite(hit.range_sigma_m):
            own[k, 2, 2] = UNCLAIMED_RANGE**2
        else:
            common = np.nan_to_num(hit.range_sigma_common_m) / at_m
            of_camera2 = min(CAMERAS_SHARE * common**2, CAMERAS_MOST**2)
            own[k, 2, 2] = max((hit.range_sigma_m / at_m) ** 2 - common**2, LEAST_NOISE**2)
            constant[k] = math.sqrt(common**2 - of_camera2)
            shared[k, 2, first + 6] = math.sqrt(of_camera2)
            by_flux[k] = _by_flux(float(common), calibration)
        turned_rad = calibration.sigma.get("rotation_body_camera", 0.0)
        moved_m = calibration.sigma.get("position_body_m", 0.0)
        axes = rays.axes[k]
        shared[k, :2, first : first + 3] = turned_rad * np.cross(axes[2], axes[:2])
        shared[k, :2, first + 3 : first + 6] = moved_m / at_m * axes[:2]
        shared[k, 2, first + 3 : first + 6] = moved_m / at_m * axes[2]
    sights = Sights(
        rays.origin_m, rays.axes, np.log(rays.range_m), by_flux, own, shared.reshape(3 * n, -1), constant
    )
    return sights, found.keys


def _by_flux(common: float, calibration: Calibration) -> float:
    """Return the share of a range that comes of flux: its answer to an error of K over that of K/F alone."""
    sigma = calibration.sigma.get("range_constant_dn_m2_per_s", 0.0) / calibration.range_constant_dn_m2_per_s
    return min(1.0, 2.0 * common / sigma) if sigma > 0.0 else 1.0


def _flare(measurement: Measurement, rows: tuple[int, ...], sights: Sights) -> _Flare:
    """Return a measurement with its place, and how well it is known but for what all share."""
    k = min(rows, key=lambda row: float(sights.own[row, 2, 2]))
    range_m = float(np.exp(sights.log_range[k]))
    if not math.isfinite(range_m):
        range_m = measurement.range_m if math.isfinite(measurement.range_m) else math.nan
    axes = sights.axes[k]
    return _Flare(
        measurement,
        rows,
        sights.origin_m[k] + range_m * axes[2],
        range_m**2 * axes.T @ sights.own[k] @ axes,
    )


def _candidates(flares: Sequence[_Flare], sights: Sights, layouts: Sequence[Layout]) -> list[_Candidate]:
    """Return all groups of flares that may be a robot."""
    candidates = []
    for layout in layouts:
        fits = _fitting_pairs(flares, sights, layout)
        groups = _cliques(len(flares), fits, len(layout.places_body_m))
        whole: set[int] = set()
        for members in reversed(groups):
            # Of flares that stand by themselves as one robot does no part is looked at.
            if whole.issuperset(members):
                continue
            candidate = _candidate(members, flares, sights, layout, fits)
            if candidate is None:
                continue
            candidates.append(candidate)
            if not any(len({*pair} & {*members}) == 1 for pair in fits):
                whole.update(members)
    return candidates


Pairs = dict[tuple[int, int], set[tuple[int, int]]]
"""By two flares, the smaller number first: which two sources of a layout they may be."""


def _fitting_pairs(flares: Sequence[_Flare], sights: Sights, layout: Layout) -> Pairs:
    """Tell which two flares may be which two sources, by how they stand apart."""
    places_m = np.array(layout.places_body_m)
    log_flux = np.log(np.array(layout.relative_flux))
    cosine, sine = np.cos(_GATE_HEADINGS), np.sin(_GATE_HEADINGS)
    fits: Pairs = {}
    for i, j in combinations(range(len(flares)), 2):
        for a, b in permutations(range(len(places_m)), 2):
            x, y, z = places_m[b] - places_m[a]
            length_m = math.sqrt(x**2 + y**2 + z**2)
            # The range constant's error may be anything here; fluxes count as the layout has them.
            apart_m = np.zeros(3)
            covariance = (_GATE_SLACK * length_m) ** 2 * np.eye(3)
            towards = np.zeros(3)
            for sign, k, source in ((-1.0, i, a), (1.0, j, b)):
                flare = flares[k]
                row = flare.rows[0]
                factor = math.exp(0.5 * sights.by_flux[row] * log_flux[source])
                apart_m += sign * (sights.origin_m[row] + factor * (flare.place_m - sights.origin_m[row]))
                covariance += factor**2 * flare.noise_m2
                towards += sign * sights.constant[row] * factor * (flare.place_m - sights.origin_m[row])
                covariance += (0.5 * layout.flux_sigma_own) ** 2 * np.outer(
                    flare.place_m - sights.origin_m[row], flare.place_m - sights.origin_m[row]
                )
                pose = sights.shared[3 * row : 3 * row + 3]
                turn = np.linalg.norm(flare.place_m - sights.origin_m[row]) * sights.axes[row]
                covariance += turn.T @ pose @ pose.T @ turn
            covariance += np.outer(towards, towards)
            if not np.isfinite(apart_m).all():
                fits.setdefault((i, j), set()).add((a, b))
                continue
            off_m = apart_m - np.stack(
                [cosine * x - sine * y, sine * x + cosine * y, np.full(len(cosine), z)], axis=1
            )
            chi2 = np.einsum("bk,bk->b", off_m @ np.linalg.inv(covariance), off_m)
            if chi2.min() < GATE_CHI2:
                fits.setdefault((i, j), set()).add((a, b))
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


def _candidate(
    members: tuple[int, ...], flares: Sequence[_Flare], sights: Sights, layout: Layout, fits: Pairs
) -> _Candidate | None:
    sources = len(layout.places_body_m)
    hidden = sources - len(members)
    rows = np.array([row for k in members for row in flares[k].rows])
    some = sights.some(rows)
    counts = [len(flares[k].rows) for k in members]
    if not np.isfinite(some.log_range).any():
        return None
    ways = []
    for way in _ways(members, sources, fits):
        model = PoseModel(some, layout, np.repeat(np.array(way), counts))
        posterior = model.posterior(GATE_CHI2 + 3 * len(rows))
        if posterior is not None:
            log_prior = len(members) * math.log(SEEN) + hidden * math.log(1.0 - SEEN)
            ways.append((way, posterior, posterior.log_evidence + log_prior + math.log(PER_M3)))
    if not ways:
        return None
    logs = np.array([log for _, _, log in ways])
    return _Candidate(members, layout, tuple(ways), float(np.logaddexp.reduce(logs)))


def _ways(members: tuple[int, ...], sources: int, fits: Pairs) -> list[tuple[int, ...]]:
    """Return which source each flare may be, of every two one that fits."""
    ways: list[tuple[int, ...]] = [()]
    for n, k in enumerate(members):
        ways = [
            (*way, source)
            for way in ways
            for source in range(sources)
            if source not in way and all((way[m], source) in fits[members[m], k] for m in range(n))
        ][:MOST_TRIED]
    return ways


_POINT = Layout("", ((0.0, 0.0, 0.0),), (1.0,))


def _alone(flare: _Flare, sights: Sights) -> float:
    """Return the logarithm of the evidence that a flare is a source by itself."""
    some = sights.some(np.array(flare.rows))
    if not np.isfinite(some.log_range).any():
        return math.log(PER_M3)
    model = PoseModel(some, _POINT, np.zeros(len(flare.rows), dtype=np.int64))
    return model.evidence_of_place() + math.log(PER_M3)


def _told_apart(candidates: Sequence[_Candidate], alone: Sequence[float]) -> list[tuple[_Candidate, float]]:
    """Return the most probable way to part all flares into robots, each with its odds over all ways.

    Flares that no chain of candidates connects are parted by themselves.
    """
    chosen: list[tuple[_Candidate, float]] = []
    for part in _connected(candidates):
        gain = [each.log_evidence - sum(alone[k] for k in each.members) for each in part]
        order = sorted(range(len(part)), key=lambda k: -gain[k])[: 4 * MOST_TOGETHER]
        best: list[tuple[float, tuple[int, ...]]] = []
        _part(order, [part[k].members for k in range(len(part))], gain, 0, (), 0.0, best)
        top = max(best)
        logs = np.array([log for log, _ in best])
        total = float(np.logaddexp.reduce(logs))
        for k in top[1]:
            with_it = [log for log, picked in best if k in picked]
            odds = math.exp(float(np.logaddexp.reduce(np.array(with_it))) - total)
            chosen.append((part[k], min(odds, 1.0)))
    return chosen


_MOST_PARTINGS = 20_000


def _part(
    order: Sequence[int],
    members: Sequence[tuple[int, ...]],
    gain: Sequence[float],
    begin: int,
    picked: tuple[int, ...],
    log: float,
    found: list[tuple[float, tuple[int, ...]]],
) -> None:
    """Gather all ways to pick candidates that share no flare."""
    found.append((log, picked))
    used = {flare for k in picked for flare in members[k]}
    for n in range(begin, len(order)):
        if len(found) > _MOST_PARTINGS:
            return
        k = order[n]
        if not used.intersection(members[k]):
            _part(order, members, gain, n + 1, (*picked, k), log + gain[k], found)


def _connected(candidates: Sequence[_Candidate]) -> list[list[_Candidate]]:
    """Return candidates that share flares together."""
    parts: list[tuple[set[int], list[_Candidate]]] = []
    for each in candidates:
        touching = [part for part in parts if part[0].intersection(each.members)]
        parts = [part for part in parts if part not in touching]
        joined = set(each.members).union(*(part[0] for part in touching))
        parts.append((joined, [*(one for part in touching for one in part[1]), each]))
    return [part for _, part in parts]


def _robot(chosen: _Candidate, odds: float, flares: Sequence[_Flare]) -> RobotPose:
    hypotheses = []
    for way, posterior, log in chosen.ways:
        share = math.exp(log - chosen.log_evidence)
        for mode in posterior.modes:
            if share * mode.share > LEAST_ODDS:
                x, y, z = mode.position_m.tolist()
                hypotheses.append(
                    PoseHypothesis(share * mode.share, (x, y, z), mode.heading_rad, mode.covariance, way)
                )
    members = [flares[k].measurement for k in chosen.members]
    return RobotPose(
        robot=members[0].robot,
        time_s=float(np.mean([each.time_s for each in members])),
        kind=chosen.layout.kind,
        flares=tuple(each.detections[0] for each in members),
        group_odds=odds,
        hypotheses=tuple(sorted(hypotheses, key=lambda each: -each.odds)),
    )
