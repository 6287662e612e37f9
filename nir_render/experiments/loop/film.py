"""`film.mp4`: a run from above; beside it one robot's cameras, whom it follows, and what it is told.

All of it is read from the run's folder (`journal`), so a film is drawn of any run that was kept.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.closed import LoopPlan
from nir_render.report.pictures import whole_picture
from nir_render.report.time.canvas import (
    FAINT_BGR,
    GROUND_BGR,
    INK_BGR,
    LINE_BGR,
    PANEL_BGR,
    Colour,
    Picture,
    bgr,
    write,
)
from nir_render.report.time.film import places_px
from nir_render.report.time.plots import COLOURS
from nir_render.run import folder as run_folder
from nir_render.truth.poses import PoseTruth, parse_pose
from nir_render.truth.sent import SentTruth, parse_sent
from perception import (
    FrameRecord,
    parse_message,
    parse_track,
    read_calibrations,
    read_frame,
    read_frame_records,
)
from perception.rig.frame_sets import robot_of
from perception.types import Calibration, Message, Track

FILM = "film.mp4"
_WIDTH, _HEIGHT = 1120, 640
_RATE_HZ, _MOST_PICTURES = 30.0, 450
_ABOVE = (20, 66, 560, 546)  # left, top, width, height
_VIEW = (250, 187)
_VIEWS_AT = ((600, 66), (860, 66), (600, 285), (860, 285))
_WORDS_AT, _WORDS = (600, 508), 4
_MARGIN_M, _TRAIL_S = 0.6, 15.0
_SAME_S = 1e-6


@dataclass(frozen=True, eq=False)
class _Run:
    """What is drawn: places of all robots, and what one of them sees, is told, and believes."""

    observer: str
    times_s: NDArray[np.float64]
    places_m: dict[str, NDArray[np.float64]]
    tracks: dict[int, list[Track]]
    words: list[Message]
    sent: list[SentTruth]
    known: dict[str, Calibration]
    frames: dict[str, list[FrameRecord]]


def film_into(run: Path, plan: LoopPlan, title: str, file: Path) -> bool:
    """Draw the film of a run.

    Parameters
    ----------
    run
        Its folder.
    plan
        What it was.
    title
        What stands above it.
    file
        Where the film goes.

    Returns
    -------
    Whether there is one: where OpenCV cannot write VP9, there is none.
    """
    seen = _read(run, plan)
    steps = len(seen.times_s)
    stride = max(1, math.ceil(steps / _MOST_PICTURES))
    faster = stride * plan.period_s * _RATE_HZ
    aside = file.with_name(f".partial-{file.name}")
    writer = cv2.VideoWriter(str(aside), cv2.VideoWriter.fourcc(*"vp09"), _RATE_HZ, (_WIDTH, _HEIGHT))
    if not writer.isOpened():
        aside.unlink(missing_ok=True)
        return False
    canvas, lens = _canvas(seen, f"{title}, {faster:.2g} × as fast", plan)
    pictures: dict[str, tuple[int, Picture]] = {}
    for at in range(0, steps, stride):
        writer.write(_drawn(canvas.copy(), lens, seen, at, run, pictures))
    writer.release()
    aside.replace(file)
    return True


@dataclass(frozen=True)
class _Lens:
    """From places in the world to the picture from above."""

    scale_px_per_m: float
    centre_m: NDArray[np.float64]

    def px(self, place_m: NDArray[np.float64]) -> tuple[int, int]:
        left, top, width, height = _ABOVE
        across_m = (place_m - self.centre_m) * self.scale_px_per_m
        return round(left + 0.5 * width + across_m[0]), round(top + 0.5 * height - across_m[1])


def _read(run: Path, plan: LoopPlan) -> _Run:
    poses: list[PoseTruth] = run_folder.parse_lines(run / run_folder.POSES, parse_pose)
    robots = list(dict.fromkeys(pose.robot for pose in poses))
    observer = robots[1]
    times_s = np.array([pose.time_s for pose in poses if pose.robot == observer])
    places_m = {
        robot: np.array([pose.position_m[:2] for pose in poses if pose.robot == robot]) for robot in robots
    }
    tracks: dict[int, list[Track]] = {}
    words: list[Message] = []
    sent: list[SentTruth] = []
    if (path := run / f"tracks.{plan.perceives_by}.jsonl").is_file():
        for record in run_folder.read_lines(path):
            if record["robot"] == observer:
                track = parse_track(record)
                tracks.setdefault(int(np.argmin(abs(times_s - track.time_s))), []).append(track)
    if (path := run / f"messages.{plan.perceives_by}.jsonl").is_file():
        words = [word for word in run_folder.parse_lines(path, parse_message) if word.robot == observer]
    if (path := run / run_folder.SENT).is_file():
        sent = run_folder.parse_lines(path, parse_sent)
    known: dict[str, Calibration] = {}
    if (run / run_folder.CALIBRATION).is_file():
        known = {name: one for name, one in read_calibrations(run).items() if robot_of(name) == observer}
    frames: dict[str, list[FrameRecord]] = {name: [] for name in known}
    if (run / run_folder.FRAMES).is_file():
        for frame in read_frame_records(run):
            if frame.camera in frames:
                frames[frame.camera].append(frame)
    return _Run(observer, times_s, places_m, tracks, words, sent, known, frames)


def _canvas(seen: _Run, title: str, plan: LoopPlan) -> tuple[Picture, _Lens]:
    """Draw what stays: titles, panels, a grid of metres."""
    canvas = np.full((_HEIGHT, _WIDTH, 3), GROUND_BGR, dtype=np.uint8)
    write(canvas, title, (20, 32), 20, INK_BGR)
    left, top, width, height = _ABOVE
    cv2.rectangle(canvas, (left, top), (left + width, top + height), PANEL_BGR, -1)
    every_m = np.concatenate(list(seen.places_m.values()))
    low_m, high_m = every_m.min(axis=0) - _MARGIN_M, every_m.max(axis=0) + _MARGIN_M
    lens = _Lens(float(min(np.array([width, height]) / (high_m - low_m))), 0.5 * (low_m + high_m))
    reach_m = 0.5 * np.array([width, height]) / lens.scale_px_per_m
    begin_m, end_m = lens.centre_m - reach_m, lens.centre_m + reach_m
    for x_m in range(math.ceil(begin_m[0]), math.floor(end_m[0]) + 1):
        column = lens.px(np.array([x_m, 0.0]))[0]
        cv2.line(canvas, (column, top), (column, top + height), LINE_BGR, 1)
    for y_m in range(math.ceil(begin_m[1]), math.floor(end_m[1]) + 1):
        row = lens.px(np.array([0.0, y_m]))[1]
        cv2.line(canvas, (left, row), (left + width, row), LINE_BGR, 1)
    write(
        canvas,
        f"lines every metre; rings: where {seen.observer} takes the others to be",
        (left, _HEIGHT - 6),
        12,
        FAINT_BGR,
    )
    if not seen.known:
        write(canvas, "robots know the truth: there are no cameras", (600, 90), 14, FAINT_BGR)
    for name, (x, y) in zip(seen.known, _VIEWS_AT, strict=False):
        cv2.rectangle(canvas, (x, y), (x + _VIEW[0], y + _VIEW[1]), PANEL_BGR, -1)
        without = "" if seen.frames[name] else _WITHOUT[plan.level]
        write(canvas, f"{name.rpartition('.')[2]}{without}", (x, y + _VIEW[1] + 17), 12, FAINT_BGR)
    return canvas, lens


_WITHOUT = {"measurements": ": measurements, without frames", "frames": ": frames not kept", "truth": ""}


def _drawn(
    canvas: Picture, lens: _Lens, seen: _Run, at: int, run: Path, pictures: dict[str, tuple[int, Picture]]
) -> Picture:
    time_s = float(seen.times_s[at])
    write(canvas, f"{time_s:6.1f} s", (1020, 32), 20, INK_BGR)
    _above_into(canvas, lens, seen, at)
    tracks = seen.tracks.get(at, [])
    for (name, known), corner in zip(seen.known.items(), _VIEWS_AT, strict=False):
        _view_into(canvas, corner, known, seen.frames[name], tracks, time_s, run, pictures)
    _words_into(canvas, seen, time_s)
    return canvas


def _above_into(canvas: Picture, lens: _Lens, seen: _Run, at: int) -> None:
    time_s = seen.times_s[at]
    begin = int(np.searchsorted(seen.times_s, time_s - _TRAIL_S))
    sends = [packet.robot for packet in seen.sent if packet.start_s <= time_s <= packet.end_s]
    for number, (robot, places_m) in enumerate(seen.places_m.items()):
        way = np.array([lens.px(place_m) for place_m in places_m[begin : at + 1 : 5]], dtype=np.int32)
        cv2.polylines(canvas, [way.reshape(-1, 1, 2)], isClosed=False, color=LINE_BGR, thickness=2)
        centre = lens.px(places_m[at])
        colour = bgr(COLOURS[4]) if number == 0 else FAINT_BGR
        cv2.circle(canvas, centre, 8, colour, -1, cv2.LINE_AA)
        if robot in sends:
            cv2.circle(canvas, centre, 13, colour, 2, cv2.LINE_AA)
        if robot == seen.observer:
            cv2.circle(canvas, centre, 4, GROUND_BGR, -1, cv2.LINE_AA)
        write(canvas, robot, (centre[0] + 12, centre[1] - 10), 12, FAINT_BGR)
    own_m = seen.places_m[seen.observer][at]
    for track in seen.tracks.get(at, []):
        cv2.circle(canvas, lens.px(own_m + track.position_body_m[:2]), 11, _colour(track), 2, cv2.LINE_AA)


def _view_into(
    canvas: Picture, corner: tuple[int, int], known: Calibration, frames: Sequence[FrameRecord],
    tracks: Sequence[Track], time_s: float, run: Path, pictures: dict[str, tuple[int, Picture]],
) -> None:  # fmt: skip
    """Draw a camera: its last kept frame, and where tracks stand in it."""
    x, y = corner
    scale = _VIEW[0] / known.width_px
    latest = bisect_right([frame.time_s for frame in frames], time_s + _SAME_S) - 1
    if latest >= 0:
        shown = pictures.get(known.camera)
        if shown is None or shown[0] != latest:
            grey = whole_picture(read_frame(run, frames[latest]), known, max(1, round(1.0 / scale)))
            shown = (
                latest,
                np.asarray(cv2.resize(grey, _VIEW, interpolation=cv2.INTER_AREA), dtype=np.uint8),
            )
            pictures[known.camera] = shown
        canvas[y : y + _VIEW[1], x : x + _VIEW[0]] = shown[1][..., None]
    if not tracks:
        return
    for track, place in zip(tracks, places_px(tracks, known), strict=True):
        if not np.isfinite(place).all():
            continue
        u, v = ((place + 0.5) * scale).tolist()
        if not (0.0 <= u < _VIEW[0] and 0.0 <= v < _VIEW[1]):
            continue
        centre = (round(x + u), round(y + v))
        cv2.circle(canvas, centre, 9, _colour(track), 1, cv2.LINE_AA)
        far_m = float(np.linalg.norm(track.position_body_m - known.position_body_m))
        text = f"{track.track}: {far_m:.2f} m" + ("" if track.detections else ", unseen")
        write(canvas, text, (min(centre[0] + 12, x + _VIEW[0] - 84), centre[1] - 8), 12, _colour(track))


def _words_into(canvas: Picture, seen: _Run, time_s: float) -> None:
    """Write what is being sent, and the last words that the robot was told, newest first."""
    if not seen.sent:
        return
    x, y = _WORDS_AT
    now = [packet for packet in seen.sent if packet.start_s <= time_s <= packet.end_s]
    sending = ", ".join(f"{one.robot} sends {one.command or one.word}" for one in now) or "nobody sends"
    write(canvas, sending, (x, y), 15, bgr(COLOURS[4]) if now else FAINT_BGR)
    write(canvas, f"what {seen.observer} has read:", (x, y + 24), 13, FAINT_BGR)
    told = [word for word in seen.words if word.end_s <= time_s][-_WORDS:][::-1]
    for number, word in enumerate(told):
        text = f"{word.end_s:5.1f} s  track {word.track}: {word.command or word.word}"
        write(canvas, text, (x, y + 46 + 22 * number), 15, INK_BGR if number == 0 else FAINT_BGR)


def _colour(track: Track) -> Colour:
    return bgr(COLOURS[track.track % len(COLOURS)])
