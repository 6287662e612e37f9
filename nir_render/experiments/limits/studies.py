"""Which threats are put upon whom, with which levers: campaign documents of a threat axis and its levers.

The first axis of a document is the threat, each other one a lever; the threat is crossed with one lever at a
time, the others as they are built.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from nir_render.errors import InputError
from nir_render.stress.campaign import Campaign, load_campaign
from nir_render.stress.design.axes import Axis
from nir_render.stress.design.points import Point, points_at

DOCUMENTS = Path(__file__).parents[2] / "data" / "experiments" / "limits"
THREATS = ("multipath", "sun", "fog", "crowding")


@dataclass(frozen=True)
class Study:
    """One threat to one ability.

    `name` is that of the document in `DOCUMENTS` and of the folder; `worst_is_high` tells whether the threat
    grows with the numbers of its axis; `expected` is what a closed form says, beside which figures are to be
    read; `repeated` are axes that are pooled in every crossing.
    """

    name: str
    threat: str
    ability: str
    worst_is_high: bool
    expected: str
    repeated: tuple[str, ...] = ()

    @property
    def document(self) -> Path:
        """The campaign document."""
        return DOCUMENTS / f"{self.name}.yaml"

    @property
    def title(self) -> str:
        """The study as a heading names it."""
        return f"{self.threat.capitalize()}: {self.ability}"


STUDIES = (
    Study(
        "multipath",
        "multipath",
        "ranging",
        worst_is_high=True,
        expected=(
            "a source at h before a matt wall of reflectance ρ throws 2ρ of its own signal back at who "
            "looks, 1 − h/√(h² + R²) of it from within R of its foot. What takes that light for the "
            "source's own, for R = 1.5 cm (2.4 px at 3 m), at h = 5 cm and ρ = 0.85, has 7 % more flux, a "
            "range 3.4 % short; robust fits it as a halo of the flare. It falls by h², and grows by the "
            "square of the range. Power and exposure scale both alike, and win nothing."
        ),
    ),
    Study(
        "sun",
        "sun",
        "ranging",
        worst_is_high=True,
        expected=(
            "flux falls by 1/d², the background does not: σ_F ∝ √(background) where it is all, and σ_d/d = "
            "σ_F/2F ∝ d²/power. A filter twice as wide lets in twice the sun and, up to the LED's own 42 "
            "nm, twice the LED: σ_F/F falls by √2, while the contrast stays; beyond 42 nm only sun is "
            "added, from outside the water band more than in proportion."
        ),
    ),
    Study(
        "fog",
        "fog",
        "ranging",
        worst_is_high=False,
        expected=(
            "who ranges by flux and knows of no fog is wrong by exp(σd/2): 5 % at V = 40 d (200 m at 5 m), "
            "whatever the power, exposure or filter. Who sees the disc of the source ranges by its size, "
            "which fog does not change; 10 mm are a pixel in radius at 4.8 m."
        ),
    ),
    Study(
        "crowding",
        "crowding",
        "ranging",
        worst_is_high=True,
        expected=(
            "all sources stand on one horizon, 1280 px for 106°: of N robots about the camera a third are in "
            "view, and another one is within δ px of a robot with 1 − exp(−2δ N/3/1280). Two within half a "
            "pixel are one flare, and one of them is lost: 5 % of all at N = 400. The side of the hall is "
            "not in it: at the same number nobody comes closer in the image. Heights that differ take the "
            "crowd off the line."
        ),
        repeated=("places",),
    ),
    Study(
        "sun_words",
        "sun",
        "messages",
        worst_is_high=True,
        expected=(
            "a word decoded whole, all five repeats at once, needs 1.4 σ a sample; to be followed, and to "
            "count as in view, a robot must stand out by 5 σ in single frames: what ends words is that "
            "nobody is seen, at 40 m in full sun, and frames more often do not help that."
        ),
    ),
    Study(
        "fog_words",
        "fog",
        "messages",
        worst_is_high=False,
        expected=(
            "light falls by exp(−σd)/d²: four times the power is worth ln 4 = 1.39 of σd. A word is received "
            "where the track that says it is where its sender is: a range that fog has spoilt loses words of "
            "which every bit was read."
        ),
    ),
    Study(
        "collisions",
        "crowding",
        "messages",
        worst_is_high=False,
        expected=(
            "1.1 cm at 5.5 m are a pixel. Within about two, flares are one, of levels none, one, the other, "
            "both; beyond, each has a track of its own. Below 1 cm the shade of the nearer hides the other, "
            "whose words are then out of view and count for nothing."
        ),
    ),
)


def levers_of(campaign: Campaign, repeated: Sequence[str] = ()) -> list[int]:
    """Return which axes are levers: all but the threat and those repeated."""
    return [index for index, axis in enumerate(campaign.axes) if index and axis.name not in repeated]


def as_built(campaign: Campaign, lever: Axis) -> int:
    """Return which of a lever's values the document's own scene has.

    Raises
    ------
    InputError
        It has none of them.
    """
    for index in range(len(lever.labels)):
        if campaign.scene.with_(lever.settings(index)).document == campaign.scene.document:
            return index
    raise InputError(f"{campaign.path}: axes.{lever.name}: the scene's own value is missing; write it too")


def points_of_study(campaign: Campaign, repeated: Sequence[str] = ()) -> list[Point]:
    """Return the points of a study: threat × one lever at a time × all that is repeated, each point once."""
    axes, levers = campaign.axes, levers_of(campaign, repeated)
    built = {index: as_built(campaign, axes[index]) for index in levers}
    found: set[tuple[int, ...]] = set()
    for lever in levers:
        ranges = [
            (built[index],) if index in built and index != lever else range(len(axis.labels))
            for index, axis in enumerate(axes)
        ]
        found.update(itertools.product(*ranges))
    return list(points_at(axes, sorted(found)))


def study_campaign(study: Study, seeds: int | None) -> Campaign:
    """Read a study's document; `seeds` in place of how many it asks for, counted from 1.

    Errors as `load_campaign`.
    """
    campaign = load_campaign(study.document)
    return campaign if seeds is None else replace(campaign, seeds=tuple(range(1, seeds + 1)))
