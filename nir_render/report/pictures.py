"""Frames as pictures: which of them are shown, how counts become grey, and what is drawn over them in a page.

Over a frame stand, as SVG, truth and what each estimator found; `pictures.html` draws them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.match import image_radius_px
from nir_render.evaluate.metrics import Evaluation, Score
from nir_render.report.parts import data_uri
from nir_render.report.style import TRUTH, look
from nir_render.report.wording import counted, metres
from perception.types import Calibration, Detection, FrameKey, RawFrame
from perception.types.picture import tone_map

Item = TypeVar("Item")

MOST_CAMERAS = 8
_FAINT_SOFTENING = 0.001
_CLOSE_UPS = 10
_CLOSE_UP_HALF_PX = 14
_LABEL_UNITS = (19.0, 2.4)  # width and height of a label of a range, in hundredths of the frame's width
_WHOLE_WIDTH_PX = 720
"""About the width at which a frame stands in the page, for screens of double density: it bounds the size."""


@dataclass(frozen=True)
class Image:
    """A grey picture and the place that it takes, in pixels of the frame."""

    address: str
    x: float
    y: float
    width: int
    height: int


@dataclass(frozen=True)
class Mark:
    """Where an estimator found something, how large that is drawn, and what is told when pointed at."""

    name: str
    u_px: float
    v_px: float
    size_px: float
    hint: str


@dataclass(frozen=True)
class ShownSource:
    """A source or its mirror image in a whole frame: its circle, what stands beside it, what was found."""

    u_px: float
    v_px: float
    radius_px: float
    faint: bool
    hint: str
    label: str
    label_x_px: float
    label_y_px: float
    anchor: str
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class WholePicture:
    """A whole frame; `unit_px` is a hundredth of its width, in which what is written over it is measured."""

    camera: str
    index: int
    caption: str
    image: Image
    unit_px: float
    sources: tuple[ShownSource, ...]
    alarms: tuple[Mark, ...]


@dataclass(frozen=True)
class Line:
    """A line of a caption, and its colour."""

    text: str
    colour: str


@dataclass(frozen=True)
class CloseUp:
    """The surroundings of a source, its true outline, and what each estimator said of it."""

    box: str
    image: Image
    u_px: float
    v_px: float
    radius_px: float
    marks: tuple[Mark, ...]
    lines: tuple[Line, ...]
    frame: str


def whole_pictures(
    keys: Sequence[FrameKey],
    result: Evaluation,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
) -> list[WholePicture]:
    """Show of each camera, of eight at most, the frame with the most sources that count and false alarms.

    Of one camera alone, the first frame and the last.
    """
    cameras = cameras_of(keys)
    chosen = spread(keys, 2) if len(cameras) == 1 else [_fullest(keys, result, c) for c in cameras]
    pictures = []
    for key in chosen[:MOST_CAMERAS]:
        scores = [score for score in (*result.scores, *result.ghosts) if key_of(score) == key]
        false_alarms = {
            name: [alarm for alarm in alarms if (alarm.camera, alarm.index) == key]
            for name, alarms in result.false_alarms.items()
        }
        pictures.append(shown_frame(load(key), calibrations[key[0]], scores, false_alarms))
    return pictures


def close_ups(
    result: Evaluation, load: Callable[[FrameKey], RawFrame], calibrations: Mapping[str, Calibration]
) -> list[CloseUp]:
    """Show close-ups of sources that count, from the nearest to the farthest, with what was said of them."""
    counting = sorted(
        (score for score in result.scores if score.countable), key=lambda score: score.truth.range_m
    )
    names = list(result.summary["estimators"])
    return [
        close_up(load(key_of(score)), calibrations[score.truth.camera], score, names)
        for score in spread(counting, _CLOSE_UPS)
    ]


def key_of(score: Score) -> FrameKey:
    """Return camera and index of the frame that a score belongs to."""
    return score.truth.camera, score.truth.index


def cameras_of(keys: Sequence[FrameKey]) -> list[str]:
    """Return the names of all cameras, in the order in which they appear."""
    return list(dict.fromkeys(camera for camera, _ in keys))


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` items, evenly spread, first and last among them."""
    if len(items) <= count:
        return list(items)
    return [items[round(index * (len(items) - 1) / (count - 1))] for index in range(count)]


