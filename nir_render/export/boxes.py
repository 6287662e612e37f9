"""What is where in the frames of a run, as boxes with names: what learners and their scores are fed with."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nir_render.errors import InputError
from nir_render.evaluate.match import image_radius_px
from nir_render.run import folder as run_folder
from nir_render.truth.lamps import LampTruth, Outline, parse_lamp
from nir_render.truth.sources import SourceTruth, parse_truth
from perception import Calibration, FrameRecord, RecordingError, read_recording
from perception.types import FrameKey

Kind = Literal["source", "ghost", "lamp"]
KINDS: tuple[Kind, ...] = ("source", "ghost", "lamp")

# Of the point spread beyond a source's edge. Of a point's light 0.954 lie within ± 2 σ in one direction, so
# 0.911 in the box.
_SIGMAS = 2.0
_PIXEL_SIGMA_PX = 1.0 / math.sqrt(12.0)  # of a pixel's own aperture, which `psf_sigma_px` is without


@dataclass(frozen=True)
class Box:
    """A thing in a frame: its box in pixels, where (0, 0) is the centre of the top left pixel.

    `name` is the source's, `robot.source`, or the lamp's. `truth` is the source's row, `outline_px` the
    lamp's polygon. Box and polygon are cut at the frame's edges, and never empty.
    """

    kind: Kind
    name: str
    left_px: float
    top_px: float
    right_px: float
    bottom_px: float
    truth: SourceTruth | None = None
    outline_px: Outline = ()

    @property
    def width_px(self) -> float:
        """Its width."""
        return self.right_px - self.left_px

    @property
    def height_px(self) -> float:
        """Its height."""
        return self.bottom_px - self.top_px

    @property
    def area_px2(self) -> float:
        """The polygon's area where it has one, or its own."""
        return _area_px2(self.outline_px) if self.outline_px else self.width_px * self.height_px


@dataclass(frozen=True, eq=False)
class Labelled:
    """A run whose frames have labels: its calibrations, its frames in order, and the boxes of each."""

    folder: Path
    calibrations: dict[str, Calibration]
    records: tuple[FrameRecord, ...]
    boxes: dict[FrameKey, tuple[Box, ...]]


def read_labelled(folder: Path) -> Labelled:
    """Read what is where in a run's frames.

    A source has a box where it shines, and something of it is seen: its disc and two σ of the point spread
    around, the pixel's aperture included. It stands at mid-exposure: what moves is drawn out beyond it.
    A lamp has the box of its outline, whatever stands before it.

    Raises
    ------
    InputError
        The folder has no truth or no frame, a frame has no calibration or no picture, or a file is broken.
    """
    if not (folder / run_folder.TRUTH).is_file():
        raise InputError(f"{folder}: has no {run_folder.TRUTH}: labels are made of a rendered run's truth")
    try:
        recording = read_recording(folder)
    except RecordingError as error:
        raise InputError(*error.problems) from None
    known, records = dict(recording.calibrations), recording.records
    found: dict[FrameKey, list[Box]] = defaultdict(list)
    for truth in run_folder.parse_lines(folder / run_folder.TRUTH, parse_truth):
        if truth.camera in known and truth.on_fraction > 0.0 and truth.visible_fraction > 0.0:
            found[truth.camera, truth.index] += _source_box(truth, known[truth.camera])
    lamps = folder / run_folder.LAMPS
    for lamp in run_folder.parse_lines(lamps, parse_lamp) if lamps.is_file() else ():
        if lamp.camera in known:
            found[lamp.camera, lamp.index] += _lamp_box(lamp, known[lamp.camera])
    boxes = {(one.camera, one.index): tuple(found[one.camera, one.index]) for one in records}
    return Labelled(folder, known, records, boxes)


def _source_box(truth: SourceTruth, known: Calibration) -> Sequence[Box]:
    spread_px = math.hypot(known.psf_sigma_px, _PIXEL_SIGMA_PX)
    reach_px = image_radius_px(truth, known) + _SIGMAS * spread_px
    kind: Kind = "source" if truth.ghost_of is None else "ghost"
    name = truth.ghost_of or f"{truth.robot}.{truth.source}"
    sides = (truth.u_px - reach_px, truth.v_px - reach_px, truth.u_px + reach_px, truth.v_px + reach_px)
    left, top = max(sides[0], -0.5), max(sides[1], -0.5)
    right, bottom = min(sides[2], known.width_px - 0.5), min(sides[3], known.height_px - 0.5)
    if not (left < right and top < bottom):
        return ()
    return (Box(kind, name, left, top, right, bottom, truth=truth),)


def _lamp_box(lamp: LampTruth, known: Calibration) -> Sequence[Box]:
    outline = _within(lamp.outline_px, known)
    if not _area_px2(outline) > 0.0:
        return ()
    us, vs = zip(*outline, strict=True)
    return (Box("lamp", lamp.lamp, min(us), min(vs), max(us), max(vs), outline_px=outline),)


def _within(outline: Outline, known: Calibration) -> Outline:
    """Return what of a polygon lies within the frame, cut along one edge after the other.

    So Sutherland and Hodgman (1974). A hollow polygon that falls apart there keeps lines without area along
    the edge.
    """
    corners = list(outline)
    right, bottom = known.width_px - 0.5, known.height_px - 0.5
    for axis, edge, inwards in ((0, -0.5, 1.0), (0, right, -1.0), (1, -0.5, 1.0), (1, bottom, -1.0)):
        kept: list[tuple[float, float]] = []
        for one, following in zip(corners, corners[1:] + corners[:1], strict=True):
            begins, ends = (inwards * (corner[axis] - edge) for corner in (one, following))
            if begins >= 0.0:
                kept.append(one)
            if (begins >= 0.0) != (ends >= 0.0):
                share = begins / (begins - ends)
                u_px, v_px = (a + share * (b - a) for a, b in zip(one, following, strict=True))
                kept.append((u_px, v_px))
        corners = kept
    return tuple(corners)


def _area_px2(outline: Outline) -> float:
    turned = zip(outline, outline[1:] + outline[:1], strict=True)
    return 0.5 * abs(sum(u * v_next - u_next * v for (u, v), (u_next, v_next) in turned))
