"""What a robot could see of the others, by truth, and what it did: in a frame set, and of packets."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nir_render.evaluate.match import (
    GATE_PX,
    MIN_PEAK_SNR,
    MIN_VISIBLE_FRACTION,
    image_radius_px,
    match,
    on_a_lamp,
)
from nir_render.evaluate.messages import is_of
from nir_render.evaluate.metrics import source_limits
from nir_render.truth.lamps import Outline
from nir_render.truth.sent import SentTruth
from nir_render.truth.sources import SourceTruth
from perception import Calibration, Detection, Message

WHYS = ("free", "eclipsed", "merged", "faint", "dark", "hidden", "cut")
"""How a robot can be seen, the best first: of its cameras the best one counts."""

MERGED_PX, NEAR_PX = 2.0, 4.0
_BESIDE = 0.1  # a neighbour with less of one's light hardly shifts it
_EDGE_PX = 3.0
_WHOLE = 0.99
_HALO_SIGMAS = 20.0  # more than flares are told apart by


@dataclass(frozen=True)
class Sight:
    """One robot in one set of frames.

    Attributes
    ----------
    why
        How it could be seen, one of `WHYS`.
    near
        Whether another source shines within 4 px of it, in the camera that shows it best.
    range_m, limit_m
        The true distance from that camera, and the Cramér–Rao bound of it, overlapping flares told apart;
        NaN where it is not found.
    found
        Whether a detection is its.
    said_m, sigma_m
        What it says of the range; NaN where it says none.
    lit_through
        Whether the source shines all through the exposure: else its flux is of a part.
    """

    robot: str
    why: str
    near: bool
    range_m: float
    limit_m: float
    found: bool
    said_m: float
    sigma_m: float
    lit_through: bool

    def record(self) -> list[Any]:
        """Return it as plain data."""
        floats = [
            round(value, 5) if math.isfinite(value) else None
            for value in (self.range_m, self.limit_m, self.said_m, self.sigma_m)
        ]
        return [self.robot, self.why, self.near, self.found, *floats, self.lit_through]


@dataclass(frozen=True)
class InSet:
    """A set of frames held against truth.

    Attributes
    ----------
    sights
        Each of the other robots.
    false_alarms
        How many detections are of no robot, lamp or mirror image.
    parts
        How many are further ones of a robot of which a body hides a part, and which has one already: what is
        left of it is taken for several.
    """

    sights: tuple[Sight, ...]
    false_alarms: int
    parts: int


def whys(rows: Sequence[SourceTruth], known: Calibration) -> list[tuple[str, bool]]:
    """Return how each source of a frame can be seen, and whether another shines within 4 px of it.

    `cut`: its centre is within 3 px of the frame's edge, or beyond. `hidden`: less than half of it is seen.
    `dark`: it is, in this frame. `faint`: its peak SNR is below 5. `merged`: another that brings a tenth of
    its light or more is within 2 px. `eclipsed`: between half of it and 99 % is seen. `free`: none of these.
    """
    places_px = np.array([(row.u_px, row.v_px) for row in rows]).reshape(-1, 2)
    light_e = np.array([row.direct_e for row in rows])
    last_px = np.array([known.width_px, known.height_px]) - 1.0 - _EDGE_PX
    found = []
    for number, row in enumerate(rows):
        apart_px = np.hypot(*(places_px - places_px[number]).T)
        apart_px[number] = math.inf
        beside = light_e >= max(_BESIDE * row.direct_e, 1.0)
        nearest_px = float(apart_px[beside].min(initial=math.inf))
        if (places_px[number] < _EDGE_PX).any() or (places_px[number] > last_px).any():
            why = "cut"
        elif row.visible_fraction < MIN_VISIBLE_FRACTION:
            why = "hidden"
        elif row.on_fraction <= 0.0:
            why = "dark"
        elif row.peak_snr < MIN_PEAK_SNR:
            why = "faint"
        elif nearest_px < MERGED_PX:
            why = "merged"
        else:
            why = "eclipsed" if row.visible_fraction < _WHOLE else "free"
        found.append((why, nearest_px < NEAR_PX))
    return found


def unlike(rows: Sequence[SourceTruth], known: Calibration) -> list[str]:
    """Return the robots whose flare is not their whole light alone: partly hidden, or one within 4 px."""
    return [
        row.robot
        for row, (_, near) in zip(rows, whys(rows, known), strict=True)
        if row.direct_e > 0.0 and (near or row.visible_fraction < _WHOLE)
    ]


def sights(
    robots: Iterable[str],
    rows_of: Mapping[str, Sequence[SourceTruth]],
    found: Mapping[str, Sequence[Detection]],
    lamps_px: Mapping[str, Sequence[Outline]],
    known: Mapping[str, Calibration],
) -> InSet:
    """Return each robot as a set of frames shows it, and what the detections are that are of none of them.

    Who sends no light to a camera, dark or hidden whole, is not found by it, whatever is found there.

    Parameters
    ----------
    robots
        The others, all of them: whom no camera has is `cut`.
    rows_of, found, lamps_px, known
        By camera: truth, detections, lamps, what is known of it.
    """
    best: dict[str, Sight] = {}
    alarms = parts = 0
    for camera, rows in rows_of.items():
        real = [row for row in rows if row.ghost_of is None]
        shining = [number for number, row in enumerate(real) if row.direct_e > 0.0]
        pairs = match([real[number] for number in shining], found[camera], known[camera])
        hits = {shining[number]: found[camera][hit] for number, hit in pairs.pairs}
        others = [found[camera][number] for number in pairs.unmatched]
        # What calls itself a ghost is none where there is no mirror image.
        images = [row for row in rows if row.ghost_of is not None and row.direct_e > 0.0]
        for other in (others[number] for number in match(images, others, known[camera]).unmatched):
            if on_a_lamp(other, lamps_px[camera]):
                continue
            is_part = any(_is_part(other, real[number], known[camera]) for number in shining)
            parts += is_part
            alarms += not is_part
        reach = _Reach(real, known[camera])
        for number, (row, (why, near)) in enumerate(zip(real, whys(real, known[camera]), strict=True)):
            hit = hits.get(number)
            limit_m = math.nan
            if hit is not None and why in ("free", "merged") and row.on_fraction >= 1.0:
                limit_m, _ = source_limits(row, known[camera], reach.of(number))
            one = Sight(
                row.robot, why, near, row.range_m, limit_m, hit is not None,
                math.nan if hit is None else hit.range_m, math.nan if hit is None else hit.range_sigma_m,
                row.on_fraction >= 1.0,
            )  # fmt: skip
            best[row.robot] = _better(best.get(row.robot), one)
    return InSet(tuple(best.get(robot, _unseen(robot)) for robot in robots), alarms, parts)


class _Reach:
    """Which sources of a frame may overlap which: for each a few, where there are hundreds."""

    def __init__(self, rows: Sequence[SourceTruth], known: Calibration) -> None:
        self._rows = rows
        self._places_px = np.array([(row.u_px, row.v_px) for row in rows]).reshape(-1, 2)
        self._radii_px = np.array([image_radius_px(row, known) for row in rows])
        self._halo_px = _HALO_SIGMAS * known.psf_sigma_px

    def of(self, number: int) -> list[SourceTruth]:
        """Return the sources whose images may reach that of one, itself among them."""
        apart_px = np.hypot(*(self._places_px - self._places_px[number]).T)
        near = apart_px < self._radii_px + self._radii_px[number] + self._halo_px
        return [self._rows[row] for row in np.flatnonzero(near).tolist()]


def _is_part(hit: Detection, row: SourceTruth, known: Calibration) -> bool:
    """Tell whether a detection lies on a source of which something hides more than a hundredth."""
    gate_px = max(GATE_PX, image_radius_px(row, known))
    apart_px = math.hypot(hit.u_px - row.u_px, hit.v_px - row.v_px)
    return row.visible_fraction < _WHOLE and apart_px <= gate_px


def _better(known: Sight | None, other: Sight) -> Sight:
    """Return what is said of a robot that two cameras show: by the one that shows it better."""
    if known is None:
        return other
    first, second = sorted((known, other), key=lambda one: (WHYS.index(one.why), not one.found, one.limit_m))
    return replace(first, found=first.found or second.found)


def _unseen(robot: str) -> Sight:
    return Sight(robot, "cut", False, math.nan, math.nan, False, math.nan, math.nan, lit_through=False)


@dataclass(frozen=True)
class Word:
    """A word that was told, and of whom it is by truth: whom its track followed meanwhile.

    Two where the message says that another track may have said it instead; none where they followed nobody.
    """

    robots: tuple[str, ...]
    message: Message


@dataclass(frozen=True)
class Packets:
    """What became of packets that were sent.

    Attributes
    ----------
    received
        For each packet whether it was told, of all five frames or of some, with the sender's track.
    misattributed
        How many words were told that another one sent just then: the wrong one is said to speak.
    wrong
        How many words nobody sent just then.
    """

    received: tuple[bool, ...]
    misattributed: int
    wrong: int


def judged_packets(sent: Sequence[SentTruth], told: Sequence[Word]) -> Packets:
    """Hold words against packets (`evaluate.messages.is_of`)."""
    received = [False] * len(sent)
    misattributed = wrong = 0
    for word in told:
        same = [number for number, packet in enumerate(sent) if is_of(word.message, packet)]
        own = [number for number in same if sent[number].robot in word.robots]
        if own:
            # Two may say one word at once, each perhaps the other: that is one packet of each.
            received[next((number for number in own if not received[number]), own[0])] = True
        elif same:
            misattributed += 1
        else:
            wrong += 1
    return Packets(tuple(received), misattributed, wrong)
