"""Point spreads in scene files: measured kernels from files, round trips, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from nir_render.scene.documents.point_spread import PointSpread

_AT = np.arange(-6, 7)
_BELL = np.exp(-0.5 * (_AT[:, None] ** 2 + _AT**2) / 1.5**2)


def _rows(grid: np.ndarray) -> list[str]:
    return [f"[{', '.join(repr(float(value)) for value in row)}]" for row in grid]


def _spread(folder: Path = Path(), **document: Any) -> PointSpread:
    return PointSpread.model_validate(document, context={"folder": folder})


def test_a_kernel_is_read_from_a_file_and_written_out_whole(tmp_path: Path) -> None:
    """A CSV of rows from top to bottom; the resolved document holds its numbers to the bit."""
    text = "\n".join(",".join(repr(float(value)) for value in row) for row in _BELL)
    (tmp_path / "lens.csv").write_text(f"# at f/2\n{text}\n", encoding="utf-8")
    spread = _spread(tmp_path, kernel={"file": "lens.csv", "pitch": "0.25 px"})
    assert spread.kernel is not None
    np.testing.assert_array_equal(spread.kernel.values, _BELL)
    again = _spread(**spread.model_dump(by_alias=True))
    assert again == spread
    assert hash(again) == hash(spread)


def test_what_the_core_keeps() -> None:
    spread = _spread(
        sigma="0.7 px",
        glare={"share": "2 %", "core_radius": "10 px", "exponent": 2.5},
        ghosts=[
            {"share": "0.1 %", "radius": "40 px"},
            {"share": "0.2 %", "radius": "9 px", "magnification": 0.8},
        ],
    )
    assert spread.core_share == pytest.approx(0.977)
    assert _spread(sigma="0.7 px", ghosts=None).core_share == 1.0


_GLARE = {"share": "2 %", "core_radius": "10 px", "exponent": 2.5}
_GHOST = {"share": "0.1 %", "radius": "40 px"}


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        ({}, "'sigma', 'diffraction' or 'kernel'"),
        ({"crosstalk": 0.01}, "no lens is sharp"),
        ({"sigma": "0.2 px"}, "greater than or equal to 0.3"),
        ({"sigma": 0.7}, "bare number"),
        ({"diffraction": "940 um"}, "less than or equal to"),
        ({"diffraction": True}, "nothing here is true or false"),
        ({"sigma": "1 px", "crosstalk": 0.5}, "less than 0.5"),
        ({"sigma": "1 px", "glare": {**_GLARE, "exponent": 1.0}}, "greater than or equal to 1.05"),
        ({"sigma": "1 px", "glare": {**_GLARE, "core_radius": "1 px"}}, "greater than or equal to 3"),
        ({"sigma": "1 px", "glare": {**_GLARE, "share": "45 %"}, "ghosts": [{**_GHOST, "share": "6 %"}]}, "51%"),
        ({"sigma": "1 px", "ghosts": [{**_GHOST, "magnification": 0.0}]}, "at least 0.02"),
        ({"sigma": "1 px", "ghosts": [{**_GHOST, "magnification": 11.0}]}, "a radius of 4 px times it"),
        ({"sigma": "1 px", "ghosts": _GHOST}, r"ghosts: wanted a list, even of one; write ghosts: \[\{share: 0.1 %"),
        ({"kernel": {"pitch": "0.25 px"}}, "'values' and 'file'"),
        ({"kernel": {"pitch": "1.5 px", "values": _rows(_BELL)}}, "less than or equal to 1"),
        ({"kernel": {"pitch": "0.25 px", "values": ["[1, 2, 1]", "[2, 4]", "[1, 2, 1]"]}}, "of one length"),
        ({"kernel": {"pitch": "0.25 px", "values": ["[1, 1]", "[1, 1]"]}}, "3 to 257"),
        ({"kernel": {"pitch": "0.25 px", "values": _rows(np.where(_BELL < 0.1, -0.1, _BELL))}}, "not negative"),
        ({"kernel": {"pitch": "0.25 px", "values": ["[1, nan, 1]"] * 3}}, "finite"),
        ({"kernel": {"pitch": "0.25 px", "values": _rows(0.0 * _BELL)}}, "0 everywhere"),
        ({"kernel": {"pitch": "0.25 px", "values": ["[0, 0, 0]", "[0, 1, 0]", "[0, 0, 0]"]}}, "too coarse"),
        ({"kernel": {"pitch": "0.25 px", "values": _rows(np.ones((5, 5)))}}, "cuts the light off"),
    ],
)  # fmt: skip
def test_what_is_no_point_spread_is_refused(document: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        _spread(**document)


def test_a_file_of_words_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lens.csv").write_text("u,v\n1,2\n", encoding="utf-8")
    with pytest.raises(ValidationError, match="wanted rows of numbers, with no header"):
        _spread(tmp_path, kernel={"file": "lens.csv", "pitch": "0.25 px"})


@pytest.mark.parametrize(
    "line", [b"1, 2, 1,", b"1; 2; 1", b"1 2 1", b"1, , 1", b"# \xd6ffnung 2", b"\xd6, 1, 2"]
)
def test_a_file_of_other_numbers_is_refused_with_its_line(tmp_path: Path, line: bytes) -> None:
    """A comma at the end, other separators, bytes of Latin-1: file, line, and how to write it."""
    (tmp_path / "lens.csv").write_bytes(b"# at f/2\n1, 2, 1\n" + line + b"\n1, 2, 1\n")
    with pytest.raises(
        ValidationError, match=r"lens\.csv, line 3: wanted rows of numbers.*such as 0, 0\.5, 0; .*UTF-8"
    ):
        _spread(tmp_path, kernel={"file": "lens.csv", "pitch": "0.25 px"})


def test_a_file_from_a_spreadsheet_is_read(tmp_path: Path) -> None:
    """A byte order mark and Windows' ends of lines change nothing."""
    text = "\r\n".join(",".join(repr(float(value)) for value in row) for row in _BELL)
    (tmp_path / "lens.csv").write_bytes(b"\xef\xbb\xbf" + text.encode() + b"\r\n\r\n")
    spread = _spread(tmp_path, kernel={"file": "lens.csv", "pitch": "0.25 px"})
    assert spread.kernel is not None
    np.testing.assert_array_equal(spread.kernel.values, _BELL)
