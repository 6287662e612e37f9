"""What a stack heard, against what was sent: packets received, wrong and false, and bits.

A packet counts for an observer that could see its source all the while: countable or dark in all sets but a
few. A message belongs to the source that its track followed while it was sent.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.tracks import Moment, SourceName
from nir_render.truth.sent import SentTruth
from perception.messages.uart import encode
from perception.types import Message, Signal

SEEN = 0.95
"""The share of the sets during a packet in which its source must have been in view."""

_SAME_START_S = 0.5


@dataclass(frozen=True)
class Reception:
    """One packet and what became of it: the messages of the estimators that received it, by name."""

    observer: str
    sent: SentTruth
    heard: Mapping[str, Message]


@dataclass(frozen=True)
class MessageEvaluation:
    """What became of each packet, the messages that nobody sent, and the numbers of `summary.json`."""

    receptions: tuple[Reception, ...]
    wrong: Mapping[str, tuple[Message, ...]]
    summary: Mapping[str, Mapping[str, Any]]


def evaluate_messages(
    moments: Sequence[Moment],
    sent: Sequence[SentTruth],
    messages: Mapping[str, Sequence[Message]],
    signals: Mapping[str, Sequence[Signal]],
) -> MessageEvaluation:
    """Score the messages of each estimator.

    Parameters
    ----------
    moments
        Who followed whom when (`evaluate_tracks`).
    sent
        All packets.
    messages, signals
        By estimator.
    """
    observers = list(dict.fromkeys(moment.robot for moment in moments))
    in_view = [
        (observer, packet)
        for observer in observers
        for packet in sent
        if packet.robot != observer and _seen(moments, observer, packet)
    ]
    heard: list[dict[str, Message]] = [{} for _ in in_view]
    wrong: dict[str, tuple[Message, ...]] = {}
    for name, said in messages.items():
        followed = _followed(moments, name)
        left = []
        for message in said:
            source = _source_of(message, followed)
            meant = [
                k
                for k, (observer, packet) in enumerate(in_view)
                if observer == message.robot
                and (packet.robot, packet.source) == (source or (None, None))[:2]
                and abs(packet.start_s - message.start_s) < _SAME_START_S
                and packet.word == message.word
            ]
            if meant:
                heard[meant[0]].setdefault(name, message)
            elif not _partly_seen(message, source, sent):
                left.append(message)
        wrong[name] = tuple(left)
    receptions = tuple(
        Reception(observer, packet, found) for (observer, packet), found in zip(in_view, heard, strict=True)
    )
    summary = {
        name: _numbers(name, receptions, wrong[name], moments, signals.get(name, ())) for name in messages
    }
    return MessageEvaluation(receptions, wrong, summary)


def _seen(moments: Sequence[Moment], observer: str, packet: SentTruth) -> bool:
    """Tell whether an observer could see a packet from beginning to end."""
    during = [
        moment
        for moment in moments
        if moment.robot == observer and packet.start_s <= moment.time_s <= packet.end_s
    ]
    if not during or moments[0].time_s > packet.start_s or moments[-1].time_s < packet.end_s:
        return False
    name = (packet.robot, packet.source, None)
    there = sum(any(one.name == name and one.life is not None for one in moment.present) for moment in during)
    return there >= SEEN * len(during)


def _followed(
    moments: Sequence[Moment], name: str
) -> dict[tuple[str, int], list[tuple[float, SourceName | None]]]:
    """Return whom each track followed when, by observer and number."""
    followed: dict[tuple[str, int], list[tuple[float, SourceName | None]]] = defaultdict(list)
    for moment in moments:
        for track, source in moment.tracks.get(name, ()):
            followed[moment.robot, track.track].append((moment.time_s, source))
    return followed


def _source_of(
    message: Message, followed: Mapping[tuple[str, int], Sequence[tuple[float, SourceName | None]]]
) -> SourceName | None:
    """Return whom the track of a message followed for most of the time."""
    during = [
        source
        for time_s, source in followed.get((message.robot, message.track), ())
        if source is not None and message.start_s <= time_s <= message.end_s
    ]
    return Counter(during).most_common(1)[0][0] if during else None


def _partly_seen(message: Message, source: SourceName | None, sent: Sequence[SentTruth]) -> bool:
    """Tell whether a message is right about a packet that does not count, as not all of it was in view."""
    return source is not None and any(
        (packet.robot, packet.source, packet.word) == (*source[:2], message.word)
        and abs(packet.start_s - message.start_s) < _SAME_START_S
        for packet in sent
    )


def _numbers(
    name: str,
    receptions: Sequence[Reception],
    wrong: Sequence[Message],
    moments: Sequence[Moment],
    signals: Sequence[Signal],
) -> dict[str, Any]:
    received = sum(name in reception.heard for reception in receptions)
    bits, errors = _bits(name, receptions, moments, signals)
    return {
        "message_sent": len(receptions),
        "message_received": received,
        "message_wrong": len(wrong),
        "message_bits": bits,
        "message_bit_error_rate": errors / bits if bits else None,
    }


def _bits(
    name: str, receptions: Sequence[Reception], moments: Sequence[Moment], signals: Sequence[Signal]
) -> tuple[int, int]:
    """Return how many bits of the packets were sampled, and how many are wrong if each is decided by itself.

    A bit is the mean of the track's levels within it, against half; start and rate are the true ones.
    """
    followed = _followed(moments, name)
    of_source: dict[tuple[str, SourceName], list[Signal]] = defaultdict(list)
    for signal in signals:
        names = [who for _, who in followed.get((signal.robot, signal.track), ()) if who is not None]
        if names:
            of_source[signal.robot, Counter(names).most_common(1)[0][0]].append(signal)
    bits = errors = 0
    for reception in receptions:
        packet = reception.sent
        sent = encode(packet.word)
        for signal in of_source[reception.observer, (packet.robot, packet.source, None)]:
            decided, known = _decided(signal, packet, len(sent))
            bits += int(known.sum())
            errors += int((decided[known] != sent[known]).sum())
    return bits, errors


def _decided(signal: Signal, packet: SentTruth, count: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    bit_s = (packet.end_s - packet.start_s) / count
    place = (signal.time_s - packet.start_s) / bit_s
    half = 0.5 * signal.exposure_s / bit_s
    # Samples that an edge may fall into say nothing of a single bit.
    whole = np.floor(place - half) == np.floor(place + half)
    inside = (place >= 0.0) & (place < count) & np.isfinite(signal.sigma_lit) & whole
    number = np.floor(place[inside]).astype(np.int64)
    samples = np.bincount(number, minlength=count)
    level = np.bincount(number, weights=signal.level[inside], minlength=count)
    return level > 0.5 * samples, samples > 0
