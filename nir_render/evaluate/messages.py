"""What a stack heard, against what was sent: packets received, missed and wrong, how late, and bits.

A packet counts for an observer that could see its source all the while: countable or dark in all sets but a
few. A message belongs to the source that its track followed while it was sent, or, where it says that another
track may have said it instead, to that one's.
"""

from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError, shown
from nir_render.evaluate.presence import SourceName
from nir_render.evaluate.tracks import Moment
from nir_render.truth.sent import SentTruth
from perception import parse_message
from perception.messages.uart import FRAME_BITS, REPEATS, encode
from perception.types import Message, Signal

SEEN = 0.95
"""The share of the sets during a packet in which its source must have been in view."""

_SLACK = 0.5 / REPEATS
"""So much of a packet, half a frame, may a message begin before it, or end after it."""


@dataclass(frozen=True)
class Told:
    """A message, and the time of the set of frames with which it was said; None where nobody wrote that."""

    message: Message
    told_s: float | None = None


def parse_told(record: Mapping[str, Any]) -> Told:
    """Return what a line of `messages.NAME.jsonl` says, and its `told_s`, if it has one.

    Raises
    ------
    RecordingError, InputError
        A field is missing, of the wrong type or out of bounds.
    """
    told_s = record.get("told_s") if isinstance(record, Mapping) else None
    if told_s is not None and (not isinstance(told_s, int | float) or isinstance(told_s, bool)):
        raise InputError(f"told_s is {shown(told_s)}; wanted a number or null")
    return Told(parse_message(record), told_s)


@dataclass(frozen=True)
class Reception:
    """One packet and what became of it: the messages of the estimators that received it, by name."""

    observer: str
    sent: SentTruth
    heard: Mapping[str, Message]


@dataclass(frozen=True)
class MessageEvaluation:
    """What became of each packet, the messages that nobody sent, and the numbers of `summary.json`.

    `sent` are all packets, also those that were not in view; `by_observer` has the numbers for each observer
    by itself, by estimator.
    """

    sent: tuple[SentTruth, ...]
    receptions: tuple[Reception, ...]
    wrong: Mapping[str, tuple[Message, ...]]
    summary: Mapping[str, Mapping[str, Any]]
    by_observer: Mapping[str, Mapping[str, Mapping[str, Any]]]


@dataclass
class _Judged:
    """What one estimator's messages to one observer are: the packets, by number, and what is left."""

    heard: dict[int, Told] = field(default_factory=dict)
    repeated: int = 0
    ambiguous: int = 0
    of_ghosts: int = 0
    misattributed: int = 0
    wrong: list[Message] = field(default_factory=list)
    bits: int = 0
    bit_errors: int = 0


