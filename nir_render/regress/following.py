"""What time adds to a reference: odometry, and tracks and messages from the detections of each estimator."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from nir_render.evaluate.tracks import FEW_SETS
from nir_render.scene.scene import Scene
from nir_render.simulation.odometry import odometry_by_robot
from perception import (
    Calibration,
    Detection,
    Message,
    Odometry,
    Pipeline,
    RawFrame,
    Track,
    frame_sets,
    odometry_record,
    parse_odometry,
)
from perception.rig.frame_sets import robot_of

ByRobot = Mapping[str, Sequence[Odometry]]


@dataclass(frozen=True, eq=False)
class Followed:
    """What follows from the detections of one estimator: tracks at each set's time, and messages."""

    tracks: tuple[Track, ...]
    messages: tuple[Message, ...]


@dataclass(frozen=True, eq=False)
class Following:
    """What time adds to a reference.

    `odometry` is by robot, `by_estimator` by estimator; both are empty of scenes of fewer than ten sets of
    frames, which say nothing of tracks.
    """

    odometry: ByRobot = field(default_factory=dict)
    by_estimator: Mapping[str, Followed] = field(default_factory=dict)


def following_of(
    scene: Scene,
    frames: Sequence[RawFrame],
    calibrations: Mapping[str, Calibration],
    detections: Mapping[str, Sequence[Detection]],
) -> Following:
    """Return what follows from the detections of a scene's frames, by each estimator."""
    if not is_sequence(frames):
        return Following()
    odometry = odometry_by_robot(scene)
    kept = as_kept(odometry)
    found = {name: followed_of(name, frames, calibrations, hits, kept) for name, hits in detections.items()}
    return Following(odometry, found)


def is_sequence(frames: Sequence[RawFrame]) -> bool:
    """Tell whether frames say anything of tracks."""
    return len({frame.index for frame in frames}) >= FEW_SETS


def as_kept(odometry: ByRobot) -> dict[str, tuple[Odometry, ...]]:
    """Return odometry with the bits that it has when it comes from a file: turns are quaternions there."""
    return {
        robot: tuple(parse_odometry(odometry_record(one)) for one in records)
        for robot, records in odometry.items()
    }


def followed_of(
    name: str,
    frames: Sequence[RawFrame],
    calibrations: Mapping[str, Calibration],
    detections: Sequence[Detection],
    odometry: ByRobot,
) -> Followed:
    """Return the tracks and messages that go with an estimator, from what it found in each frame."""
    hits: dict[tuple[str, int], list[Detection]] = defaultdict(list)
    for one in detections:
        hits[one.camera, one.index].append(one)
    pipelines: dict[str, Pipeline] = {}
    tracks: list[Track] = []
    messages: list[Message] = []
    for taken in frame_sets(frames):
        robot = robot_of(taken[0].camera)
        pipeline = pipelines.setdefault(robot, Pipeline.of(name, calibrations))
        found = [hits[frame.camera, frame.index] for frame in taken]
        heard = pipeline.follow(taken, found, odometry.get(robot, ()))
        tracks += heard.tracks
        messages += heard.messages
    for pipeline in pipelines.values():
        messages += pipeline.finish()
    return Followed(tuple(tracks), tuple(messages))
