"""The section "Over time" of a run's page: sentence, numbers and plots."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nir_render.evaluate.metrics import Evaluation
from nir_render.report.drawing import Drawing
from nir_render.report.parts import Table
from nir_render.report.time.blinks import blink_plot
from nir_render.report.time.lanes import lanes_of
from nir_render.report.time.plots import above_plot, error_plot, life_plot
from nir_render.report.wording import counted, degrees, metres, share
from perception.types import Message, Signal


@dataclass(frozen=True, eq=False)
class Said:
    """What estimators said over time, by name: how bright each track was, and what it sent."""

    signals: Mapping[str, Sequence[Signal]] = field(default_factory=dict)
    messages: Mapping[str, Sequence[Message]] = field(default_factory=dict)


@dataclass(frozen=True)
class OverTime:
    """The section of a page; `errors` and `blinks` by estimator."""

    sentence: str
    numbers: Table
    above: Drawing | None
    lives: Drawing | None
    errors: Mapping[str, Drawing]
    blinks: Mapping[str, Drawing]


def time_section(result: Evaluation, said: Said) -> OverTime | None:
    """Return the section about a run's tracks; None where there are none."""
    over_time = result.over_time
    if over_time is None or not over_time.moments:
        return None
    moments, names = over_time.moments, list(over_time.summary)
    sights: Counter[str] = Counter()
    for moment in moments:
        sights[moment.robot] += sum(one.life is not None for one in moment.present)
    observer = sights.most_common(1)[0][0]
    lanes = {name: lanes_of(moments, observer, name) for name in names}
    there = any(lanes.values())
    times_s = [moment.time_s for moment in moments]
    sentence = (
        f"{counted(len(moments), 'set')} of frames in {max(times_s) - min(times_s):.1f} s. A source that is "
        "dark or hidden for up to a second is to keep its track"
        + ("." if len(sights) == 1 else f"; the plots show what {observer} saw, of {len(sights)} observers.")
    )
    heard = result.heard
    receptions = [] if heard is None else [one for one in heard.receptions if one.observer == observer]
    blinks = {
        name: blink_plot(
            [signal for signal in said.signals.get(name, ()) if signal.robot == observer],
            [message for message in said.messages.get(name, ()) if message.robot == observer],
            lanes[name],
            receptions,
            name,
        )
        for name in names
    }
    return OverTime(
        sentence,
        _numbers({name: result.summary["estimators"][name] for name in names}),
        above_plot(lanes, observer) if there else None,
        life_plot(lanes) if there else None,
        {name: error_plot(own, name) for name, own in lanes.items() if own},
        {name: drawing for name, drawing in blinks.items() if drawing is not None},
    )


def _numbers(summary: Mapping[str, Mapping[str, Any]]) -> Table:
    headings = [
        "estimator", "HOTA", "IDF1", "MOTA", "switches", "false tracks per set", "place RMSE", "range RMSE",
        "bearing RMS", "NEES (1 is honest)", "packets received", "wrong", "bit errors",
    ]  # fmt: skip
    rows = []
    for name, numbers in summary.items():
        sent = numbers.get("message_sent")
        rows.append([
            name, *(_plain(numbers[key], 3) for key in ("track_hota", "track_idf1", "track_mota")),
            str(numbers["track_switches"]), _plain(numbers["track_false_alarms_per_set"], 3),
            metres(numbers["track_position_rmse_m"]), metres(numbers["track_range_rmse_m"]),
            degrees(numbers["track_bearing_rms_deg"]), _plain(numbers["track_nees"], 2),
            "–" if sent is None else f"{numbers['message_received']} of {sent}",
            str(numbers.get("message_wrong", "–")),
            share(numbers.get("message_bit_error_rate"), more=1),
        ])  # fmt: skip
    return Table(headings, rows)


def _plain(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}".replace("-", "−")
