"""The parts that pages are put together from: the page itself, tables, plots, marks, facts."""

import base64
import importlib.resources
from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import Any

from nir_render.report import style
from nir_render.report.pictures import marker_svg


def page(title: str, subtitle: Sequence[str], body: Sequence[str]) -> str:
    """Return an HTML document; title and subtitle are plain text, the body's parts are HTML already."""
    template = (
        importlib.resources.files("nir_render.report").joinpath("page.html").read_text(encoding="utf-8")
    )
    return Template(template).substitute(
        title=escape(title),
        subtitle=escape(" · ".join(subtitle)),
        body="\n".join(body),
        ground=style.GROUND,
        panel=style.PANEL,
        line=style.LINE,
        ink=style.INK,
        faint=style.FAINT,
        good=style.GOOD,
        fair=style.FAIR,
        bad=style.BAD,
    )


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], text: Sequence[int] = ()) -> str:
    """Return a table; cells are HTML already, headings are not. Columns of `text` are set as such."""

    def kind(column: int) -> str:
        return ' class="text"' if column in text else ""

    head = "".join(f"<th{kind(column)}>{escape(heading)}</th>" for column, heading in enumerate(headings))
    lines = [
        "<tr>" + "".join(f"<td{kind(column)}>{cell}</td>" for column, cell in enumerate(row)) + "</tr>"
        for row in rows
    ]
    header = f"<thead><tr>{head}</tr></thead>" if head else ""
    return f'<div class="scroll"><table>{header}<tbody>{"".join(lines)}</tbody></table></div>'


def plot(svg: str, said: str) -> str:
    """Return a plot as an image of its own: names within one SVG cannot clash with those of another."""
    data = base64.b64encode(svg.encode()).decode()
    return f'<figure class="plot"><img alt="{escape(said)}" src="data:image/svg+xml;base64,{data}"></figure>'


def mark(name: str, names: Sequence[str]) -> str:
    """Return an estimator's mark, to stand within a line."""
    return f'<svg viewBox="0 0 16 16" width="16" height="16">{marker_svg(name, names, 8, 8, 11)}</svg>'


def facts_table(facts: Mapping[str, Any]) -> str:
    """Return nested facts as a table of two columns; empty ones are left out."""
    return table([], [[escape(name), escape(value)] for name, value in _flat(facts)], text=(1,))


def _flat(facts: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Name every leaf of nested facts: `seconds render`."""
    leaves: list[tuple[str, str]] = []
    for key, value in facts.items():
        name = f"{prefix} {key}".strip().replace("_", " ")
        if isinstance(value, Mapping):
            leaves += _flat(value, name)
        elif value not in ("", None):
            leaves.append((name, str(value)))
    return leaves
