"""Which threats are put upon whom, and with which levers: campaign documents of one threat axis and its levers.

The first axis of a document is the threat, each other one a lever; the threat is crossed with one lever at a
time, the others as they are built. Axes named in `Study.repeated` are run through in every crossing and pooled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from nir_render.stress.campaign import Campaign, load_campaign
from nir_render.stress.design.axes import Axis

DOCUMENTS = Path(__file__).parents[2] / "data" / "experiments" / "limits"
THREATS = ("multipath", "sun", "fog", "crowding")


@dataclass(frozen=True)
class Study:
    """One threat to one ability.

    `name` is that of the document in `DOCUMENTS` and of the folder; `expected` a closed form beside which the
    figures are to be read; `repeated` are axes that are pooled in every crossing.
    """

    name: str
    threat: str
    ability: str
    expected: str
    repeated: tuple[str, ...] = ()

    @property
    def document(self) -> Path:
        """The campaign document."""
        return DOCUMENTS / f"{self.name}.yaml"


STUDIES = (
    Study("multipath", "multipath", "ranging", ""),
    Study("sun", "sun", "ranging", ""),
    Study("fog", "fog", "ranging", ""),
    Study("crowding", "crowding", "ranging", "", repeated=("places",)),
    Study("sun_words", "sun", "messages", ""),
    Study("fog_words", "fog", "messages", ""),
    Study("collisions", "crowding", "messages", ""),
)


def threat_of(campaign: Campaign) -> Axis:
    """Return the axis of the threat."""
    return campaign.axes[0]


def crossings_of(campaign: Campaign, repeated: Sequence[str] = ()) -> Mapping[str, Campaign]:
    """Return a campaign of the threat and each lever, by the lever's name: `NAME_LEVER`."""
    threat, *others = campaign.axes
    kept = tuple(axis for axis in others if axis.name in repeated)
    return {
        lever.name: replace(campaign, name=f"{campaign.name}_{lever.name}", axes=(threat, lever, *kept))
        for lever in others
        if lever not in kept
    }


def study_campaign(study: Study, seeds: int | None) -> Campaign:
    """Read a study's document; `seeds` in place of how many it asks for, counted from 1.

    Errors as `load_campaign`.
    """
    campaign = load_campaign(study.document)
    return campaign if seeds is None else replace(campaign, seeds=tuple(range(1, seeds + 1)))
