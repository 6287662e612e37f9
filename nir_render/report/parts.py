"""Pages by templates: one environment that escapes whatever is no markup, and what templates are filled with.

Templates lie beside the page that they make, and are named by their place in the package, such as
"report/page.html". `report/base.html` is the page around all of them, `report/kit.html` has tables, plots and
marks.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from nir_render.report import style

_MARKS = {
    "s": "M{left} {top}h{size}v{size}h-{size}z",
    "+": "M{left} {y}h{size}M{x} {top}v{size}",
    "x": "M{left} {top}l{size} {size}m-{size} 0l{size} -{size}",
    "D": "M{x} {top}l{half} {half}l-{half} {half}l-{half} -{half}z",
    "^": "M{x} {top}l{half} {size}h-{size}z",
    "v": "M{x} {bottom}l{half} -{size}h-{size}z",
}
"""Paths of SVG, by matplotlib's name of the marker."""


@dataclass(frozen=True)
class Table:
    """A table of a page: headings, and cells that are text or `Markup`."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def render_page(template: str, **values: Any) -> str:
    """Fill a template; whatever is no `Markup` is escaped, and what a template asks for must be there."""
    return _environment().get_template(template).render(**values)


def marker(name: str, names: Sequence[str], x: float, y: float, size: float) -> Markup:
    """Draw an estimator's mark around a place, as a path of SVG."""
    look = style.look(name, names)
    half = 0.5 * size
    lengths = {
        "x": x,
        "y": y,
        "left": x - half,
        "top": y - half,
        "bottom": y + half,
        "half": half,
        "size": size,
    }
    path = _MARKS[look.marker].format_map({key: f"{value:.2f}" for key, value in lengths.items()})
    return Markup('<path d="{}" stroke="{}" class="mark"/>').format(path, look.colour)


def named_mark(name: str, names: Sequence[str]) -> Markup:
    """Return an estimator's mark, to stand within a line, and its name."""
    path = marker(name, names, 8, 8, 11)
    return Markup('<svg viewBox="0 0 16 16" width="16" height="16">{}</svg> {}').format(path, name)


def data_uri(content: bytes | str, mime: str) -> str:
    """Return an address that holds its content: names within an SVG so clash with no other's."""
    data = content.encode() if isinstance(content, str) else content
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"


def facts_table(facts: Mapping[str, Any], but: Sequence[str] = ()) -> Table:
    """Return nested facts as a table of two columns, a row for each leaf, `seconds render`.

    Empty ones are left out, and those of the names in `but`.
    """
    return Table((), _fact_rows({key: value for key, value in facts.items() if key not in but}))


def _fact_rows(facts: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in facts.items():
        name = f"{prefix} {key}".strip().replace("_", " ")
        if isinstance(value, Mapping):
            rows += _fact_rows(value, name)
        elif value not in ("", None):
            rows.append((name, str(value)))
    return rows


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("nir_render", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    colours = ("GROUND", "PANEL", "LINE", "INK", "FAINT", "TRUTH", "GOOD", "FAIR", "BAD")
    environment.globals["colours"] = {name.lower(): getattr(style, name) for name in colours}
    environment.globals["marker"] = marker
    environment.globals["named_mark"] = named_mark
    environment.filters["data_uri"] = data_uri
    environment.filters["px"] = lambda value: f"{value:.2f}"
    return environment
