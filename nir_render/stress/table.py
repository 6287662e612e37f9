"""The table of a campaign: a file of rows for each job that is done, and all of them as one Parquet table."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from nir_render.run.folder import write_file
from nir_render.stress.design.axes import Axis
from nir_render.stress.job.sequences import Row
from nir_render.stress.jobs import Job

_TEXT, _FLAG, _WHOLE, _NUMBER = pa.string(), pa.bool_(), pa.int64(), pa.float64()
_ROWS = pa.schema(
    [
        ("camera", _TEXT),
        ("index", _WHOLE),
        ("time_s", _NUMBER),
        ("estimator", _TEXT),
        # frame: one row per frame and estimator; source: one per source in view; ghost: one per mirror image
        # of a source; false_alarm: one per detection of nothing; sequence: one per observer (`camera` names
        # it) of ten sets of frames or more; packet: one per packet that an observer could see.
        ("kind", _TEXT),
        # Of a frame.
        ("exposure_s", _NUMBER),
        ("gain", _NUMBER),
        ("frame_false_alarms", _WHOLE),
        ("frame_ghosts_reported", _WHOLE),
        ("frame_lamps_reported", _WHOLE),
        ("render_noise_share", _NUMBER),
        ("render_noise_target", _NUMBER),
        # The truth about a source.
        ("robot", _TEXT),
        ("source", _TEXT),
        ("ghost_of", _TEXT),
        ("countable", _FLAG),
        ("true_u_px", _NUMBER),
        ("true_v_px", _NUMBER),
        ("true_range_m", _NUMBER),
        ("visible_fraction", _NUMBER),
        ("on_fraction", _NUMBER),
        ("direct_e", _NUMBER),
        ("mirrored_e", _NUMBER),
        ("scattered_e", _NUMBER),
        ("background_e", _NUMBER),
        ("peak_snr", _NUMBER),
        ("saturated_px", _WHOLE),
        ("range_limit_m", _NUMBER),
        ("bearing_limit_deg", _NUMBER),
        # What the estimator said of it.
        ("found", _FLAG),
        ("ranged", _FLAG),
        ("u_px", _NUMBER),
        ("v_px", _NUMBER),
        ("u_sigma_px", _NUMBER),
        ("v_sigma_px", _NUMBER),
        ("flux_dn", _NUMBER),
        ("mean_dn", _NUMBER),
        ("background_dn", _NUMBER),
        ("area_px", _WHOLE),
        ("saturated", _FLAG),
        ("merged", _FLAG),
        ("range_m", _NUMBER),
        ("range_sigma_m", _NUMBER),
        ("range_error_m", _NUMBER),
        ("bearing_error_deg", _NUMBER),
        # Of a sequence.
        ("track_hota", _NUMBER),
        ("track_idf1", _NUMBER),
        ("track_switches", _WHOLE),
        ("message_wrong", _WHOLE),
        ("message_bit_error_rate", _NUMBER),
        # Of a packet.
        ("received", _FLAG),
    ]
)
_FRAMES_HASH = b"frames_sha256"


def write_part(path: Path, rows: Sequence[Row], frames_sha256: str) -> None:
    """Write what one job has found, aside, synced and renamed: a file is there whole or not at all.

    Raises
    ------
    InputError
        The disk is full, the folder cannot be written.
    KeyError
        A row has a field that is no column.
    """
    known = set(_ROWS.names)
    for row in rows:
        if not known.issuperset(row):
            raise KeyError(f"not in the table: {', '.join(sorted(set(row) - known))}")
    table = pa.Table.from_pylist(list(rows), schema=_ROWS)
    _write(path, table.replace_schema_metadata({_FRAMES_HASH: frames_sha256.encode()}))


def read_part(path: Path) -> tuple[pa.Table, str] | None:
    """Return a job's rows and the hash of its frames; None where there is no file, or none that is whole."""
    try:
        table = pq.read_table(BytesIO(path.read_bytes()))
        frames_sha256 = table.schema.metadata[_FRAMES_HASH].decode()
    except (OSError, pa.ArrowException, KeyError, TypeError):
        return None
    return (table, frames_sha256) if table.schema.equals(_ROWS) else None


def gathered(jobs: Sequence[Job], parts: Sequence[pa.Table], axes: Sequence[Axis]) -> pa.Table:
    """Return the rows of all jobs, in their order, with the columns job, seed and `axis.NAME` before them.

    A column of an axis holds its value in SI units, or its label where it is no number.
    """
    tables = []
    for job, part in zip(jobs, parts, strict=True):
        columns: list[tuple[str, pa.Array]] = [
            ("job", pa.repeat(pa.scalar(job.key, _TEXT), len(part))),
            ("seed", pa.repeat(pa.scalar(job.seed, _WHOLE), len(part))),
        ]
        for axis, value in zip(axes, job.point.written, strict=True):
            scalar = pa.scalar(value, _TEXT if axis.values_si is None else _NUMBER)
            columns.append((f"axis.{axis.name}", pa.repeat(scalar, len(part))))
        names, arrays = zip(*columns, strict=True)
        job_columns = pa.table(list(arrays), names=list(names))
        tables.append(
            pa.table(
                [*job_columns.columns, *part.columns], names=[*job_columns.column_names, *part.column_names]
            )
        )
    return pa.concat_tables(tables)


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table as one Parquet file; the same rows give the same bytes."""
    _write(path, table)


def read_table(path: Path) -> pa.Table:
    """Read the table of a campaign."""
    return pq.read_table(path)


def _write(path: Path, table: pa.Table) -> None:
    sink = BytesIO()
    # One row group, so that the bytes do not follow from how the table was put together.
    pq.write_table(table.combine_chunks(), sink, compression="zstd", row_group_size=max(len(table), 1))
    write_file(path, sink.getvalue())
