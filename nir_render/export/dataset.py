"""The frames of runs with their labels, for whoever learns from them; as one HDF5 file, too.

`RunDataset` is what PyTorch calls a map-style data set, and needs no PyTorch: `len(runs)`, `runs[3]`. Frames
hold different numbers of things, so a `DataLoader` wants `collate_fn=collate`.
"""

import bisect
import itertools
import math
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError, shown
from nir_render.export.boxes import KINDS, Box, Kind, Labelled, read_labelled
from nir_render.run.folder import write_stream
from perception import RecordingError, read_frame


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame, and what is where in it.

    Attributes
    ----------
    camera, index, time_s, exposure_s, line_time_s, gain, black_level_dn
        Of the frame, as in `frames.jsonl`.
    frame_kind
        What was taken: `scene`, or `dark`, `flat`, `rail`, `shared` of a calibration.
    data_dn
        Raw counts, uint16, shape (rows, columns).
    boxes_px
        Left, top, right, bottom of each thing, where (0, 0) is the centre of the top left pixel, float32,
        shape (n, 4).
    kinds
        Index into `dataset.KINDS` (source, ghost, lamp), int64, shape (n,).
    names
        `robot.source`, or the lamp's name, n of them.
    places_px
        Where the centre of each is imaged, float32, shape (n, 2); of a lamp the middle of its box.
    ranges_m
        Straight distance from the camera, float32, shape (n,); NaN of lamps.
    bearings_body
        Unit vectors in the robot's axes, float32, shape (n, 3); NaN of lamps.
    visible_fraction, on_fraction
        Share of the disc that is seen, mean drive over the exposure, float32, shape (n,); 1 of lamps, whose
        share is not known.
    peak_snr
        Of a flare's brightest pixel, float32, shape (n,); NaN of lamps, infinite where the truth has none.
    """

    camera: str
    index: int
    time_s: float
    exposure_s: float
    line_time_s: float
    gain: float
    black_level_dn: float
    frame_kind: str
    data_dn: NDArray[np.uint16]
    boxes_px: NDArray[np.float32]
    kinds: NDArray[np.int64]
    names: tuple[str, ...]
    places_px: NDArray[np.float32]
    ranges_m: NDArray[np.float32]
    bearings_body: NDArray[np.float32]
    visible_fraction: NDArray[np.float32]
    on_fraction: NDArray[np.float32]
    peak_snr: NDArray[np.float32]


def collate(samples: Sequence[Sample]) -> dict[str, list[Any]]:
    """Return a batch: a list of each field of `Sample`, by its name, one entry for a frame."""
    return {field.name: [getattr(sample, field.name) for sample in samples] for field in fields(Sample)}


class RunDataset:
    """All frames of one run or of several, in order: run by run as `frames.jsonl` has them.

    Frames are read when they are asked for; labels at the beginning.

    Raises
    ------
    InputError
        When it is made: as `boxes.read_labelled`, or there is no such kind. When a frame is asked for: its
        picture is of another size than its calibration says. RecordingError where the picture is broken.
    """

    def __init__(self, *folders: str | Path, kinds: Sequence[Kind] = KINDS) -> None:
        if not folders:
            raise InputError("a data set wants the folder of a run, or several")
        if isinstance(kinds, str) or not set(kinds) <= set(KINDS):
            raise InputError(f"kinds is {shown(kinds)}; wanted a list of some of {', '.join(KINDS)}")
        self._runs = [read_labelled(Path(folder)) for folder in folders]
        self._ends = list(itertools.accumulate(len(run.records) for run in self._runs))
        self._kinds = frozenset(kinds)

    def __len__(self) -> int:
        """Return how many frames there are."""
        return self._ends[-1]

    def __getitem__(self, number: int) -> Sample:
        """Return one frame with its labels; negative numbers count from the end."""
        position = number + len(self) if number < 0 else number
        if not 0 <= position < len(self):
            raise IndexError(f"{number} is no frame of {len(self)}")
        which = bisect.bisect_right(self._ends, position)
        run = self._runs[which]
        return _sample(run, position - (self._ends[which] - len(run.records)), self._kinds)

    def __iter__(self) -> Iterator[Sample]:
        """Yield all frames in order."""
        return (self[number] for number in range(len(self)))


def _sample(run: Labelled, number: int, kinds: frozenset[Kind]) -> Sample:
    record = run.records[number]
    frame = read_frame(run.folder, record)
    known = run.calibrations[record.camera]
    rows, columns = frame.data_dn.shape
    if (rows, columns) != (known.height_px, known.width_px):
        raise InputError(
            f"{run.folder / record.file}: has {columns} × {rows} pixels, the calibration of {record.camera} "
            f"says {known.width_px} × {known.height_px}; give the pictures that were rendered"
        )
    boxes = [box for box in run.boxes[record.camera, record.index] if box.kind in kinds]
    unknown = (math.nan,) * 3
    return Sample(
        camera=frame.camera,
        index=frame.index,
        time_s=frame.time_s,
        exposure_s=frame.exposure_s,
        line_time_s=frame.line_time_s,
        gain=frame.gain,
        black_level_dn=frame.black_level_dn,
        frame_kind=record.kind,
        data_dn=frame.data_dn,
        boxes_px=_array([(box.left_px, box.top_px, box.right_px, box.bottom_px) for box in boxes], 4),
        kinds=np.array([KINDS.index(box.kind) for box in boxes], dtype=np.int64),
        names=tuple(box.name for box in boxes),
        places_px=_array([_place(box) for box in boxes], 2),
        ranges_m=_column([math.nan if box.truth is None else box.truth.range_m for box in boxes]),
        bearings_body=_array([unknown if box.truth is None else box.truth.bearing_body for box in boxes], 3),
        visible_fraction=_column([1.0 if box.truth is None else box.truth.visible_fraction for box in boxes]),
        on_fraction=_column([1.0 if box.truth is None else box.truth.on_fraction for box in boxes]),
        peak_snr=_column([math.nan if box.truth is None else box.truth.peak_snr for box in boxes]),
    )


def _place(box: Box) -> tuple[float, float]:
    if box.truth is None:
        return 0.5 * (box.left_px + box.right_px), 0.5 * (box.top_px + box.bottom_px)
    return box.truth.u_px, box.truth.v_px


def _column(values: Sequence[float]) -> NDArray[np.float32]:
    return np.array(values, dtype=np.float32)


def _array(rows: Sequence[Sequence[float]], columns: int) -> NDArray[np.float32]:
    return np.array(rows, dtype=np.float32).reshape(len(rows), columns)


_NO_PIXELS = np.empty((0, 0), dtype=np.uint16)
_OF_THINGS = (
    "boxes_px", "places_px", "ranges_m", "bearings_body", "visible_fraction", "on_fraction", "peak_snr",
)  # fmt: skip


def export_hdf5(folder: Path, file: Path) -> dict[str, int]:
    """Write a run's frames and labels as one HDF5 file.

    Each camera has a group: `frames` (n, rows, columns) uint16, `index`, `time_s`, `exposure_s`,
    `line_time_s`, `gain`, `black_level_dn`, `frame_kind` (n,); and of all things in all frames `frame` (which
    of the n), `boxes_px`, `kind`, `name`, `places_px`, `ranges_m`, `bearings_body`, `visible_fraction`,
    `on_fraction`, `peak_snr`, as `Sample` has them. One frame is held in memory at a time.

    Returns
    -------
    How many frames there are, by camera.

    Raises
    ------
    InputError
        The package `h5py` is not installed, as `RunDataset`, or the disk refuses.
    """
    try:
        import h5py
    except ImportError:
        raise InputError(
            "HDF5 files are written by the package h5py, which is not installed; install nir-render[export]"
        ) from None
    run = read_labelled(folder)
    # HDF5 reads what it writes, so it is written where that goes first.
    with write_stream(file) as stream, tempfile.TemporaryFile(dir=file.parent) as aside:
        with h5py.File(aside, "w") as target:
            counts = _write_run(target, run)
        aside.seek(0)
        shutil.copyfileobj(aside, stream)
    return counts


def _write_run(target: Any, run: Labelled) -> dict[str, int]:
    counts: dict[str, int] = {}
    target.attrs["format"] = 1
    target.attrs["kinds"] = list(KINDS)
    for camera in dict.fromkeys(record.camera for record in run.records):
        numbers = [i for i, record in enumerate(run.records) if record.camera == camera]
        try:
            _write_camera(target.create_group(camera), run, numbers)
        except RecordingError as error:  # a picture is read only now
            raise InputError(*error.problems) from None
        counts[camera] = len(numbers)
    return counts


def _write_camera(group: Any, run: Labelled, numbers: Sequence[int]) -> None:
    known = run.calibrations[run.records[numbers[0]].camera]
    shape = (known.height_px, known.width_px)
    frames = group.create_dataset(
        "frames",
        (len(numbers), *shape),
        np.uint16,
        chunks=(1, *shape),
        compression="gzip",
        compression_opts=1,
    )
    samples: list[Sample] = []
    for place, number in enumerate(numbers):
        sample = _sample(run, number, frozenset(KINDS))
        frames[place] = sample.data_dn
        samples.append(replace(sample, data_dn=_NO_PIXELS))
    for name in ("index", "time_s", "exposure_s", "line_time_s", "gain", "black_level_dn"):
        group[name] = np.array([getattr(sample, name) for sample in samples])
    group["frame_kind"] = [sample.frame_kind for sample in samples]
    group["frame"] = np.repeat(np.arange(len(samples)), [len(sample.names) for sample in samples])
    group["kind"] = np.concatenate([sample.kinds for sample in samples])
    group["name"] = [name for sample in samples for name in sample.names] or np.empty(0, dtype="S1")
    for name in _OF_THINGS:
        group[name] = np.concatenate([getattr(sample, name) for sample in samples])
