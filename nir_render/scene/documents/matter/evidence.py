"""Where the figures of a material come from, and how far a surface of its kind may be off them."""

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nir_render.scene.documents.base import Document, Fraction

_MOST_DEVIATION = 5.0


class Evidence(Document):
    """What stands behind a material's figures.

    `basis` says whether samples were `measured`, figures were `computed` from measured constants, or are
    `assumed`. `uncertainty` is the relative standard deviation from one such surface to another, of what the
    material reflects (of a pane, of what it passes); `least` and `most` bound that at 940 nm.
    """

    example: ClassVar[str] = (
        '{source: "ECOSTRESS 0092UUU", basis: measured, uncertainty: 10 %, least: 0.25, most: 0.45}'
    )

    source: Annotated[str, Field(min_length=1, max_length=1000)]
    basis: Literal["measured", "computed", "assumed"]
    uncertainty: Annotated[Fraction, Field(ge=0, le=1)]
    least: Annotated[Fraction, Field(ge=0, le=1)] | None = None
    most: Annotated[Fraction, Field(ge=0, le=1)] | None = None


class Matter(Document):
    """What all materials have: the evidence of their figures, and how far this surface is off them.

    `deviation` counts standard deviations of the evidence's `uncertainty`: what campaigns draw.
    """

    evidence: Evidence | None = None
    deviation: Annotated[float, Field(ge=-_MOST_DEVIATION, le=_MOST_DEVIATION)] | None = None


def factor(matter: Matter, nominal: float | None) -> float:
    """Return what a surface reflects over what its material's figures say.

    `nominal` is the figure at 940 nm. A deviation is as many standard deviations while it is small beside the
    way to the bound, and comes near the bound without reaching it: room · tanh(deviation · σ / room). Without
    bounds (`nominal` is None: coefficients of retroreflection) it is the exponential, and never 0.
    """
    if not matter.deviation or matter.evidence is None:
        return 1.0
    evidence = matter.evidence
    step = matter.deviation * evidence.uncertainty
    if nominal is None or nominal == 0.0:
        return math.exp(step)
    low = 0.0 if evidence.least is None else min(evidence.least / nominal, 1.0)
    high = (1.0 if evidence.most is None else max(evidence.most, nominal)) / nominal
    room = high - 1.0 if step > 0.0 else 1.0 - low
    return 1.0 + math.copysign(room * math.tanh(abs(step) / room), step) if room > 0.0 else 1.0
