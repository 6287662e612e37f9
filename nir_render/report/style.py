"""The look that pictures and pages share: colours, markers, and matplotlib's settings."""

from collections.abc import Sequence
from typing import Any, NamedTuple

GROUND, PANEL, LINE = "#101418", "#171c22", "#2d343c"
INK, FAINT = "#e6e8ea", "#9aa4ad"
TRUTH = "#4cc9f0"
LIMIT = "#c8d0d8"
GOOD, FAIR, BAD = "#2ec27e", "#e5a50a", "#f0576b"


class Look(NamedTuple):
    """How an estimator is drawn: a matplotlib marker, and a colour."""

    marker: str
    colour: str


_BUILT_IN = {"paper": Look("s", "#ff9f1c"), "robust": Look("+", "#70e000")}
_OTHERS = (Look("x", "#f72585"), Look("D", "#b392f0"), Look("^", "#ffd166"), Look("v", "#5e9bff"))

MATPLOTLIB: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "text.parse_math": False,  # names come from the user, and may hold a dollar sign
    "axes.facecolor": PANEL,
    "axes.edgecolor": LINE,
    "axes.labelcolor": INK,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "figure.facecolor": GROUND,
    "legend.frameon": False,
    "svg.hashsalt": "nir_render",  # the same run gives the same bits
}


def look(name: str, names: Sequence[str]) -> Look:
    """Return how an estimator is drawn among all that are: one's own take other looks in turn."""
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    own = [other for other in names if other not in _BUILT_IN]
    return _OTHERS[own.index(name) % len(_OTHERS)]
