"""The blink timeline: how bright each track was, which bits were sent, and what was read."""

from collections import Counter
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from nir_render.report.drawing import Drawing, sheet, svg_of
from nir_render.report.style import BAD, FAINT, GOOD, MATPLOTLIB, TRUTH
from nir_render.report.time.lanes import Lane
from nir_render.report.time.plots import COLOURS
from nir_render.truth.sent import SentTruth
from perception.messages.uart import Bits, encode
from perception.types import Message, Signal

_MOST_SHOWN = 16
_FEW = 8
_LOW, _HIGH = -0.3, 1.7


def blink_plot(
    signals: Sequence[Signal],
    messages: Sequence[Message],
    lanes: Sequence[Lane],
    sent: Sequence[SentTruth],
    wrong: Sequence[Message] | None,
    name: str,
) -> Drawing | None:
    """Draw one strip a track: its levels, the bits of its messages, and those that its source sent.

    Parameters
    ----------
    signals, messages
        Of one observer, by one estimator.
    lanes
        Whom that estimator's tracks followed.
    sent
        All packets, of whomever.
    wrong
        Which of the messages nobody sent; None where nobody knows what was sent.

    Returns
    -------
    None where no track has a signal.
    """
    spoke = Counter(message.track for message in messages)
    there = [signal for signal in signals if signal.time_s.size]
    there.sort(key=lambda signal: (-spoke[signal.track], -signal.time_s.size, signal.track))
    shown = sorted(there[:_MOST_SHOWN], key=lambda signal: signal.track)
    if not shown:
        return None
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(0.9 + (1.25 if len(shown) <= _FEW else 0.95) * len(shown))
        strips = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        for axes, signal in zip(strips, shown, strict=True):
            lane = _followed(signal.track, lanes)
            _draw_level(axes, signal)
            for packet in sent:
                if lane is not None and lane.name == (packet.robot, packet.source, None):
                    _draw_bits(axes, encode(packet.word), packet.start_s, packet.end_s, 1.38, TRUTH)
            for message in (each for each in messages if each.track == signal.track):
                colour = FAINT if wrong is None else BAD if message in wrong else GOOD
                bits = encode(message.word, max(message.frames, 1))
                _draw_bits(axes, bits, message.start_s, message.end_s, 1.12, colour)
                text = f"{message.command} ({message.word})"
                if message.ambiguous_with is not None:
                    text += f", or track {message.ambiguous_with}"
                axes.text(
                    message.end_s, 1.2, f"  {text}", fontsize=8, va="bottom", color=colour, clip_on=True
                )
            axes.set_ylim(_LOW, _HIGH)
            axes.set_yticks([0.0, 1.0], ["dark", "lit"])
            follows = "nobody" if lane is None else lane.label
            axes.set_title(f"track {signal.track}: {follows}", fontsize=8, loc="left", color=FAINT, pad=2)
        more = len(there) - len(shown)
        left_out = f" ({more} tracks that said less, or lived for less, are not shown)" if more else ""
        strips[-1].set_xlabel(f"time, s{left_out}")
        return Drawing(svg_of(figure), f"{name}: brightness of each track over time, bits sent and bits read")


def _followed(track: int, lanes: Sequence[Lane]) -> Lane | None:
    """Return the source that a track followed for most of the time."""
    held = [(int((lane.track == track).sum()), k) for k, lane in enumerate(lanes)]
    count, best = max(held, default=(0, 0))
    return lanes[best] if count else None


def _draw_level(axes: Axes, signal: Signal) -> None:
    colour = COLOURS[signal.track % len(COLOURS)]
    known = np.isfinite(signal.sigma_lit)
    level = np.clip(signal.level, _LOW, _HIGH)
    axes.plot(
        signal.time_s, np.where(known, level, np.nan), ".-", color=colour, linewidth=0.7, markersize=3.5
    )
    if (~known).any():
        unknown_s = signal.time_s[~known]
        axes.plot(unknown_s, np.full(unknown_s.shape, _LOW + 0.1), "|", color=BAD, markersize=4)


def _draw_bits(axes: Axes, bits: Bits, start_s: float, end_s: float, at: float, colour: str) -> None:
    edges_s = np.linspace(start_s, end_s, len(bits) + 1)
    axes.stairs(at + 0.18 * np.asarray(bits, dtype=np.float64), edges_s, baseline=at, color=colour, fill=True)
    axes.plot([start_s, end_s], [at, at], color=colour, linewidth=0.7)
