"""The page of what others measured is the output of its script, and what it calls equal is."""

from pathlib import Path

import pytest

from tests.paths import ROOT
from tools.witness import PAGE, Witness, page, witnesses

pytest.importorskip("pvlib")


def test_the_page_is_what_its_script_makes(tmp_path: Path) -> None:
    """Three rows differ, and say why: a camera of another maker, and the paper's two sources."""
    rows = witnesses(tmp_path)
    assert PAGE.read_text(encoding="utf-8") == page(rows)
    apart = [row.what for row in rows if not row.agrees]
    assert len(apart) == 3
    assert all(row.why for row in rows if not row.agrees)


@pytest.mark.parametrize(("ours", "agrees"), [(102.9, True), (103.1, False), (96.9, False)])
def test_equal_is_within_three_per_cent(ours: float, agrees: bool) -> None:
    assert Witness("", "nm", 100.0, ours, "").agrees == agrees
