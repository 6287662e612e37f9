"""Whether cameras agree on the flares that two of them should see; if not, they stand otherwise than said."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import bearing_body, direction_camera
from perception.model.lens import project
from perception.rig.frame_sets import robot_of
from perception.types import Calibration, Detection

Array = NDArray[np.float64]

LEAST_SHARED = 6
"""So many flares must have been in two cameras' view before anything is said of them."""

_FOUND, _EXPLAINED = 0.7, 0.8
_TOLERANCE_RAD = math.radians(3.0)
_BRIGHT = 20.0  # flux over its σ: what the other camera cannot have missed
_USUAL_RANGE_M = 3.0  # where none is known; cameras of a rig stand close together
_MOST_SETS = 400


@dataclass(frozen=True)
class Overlap:
    """How cameras of one robot agree.

    Attributes
    ----------
    shared, agreed
        Flares that another camera should see too, by the extrinsics, and of these what it has there.
    exchanged
        Two cameras that would agree if each had the other's images; several pairs where each explains as much
        (of four in a ring front and back, or left and right), none where no two would.
    shared_exchanged, agreed_exchanged
        What `shared` and `agreed` would be then.
    """

    shared: int
    agreed: int
    exchanged: tuple[tuple[str, str], ...] = ()
    shared_exchanged: int = 0
    agreed_exchanged: int = 0

    @property
    def contradicts(self) -> bool:
        """Whether the flares contradict the extrinsics: fewer than seven of ten are where they should be."""
        return self.shared >= LEAST_SHARED and self.agreed < _FOUND * self.shared


def finest(estimators: Sequence[str]) -> str | None:
    """Return the estimator whose detections say best how cameras stand; None of none."""
    return "robust" if "robust" in estimators else next(iter(estimators), None)


def overlap_warnings(
    sets: Iterable[Mapping[str, Sequence[Detection]]], calibrations: Mapping[str, Calibration]
) -> Iterator[str]:
    """Yield what is to be told of each robot whose cameras contradict their extrinsics (`overlap_of`)."""
    by_robot: dict[str, list[Mapping[str, Sequence[Detection]]]] = {}
    for each in sets:
        for robot in dict.fromkeys(map(robot_of, each)):
            own = {camera: hits for camera, hits in each.items() if robot_of(camera) == robot}
            by_robot.setdefault(robot, []).append(own)
    for robot, own_sets in by_robot.items():
        overlap = overlap_of(own_sets, calibrations)
        if overlap.contradicts:
            yield overlap_warning(robot, overlap)


def overlap_warning(robot: str, overlap: Overlap) -> str:
    """Say that cameras contradict their extrinsics, and what would explain it."""
    seen = (
        f"{robot}: of {overlap.shared} flares that two cameras should see, by rotation_body_camera and "
        f"position_body_m of calibration.json, {overlap.agreed} are in both"
    )
    if not overlap.exchanged:
        return f"{seen}: check the cameras' mounting, focal lengths, and which file is of which camera"
    pairs = ", or of ".join(f"{one} and {other}" for one, other in overlap.exchanged)
    return (
        f"{seen}; with the images of {pairs} exchanged it were {overlap.agreed_exchanged} of "
        f"{overlap.shared_exchanged}: these look swapped; check which file is of which camera"
    )


@dataclass(frozen=True, eq=False)
class _Seen:
    """The bright flares of one camera's image in a set: places, ranges; and all places that it has."""

    bright_px: Array
    range_m: Array
    places_px: Array


def overlap_of(
    sets: Iterable[Mapping[str, Sequence[Detection]]], calibrations: Mapping[str, Calibration]
) -> Overlap:
    """Compare what the cameras of one robot see.

    Parameters
    ----------
    sets
        Of each set of frames the detections by camera; cameras that took no frame are not in it.
    calibrations
        By camera.
    """
    seen = [
        {camera: _seen(hits) for camera, hits in each.items()}
        for each in itertools.islice(sets, _MOST_SETS)
        if len(each) > 1
    ]
    cameras = sorted({camera for each in seen for camera in each})
    own = {camera: calibrations[camera] for camera in cameras}
    found = Overlap(*_agreement(seen, own))
    if not found.contradicts:
        return found
    best = found
    for one, other in itertools.combinations(cameras, 2):
        if (own[one].width_px, own[one].height_px) != (own[other].width_px, own[other].height_px):
            continue
        shared, agreed = _agreement(seen, {**own, one: own[other], other: own[one]})
        if shared < LEAST_SHARED or agreed < max(_EXPLAINED * shared, best.agreed_exchanged):
            continue
        others = best.exchanged if agreed == best.agreed_exchanged else ()
        best = Overlap(found.shared, found.agreed, (*others, (one, other)), shared, agreed)
    return best


def _seen(hits: Sequence[Detection]) -> _Seen:
    bright = [
        hit for hit in hits if not hit.merged and not hit.ghost and hit.flux_dn > _BRIGHT * hit.flux_sigma_dn
    ]
    ranges_m = [hit.range_m if math.isfinite(hit.range_m) else _USUAL_RANGE_M for hit in bright]
    places = (np.array([(hit.u_px, hit.v_px) for hit in some]).reshape(-1, 2) for some in (bright, hits))
    bright_px, places_px = places
    return _Seen(bright_px, np.array(ranges_m), places_px)


def _agreement(
    seen: Sequence[Mapping[str, _Seen]], calibrations: Mapping[str, Calibration]
) -> tuple[int, int]:
    """Return how many bright flares another camera should see, and how many it has."""
    shared = agreed = 0
    for each in seen:
        for one, other in itertools.permutations(each, 2):
            known = calibrations[other]
            expected = _as_seen_by(known, _positions_m(each[one], calibrations[one]))
            if not expected.size:
                continue
            shared += len(expected)
            there = direction_camera(each[other].places_px, known)
            if len(there):
                agreed += int(((expected @ there.T).max(axis=1) > math.cos(_TOLERANCE_RAD)).sum())
    return shared, agreed


def _positions_m(seen: _Seen, calibration: Calibration) -> Array:
    """Return where bright flares are in body axes, shape (n, 3)."""
    towards = bearing_body(seen.bright_px, calibration)
    return np.asarray(calibration.position_body_m + seen.range_m[:, None] * towards)


def _as_seen_by(calibration: Calibration, positions_m: Array) -> Array:
    """Return directions in camera axes, shape (m, 3), of those that lie well within its image."""
    towards = (positions_m - calibration.position_body_m) @ calibration.rotation_body_camera
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    towards = towards[towards[:, 2] > 0.0]
    places_px = project(towards, calibration)
    margin_px = max(calibration.fx_px, calibration.fy_px) * math.tan(_TOLERANCE_RAD)
    size_px = np.array([calibration.width_px - 1, calibration.height_px - 1])
    inside = (places_px > margin_px) & (places_px < size_px - margin_px)
    return np.asarray(towards[inside.all(axis=1)])
