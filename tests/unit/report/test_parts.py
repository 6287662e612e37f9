"""What pages are put together from: escaped, whole, and refused where something is missing."""

import jinja2
import pytest
from markupsafe import Markup

from nir_render.report.parts import Table, facts_table, marker, named_mark, render_page
from tests.paths import ROOT

HOSTILE = "<b>&'\""


def test_every_template_is_read_without_fault() -> None:
    """And what a page asks for must be there."""
    templates = sorted((ROOT / "nir_render").rglob("*.html"))
    assert len(templates) >= 7
    for template in templates:
        name = template.relative_to(ROOT / "nir_render").as_posix()
        if template.stem in ("base", "page", "recording_page", "check", "update"):
            with pytest.raises(jinja2.UndefinedError, match="'title' is undefined"):
                render_page(name)
        else:
            render_page(name)


def test_a_name_is_escaped_and_its_mark_is_not() -> None:
    path = '<path d="M2.50 2.50h11.00v11.00h-11.00z" stroke="#ff9f1c" class="mark"/>'
    assert marker("paper", ["paper"], 8.0, 8.0, 11.0) == Markup(path)
    assert named_mark(HOSTILE, [HOSTILE]).endswith("</svg> &lt;b&gt;&amp;&#39;&#34;")


def test_facts_are_named_by_their_way_and_empty_ones_left_out() -> None:
    facts = {"seconds": {"render": 1.5, "perceive": None}, "note": "", "who": HOSTILE, "sha256": {"a": "b"}}
    assert facts_table(facts, but=("sha256",)) == Table((), [("seconds render", "1.5"), ("who", HOSTILE)])
