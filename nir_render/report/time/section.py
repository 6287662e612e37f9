"""The section "Over time" of a run's page: sentence, numbers and plots."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nir_render.evaluate.metrics import Evaluation
from nir_render.evaluate.tracks import FEW_SETS
from nir_render.report.drawing import Drawing
from nir_render.report.parts import Table
from nir_render.report.time.blinks import blink_plot
from nir_render.report.time.lanes import lanes_of
from nir_render.report.time.plots import above_plot, error_plot, life_plot
from nir_render.report.wording import counted, degrees, metres, share
from perception.types import Message, Signal

_MOST_OBSERVERS = 3


@dataclass(frozen=True, eq=False)
class Said:
    """What estimators said over time, by name: how bright each track was, and what it sent."""

    signals: Mapping[str, Sequence[Signal]] = field(default_factory=dict)
    messages: Mapping[str, Sequence[Message]] = field(default_factory=dict)


@dataclass(frozen=True)
class View:
    """What one observer saw: plots, `errors` and `blinks` by estimator."""

    observer: str
    above: Drawing | None
    lives: Drawing | None
    errors: Mapping[str, Drawing]
    blinks: Mapping[str, Drawing]


@dataclass(frozen=True)
class OverTime:
    """The section of a page; `messages` is None where nobody sent anything."""

    sentence: str
    tracks: Table
    messages: Table | None
    views: tuple[View, ...]


def time_section(result: Evaluation, said: Said) -> OverTime | None:
    """Return the section about a run's tracks; None where there are none, or have hardly begun."""
    over_time = result.over_time
    if over_time is None or len(over_time.moments) < FEW_SETS:
        return None
    moments, names = over_time.moments, list(over_time.summary)
    sights: Counter[str] = Counter()
    for moment in moments:
        sights[moment.robot] += sum(one.life is not None for one in moment.present)
    shown = [robot for robot, _ in sights.most_common(_MOST_OBSERVERS)]
    times_s = [moment.time_s for moment in moments]
    sentence = (
        f"{counted(len(moments), 'set')} of frames in {max(times_s) - min(times_s):.1f} s. A source that is "
        "dark or hidden for up to a second is to keep its track."
    )
    if len(sights) > len(shown):
        sentence += f" Plots show the {len(shown)} of {len(sights)} observers that saw most."
    rows = _by_row(result.summary["estimators"], names)
    sent = any("message_sent" in numbers for _, numbers in rows)
    return OverTime(
        sentence,
        _track_table(rows),
        _message_table(rows) if sent else None,
        tuple(_view(robot, result, said, names) for robot in shown),
    )


def _view(observer: str, result: Evaluation, said: Said, names: Sequence[str]) -> View:
    moments = () if result.over_time is None else result.over_time.moments
    lanes = {name: lanes_of(moments, observer, name) for name in names}
    there = any(lanes.values())
    heard = result.heard
    blinks = {
        name: blink_plot(
            [signal for signal in said.signals.get(name, ()) if signal.robot == observer],
            [message for message in said.messages.get(name, ()) if message.robot == observer],
            lanes[name],
            () if heard is None else heard.sent,
            None if heard is None else heard.wrong.get(name, ()),
            name,
        )
        for name in names
    }
    return View(
        observer,
        above_plot(lanes, observer) if there else None,
        life_plot(lanes) if there else None,
        {name: error_plot(own, name) for name, own in lanes.items() if own},
        {name: drawing for name, drawing in blinks.items() if drawing is not None},
    )


_Rows = Sequence[tuple[str, Mapping[str, Any]]]


def _by_row(estimators: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> _Rows:
    """Return what a row is called, and its numbers: each estimator, beneath it each of several observers."""
    rows: list[tuple[str, Mapping[str, Any]]] = []
    for name in names:
        rows.append((name, estimators[name]))
        rows += [(f"{name}, {robot}", own) for robot, own in estimators[name].get("observers", {}).items()]
    return rows


def _track_table(rows: _Rows) -> Table:
    headings = [
        "estimator", "HOTA", "IDF1", "MOTA", "switches", "false tracks per set", "place RMSE", "range RMSE",
        "range bias", "bearing RMS", "velocity RMSE", "NEES of place", "of velocity", "of both (1 is honest)",
    ]  # fmt: skip
    return Table(headings, [
        [
            name, *(_plain(numbers[key], 3) for key in ("track_hota", "track_idf1", "track_mota")),
            str(numbers["track_switches"]), _plain(numbers["track_false_alarms_per_set"], 3),
            metres(numbers["track_position_rmse_m"]), metres(numbers["track_range_rmse_m"]),
            metres(numbers["track_range_bias_m"]), degrees(numbers["track_bearing_rms_deg"]),
            _with_unit(numbers["track_velocity_rmse_m_per_s"], 3, "m/s"),
            *(_plain(numbers[key], 2) for key in ("track_nees", "track_velocity_nees", "track_state_nees")),
        ]
        for name, numbers in rows
    ])  # fmt: skip


def _message_table(rows: _Rows) -> Table:
    headings = [
        "estimator", "packets received", "wrong", "of them another's", "said again", "ambiguous",
        "of mirror images", "latency, median", "largest", "bit errors", "of bits",
    ]  # fmt: skip
    counts = ("wrong", "misattributed", "repeated", "ambiguous", "of_ghosts")
    return Table(headings, [
        [
            name, f"{numbers['message_received']} of {numbers['message_sent']}",
            *(str(numbers[f"message_{key}"]) for key in counts),
            *(_with_unit(numbers[f"message_latency_{key}_s"], 2, "s") for key in ("median", "max")),
            share(numbers["message_bit_error_rate"], more=1), str(numbers["message_bits"]),
        ]
        for name, numbers in rows
        if "message_sent" in numbers
    ])  # fmt: skip


def _plain(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}".replace("-", "−")


def _with_unit(value: float | None, digits: int, unit: str) -> str:
    return "–" if value is None else f"{_plain(value, digits)} {unit}"
