"""A short run of `tests.fuzz`: documents with slips in them are right, or refused in words that help."""

from pathlib import Path

from tests.fuzz import fuzz


def test_no_mutated_document_is_met_with_less_than_help(tmp_path: Path) -> None:
    """100 documents of a fixed seed; thousands by `python -m tests.fuzz`."""
    summary = fuzz(11, range(100), tmp_path)
    assert summary.failures == []
    assert summary.documents == 100
    assert summary.refused > 50
    assert summary.valid > 5
    assert summary.with_line > 0.8 * summary.problems
