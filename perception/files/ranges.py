"""`ranges.csv`: the known ranges of a recording made on a rail, one line per frame: camera,index,range_m."""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path

from perception.files.fields import Place, read_text
from perception.types import FrameKey

RANGES_FILE = "ranges.csv"
_HEADER = ["camera", "index", "range_m"]


def encode_ranges(ranges_m: Mapping[FrameKey, float]) -> str:
    """Write the text of `ranges.csv`; read again, it gives the same numbers bit by bit.

    Examples
    --------
    >>> print(encode_ranges({("r1.front", 0): 1.0, ("r1.front", 1): 2.5}), end="")
    camera,index,range_m
    r1.front,0,1.0
    r1.front,1,2.5
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADER)
    writer.writerows((camera, index, repr(range_m)) for (camera, index), range_m in ranges_m.items())
    return text.getvalue()


def read_ranges(folder: str | Path) -> dict[FrameKey, float]:
    """Read the known range of each frame; frames that have none are left out of the file.

    Parameters
    ----------
    folder
        A recording's folder, with `ranges.csv` beside `frames.jsonl`. A range counts from the lens to the
        centre of the one source in view.

    Raises
    ------
    RecordingError
        If the file is missing, its header is another, a line is broken, or a frame stands in it twice.
    """
    path = Path(folder) / RANGES_FILE
    if not path.is_file():
        raise Place(str(path)).error(
            "the file is missing", f"Write one line per frame under the header {','.join(_HEADER)}"
        )
    rows = csv.reader(read_text(path).splitlines())
    header = next(rows, [])
    if [name.strip() for name in header] != _HEADER:
        raise Place(str(path), 1).error(f"is {','.join(header)!r}", f"Write the header {','.join(_HEADER)}")
    ranges_m: dict[FrameKey, float] = {}
    for row in rows:
        if not row:
            continue
        key, range_m = _parse(row, place := Place(str(path), rows.line_num))
        if key in ranges_m:
            raise place.error(f"a second range of frame {key[1]} of {key[0]!r}", "Keep one of them")
        ranges_m[key] = range_m
    return ranges_m


def _parse(row: list[str], place: Place) -> tuple[FrameKey, float]:
    broken = place.error(f"is {','.join(row)!r}", "Write camera,index,range_m, such as r1.front,0,1.000")
    try:
        camera, index_text, range_text = (cell.strip() for cell in row)
        index, range_m = int(index_text), float(range_text)
    except ValueError:
        raise broken from None
    if not camera or index < 0:
        raise broken
    if not (math.isfinite(range_m) and range_m > 0.0):
        raise place.error(f"is {range_text!r}", "Write metres, a number above 0", "range_m")
    return (camera, index), range_m
