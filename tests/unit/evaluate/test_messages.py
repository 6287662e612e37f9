"""Messages against what was sent, each case made by hand."""

from collections.abc import Mapping

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.evaluate.messages import MessageEvaluation, Told, evaluate_messages, parse_told
from nir_render.evaluate.presence import Present, SourceName
from nir_render.evaluate.tracks import Moment
from nir_render.truth.sent import SentTruth
from perception import message_record
from perception.messages.uart import encode, meaning
from perception.types import Message, Signal, Track

TIMES_S = np.arange(0.0, 12.0, 0.1)
START_S, END_S = 1.0, 6.5
WORDS = {"r2": 1, "r3": 2, "r4": 3, "r5": 4}
TRACKS: Mapping[int, SourceName] = {
    1: ("r2", "top", None), 2: ("r3", "top", None), 3: ("r4", "top", None), 4: ("r5", "top", None),
    6: ("r2", "top", "r2.top"),
}  # fmt: skip


def _moments(robot: str = "r1", hidden: str | None = "r5") -> list[Moment]:
    """Return instants in which all are followed; one of them is hidden until 3 s."""
    moments = []
    for time_s in TIMES_S:
        present = tuple(
            Present(name, np.zeros(3), None if name[2] or (name[0] == hidden and time_s < 3.0) else 0, 1.0)
            for name in TRACKS.values()
        )
        tracks = tuple(
            (Track(robot, time_s, number, np.zeros(3), np.zeros(3), np.eye(6)), name)
            for number, name in TRACKS.items()
        )
        moments.append(Moment(robot, float(time_s), present, {"robust": tracks}))
    return moments


def _said(
    track: int, word: int, told_s: float | None = 7.0, ambiguous_with: int | None = None,
    start_s: float = 1.02, end_s: float = 6.52, frames: int = 5, robot: str = "r1",
) -> Told:  # fmt: skip
    message = Message(robot, track, start_s, end_s, word, meaning(word), 1.0, frames, None, ambiguous_with)
    return Told(message, told_s)


def _sent() -> list[SentTruth]:
    return [SentTruth(robot, "top", START_S, END_S, word, meaning(word)) for robot, word in WORDS.items()]


def _scored(*said: Told, signals: tuple[Signal, ...] = ()) -> MessageEvaluation:
    return evaluate_messages(_moments(), _sent(), {"robust": said}, {"robust": signals})


def test_what_becomes_of_packets_and_messages() -> None:
    """Three packets are in view: one received twice, one by an ambiguous message, late; one misread.

    Said besides: the packet that was hidden at first; a mirror image's; another robot's word; a second late.
    """
    result = _scored(
        _said(1, 1, told_s=6.9),
        _said(1, 1, told_s=7.5),
        _said(2, 7),
        _said(2, 3, told_s=9.5, ambiguous_with=3),
        _said(4, 4),
        _said(6, 1),
        _said(2, 1),
        _said(3, 3, start_s=2.0, end_s=7.5),
    )
    numbers = result.summary["robust"]
    assert [(one.sent.robot, list(one.heard)) for one in result.receptions] == [
        ("r2", ["robust"]), ("r3", []), ("r4", ["robust"]),
    ]  # fmt: skip
    assert (numbers["message_sent"], numbers["message_received"], numbers["message_missed"]) == (3, 2, 1)
    assert numbers["message_repeated"] == numbers["message_ambiguous"] == numbers["message_of_ghosts"] == 1
    assert [message.word for message in result.wrong["robust"]] == [7, 1, 3]
    assert (numbers["message_wrong"], numbers["message_misattributed"]) == (3, 1)
    assert numbers["message_latency_median_s"] == pytest.approx((0.4 + 3.0) / 2)
    assert numbers["message_latency_max_s"] == pytest.approx(3.0)


def test_a_word_of_one_too_faint_to_count_is_neither_received_nor_wrong() -> None:
    """Track 9 follows nobody: a word of the hidden r5 may well be its; one of r2, which all see, is not."""
    numbers = _scored(_said(9, 4)).summary["robust"]
    assert (numbers["message_received"], numbers["message_wrong"]) == (0, 0)
    numbers = _scored(_said(9, 1), _said(9, 7)).summary["robust"]
    assert (numbers["message_received"], numbers["message_wrong"], numbers["message_misattributed"]) == (
        0,
        2,
        1,
    )


def test_some_frames_of_a_packet_are_enough() -> None:
    """The last two of its five frames, 1.1 s each; nobody wrote when it was said."""
    numbers = _scored(_said(1, 1, told_s=None, start_s=4.3, end_s=6.5, frames=2)).summary["robust"]
    assert (numbers["message_received"], numbers["message_wrong"]) == (1, 0)
    assert numbers["message_latency_median_s"] is None


def test_a_packet_that_begins_or_ends_outside_the_run_does_not_count() -> None:
    late = SentTruth("r2", "top", 8.0, 13.5, 1, meaning(1))
    result = evaluate_messages(_moments(), [late], {"robust": []}, {})
    assert result.summary["robust"]["message_sent"] == 0


def test_observers_are_told_apart() -> None:
    """Two see the same four packets, all of them; each hears another one, and one sends one itself."""
    moments = [each for pair in zip(_moments("r1", None), _moments("r5", None), strict=True) for each in pair]
    said = [_said(1, 1), _said(2, 2, robot="r5"), _said(2, 9, robot="r5")]
    result = evaluate_messages(moments, _sent(), {"robust": said}, {})
    both, own = result.summary["robust"], result.by_observer["robust"]
    assert (both["message_sent"], both["message_received"], both["message_wrong"]) == (7, 2, 1)
    assert [own[robot]["message_sent"] for robot in ("r1", "r5")] == [4, 3]
    assert [own[robot]["message_wrong"] for robot in ("r1", "r5")] == [0, 1]


def test_bits_are_decided_one_by_one() -> None:
    """One sample in the middle of each of 55 bits, one of them flipped, one unknown: 1 of 54 is wrong."""
    levels = encode(WORDS["r2"]).astype(np.float64)
    levels[10] = 1.0 - levels[10]
    sigma = np.full(55, 0.05)
    sigma[20] = np.inf
    middle_s = np.linspace(START_S + 0.05, END_S - 0.05, 55)
    signal = Signal("r1", 1, middle_s, np.full(55, 1e-3), levels, sigma, sigma)
    numbers = _scored(signals=(signal,)).summary["robust"]
    assert (numbers["message_bits"], numbers["message_bit_error_rate"]) == (54, pytest.approx(1 / 54))


def test_when_it_was_told_is_read_beside_the_message() -> None:
    told = _said(1, 1, told_s=6.9)
    assert parse_told({**message_record(told.message), "told_s": 6.9}) == told
    assert parse_told(message_record(told.message)).told_s is None
    with pytest.raises(InputError, match="told_s"):
        parse_told({**message_record(told.message), "told_s": "soon"})