def whole_picture(frame: RawFrame, calibration: Calibration, block_px: int) -> NDArray[np.uint8]:
    """Turn a frame into grey at the scale of a page: in means of blocks faint walls rise from the noise.

    Parameters
    ----------
    frame, calibration
        The frame, shape (rows, columns), and its camera.
    block_px
        Side of a block.

    Returns
    -------
    Grey values, uint8, shape (rows // block_px, columns // block_px).
    """
    rows, columns = frame.data_dn.shape
    small = (max(columns // block_px, 1), max(rows // block_px, 1))
    means_dn = cv2.resize(frame.data_dn.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    return tone_map(
        np.asarray(means_dn, dtype=np.float32),
        frame.black_level_dn,
        float(calibration.saturation_dn),
        _FAINT_SOFTENING,
    )


def png_uri(picture: NDArray[np.uint8]) -> str:
    """Return the address that holds a picture, grey or BGR, without loss."""
    return data_uri(_encoded(picture, ".png"), "image/png")


def shown_frame(
    frame: RawFrame,
    calibration: Calibration,
    scores: Sequence[Score],
    false_alarms: Mapping[str, Sequence[Detection]],
) -> WholePicture:
    """Show a whole frame: sources, ghosts, and what the estimators of `scores` and `false_alarms` found."""
    rows, columns = frame.data_dn.shape
    block_px = max(1, round(columns / _WHOLE_WIDTH_PX))
    grey = whole_picture(frame, calibration, block_px)
    address = data_uri(_encoded(grey, ".jpg", (cv2.IMWRITE_JPEG_QUALITY, 85)), "image/jpeg")
    # Everything is drawn in units of the frame's pixels; marks grow with the frame so that they can be seen.
    unit_px = columns / 100.0
    alarms = sum(map(len, false_alarms.values()))
    counted_alarms = f" · {counted(alarms, 'false alarm')}" if alarms else ""
    return WholePicture(
        camera=frame.camera,
        index=frame.index,
        caption=f"frame {frame.index} · {frame.time_s:.2f} s · exposed {frame.exposure_s * 1e3:.3g} ms"
        f"{counted_alarms}",
        image=Image(address, -0.5, -0.5, columns, rows),
        unit_px=unit_px,
        sources=tuple(_shown_source(score, calibration, columns, unit_px) for score in scores),
        alarms=tuple(
            _mark(name, alarm, 1.8 * unit_px, "false alarm, ")
            for name, found in false_alarms.items()
            for alarm in found
        ),
    )


def _shown_source(score: Score, calibration: Calibration, columns: int, unit_px: float) -> ShownSource:
    truth = score.truth
    radius_px = max(1.6 * unit_px, 1.2 * image_radius_px(truth, calibration))
    hint, label = _hint_and_label(score)
    to_the_left = truth.u_px > 0.82 * columns
    return ShownSource(
        u_px=truth.u_px,
        v_px=truth.v_px,
        radius_px=radius_px,
        faint=not score.countable,
        hint=hint,
        label=label,
        label_x_px=truth.u_px + (-1.4 if to_the_left else 1.4) * radius_px,
        label_y_px=truth.v_px - 0.8 * unit_px,
        anchor="end" if to_the_left else "start",
        marks=tuple(_mark(name, found, 1.8 * unit_px) for name, found in score.detections.items()),
    )


def _hint_and_label(score: Score) -> tuple[str, str]:
    """Return what is told of a source or ghost when pointed at, and what stands beside it."""
    truth = score.truth
    if truth.ghost_of is not None:
        return f"mirror image of {truth.ghost_of}, {truth.range_m:.3f} m away", f"ghost of {truth.robot}"
    hint = f"{truth.robot}.{truth.source}, true range {truth.range_m:.3f} m"
    faint = "" if score.countable else " (too faint or hidden to count)"
    return hint + faint, f"{truth.robot} {metres(truth.range_m)}"


def close_up(
    frame: RawFrame,
    calibration: Calibration,
    score: Score,
    names: Sequence[str],
    among: Sequence[str] | None = None,
) -> CloseUp:
    """Show the surroundings of a source, and what the estimators of these names said of it.

    `among` are all estimators of the page, by which each has its look; these alone by default.
    """
    truth = score.truth
    radius_px = image_radius_px(truth, calibration)
    half = max(_CLOSE_UP_HALF_PX, round(1.5 * radius_px))
    left, top = round(truth.u_px) - half, round(truth.v_px) - half
    rows, columns = frame.data_dn.shape
    right, bottom = min(columns, left + 2 * half + 1), min(rows, top + 2 * half + 1)
    left, top = max(0, left), max(0, top)
    crop = tone_map(
        frame.data_dn[top:bottom, left:right], frame.black_level_dn, float(calibration.saturation_dn)
    )
    return CloseUp(
        box=f"{truth.u_px - half:.2f} {truth.v_px - half:.2f} {2 * half} {2 * half}",
        image=Image(png_uri(crop), left - 0.5, top - 0.5, right - left, bottom - top),
        u_px=truth.u_px,
        v_px=truth.v_px,
        radius_px=radius_px,
        marks=tuple(
            _mark(name, score.detections[name], 0.22 * half) for name in names if name in score.detections
        ),
        lines=(
            Line(f"true {truth.range_m:.3f} m", TRUTH),
            *(
                Line(f"{name} {_range_text(score, name)}", look(name, among or names).colour)
                for name in names
            ),
        ),
        frame=f"{truth.camera} {truth.index}",
    )


def _range_text(score: Score, name: str) -> str:
    if name not in score.detections:
        return "not found"
    return f"{score.detections[name].range_m:.3f} m".replace("nan m", "no range")


def _mark(name: str, found: Detection, size_px: float, prefix: str = "") -> Mark:
    hint = f"{prefix}{name}: {found.range_m:.3f} m at ({found.u_px:.2f}, {found.v_px:.2f}) px"
    return Mark(name, found.u_px, found.v_px, size_px, hint)


def _fullest(keys: Sequence[FrameKey], result: Evaluation, camera: str) -> FrameKey:
    """Return the camera's frame with the most sources that count and false alarms; the first among equals."""
    count = {key: 0 for key in keys if key[0] == camera}
    shown = [key_of(score) for score in result.scores if score.countable]
    shown += [(alarm.camera, alarm.index) for alarms in result.false_alarms.values() for alarm in alarms]
    for key in shown:
        if key in count:
            count[key] += 1
    return max(count, key=lambda key: count[key])


def _encoded(picture: NDArray[np.uint8], kind: str, options: Sequence[int] = ()) -> bytes:
    done, buffer = cv2.imencode(kind, picture, list(options))
    if not done:
        raise RuntimeError(f"OpenCV could not encode a picture as {kind}")
    return buffer.tobytes()


def labels_of(
    texts: Sequence[tuple[float, float, str]], columns: int, rows: int
) -> Iterator[tuple[float, float, str, str]]:
    """Yield place, anchor and text of labels, each where none is yet, as near to its flare as can be.

    Parameters
    ----------
    texts
        Column and row of each flare, and what is said of it.
    columns, rows
        Of the frame, in whose pixels places are.
    """
    unit_px, placed = columns / 100.0, list[tuple[float, float]]()
    wide_px, high_px = (units * unit_px for units in _LABEL_UNITS)
    for u_px, v_px, text in sorted(texts, key=lambda one: one[1]):
        at_right = u_px > 0.78 * columns
        left_px = u_px + (-1.6 * unit_px - wide_px if at_right else 1.6 * unit_px)
        taken_px = [down_px for other_px, down_px in placed if abs(other_px - left_px) < wide_px]
        wanted_px = min(max(v_px - 0.8 * unit_px, high_px), rows - 1.0)
        tried_px = (wanted_px + turn * step * high_px for step in range(2 * len(texts)) for turn in (1, -1))
        free_px = (
            one_px
            for one_px in tried_px
            if high_px <= one_px <= rows - 1.0
            and all(abs(one_px - other_px) > 0.99 * high_px for other_px in taken_px)
        )
        placed.append((left_px, next(free_px, wanted_px)))
        yield left_px + (wide_px if at_right else 0.0), placed[-1][1], "end" if at_right else "start", text
