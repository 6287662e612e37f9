"""What the observer's four cameras show in the last set of a run, and whom it follows there."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.report.pictures import whole_picture
from nir_render.report.time.film import places_px
from nir_render.run import folder as run_folder
from perception import Track, parse_track, read_calibrations, read_frame, read_frame_records

TRACKS = "tracks.robust.jsonl"

_VIEW = (640, 480)  # width, height
_GAP = 4
_SEEN, _UNSEEN = (122, 194, 46), (133, 37, 247)  # blue, green, red


def views_of(run: Path) -> NDArray[np.uint8] | None:
    """Return the four cameras' pictures beside each other, BGR, or None of a run without frames.

    A ring stands where a track is: green where it was seen in this set, red where it is predicted.
    """
    if not (run / run_folder.FRAMES).is_file():
        return None
    known, frames = read_calibrations(run), list(read_frame_records(run))
    tracks: list[Track] = run_folder.parse_lines(run / TRACKS, parse_track)
    drawn = []
    for frame in frames:
        calibration = known[frame.camera]
        grey = whole_picture(read_frame(run, frame), calibration, calibration.width_px // _VIEW[0])
        picture = np.asarray(cv2.cvtColor(cv2.resize(grey, _VIEW), cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        _rings_into(picture, tracks, places_px(tracks, calibration) * (_VIEW[0] / calibration.width_px))
        cv2.putText(picture, frame.camera, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (220, 220, 220), 1)
        drawn.append(picture)
    if len(drawn) % 2:
        drawn.append(np.zeros_like(drawn[0]))
    beside, below = (
        np.zeros((_VIEW[1], _GAP, 3), np.uint8),
        np.zeros((_GAP, 2 * _VIEW[0] + _GAP, 3), np.uint8),
    )
    parts: list[NDArray[np.uint8]] = []
    for left, right in zip(drawn[::2], drawn[1::2], strict=True):
        parts += [below] if parts else []
        parts.append(np.hstack([left, beside, right]))
    return np.asarray(np.vstack(parts), dtype=np.uint8)


def _rings_into(picture: NDArray[np.uint8], tracks: Sequence[Track], places: NDArray[np.float64]) -> None:
    for track, place in zip(tracks, places, strict=True):
        if track.ghost == "yes" or not np.isfinite(place).all():
            continue
        u, v = place.tolist()
        if 0.0 <= u < _VIEW[0] and 0.0 <= v < _VIEW[1]:
            colour = _SEEN if track.detections else _UNSEEN
            cv2.circle(picture, (round(u), round(v)), 7, colour, 1, cv2.LINE_AA)
