"""One robot of a swarm looks around: the hall from above, what its cameras show, what it has read."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.swarm.hall import OBSERVER
from nir_render.experiments.swarm.identity import numbers_told
from nir_render.report.style import FAIR, GOOD, TRUTH
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
from nir_render.scene.pose import Pose
from perception import Calibration, Message, RawFrame, Track
from perception.model.bearing import bearing_body
from perception.types.picture import tone_map

Array = NDArray[np.float64]

_WIDTH, _EDGE = 1000, 16
_ABOVE_AT, _ABOVE = (_EDGE, 52), 600  # left and top, and how wide and high
_SAID_AT, _LINES = (_EDGE + _ABOVE + 24, 74), 15
_STRIP_AT, _STRIP_WIDTH = _ABOVE_AT[1] + _ABOVE + 22, _WIDTH - 2 * _EDGE
_ROWS = (-125, 45)  # of a frame, beside that of its optical axis: what a strip shows
_TITLE, _SMALL = 22, 13
_SOFTENING = 0.02  # of grey: flares stand out, noise hardly does
_STEP = 16
_NAMED, _FOLLOWED, _UNSEEN, _WEDGE = bgr(GOOD), bgr(FAIR), bgr("#b392f0"), bgr(TRUTH)


@dataclass(frozen=True, eq=False)
class Moment:
    """What there is at a time: frames, whom the observer follows by them, what it has read so far."""

    time_s: float
    frames: Sequence[RawFrame]
    tracks: Sequence[Track]
    words: Sequence[Message]


class SwarmPicture:
    """Draws moments of one run.

    Parameters
    ----------
    places_m
        Where robots stand, the observer first, shape (robots, 2).
    observer
        Its pose.
    known
        Its cameras.
    side_m
        How long the walls of the hall are.
    """

    def __init__(
        self, places_m: Array, observer: Pose, known: Mapping[str, Calibration], side_m: float
    ) -> None:
        self._places_m, self._observer, self._known, self._side_m = places_m, observer, known, side_m
        self._canvas = self._without_tracks()

    def drawn(self, moment: Moment) -> Picture:
        """Return the picture of a moment, BGR, shape (height, 1000, 3).

        Dots are robots as they stand. A ring is a track: green if it has said who it is, yellow if not yet,
        violet if it is not seen just now: dark, or hidden. From above a line goes through it, along which it
        may be by one σ.
        """
        canvas = self._canvas.copy()
        tracks = [track for track in moment.tracks if track.ghost != "yes"]
        told = {words[-1].track: number for number, words in numbers_told(moment.words, len(self._places_m))}
        write(canvas, f"{moment.time_s:5.1f} s", (_WIDTH - 90, 34), _TITLE, INK_BGR)
        for track in tracks:
            self._track_into(canvas, track, told)
        self._said_into(canvas, moment, tracks, told)
        for number, frame in enumerate(moment.frames):
            self._strip_into(canvas, number, frame, tracks, told)
        return canvas

    def _without_tracks(self) -> Picture:
        """Draw what stays: the title, the hall from above with who stands there, and where cameras look."""
        strips = len(self._known) * (self._strip_px() + 8)
        height = 2 * ((_STRIP_AT + strips + 10) // 2)  # films want even numbers
        canvas = np.full((height, _WIDTH, 3), GROUND_BGR, dtype=np.uint8)
        title = (
            f"{len(self._places_m)} robots in a hall of {self._side_m:.3g} m: what one of them makes of it"
        )
        write(canvas, title, (_EDGE, 34), _TITLE, INK_BGR)
        left, top = _ABOVE_AT
        cv2.rectangle(canvas, (left, top), (left + _ABOVE, top + _ABOVE), PANEL_BGR, -1)
        half_m = math.floor(0.5 * self._side_m)
        for at_m in range(-half_m, half_m + 1):
            ends_m = ((at_m, -0.5 * self._side_m), (at_m, 0.5 * self._side_m))
            for begin_m, end_m in (ends_m, [end[::-1] for end in ends_m]):
                begin, end = self._px(np.array(begin_m)), self._px(np.array(end_m))
                cv2.line(canvas, begin, end, LINE_BGR, 1, cv2.LINE_AA)
        for known in self._known.values():
            self._view_into(canvas, known)
        for place_m in self._places_m[1:]:
            cv2.circle(canvas, self._px(place_m), 2, FAINT_BGR, -1, cv2.LINE_AA)
        cv2.circle(canvas, self._px(self._places_m[0]), 6, _WEDGE, -1, cv2.LINE_AA)
        return canvas

    def _view_into(self, canvas: Picture, known: Calibration) -> None:
        """Draw how far aside a camera sees."""
        corner_m = self._px(self._places_m[0])
        aside_px = np.array([[-0.5, known.cy_px], [known.width_px - 0.5, known.cy_px]])
        for bearing in np.asarray(bearing_body(aside_px, known)):
            ahead = self._observer.rotation @ bearing
            along = ahead[:2] / np.linalg.norm(ahead[:2])
            cv2.line(canvas, corner_m, self._px(self._places_m[0] + 0.7 * along), _WEDGE, 1, cv2.LINE_AA)
        ahead = self._observer.rotation @ known.rotation_body_camera[:, 2]
        at = self._px(self._places_m[0] + 0.85 * ahead[:2])
        name = known.camera.rpartition(".")[2]
        write(canvas, name, (at[0] - 3 * len(name), at[1] + 4), 11, _WEDGE)

    def _track_into(self, canvas: Picture, track: Track, told: Mapping[int, int]) -> None:
        place_m = (self._observer.rotation @ track.position_body_m)[:2] + self._places_m[0]
        across = track.position_body_m / np.linalg.norm(track.position_body_m)
        sigma_m = math.sqrt(float(across @ track.covariance[:3, :3] @ across))
        along_m = sigma_m * (self._observer.rotation @ across)[:2]
        colour = _colour(track, told)
        at = self._px(place_m)
        if _is_on(at):
            ends = self._px(place_m - along_m), self._px(place_m + along_m)
            if all(map(_is_on, ends)):
                cv2.line(canvas, *ends, colour, 1, cv2.LINE_AA)
            cv2.circle(canvas, at, 5, colour, 1, cv2.LINE_AA)
            if track.track in told:
                write(canvas, str(told[track.track]), (at[0] + 7, at[1] - 3), 12, colour)

    def _said_into(
        self, canvas: Picture, moment: Moment, tracks: Sequence[Track], told: Mapping[int, int]
    ) -> None:
        """Write how many it follows and knows, and what it has read, newest first."""
        (x, y), others = _SAID_AT, len(self._places_m) - 1
        named = sum(track.track in told for track in tracks)
        unseen = sum(not track.detections for track in tracks)
        lines = (
            (f"{len(tracks)} followed, of {others} others", _FOLLOWED),
            (f"{unseen} of them dark or hidden just now", _UNSEEN),
            (f"{named} of them have said who they are", _NAMED),
        )
        for number, (text, colour) in enumerate(lines):
            cv2.circle(canvas, (x + 5, y - 5 + 26 * number), 5, colour, 1, cv2.LINE_AA)
            write(canvas, text, (x + 20, y + 26 * number), 16, INK_BGR)
        cv2.circle(canvas, (x + 5, y - 5 + 26 * len(lines)), 2, FAINT_BGR, -1, cv2.LINE_AA)
        write(canvas, "where robots are in truth", (x + 20, y + 26 * len(lines)), 16, INK_BGR)
        cv2.circle(canvas, (x + 5, y - 5 + 26 * (len(lines) + 1)), 6, _WEDGE, -1, cv2.LINE_AA)
        write(canvas, "who looks, and its four cameras", (x + 20, y + 26 * (len(lines) + 1)), 16, INK_BGR)
        y += 26 * (len(lines) + 1) + 44
        write(canvas, "read by light, newest first:", (x, y), 15, FAINT_BGR)
        newest = sorted(moment.words, key=lambda word: -word.end_s)[:_LINES]
        for number, word in enumerate(newest):
            who = f", so it is {OBSERVER[0]}{told[word.track]:04d}" if word.track in told else ""
            text = f"{word.end_s:5.1f} s   track {word.track} says {word.word}{who}"
            write(canvas, text, (x, y + 24 + 21 * number), 14, INK_BGR if number == 0 else FAINT_BGR)

    def _strip_into(
        self, canvas: Picture, number: int, frame: RawFrame, tracks: Sequence[Track], told: Mapping[int, int]
    ) -> None:
        """Draw the rows of a frame in which sources are, and where tracks stand in it."""
        known, height = self._known[frame.camera], self._strip_px()
        left, top = _EDGE, _STRIP_AT + number * (height + 8)
        scale, first = self._scale(known), self._first_row(known)
        rows = frame.data_dn[first : first + _ROWS[1] - _ROWS[0]].astype(np.float32)
        means_dn = cv2.resize(rows, (_STRIP_WIDTH, height), interpolation=cv2.INTER_AREA)
        shown = tone_map(
            np.asarray(means_dn, dtype=np.float32),
            frame.black_level_dn,
            float(known.saturation_dn),
            _SOFTENING,
        )
        few = shown // _STEP * _STEP  # levels, so that the dark ground is even and its file small
        canvas[top : top + height, left : left + _STRIP_WIDTH] = few[..., None]
        taken: list[tuple[float, float]] = []
        nearest = sorted(zip(tracks, places_px(tracks, known), strict=True), key=lambda one: _far_m(one[0]))
        for track, place in nearest:
            u, v = scale * (place[0] + 0.5), scale * (place[1] + 0.5 - first)
            if not (np.isfinite(place).all() and 0.0 <= u < _STRIP_WIDTH and 0.0 <= v < height):
                continue
            colour = _colour(track, told)
            cv2.circle(canvas, (round(left + u), round(top + v)), 6, colour, 1, cv2.LINE_AA)
            if track.track not in told:
                continue
            text = str(told[track.track])
            wide = 4.0 * len(text)
            if all(u + wide < begin or end < u - wide for begin, end in taken):
                taken.append((u - wide, u + wide))
                write(canvas, text, (round(left + u - wide + 1), round(top + v) - 10), 12, colour)
        name = frame.camera.rpartition(".")[2]
        write(canvas, name, (left + 8, top + 18), _SMALL, _WEDGE)

    def _scale(self, known: Calibration) -> float:
        return _STRIP_WIDTH / known.width_px

    def _first_row(self, known: Calibration) -> int:
        return max(round(known.cy_px) + _ROWS[0], 0)

    def _strip_px(self) -> int:
        return round((_ROWS[1] - _ROWS[0]) * min(map(self._scale, self._known.values())))

    def _px(self, place_m: Array) -> tuple[int, int]:
        """Return where a place is in the picture from above."""
        scale = (_ABOVE - 16) / self._side_m
        left, top = _ABOVE_AT
        x, y = (0.5 * _ABOVE + scale * place_m * (1.0, -1.0)).tolist()
        return round(left + x), round(top + y)


def _is_on(at: tuple[int, int]) -> bool:
    """Tell whether a pixel is in the picture from above."""
    return all(0 <= one - corner <= _ABOVE for one, corner in zip(at, _ABOVE_AT, strict=True))


def _far_m(track: Track) -> float:
    return float(np.linalg.norm(track.position_body_m))


def _colour(track: Track, told: Mapping[int, int]) -> Colour:
    if not track.detections:
        return _UNSEEN
    return _NAMED if track.track in told else _FOLLOWED
