"""What is where in the frames of a run, as boxes with names: what learners and their scores are fed with."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from nir_render.errors import InputError
from nir_render.evaluate.match import image_radius_px
from nir_render.run import folder as run_folder
from nir_render.truth.lamps import LampTruth, Outline, parse_lamp
from nir_render.truth.sources import SourceTruth, parse_truth
from perception import Calibration, FrameRecord, read_calibrations, read_frame_records
from perception.types import FrameKey

Kind = Literal["source", "ghost", "lamp"]
KINDS: tuple[Kind, ...] = ("source", "ghost", "lamp")

_SIGMAS = (
    2.0  # of the point spread beyond a source's edge: 0.86 of a point's light in one direction and the other
)


@dataclass(frozen=True)
class Box:
    """A thing in a frame: its box in pixels, where (0, 0) is the centre of the top left pixel.

    `name` is the source's, `robot.source`, or the lamp's. `truth` is the source's row, `outline_px` the
    lamp's polygon. The box is cut at the frame's edges, and never empty.
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
    around. A lamp has the box of its outline.

    Raises
    ------
    InputError
        The folder has no truth; RecordingError where its frames or calibrations are broken.
    """
    if not (folder / run_folder.TRUTH).is_file():
        raise InputError(f"{folder}: has no {run_folder.TRUTH}: labels are made of a rendered run's truth")
    known = read_calibrations(folder)
    records = tuple(read_frame_records(folder))
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
    reach_px = max(image_radius_px(truth, known) + _SIGMAS * known.psf_sigma_px, 0.5)
    kind: Kind = "source" if truth.ghost_of is None else "ghost"
    name = truth.ghost_of or f"{truth.robot}.{truth.source}"
    sides = (truth.u_px - reach_px, truth.v_px - reach_px, truth.u_px + reach_px, truth.v_px + reach_px)
    return _cut(Box(kind, name, *sides, truth=truth), known)


def _lamp_box(lamp: LampTruth, known: Calibration) -> Sequence[Box]:
    corners = np.array(lamp.outline_px)
    left, top = corners.min(axis=0).tolist()
    right, bottom = corners.max(axis=0).tolist()
    return _cut(Box("lamp", lamp.lamp, left, top, right, bottom, outline_px=lamp.outline_px), known)


def _cut(box: Box, known: Calibration) -> Sequence[Box]:
    """Return a box within its frame; none where nothing of it is there."""
    left, right = max(box.left_px, -0.5), min(box.right_px, known.width_px - 0.5)
    top, bottom = max(box.top_px, -0.5), min(box.bottom_px, known.height_px - 0.5)
    if not (left < right and top < bottom):
        return ()
    return (Box(box.kind, box.name, left, top, right, bottom, box.truth, box.outline_px),)
