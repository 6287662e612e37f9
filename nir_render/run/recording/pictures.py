"""The pictures of one camera: which they are, what they have in common, and what their dark pixels say."""

import itertools
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError, shown
from perception import RecordingError, read_picture
from perception.calibration.dark import Darkness, darkness
from perception.files.fields import first_of

KINDS = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
_LOOKED_AT = 8
_FEWEST_NUMBERED = 4  # pictures whose names may count
_MOSTLY = 0.75  # of the steps of a number that counts are alike


@dataclass(frozen=True)
class Pictures:
    """The pictures of one camera.

    `files` count from the recording's folder; `bits` are those that the files store, `most_dn` is the largest
    count in any of them, `lossy_sigma_dn` the largest σ of compression.
    """

    files: tuple[str, ...]
    width_px: int
    height_px: int
    bits: int
    most_dn: int
    lossy_sigma_dn: float
    darkness: Darkness

    @property
    def gaps(self) -> list[tuple[str, str]]:
        """Pictures between which numbers are missing, where their names go on by one number in even steps."""
        names = [_as_counted(file) for file in self.files]
        if len(names) < _FEWEST_NUMBERED or len({tuple(kind for kind, _ in name) for name in names}) > 1:
            return []
        varying = [parts for parts in zip(*names, strict=True) if len(set(parts)) > 1]
        if len(varying) != 1 or not all(isinstance(number, int) for _, number in varying[0]):
            return []
        steps = [int(other) - int(one) for (_, one), (_, other) in itertools.pairwise(varying[0])]
        usual, times = Counter(steps).most_common(1)[0]
        if times < _MOSTLY * len(steps) or any(step % usual for step in steps):
            return []  # times, perhaps
        return [
            pair for pair, step in zip(itertools.pairwise(self.files), steps, strict=True) if step > usual
        ]


def find_pictures(folder: Path, pattern: str) -> list[str]:
    """Return the pictures that a pattern names, from the folder on, in the order in which people count.

    Raises
    ------
    InputError
        The pattern leads out of the folder, or names nothing.
    """
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts or "\\" in pattern:
        raise InputError(
            f"{shown(pattern)} leads out of the folder; put the pictures within it, with forward slashes"
        )
    try:
        found = [path for path in folder.glob(pattern) if path.is_file()]
    except (ValueError, NotImplementedError, OSError, re.error) as error:
        raise InputError(f"{shown(pattern)} is no pattern ({error}); write such as frames/*.png") from None
    if not found:
        raise InputError(f"{shown(pattern)} names no file in {folder}; write such as frames/*.png")
    return sorted((path.relative_to(folder).as_posix() for path in found), key=_as_counted)


def read_pictures(folder: Path, pattern: str) -> Pictures:
    """Read all pictures of a camera.

    Raises
    ------
    InputError
        As `find_pictures`; all pictures that cannot be read; pictures of several sizes or kinds.
    """
    files = find_pictures(folder, pattern)
    problems: list[str] = []
    sizes: dict[tuple[int, int, int], str] = {}
    step = max(1, -(-len(files) // _LOOKED_AT))
    stack: list[NDArray[np.uint16]] = []
    most_dn, lossy_dn = 0, 0.0
    for number, file in enumerate(files):
        try:
            picture = read_picture(folder / file)
        except RecordingError as error:
            problems += error.problems
            continue
        rows, columns = picture.data_dn.shape
        sizes.setdefault((columns, rows, picture.bits), file)
        most_dn = max(most_dn, int(picture.data_dn.max(initial=0)))
        lossy_dn = max(lossy_dn, picture.lossy_sigma_dn)
        if number % step in (0, 1) and len(sizes) == 1:  # pairs of frames that follow each other
            stack.append(picture.data_dn)
    if len(sizes) > 1:
        told = ", ".join(f"{file} ({w} × {h} px, {bits} bits)" for (w, h, bits), file in sizes.items())
        problems.append(f"the pictures are not alike: {told}; take out those of other cameras or settings")
    if problems:
        raise InputError(*first_of(problems))
    ((width_px, height_px, bits),) = sizes
    return Pictures(tuple(files), width_px, height_px, bits, most_dn, lossy_dn, darkness(stack))


def _as_counted(name: str) -> list[tuple[int, int | str]]:
    """Return a key that sorts img2 before img10."""
    parts = re.split(r"(\d{1,18})", name)
    return [(1, int(part)) if part.isdigit() else (0, part) for part in parts]
