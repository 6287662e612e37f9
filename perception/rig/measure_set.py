"""The one call from a set of frames to who stands where."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from perception.estimators import Estimator, detect_frames
from perception.rig.extinction import Extinction, corrected, estimated_extinction
from perception.rig.frame_sets import Exposed, robot_of
from perception.rig.fusion import associated, fused, measurements_of
from perception.rig.ghosts import called, told_ghosts
from perception.rig.mirrors.planes import check_planes
from perception.rig.moving import OneTime, at_one_time
from perception.rig.robots import told_robots
from perception.rig.sightings import sightings_of
from perception.types import (
    Calibration,
    Detection,
    Detections,
    Measurement,
    MirrorPlane,
    Odometry,
    RawFrame,
    SetMeasurements,
)

_FOG_PASSES = 3


def detect_set(
    frames: Sequence[RawFrame],
    calibrations: Mapping[str, Calibration],
    estimator: str | Estimator = "robust",
    planes: Sequence[MirrorPlane] = (),
    odometry: Sequence[Odometry] = (),
    *,
    limit_s: float = math.inf,
) -> SetMeasurements:
    """Find the sources around a robot in a set of its cameras' frames.

    Parameters
    ----------
    frames
        Of one robot, taken within half a period (`frame_sets`): one of each camera, or several exposures.
    calibrations
        Of each camera, by its name.
    estimator
        As for `detect`.
    planes
        Mirrors known from earlier sets, in the body axes of today.
    odometry
        As for `measure_set`.
    limit_s
        As for `detect`, of each frame.

    Returns
    -------
    SetMeasurements
        Every source once, however many cameras see it, with whether it is a mirror image (`told_ghosts`).
        Where calibrations give the extinction a σ it is estimated too, if the set tells it, and ranges are
        corrected (`extinction`).

    Raises
    ------
    ValueError
        As for `detect`, if a camera has no calibration, or the frames are of several robots.
    """
    found = detect_frames(frames, calibrations, estimator, limit_s=limit_s)
    return measure_set(frames, found, calibrations, planes, odometry)


def measure_set(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    planes: Sequence[MirrorPlane] = (),
    odometry: Sequence[Odometry] = (),
) -> SetMeasurements:
    """As `detect_set`, from the detections of each frame, or record of a frame.

    Parameters
    ----------
    odometry
        The robot's records around the set, by time: where its cameras do not expose all at once, and it turns
        or drives, their rays meet only if that is reckoned with. Without any it stands still.

    Raises
    ------
    ValueError
        If a camera has no calibration, the frames are of several robots, or odometry is not by time.
    """
    robots = sorted({robot_of(frame.camera) for frame in frames})
    if len(robots) > 1:
        raise ValueError(f"a set is of one robot's frames, not of {', '.join(robots)}: see frame_sets")
    if unknown := sorted({frame.camera for frame in frames} - set(calibrations)):
        raise ValueError(f"no calibration for {', '.join(unknown)}")
    check_planes(planes)
    known, measurements, mirrors = _measured(frames, detections, calibrations, planes, odometry)
    extinction: Extinction | None = None
    as_found = detections
    images: set[tuple[str, int, int]] | None = None
    # Ranges that are corrected show mirrors that ranges in fog did not, whose images are no fog.
    for _ in range(_FOG_PASSES):
        shown = {key for each in measurements if each.ghost == "yes" for key in each.detections}
        if shown == images:
            break
        images = shown
        extinction = estimated_extinction(frames, as_found, calibrations, images)
        if extinction is None:
            break
        detections = corrected(frames, as_found, calibrations, extinction)
        known, measurements, mirrors = _measured(frames, detections, calibrations, planes, odometry)
    seen = SetMeasurements(
        measurements,
        tuple(map(_kept, as_found, detections)),
        mirrors,
        *((extinction.per_m, extinction.sigma_per_m) if extinction is not None else ()),
    )
    return replace(seen, robots=told_robots(known, frames, detections, calibrations, measurements))


def _kept(found: Sequence[Detection], now: Sequence[Detection]) -> Detections:
    """Return a frame's detections, with what was said of them as a whole."""
    if isinstance(found, Detections):
        return found.replaced_by(now)
    return Detections(now)


def _measured(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    planes: Sequence[MirrorPlane],
    odometry: Sequence[Odometry],
) -> tuple[OneTime, tuple[Measurement, ...], tuple[MirrorPlane, ...]]:
    """Join detections to measurements, and tell mirror images from robots."""
    known = at_one_time(sightings_of(frames, detections, calibrations), odometry)
    found = known.sightings
    own_sources_body_m = calibrations[frames[0].camera].own_sources_body_m if frames else np.empty((0, 3))
    groups = associated(found)
    sources = fused(found, groups)
    probability, mirrors = told_ghosts(sources, own_sources_body_m, planes)
    ghosts = [called(each) for each in probability.tolist()]
    return known, known.back(measurements_of(sources, groups, found, ghosts, probability)), mirrors
