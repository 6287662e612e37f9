"""What a run says as it goes, in the files of a run folder: poses, odometry, tracks, words, kept frames.

Lines are added at the ends of files. A run that is killed goes on from its last saved state, so files are cut
to the lengths that they had then: what comes again is the same.
"""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run.folder import CALIBRATION, FRAMES, disk_error, write_file, write_json
from perception import Calibration, RawFrame, calibration_document, encode_png16, frame_record

Line = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Told:
    """What there is to tell of a step: lines by the names of their files, frames to be kept, whole files."""

    lines: Mapping[str, Sequence[Line]]
    frames: Sequence[RawFrame] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass
class Journal:
    """The files of a run in the making.

    Attributes
    ----------
    folder
        Where they lie.
    lengths
        How long each is, in bytes, with all that was written.
    """

    folder: Path
    lengths: dict[str, int] = field(default_factory=dict)

    @staticmethod
    def begin(folder: Path, calibrations: Iterable[Calibration]) -> "Journal":
        """Begin one; what an earlier attempt without a saved state left there goes.

        Raises
        ------
        InputError
            The disk refuses.
        """
        known = list(calibrations)
        if known:
            write_json(folder / CALIBRATION, calibration_document(known))
        return Journal(folder)

    def write(self, told: Told) -> None:
        """Add what there is to tell of a step; errors as `begin`."""
        lines = dict(told.lines)
        if told.frames:
            lines[FRAMES] = [self._kept(frame) for frame in told.frames]
        for name, content in told.files.items():
            write_file(self.folder / name, content)
        for name, records in lines.items():
            text = "".join(json.dumps(record, allow_nan=False) + "\n" for record in records).encode()
            self._add(name, text)

    def sync(self) -> None:
        """See to it that all that was written is on the disk; errors as `begin`."""
        for name in self.lengths:
            path = self.folder / name
            try:
                with path.open("rb") as file:
                    os.fsync(file.fileno())
            except OSError as error:
                raise disk_error(path, error) from None

    def _kept(self, frame: RawFrame) -> dict[str, Any]:
        file = f"frames/{frame.camera}/{frame.index:06d}.png"
        write_file(self.folder / file, encode_png16(frame.data_dn))
        return frame_record(frame, file)

    def _add(self, name: str, text: bytes) -> None:
        """Write from where the file ended when the state was saved: what an ended process added goes."""
        path, length = self.folder / name, self.lengths.get(name, 0)
        if length == 0 and not text and not path.exists():
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab") as file:
                file.truncate(length)
                file.seek(length)
                file.write(text)
        except OSError as error:
            raise disk_error(path, error) from None
        self.lengths[name] = length + len(text)


def check_whole(journal: Journal) -> None:
    """Raise InputError where files are shorter than the saved state says: someone has cut them."""
    for name, length in journal.lengths.items():
        path = journal.folder / name
        if not path.is_file() or path.stat().st_size < length:
            raise InputError(
                f"{path}: is shorter than the run's saved state says; remove the folder of this seed and its "
                ".state file, and it runs anew"
            )
