"""`preview.gif`: the frames of one camera with the numbers of the tracks drawn in."""

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.tracks import Moment
from nir_render.report.pictures import spread, whole_picture
from nir_render.report.time.plots import COLOURS
from perception.model.lens import project
from perception.rig.frame_sets import robot_of
from perception.types import Calibration, FrameKey, RawFrame, Track

MOST_BYTES = 3_000_000
_MOST_FRAMES = 80
_WIDTH_PX = 480


def film_gif(
    keys: Sequence[FrameKey],
    moments: Sequence[Moment],
    name: str,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
) -> bytes | None:
    """Draw the camera with most frames, one estimator's tracks in it.

    Frames are left out until it has at most 80 of them and 3 MB; it runs as fast as time did.

    Returns
    -------
    A GIF file; None where no camera has two frames.
    """
    cameras = dict.fromkeys(camera for camera, _ in keys)
    by_camera = {camera: [key for key in keys if key[0] == camera] for camera in cameras}
    best = max(by_camera, key=lambda camera: len(by_camera[camera]), default=None)
    if best is None or len(by_camera[best]) < 2:
        return None
    calibration = calibrations[best]
    own = [moment for moment in moments if moment.robot == robot_of(best)]
    block_px = max(1, -(-calibration.width_px // _WIDTH_PX))
    shown = spread(by_camera[best], _MOST_FRAMES)
    pictures, times_s = [], []
    for key in shown:
        frame = load(key)
        mid_s = frame.time_s + 0.5 * frame.exposure_s
        at = min(own, key=lambda moment: abs(moment.time_s - mid_s), default=None)
        tracks = [] if at is None else [track for track, _ in at.tracks.get(name, ())]
        pictures.append(_drawn(whole_picture(frame, calibration, block_px), tracks, calibration, block_px))
        times_s.append(frame.time_s)
    step = 1
    while True:
        film = _encoded(pictures[::step], times_s[::step])
        if len(film) <= MOST_BYTES or step >= len(pictures) // 2:
            return film
        step *= 2


def places_px(tracks: Sequence[Track], calibration: Calibration) -> NDArray[np.float64]:
    """Return where tracks stand in a camera's image, shape (n, 2); NaN for what is behind it."""
    place_m = np.array([track.position_body_m for track in tracks]).reshape(-1, 3)
    return project((place_m - calibration.position_body_m) @ calibration.rotation_body_camera, calibration)


def _drawn(
    grey: NDArray[np.uint8], tracks: Sequence[Track], calibration: Calibration, block_px: int
) -> NDArray[np.uint8]:
    picture = np.ascontiguousarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    rows, columns = grey.shape
    for track, place in zip(tracks, places_px(tracks, calibration), strict=True):
        u, v = (place + 0.5) / block_px - 0.5
        if not (0.0 <= u < columns and 0.0 <= v < rows):
            continue
        colour = tuple(int(COLOURS[track.track % len(COLOURS)][i : i + 2], 16) for i in (5, 3, 1))
        centre = (round(u), round(v))
        cv2.circle(picture, centre, 7, colour, 1, cv2.LINE_8)
        text = f"{track.track}" + ("" if track.detections else "?") + ("'" if track.ghost == "yes" else "")
        cv2.putText(picture, text, (centre[0] + 9, centre[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1)
    return np.asarray(picture, dtype=np.uint8)


def _encoded(pictures: Sequence[NDArray[np.uint8]], times_s: Sequence[float]) -> bytes:
    film = cv2.Animation()
    film.frames = list(pictures)
    pace_ms = np.diff(times_s) * 1e3
    film.durations = np.maximum(np.append(pace_ms, pace_ms[-1]), 20.0).astype(np.int32)
    done, buffer = cv2.imencodeanimation(".gif", film)
    if not done:
        raise RuntimeError("OpenCV could not encode the film as GIF")
    return bytes(buffer.tobytes())
