"""Where robots went, as files of TUM: what trajectory tools such as evo read."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

from scipy.spatial.transform import Rotation

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from nir_render.run.folder import write_file
from nir_render.truth.poses import parse_pose
from perception import parse_track
from perception.files.tracks import read_odometry

_STILL = "0 0 0 1"  # tracks have a place and no orientation


def export_tum(folder: Path, target: Path) -> dict[str, int]:
    """Write trajectories, a file each: seconds, place in metres, quaternion (x, y, z, w).

    `truth.ROBOT.txt` in the world, `odometry.ROBOT.txt` in the robot's frame of odometry, and
    `track.NAME.ROBOT.ID.txt` of what the estimator NAME's track ID says of another robot, in the body axes of
    the observing ROBOT at each time.

    Returns
    -------
    How many lines there are, by file.

    Raises
    ------
    InputError
        The folder has no poses, odometry or tracks, one of these is broken, or the disk refuses.
    """
    files: dict[str, list[tuple[float, str]]] = defaultdict(list)
    if (folder / run_folder.POSES).is_file():
        for pose in run_folder.parse_lines(folder / run_folder.POSES, parse_pose):
            files[f"truth.{pose.robot}.txt"].append(
                (pose.time_s, _line(pose.position_m, pose.quaternion_xyzw))
            )
    for robot, records in read_odometry(folder).items():
        for one in records:
            files[f"odometry.{robot}.txt"].append(
                (one.time_s, _line(one.position_m, Rotation.from_matrix(one.rotation).as_quat()))
            )
    for path in sorted(folder.glob("tracks.*.jsonl")):
        name = path.name.removeprefix("tracks.").removesuffix(".jsonl")
        for track in run_folder.parse_lines(path, parse_track):
            file = f"track.{name}.{track.robot}.{track.track}.txt"
            files[file].append((track.time_s, _line(track.position_body_m, ()) + _STILL))
    if not files:
        raise InputError(f"{folder}: has no poses, odometry or tracks; render it, or perceive it first")
    for file, lines in files.items():
        text = "".join(f"{time_s:.9f} {rest}\n" for time_s, rest in sorted(lines))
        write_file(target / file, f"# timestamp tx ty tz qx qy qz qw\n{text}".encode())
    return {file: len(lines) for file, lines in sorted(files.items())}


def _line(position_m: Iterable[float], quaternion_xyzw: Iterable[float]) -> str:
    place = "".join(f"{value:.9g} " for value in position_m)
    return place + " ".join(f"{value:.9g}" for value in quaternion_xyzw)
