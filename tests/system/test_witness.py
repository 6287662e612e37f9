"""The page of what others measured is the output of its script, and what it calls equal is."""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT

pytest.importorskip("pvlib")


@cache
def witness() -> Any:
    """Return the script as a module."""
    spec = importlib.util.spec_from_file_location("witness", ROOT / "tools" / "witness.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["witness"] = module  # its dataclass looks there
    spec.loader.exec_module(module)
    return module


@pytest.mark.verify
def test_the_page_is_what_its_script_makes(tmp_path: Path) -> None:
    """Two rows differ, and say why: a camera of another maker, and a photodiode whose curve is assumed even."""
    rows = witness().witnesses(tmp_path)
    assert witness().PAGE.read_text(encoding="utf-8") == witness().page(rows)
    apart = [row for row in rows if not row.agrees]
    assert len(apart) == 2
    assert all(row.why for row in apart)


@pytest.mark.parametrize(("ours", "agrees"), [(102.9, True), (103.1, False), (96.9, False)])
def test_equal_is_within_three_per_cent(ours: float, agrees: bool) -> None:
    assert witness().Witness("", "nm", 100.0, ours, "").agrees == agrees


@pytest.mark.parametrize(
    ("bound", "ours", "holds"),
    [("at most", 4.5, True), ("at most", 10.1, False), ("more than", 91.0, True), ("more than", 9.0, False)],
)
def test_a_bound_holds_or_not(bound: str, ours: float, holds: bool) -> None:
    row = witness().Witness("", "%", 10.0, ours, "", bound=bound)
    assert (row.agrees, row.verdict) == (holds, "holds" if holds else "differs")
