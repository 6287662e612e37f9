"""What a run says, as the fields of ROS 2 messages: `to_…(…)` gives what `cdr.encode` takes.

Times are seconds of the run's own clock, from 0 on; lengths are metres. Axes are the same in both houses:
cameras x right, y down, z forward (ROS's optical frames), bodies x forward, y left, z up; (0, 0) is the
centre of the first pixel.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nir_render.truth.poses import PoseTruth
from nir_render.truth.sent import SentTruth
from perception import FrameRecord
from perception.types import Calibration, Detection, Message, Odometry, RawFrame, Track

Fields = dict[str, Any]

_SPHERE, _TEXT, _MODIFY, _DELETE_ALL = 2, 9, 0, 3  # of visualization_msgs/Marker
_RING_PX, _LINE_PX, _LETTERS_PX, _LETTERS_M = 24.0, 2.0, 20.0, 0.12
_FOUND = {"r": 0.2, "g": 0.9, "b": 0.5, "a": 1.0}
_GHOST = {"r": 0.9, "g": 0.3, "b": 0.6, "a": 1.0}
_NOTHING = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}


def nanoseconds(time_s: float) -> int:
    """Return a time in whole nanoseconds."""
    return round(time_s * 1e9)


def to_time(time_s: float) -> Fields:
    """Return a `builtin_interfaces/Time`."""
    sec, nanosec = divmod(nanoseconds(time_s), 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def to_header(time_s: float, frame_id: str) -> Fields:
    """Return a `std_msgs/Header`."""
    return {"stamp": to_time(time_s), "frame_id": frame_id}


def to_image(frame: RawFrame, frame_id: str, time_s: float) -> Fields:
    """Return a `sensor_msgs/Image` of the raw counts: mono16, bit by bit."""
    rows, columns = frame.data_dn.shape
    return {
        "header": to_header(time_s, frame_id),
        "height": rows,
        "width": columns,
        "encoding": "mono16",
        "is_bigendian": 0,
        "step": 2 * columns,
        "data": frame.data_dn.astype("<u2").tobytes(),
    }


def to_exposure(frame: FrameRecord, frame_id: str, time_s: float) -> Fields:
    """Return a `nir_render_msgs/Exposure`: how a frame was taken, as `frames.jsonl` has it."""
    return {
        "header": to_header(time_s, frame_id),
        "camera": frame.camera,
        "index": frame.index,
        "time_s": frame.time_s,
        "exposure_s": frame.exposure_s,
        "line_time_s": frame.line_time_s,
        "gain": frame.gain,
        "black_level_dn": frame.black_level_dn,
    }


def to_camera_info(known: Calibration, frame_id: str, time_s: float) -> Fields:
    """Return a `sensor_msgs/CameraInfo`; ROS names OpenCV's models differently."""
    fx, fy, cx, cy = known.fx_px, known.fy_px, known.cx_px, known.cy_px
    distortion = list(known.distortion)
    if known.lens_model == "fisheye":
        model = "equidistant"
    elif len(distortion) == 8:
        model = "rational_polynomial"
    else:
        model, distortion = "plumb_bob", [*distortion, *[0.0] * (5 - len(distortion))]
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {
        "header": to_header(time_s, frame_id),
        "height": known.height_px,
        "width": known.width_px,
        "distortion_model": model,
        "d": distortion,
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": region,
    }


def to_mounts(mounts: Mapping[tuple[str, str], Calibration], time_s: float) -> Fields:
    """Return a `tf2_msgs/TFMessage`: how cameras stand on their robots, by both names."""
    transforms = [
        _transform(time_s, robot, frame_id, known.position_body_m, _quaternion(known.rotation_body_camera))
        for (robot, frame_id), known in mounts.items()
    ]
    return {"transforms": transforms}


def to_place(pose: PoseTruth, robot: str, time_s: float) -> Fields:
    """Return a `tf2_msgs/TFMessage`: where a robot truly stands in the world."""
    return {"transforms": [_transform(time_s, "world", robot, pose.position_m, pose.quaternion_xyzw)]}


def to_odometry(one: Odometry, robot: str, time_s: float) -> Fields:
    """Return a `nav_msgs/Odometry`; its velocity is not known, which a covariance of -1 says."""
    variances = [one.position_sigma_m**2] * 3 + [one.rotation_sigma_rad**2] * 3
    pose = {"position": _xyz(one.position_m), "orientation": _xyzw(_quaternion(one.rotation))}
    still = {"linear": _xyz((0.0, 0.0, 0.0)), "angular": _xyz((0.0, 0.0, 0.0))}
    return {
        "header": to_header(time_s, f"{robot}/odom"),
        "child_frame_id": robot,
        "pose": {"pose": pose, "covariance": np.diag(variances).ravel()},
        "twist": {"twist": still, "covariance": [-1.0] + [0.0] * 35},
    }


def to_detections(
    found: Sequence[Detection], camera: str, index: int, frame_id: str, time_s: float
) -> Fields:
    """Return a `nir_render_msgs/Detections`: what was found in one frame."""
    names = (
        "u_px", "v_px", "u_sigma_px", "v_sigma_px", "flux_dn", "flux_sigma_dn", "background_dn", "saturated",
        "merged", "ghost", "range_m", "range_sigma_m", "bearing_body",
    )  # fmt: skip
    return {
        "header": to_header(time_s, frame_id),
        "camera": camera,
        "index": index,
        "detections": [{name: getattr(one, name) for name in names} for one in found],
    }


