"""Rows to files and back, and all files as one table."""

from pathlib import Path

import pyarrow as pa
import pytest

from nir_render.stress.design.axes import AxisDocument
from nir_render.stress.design.points import points_of
from nir_render.stress.jobs import Job
from nir_render.stress.table import gathered, read_part, read_table, write_part, write_table

AXES = (
    AxisDocument.model_validate(["20 us", "1 ms"]).axis("a.exposure"),
    AxisDocument.model_validate(["steel", "paint"]).axis("material"),
)
ROWS = [
    {"camera": "r1.front", "index": 0, "estimator": "paper", "kind": "frame", "frame_false_alarms": 2},
    {
        "camera": "r1.front",
        "index": 0,
        "estimator": "paper",
        "kind": "source",
        "found": False,
        "range_m": None,
    },
]


def job(number: int, values: tuple[int, int]) -> Job:
    point = next(point for point in points_of(AXES, None) if point.values == values)
    return Job(f"{number:032x}", point, number, {}, "light")


def test_a_part_comes_back_as_it_was_written(tmp_path: Path) -> None:
    write_part(tmp_path / "one.parquet", ROWS, "abc")
    read = read_part(tmp_path / "one.parquet")
    assert read is not None
    table, frames_sha256 = read
    assert frames_sha256 == "abc"
    assert table["frame_false_alarms"].to_pylist() == [2, None]
    assert table["found"].to_pylist() == [None, False]
    assert [path.name for path in tmp_path.iterdir()] == ["one.parquet"]


def test_a_part_that_is_not_whole_counts_as_none(tmp_path: Path) -> None:
    file = tmp_path / "one.parquet"
    assert read_part(file) is None
    write_part(file, ROWS, "abc")
    whole = file.read_bytes()
    for cut in (0, 4, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:cut])
        assert read_part(file) is None
    write_table(file, pa.table({"something": [1, 2]}))  # of another version, or of something else
    assert read_part(file) is None


def test_a_field_that_is_no_column_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="ragne_m"):
        write_part(tmp_path / "one.parquet", [{"ragne_m": 1.0}], "abc")


def test_all_jobs_are_one_table_with_their_axes_in_si_units_or_by_label(tmp_path: Path) -> None:
    write_part(tmp_path / "one.parquet", ROWS, "abc")
    part = read_part(tmp_path / "one.parquet")
    assert part is not None
    table = gathered([job(1, (0, 1)), job(2, (1, 0))], [part[0], part[0]], AXES)
    assert table.column_names[:4] == ["job", "seed", "axis.a.exposure", "axis.material"]
    assert table["axis.a.exposure"].to_pylist() == pytest.approx([20e-6, 20e-6, 1e-3, 1e-3], rel=1e-12)
    assert table["axis.material"].to_pylist() == ["paint", "paint", "steel", "steel"]
    assert table["seed"].to_pylist() == [1, 1, 2, 2]
    assert table["kind"].to_pylist() == ["frame", "source"] * 2
    write_table(tmp_path / "first.parquet", table)
    write_table(tmp_path / "again.parquet", table)
    assert (tmp_path / "first.parquet").read_bytes() == (tmp_path / "again.parquet").read_bytes()
    assert read_table(tmp_path / "first.parquet").equals(table)