def evaluate_messages(
    moments: Sequence[Moment],
    sent: Sequence[SentTruth],
    messages: Mapping[str, Sequence[Told]],
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
    in_order = sorted(moments, key=lambda moment: moment.time_s)
    own = {robot: [moment for moment in in_order if moment.robot == robot] for robot in observers}
    in_view = [
        (robot, packet)
        for robot in observers
        for packet in _seen_by(own[robot], [packet for packet in sent if packet.robot != robot])
    ]
    judged: dict[str, dict[str, _Judged]] = {}
    for name, said in messages.items():
        judged[name] = {}
        for robot in observers:
            ways = _Ways(own[robot], name)
            found = _judged(
                [told for told in said if told.message.robot == robot], robot, in_view, sent, ways
            )
            heard_of = [signal for signal in signals.get(name, ()) if signal.robot == robot]
            seen = [packet for observer, packet in in_view if observer == robot]
            found.bits, found.bit_errors = _bits(seen, heard_of, ways)
            judged[name][robot] = found
    packets = Counter(robot for robot, _ in in_view)
    return MessageEvaluation(
        tuple(sent),
        tuple(
            Reception(
                robot,
                packet,
                {
                    name: of_name[robot].heard[k].message
                    for name, of_name in judged.items()
                    if k in of_name[robot].heard
                },
            )
            for k, (robot, packet) in enumerate(in_view)
        ),
        {
            name: tuple(message for each in of_name.values() for message in each.wrong)
            for name, of_name in judged.items()
        },
        {name: _numbers(of_name.values(), in_view, len(in_view)) for name, of_name in judged.items()},
        {
            name: {robot: _numbers([each], in_view, packets[robot]) for robot, each in of_name.items()}
            for name, of_name in judged.items()
        },
    )


def _seen_by(moments: Sequence[Moment], sent: Iterable[SentTruth]) -> list[SentTruth]:
    """Return the packets that an observer could see from beginning to end."""
    times_s = [moment.time_s for moment in moments]
    there: dict[SourceName, list[int]] = defaultdict(list)
    for k, moment in enumerate(moments):
        for one in moment.present:
            if one.life is not None:
                there[one.name].append(k)
    seen = []
    for packet in sent:
        first, last = bisect_left(times_s, packet.start_s), bisect_right(times_s, packet.end_s)
        if first == last or times_s[0] > packet.start_s or times_s[-1] < packet.end_s:
            continue
        own = there[packet.robot, packet.source, None]
        if bisect_left(own, last) - bisect_left(own, first) >= SEEN * (last - first):
            seen.append(packet)
    return seen


class _Ways:
    """Whom the tracks of one estimator followed, as one observer saw it."""

    def __init__(self, moments: Sequence[Moment], name: str) -> None:
        self._times_s: dict[int, list[float]] = defaultdict(list)
        self._names: dict[int, list[SourceName | None]] = defaultdict(list)
        for moment in moments:
            for track, source in moment.tracks.get(name, ()):
                self._times_s[track.track].append(moment.time_s)
                self._names[track.track].append(source)

    def source_of(self, track: int, start_s: float, end_s: float) -> SourceName | None:
        """Return whom a track followed for most of a time in which it followed anybody."""
        times_s = self._times_s.get(track, [])
        during = self._names.get(track, [])[bisect_left(times_s, start_s) : bisect_right(times_s, end_s)]
        known = Counter(source for source in during if source is not None)
        return known.most_common(1)[0][0] if known else None


def _judged(
    said: Sequence[Told],
    robot: str,
    in_view: Sequence[tuple[str, SentTruth]],
    sent: Sequence[SentTruth],
    ways: _Ways,
) -> _Judged:
    """Tell of each message to an observer which packet it is of, or what is wrong with it."""
    found = _Judged()
    for told in said:
        message = told.message
        tracks = [message.track] + ([] if message.ambiguous_with is None else [message.ambiguous_with])
        found.ambiguous += len(tracks) > 1
        sources = {ways.source_of(track, message.start_s, message.end_s) for track in tracks} - {None}
        meant = [
            k
            for k, (observer, packet) in enumerate(in_view)
            if observer == robot and (packet.robot, packet.source, None) in sources and is_of(message, packet)
        ]
        if meant:
            # Two may say one word at once, each ambiguous with the other: that is one packet of each.
            new = [k for k in meant if k not in found.heard]
            found.repeated += not new
            if new:
                found.heard[new[0]] = told
            continue
        right = [packet for packet in sent if is_of(message, packet) and packet.robot != robot]
        if any((packet.robot, packet.source, None) in sources for packet in right):
            continue  # not all of it was in view: neither received nor wrong
        if not sources and any((robot, packet) not in in_view for packet in right):
            continue  # a track too far off to follow anybody has the word of one too faint to count
        if any(
            (packet.robot, packet.source) == source[:2] for packet in right for source in sources if source
        ):
            found.of_ghosts += 1
            continue
        found.misattributed += bool(right)
        found.wrong.append(message)
    return found


def is_of(message: Message, packet: SentTruth) -> bool:
    """Tell whether a message, of all five frames or of some, lies in a packet and has its word."""
    slack_s = _SLACK * (packet.end_s - packet.start_s)
    return (
        message.word == packet.word
        and message.start_s > packet.start_s - slack_s
        and message.end_s < packet.end_s + slack_s
    )


def _numbers(
    judged: Iterable[_Judged], in_view: Sequence[tuple[str, SentTruth]], packets: int
) -> dict[str, Any]:
    """Return the numbers of observers together, of so many packets that they could see."""
    each = list(judged)
    late_s = [
        told.told_s - in_view[k][1].end_s
        for one in each
        for k, told in one.heard.items()
        if told.told_s is not None
    ]
    received = sum(len(one.heard) for one in each)
    bits = sum(one.bits for one in each)
    return {
        "message_sent": packets,
        "message_received": received,
        "message_missed": packets - received,
        "message_wrong": sum(len(one.wrong) for one in each),
        "message_misattributed": sum(one.misattributed for one in each),
        "message_repeated": sum(one.repeated for one in each),
        "message_ambiguous": sum(one.ambiguous for one in each),
        "message_of_ghosts": sum(one.of_ghosts for one in each),
        "message_latency_median_s": float(np.median(late_s)) if late_s else None,
        "message_latency_max_s": max(late_s, default=None),
        "message_bits": bits,
        "message_bit_error_rate": sum(one.bit_errors for one in each) / bits if bits else None,
    }


def _bits(sent: Sequence[SentTruth], signals: Sequence[Signal], ways: _Ways) -> tuple[int, int]:
    """Return how many bits of packets were sampled, and how many are wrong if each is decided by itself.

    A bit is the mean of the levels within it, against half, of a track that followed its source during the
    packet; start and rate are the true ones.
    """
    bits = errors = 0
    for packet in sent:
        coded = encode(packet.word)
        source = (packet.robot, packet.source, None)
        for signal in signals:
            if ways.source_of(signal.track, packet.start_s, packet.end_s) == source:
                decided, known = decided_bits(signal, packet)
                bits += int(known.sum())
                errors += int((decided[known] != coded[known]).sum())
    return bits, errors


def decided_bits(signal: Signal, packet: SentTruth) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return a packet's bits, each the mean of the levels within it against half, and which are known."""
    count = FRAME_BITS * REPEATS
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
