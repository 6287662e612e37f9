"""Tracks whose images no camera tells apart: the sum of their light is measured, and both are read from it.

While two are in one place of the image neither has a brightness of its own that could be trusted: who of them
is lit is a matter of the sum. It is kept as long as they are together, and read (`messages.pair`) when
they have parted.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.messages.pair import decode_pair
from perception.messages.settings import DecoderSettings
from perception.photometry import (
    Expected,
    Sample,
    sample_at,
    sample_of_detection,
    signal_of,
)
from perception.types import Calibration, Detection, Message, RawFrame

UNLIKE = 0.05
"""Standard deviation of a source's flux over what its track predicts, relative, beside the track's own."""

APART = 1.5
SURE_PX = 2.0
"""Images are one up to this many widths apart; a place less certain than so many pixels says less of that."""

_PARTED_S = 1.5
_LONGEST_S, _KEPT_S = 18.0, 7.0
"""Tracks have parted for good; a signal so long is read, and its end is kept: a packet lasts 5.5 s."""

_SHORTEST_S = 2.2
_IDLE_S = 1.4
"""Longer than any packet is lit, with a bit to spare: what lies before and after is read by itself."""
_IDLE_SIGMAS = 5.0

Array = NDArray[np.float64]
Tracks = tuple[int, int]


@dataclass(frozen=True)
class SumSample:
    """Brightness of two sources in one place.

    Attributes
    ----------
    sample
        Of the sum, over what the first is when lit.
    ratio
        How bright the second is over the first, by where they are predicted.
    """

    sample: Sample
    ratio: float


def inseparable(expected: Mapping[int, Expected]) -> list[Tracks]:
    """Return the pairs of tracks, by number, whose images in a frame are one, as far as places are known."""
    if len(expected) < 2:
        return []
    numbers = list(expected)
    images = np.array([(one.u_px, one.v_px, one.width_px, one.sigma_px) for one in expected.values()])
    return [(numbers[k], numbers[n]) for k, n in _inseparable(images).tolist()]


@compiled
def _inseparable(images: Array) -> NDArray[np.int64]:
    """Return the pairs of images (u, v, width, uncertainty), shape (n, 4), that are one, shape (pairs, 2)."""
    n, count = len(images), 0
    pairs = np.empty((n * (n - 1) // 2, 2), dtype=np.int64)
    for k in range(n):
        for m in range(k + 1, n):
            apart_px = math.hypot(images[k, 0] - images[m, 0], images[k, 1] - images[m, 1])
            unsure_px = min(math.hypot(images[k, 3], images[m, 3]), SURE_PX)
            if apart_px < APART * math.hypot(max(images[k, 2], images[m, 2]), unsure_px):
                pairs[count] = k, m
                count += 1
    return pairs[:count]


def sample_of_sum(
    one: Expected,
    other: Expected,
    found: Sequence[Detection],
    others: Collection[int],
    frame: RawFrame,
    calibration: Calibration,
) -> SumSample | None:
    """Return how bright two inseparable sources are together; None where nothing can be said.

    All that was found within their images is theirs, but for `others`, which are other tracks', by their
    places in `found`; where nothing was, both may be dark: that is measured.
    """
    ratio = other.flux_dn / one.flux_dn
    share = ratio / (1.0 + ratio)
    between = Expected(
        u_px=one.u_px + share * (other.u_px - one.u_px),
        v_px=one.v_px + share * (other.v_px - one.v_px),
        sigma_px=max(one.sigma_px, other.sigma_px),
        range_m=one.range_m,
        flux_dn=one.flux_dn,
        width_px=one.width_px,
    )
    apart_px = math.hypot(one.u_px - other.u_px, one.v_px - other.v_px)
    reach_px = apart_px + 2.0 * APART * math.hypot(one.width_px, min(between.sigma_px, SURE_PX))
    theirs = [
        hit
        for number, hit in enumerate(found)
        if number not in others and math.hypot(hit.u_px - between.u_px, hit.v_px - between.v_px) < reach_px
    ]
    if not theirs:
        dark = sample_at(between, found, frame, calibration)
        return None if dark is None else SumSample(dark, ratio)
    samples = [sample_of_detection(hit, between, frame, calibration) for hit in theirs]
    if not all(math.isfinite(hit.flux_sigma_dn) for hit in theirs):
        return None  # clipped beyond recovery: how much there is of both is not said
    total = Sample(
        samples[0].time_s,
        samples[0].exposure_s,
        sum(sample.level for sample in samples),
        math.hypot(*(sample.sigma_dark for sample in samples)),
        math.hypot(*(sample.sigma_lit for sample in samples)),
    )
    return SumSample(total, ratio)


class PairReader:
    """Reads pairs of tracks while no camera tells them apart."""

    def __init__(self, settings: DecoderSettings | None = None) -> None:
        self._settings = settings
        self._pairs: dict[Tracks, list[SumSample]] = {}
        self._waiting: list[tuple[Tracks, list[SumSample]]] = []
        self._said: list[Message] = []

    def push(
        self, robot: str, time_s: float, sums: Mapping[Tracks, SumSample], said: Iterable[Message]
    ) -> tuple[Message, ...]:
        """Take the samples of a set, and what single tracks said; return what pairs say.

        A stretch of a pair is read once it has parted, once both have been idle for longer than any packet
        is, or when it has been together for long: one stretch a set, for it takes as long as some sets. Where
        four and more are one light, none of their pairs is read. What one of its tracks was heard to say by
        itself is not said again.
        """
        self._said = [message for message in self._said if time_s - message.end_s < 2.0 * _LONGEST_S]
        self._said += said
        members = Counter(track for tracks in sums for track in tracks)
        for tracks, sample in sums.items():
            if max(members[track] for track in tracks) > 2:
                continue
            together = self._pairs.setdefault(tracks, [])
            if not together or sample.sample.time_s > together[-1].sample.time_s:
                together.append(sample)
        for tracks in list(self._pairs):
            together = self._pairs[tracks]
            if time_s - together[-1].sample.time_s > _PARTED_S:
                self._waiting.append((tracks, self._pairs.pop(tracks)))
            elif (idle := _idle_since(together)) is not None:
                self._waiting.append((tracks, together))
                self._pairs[tracks] = together[idle:]
            elif _span_s(together) > _LONGEST_S:
                self._waiting.append((tracks, together))
                self._pairs[tracks] = [one for one in together if time_s - one.sample.time_s < _KEPT_S]
        while self._waiting:
            tracks, together = self._waiting.pop(0)
            if _is_worth_reading(together):
                return tuple(self._read(robot, tracks, together))
        return ()

    def finish(self, robot: str, said: Iterable[Message]) -> tuple[Message, ...]:
        """Return what the pairs say that are still together, and single tracks did not say at last."""
        self._said += said
        waiting = [*self._waiting, *self._pairs.items()]
        heard = [
            message
            for tracks, together in waiting
            if _is_worth_reading(together)
            for message in self._read(robot, tracks, together)
        ]
        self._waiting.clear()
        self._pairs.clear()
        self._said.clear()
        return tuple(heard)

    def _read(self, robot: str, tracks: Tracks, together: Sequence[SumSample]) -> list[Message]:
        ratio = np.array([one.ratio for one in together])
        signal = signal_of(robot, tracks[0], [one.sample for one in together])
        levels, sigmas = np.stack([np.ones(len(ratio)), ratio]), (UNLIKE, UNLIKE * float(ratio.mean()))
        new: list[Message] = []
        known = [one for one in self._said if {one.track, one.ambiguous_with} & set(tracks)]
        for message in decode_pair(signal, levels, sigmas, tracks, self._settings):
            same = next((one for one in known if _same(message, one)), None)
            if same is None:
                new.append(message)
            else:
                known.remove(same)
        self._said += new
        return new


def _span_s(together: Sequence[SumSample]) -> float:
    return together[-1].sample.time_s - together[0].sample.time_s


def _is_idle(one: SumSample) -> bool:
    """Tell whether both were lit in a sample, as far as it says."""
    both = 1.0 + one.ratio
    return one.sample.level > both - _IDLE_SIGMAS * math.hypot(one.sample.sigma_lit, UNLIKE * both)


def _is_worth_reading(together: Sequence[SumSample]) -> bool:
    return _span_s(together) >= _SHORTEST_S and not all(map(_is_idle, together))


def _idle_since(together: Sequence[SumSample]) -> int | None:
    """Return from which sample on both are idle, after some dark, where that is longer than in any packet."""
    first = len(together)
    while first > 0 and _is_idle(together[first - 1]):
        first -= 1
    if first == 0 or together[-1].sample.time_s - together[first - 1].sample.time_s < _IDLE_S:
        return None
    return first


def _same(one: Message, other: Message) -> bool:
    """Say whether two messages of a pair's tracks are one that was heard twice, or of other frames."""
    may_be = one.track == other.track or None not in (one.ambiguous_with, other.ambiguous_with)
    may_be = may_be or other.track == one.ambiguous_with or one.track == other.ambiguous_with
    return may_be and one.word == other.word and one.start_s < other.end_s and other.start_s < one.end_s
