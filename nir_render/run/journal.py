"""The journal of a render in work: one line for each frame that is whole, so that a killed run goes on.

A line is written after its frame's picture. What a kill cuts off is at most the last line, and its frame is
rendered again.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nir_render.camera.render_noise import RenderNoise
from nir_render.camera.timing.exposure_control import ExposureState, Seen, Setting
from nir_render.errors import InputError

JOURNAL = "journal.jsonl"


@dataclass(frozen=True, eq=False)
class Entry:
    """What is said of one frame.

    Attributes
    ----------
    lines
        The records of this frame, by the file that they belong to.
    noise
        The render's, beside the sensor's own.
    exposure
        What its camera's automatic exposure knows after the frame; None without one.
    lights
        How many lights had been rendered, and how many reused, when the frame was done.
    first
        What is said of a camera by its first frame: samples and the error of enlarging; None of later ones.
    refresh
        What was measured on the way to it of the error of interpolated light.
    """

    camera: str
    index: int
    lines: Mapping[str, list[dict[str, Any]]]
    noise: RenderNoise
    exposure: ExposureState | None
    lights: tuple[int, int]
    first: dict[str, Any] | None
    refresh: list[dict[str, Any]]

    @property
    def name(self) -> str:
        """The frame, as "r1.front 3"."""
        return f"{self.camera} {self.index}"


class Journal:
    """The journal in a folder, to add to."""

    def __init__(self, folder: Path) -> None:
        """Open it, new or old; what a kill has left of a last line is cut off."""
        self._path = folder / JOURNAL
        if self._path.is_file():
            with self._path.open("r+b") as file:
                file.truncate(_whole_bytes(self._path))
        try:
            self._file = self._path.open("ab")
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written ({error.strerror or error})") from None

    def add(self, entry: Entry) -> None:
        """Add a frame; when this returns, a kill of the process does not lose it."""
        self._file.write(json.dumps(asdict(entry), allow_nan=False).encode() + b"\n")
        self._file.flush()

    def entries(self) -> Iterator[Entry]:
        """Yield the frames, in the order in which they were made."""
        with self._path.open("rb") as file:
            for line in file:
                yield _entry(json.loads(line))

    def close(self) -> None:
        """Add no more."""
        self._file.close()

    def remove(self) -> None:
        """Remove the file: the run is whole."""
        self.close()
        self._path.unlink()


def _whole_bytes(path: Path) -> int:
    """Return how many bytes of a file are whole lines."""
    whole = 0
    with path.open("rb") as file:
        for line in file:
            whole += len(line) if line.endswith(b"\n") else 0
    return whole


def _entry(record: dict[str, Any]) -> Entry:
    exposure = record["exposure"]
    if exposure is not None:
        exposure = ExposureState(
            tuple(Setting(**setting) for setting in exposure["upcoming"]),
            tuple(Seen(**seen) for seen in exposure["seen"]),
        )
    return Entry(
        camera=record["camera"],
        index=record["index"],
        lines=record["lines"],
        noise=RenderNoise(**record["noise"]),
        exposure=exposure,
        lights=(record["lights"][0], record["lights"][1]),
        first=record["first"],
        refresh=record["refresh"],
    )
