"""Which flares are one robot, which source each of them is, and how the robot stands."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from perception.rig.frame_sets import Exposed
from perception.rig.moving import at_one_time
from perception.rig.pose.layout import LEAST_ODDS, PoseModel, Sights
from perception.rig.pose.partings import Candidate, told_apart
from perception.rig.rays import UNKNOWN_RANGE
from perception.rig.sightings import CAMERAS_MOST, CAMERAS_SHARE, LEAST_NOISE, UNCLAIMED_RANGE, sightings_of
from perception.types import Calibration, Detection, Layout, Measurement, Odometry, PoseHypothesis, RobotPose

Array = NDArray[np.float64]

SEEN = 0.9
"""How probable it is, beforehand, that a source of a robot is seen: it may be off, or behind its body."""

PER_M3 = 0.1
"""How densely robots, and other sources, are taken to stand."""

GATE_CHI2 = 30.0
"""More χ² than this beyond its degrees of freedom is another robot: less than once in a million."""

_LEAST_ACROSS_M = 1e-3  # of sources from each other, level: less tells no heading

MOST_FLARES = 40
MOST_TRIED = 720

_GATE_HEADINGS = np.arange(72) * (2.0 * math.pi / 72.0)
_GATE_SLACK = 0.05  # of the distance between two sources: half a step of the headings above


@dataclass(frozen=True, eq=False)
class _Flare:
    """A measurement, its sightings' rows, roughly where it is, and its noise in m², shape (3, 3)."""

    measurement: Measurement
    rows: tuple[int, ...]
    place_m: Array
    noise_m2: Array


def told_robots(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    measurements: Sequence[Measurement],
    odometry: Sequence[Odometry] = (),
) -> tuple[RobotPose, ...]:
    """Return the robots with several sources that a set of measurements shows.

    A robot is told from two of its flares on, at least one of them with a range and its σ; mirror images are
    none. Flares that no layout explains together are left alone, and so are sources straight above each
    other, which tell no heading.

    Parameters
    ----------
    frames, detections, calibrations, odometry
        As for `measure_set`. Layouts are those that any of the cameras knows, by their kind.
    measurements
        Made of the detections.
    """
    cameras = dict.fromkeys(frame.camera for frame in frames)
    known = {each.kind: each for camera in cameras for each in calibrations[camera].layouts}
    layouts = [each for each in known.values() if _tells_heading(each)]
    claimed = any(math.isfinite(hit.range_sigma_m) for each in detections for hit in each)
    if not layouts or not claimed or len(measurements) < 2:
        return ()
    sights, keys, time_s = sights_of(frames, detections, calibrations, odometry)
    row_of = {key: row for row, key in enumerate(keys)}
    flares = [
        _flare(each, tuple(row_of[key] for key in each.detections), sights)
        for each in measurements
        if each.ghost != "yes"
    ]
    flares = sorted(flares, key=lambda flare: float(np.linalg.norm(flare.place_m)))[:MOST_FLARES]
    candidates = _candidates(flares, sights, layouts)
    robots = []
    for chosen, odds in told_apart(candidates, [_alone(flare, sights) for flare in flares]):
        robots.append(_robot(chosen, odds, flares, time_s))
    return tuple(robots)


def _tells_heading(layout: Layout) -> bool:
    across_m = np.ptp(np.array(layout.places_body_m)[:, :2], axis=0)
    return bool(across_m.max() > _LEAST_ACROSS_M)


def sights_of(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    odometry: Sequence[Odometry] = (),
) -> tuple[Sights, tuple[tuple[str, int, int], ...], float]:
    """Return what detections say, with the errors that they share told from their own; and which they are.

    With odometry all is in the body axes of one time, which comes last: NaN without.
    """
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
    carried = at_one_time(sightings_of(frames, detections, exact), odometry)
    found = carried.sightings
    rays, n = found.rays, len(found.keys)
    hits = [hit for each in detections for hit in each]
    cameras = [key[0] for key in found.keys]
    names = list(dict.fromkeys(cameras))
    own, constant, by_flux = np.zeros((n, 3, 3)), np.zeros(n), np.ones(n)
    shared = np.zeros((n, 3, 7 * len(names)))
    own[:, :2, :2] = found.together.angular_rad2
    astray2 = found.together.noise**2 - rays.noise**2  # where the observer moved between its cameras
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
            own[k, 2, 2] += astray2[k]
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
    return sights, found.keys, carried.time_s


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


def _candidates(flares: Sequence[_Flare], sights: Sights, layouts: Sequence[Layout]) -> list[Candidate]:
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
    near = _stand_near(flares, layout)
    for i, j in combinations(range(len(flares)), 2):
        if not near[i, j]:
            continue
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


def _stand_near(flares: Sequence[_Flare], layout: Layout) -> NDArray[np.bool_]:
    """Tell which two flares are not too far apart across the line of sight to be of one robot, generously."""
    places_m = np.array(layout.places_body_m)
    longest_m = float(np.linalg.norm(places_m[:, None] - places_m, axis=-1).max())
    # A source of less flux seems farther off by the root of it, and so farther from others.
    stretched = math.exp(0.5 * float(np.ptp(np.log(np.array(layout.relative_flux)))))
    place_m = np.array([flare.place_m for flare in flares])
    apart_m = place_m[:, None] - place_m
    middle_m = 0.5 * (place_m[:, None] + place_m)
    along = middle_m / np.maximum(np.linalg.norm(middle_m, axis=-1, keepdims=True), 1e-9)
    across_m = np.linalg.norm(apart_m - (apart_m * along).sum(axis=-1, keepdims=True) * along, axis=-1)
    # In sight's axes angles' noise is the least of the three, and K's error stretches all alike.
    noise_m = np.array([math.sqrt(max(float(np.trace(flare.noise_m2)), 0.0)) for flare in flares])
    reach_m = 1.5 * stretched * longest_m + 6.0 * np.minimum(noise_m[:, None] + noise_m, 0.1)
    return np.asarray(~(across_m > reach_m))  # what has no range is not told apart


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
) -> Candidate | None:
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
    return Candidate(members, layout, tuple(ways), float(np.logaddexp.reduce(logs)))


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


def _robot(chosen: Candidate, odds: float, flares: Sequence[_Flare], time_s: float) -> RobotPose:
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
        time_s=time_s if math.isfinite(time_s) else float(np.mean([each.time_s for each in members])),
        kind=chosen.layout.kind,
        flares=tuple(each.detections[0] for each in members),
        group_odds=odds,
        hypotheses=tuple(sorted(hypotheses, key=lambda each: -each.odds)),
    )
