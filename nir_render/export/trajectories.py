"""Where robots went, as files of TUM: what trajectory tools such as evo read."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nir_render.errors import InputError
from nir_render.export.aside import export_folder
from nir_render.run import folder as run_folder
from nir_render.run.folder import write_file
from nir_render.truth.poses import parse_pose
from nir_render.truth.sources import parse_truth
from perception import RecordingError, parse_track, read_calibrations, read_frame_records
from perception.files.tracks import read_odometry
from perception.rig.frame_sets import mid_exposure_s, robot_of

_STILL = (0.0, 0.0, 0.0, 1.0)  # sources and tracks have a place and no orientation


def export_tum(folder: Path, target: Path, overwrite: bool = False) -> dict[str, int]:
    """Write trajectories, a file each: seconds, place in metres, quaternion (x, y, z, w).

    `truth.ROBOT.txt` in the world, `odometry.ROBOT.txt` in the robot's frame of odometry,
    `track.NAME.ROBOT.ID.txt` of what the estimator NAME's track ID says of another robot, in the body axes of
    the observing ROBOT at each time, and `relative.OBSERVER.ROBOT.SOURCE.txt`, where that source truly is in
    these axes, at the middle of each exposure that the truth has a line for, be it seen there or not.

    Returns
    -------
    How many lines there are, by file.

    Raises
    ------
    InputError
        The folder has no poses, odometry, tracks or truth, or one of these is broken; as
        `aside.export_folder`.
    """
    files: dict[str, dict[float, str]] = defaultdict(dict)
    try:
        for file, time_s, line in _lines(folder):
            files[file][time_s] = line
    except RecordingError as error:
        raise InputError(*error.problems) from None
    if not files:
        raise InputError(
            f"{folder}: has no poses, odometry, tracks or truth; render it, or perceive it first"
        )
    with export_folder(target, overwrite) as aside:
        for file, lines in files.items():
            text = "".join(f"{time_s:.9f} {line}\n" for time_s, line in sorted(lines.items()))
            write_file(aside / file, f"# timestamp tx ty tz qx qy qz qw\n{text}".encode())
    return {file: len(lines) for file, lines in sorted(files.items())}


def _lines(folder: Path) -> Iterator[tuple[str, float, str]]:
    """Yield all lines there are: file, time, and the rest."""
    if (folder / run_folder.POSES).is_file():
        for pose in run_folder.parse_lines(folder / run_folder.POSES, parse_pose):
            yield f"truth.{pose.robot}.txt", pose.time_s, _line(pose.position_m, pose.quaternion_xyzw)
    for robot, records in read_odometry(folder).items():
        for one in records:
            turn = Rotation.from_matrix(one.rotation).as_quat()
            yield f"odometry.{robot}.txt", one.time_s, _line(one.position_m, turn)
    for path in sorted(folder.glob("tracks.*.jsonl")):
        name = path.name.removeprefix("tracks.").removesuffix(".jsonl")
        for track in run_folder.parse_lines(path, parse_track):
            file = f"track.{name}.{track.robot}.{track.track}.txt"
            yield file, track.time_s, _line(track.position_body_m, _STILL)
    if (folder / run_folder.TRUTH).is_file():
        yield from _relative(folder)


def _relative(folder: Path) -> Iterator[tuple[str, float, str]]:
    """Yield where sources are from those who look at them, of all cameras; mirror images are no place."""
    known = read_calibrations(folder)
    taken_s = {
        (frame.camera, frame.index): mid_exposure_s(frame, known[frame.camera].height_px)
        for frame in read_frame_records(folder)
        if frame.camera in known
    }
    for truth in run_folder.parse_lines(folder / run_folder.TRUTH, parse_truth):
        key = (truth.camera, truth.index)
        if truth.ghost_of is None and key in taken_s:
            place = known[truth.camera].position_body_m + truth.range_m * np.array(truth.bearing_body)
            file = f"relative.{robot_of(truth.camera)}.{truth.robot}.{truth.source}.txt"
            yield file, taken_s[key], _line(place, _STILL)


def _line(position_m: Iterable[float], quaternion_xyzw: Iterable[float]) -> str:
    return " ".join(f"{value:.9g}" for value in (*position_m, *quaternion_xyzw))