def to_annotations(found: Sequence[Detection], time_s: float) -> Fields:
    """Return a `foxglove_msgs/ImageAnnotations`: a ring and the range at each detection."""
    stamp = to_time(time_s)
    rings, texts = [], []
    for one in found:
        colour = _GHOST if one.ghost else _FOUND
        rings.append(
            {"timestamp": stamp, "position": {"x": one.u_px, "y": one.v_px}, "diameter": _RING_PX,
             "thickness": _LINE_PX, "fill_color": _NOTHING, "outline_color": colour}
        )  # fmt: skip
        if math.isfinite(one.range_m):
            texts.append(
                {"timestamp": stamp, "position": {"x": one.u_px + _RING_PX, "y": one.v_px},
                 "text": f"{one.range_m:.2f} m", "font_size": _LETTERS_PX, "text_color": colour,
                 "background_color": _NOTHING}
            )  # fmt: skip
    return {"circles": rings, "points": [], "texts": texts}


def to_tracks(tracks: Sequence[Track], robot: str, time_s: float) -> Fields:
    """Return a `nir_render_msgs/Tracks`: whom a robot follows at one time, in its own axes."""
    listed = [
        {"track": one.track, "position_body_m": one.position_body_m,
         "velocity_body_m_per_s": one.velocity_body_m_per_s, "covariance": one.covariance.ravel(),
         "unseen_s": one.unseen_s, "identity": one.identity or "", "ghost": one.ghost}
        for one in tracks
    ]  # fmt: skip
    return {"header": to_header(time_s, robot), "tracks": listed}


def to_markers(tracks: Sequence[Track], robot: str, time_s: float) -> Fields:
    """Return a `visualization_msgs/MarkerArray`: tracks as ellipsoids of 1 σ, their numbers above them."""
    markers = [_marker(time_s, robot, 0, _SPHERE, _DELETE_ALL)]
    for one in tracks:
        colour = _GHOST if one.ghost == "yes" else _FOUND
        variances, axes = np.linalg.eigh(one.covariance[:3, :3])
        axes[:, 0] *= np.sign(np.linalg.det(axes))  # a turn, no mirror
        size_m = np.maximum(2.0 * np.sqrt(np.maximum(variances, 0.0)), 0.02)
        text = str(one.track) if one.identity is None else f"{one.track} {one.identity}"
        above_m = one.position_body_m + np.array([0.0, 0.0, _LETTERS_M])
        upright = (0.0, 0.0, 0.0, 1.0)
        markers += [
            _marker(time_s, robot, one.track, _SPHERE, _MODIFY, one.position_body_m, _quaternion(axes),
                    size_m, colour),
            _marker(time_s, robot, one.track, _TEXT, _MODIFY, above_m, upright, [_LETTERS_M] * 3, colour,
                    text),
        ]  # fmt: skip
    return {"markers": markers}


def to_word(one: Message | SentTruth, robot: str, time_s: float) -> Fields:
    """Return a `nir_render_msgs/Word`: what a robot was told by a track, or what it sent (track -1)."""
    return {
        "header": to_header(time_s, robot),
        "robot": one.robot,
        "track": one.track if isinstance(one, Message) else -1,
        "start_s": one.start_s,
        "end_s": one.end_s,
        "word": one.word,
        "command": one.command,
        "confidence": one.confidence if isinstance(one, Message) else 1.0,
        "identity": (one.identity or "") if isinstance(one, Message) else one.robot,
    }


def _transform(
    time_s: float, outer: str, inner: str, place_m: Sequence[float] | NDArray[np.float64],
    quaternion: Sequence[float],
) -> Fields:  # fmt: skip
    return {
        "header": to_header(time_s, outer),
        "child_frame_id": inner,
        "transform": {"translation": _xyz(place_m), "rotation": _xyzw(quaternion)},
    }


def _marker(
    time_s: float, robot: str, number: int, shape: int, action: int,
    place_m: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    size_m: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0), colour: Fields = _NOTHING,
    text: str = "",
) -> Fields:  # fmt: skip
    return {
        "header": to_header(time_s, robot),
        "ns": "numbers" if shape == _TEXT else "tracks",
        "id": number,
        "type": shape,
        "action": action,
        "pose": {"position": _xyz(place_m), "orientation": _xyzw(quaternion)},
        "scale": _xyz(size_m),
        "color": colour,
        "lifetime": {"sec": 0, "nanosec": 0},
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": {"header": to_header(time_s, ""), "format": "", "data": b""},
        "uv_coordinates": [],
        "text": text,
        "mesh_resource": "",
        "mesh_file": {"filename": "", "data": b""},
        "mesh_use_embedded_materials": False,
    }


def _xyz(values: Sequence[float] | NDArray[np.float64]) -> Fields:
    return dict(zip("xyz", map(float, values), strict=True))


def _xyzw(values: Sequence[float]) -> Fields:
    return dict(zip("xyzw", map(float, values), strict=True))


def _quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """Return a rotation, shape (3, 3), as (x, y, z, w)."""
    return [float(value) for value in Rotation.from_matrix(rotation).as_quat()]
