from pathlib import Path

import pytest

from perception import RecordingError, encode_ranges, read_ranges


def test_round_trip_bit_by_bit(tmp_path: Path) -> None:
    ranges_m = {("r1.front", 0): 1.0036433629531958, ("r1.front", 12): 10.0, ("r1.left", 0): 1 / 3}
    (tmp_path / "ranges.csv").write_text(encode_ranges(ranges_m))
    assert read_ranges(tmp_path) == ranges_m


def test_written_by_hand(tmp_path: Path) -> None:
    """With spaces, Windows line ends and an empty line at the end, as spreadsheets and people leave them."""
    (tmp_path / "ranges.csv").write_bytes(b"camera, index, range_m\r\nr1.front, 3, 2.5\r\n\r\n")
    assert read_ranges(tmp_path) == {("r1.front", 3): 2.5}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1.*Write the header camera,index,range_m"),
        ("camera,index,distance\n", "line 1.*'camera,index,distance'"),
        ("camera,index,range_m\nr1.front,0\n", "line 2.*'r1.front,0'"),
        ("camera,index,range_m\nr1.front,0,1\nr1.front,x,1\n", "line 3.*'r1.front,x,1'"),
        ("camera,index,range_m\nr1.front,-1,1\n", "line 2"),
        ("camera,index,range_m\n,1,1\n", "line 2"),
        ("camera,index,range_m\nr1.front,0,0\n", "line 2, field 'range_m'.*above 0"),
        ("camera,index,range_m\nr1.front,0,nan\n", "line 2, field 'range_m'.*above 0"),
        (
            "camera,index,range_m\nr1.front,0,1\nr1.front,0,2\n",
            "line 3: a second range of frame 0 of 'r1.front'",
        ),
    ],
)
def test_bad_files_name_line_and_remedy(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "ranges.csv").write_text(text)
    with pytest.raises(RecordingError, match=said):
        read_ranges(tmp_path)


def test_a_missing_file_says_what_to_write(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"ranges\.csv: the file is missing.*camera,index,range_m"):
        read_ranges(tmp_path)
