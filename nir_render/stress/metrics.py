"""The metrics that a campaign is judged by, each a ratio of sums over rows of its table, and their bounds.

A metric is Σ of a term over rows divided by their number, or the root of that. So sums pool: those of two
jobs, added, give the metric of both.
"""

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import shown
from nir_render.scene.text.units import ANGLE, FRACTION, LENGTH, Quantity, parse_quantity

Values = NDArray[np.float64]
Rows = Mapping[str, NDArray[Any]]
"""Columns of the table, shape (rows,) each; NaN where a number is missing."""


@dataclass(frozen=True)
class Metric:
    """One metric of an estimator.

    Attributes
    ----------
    name
        As a campaign document and the command write it.
    title
        As a person reads it.
    explained
        What it is, in a sentence.
    quantity
        Values are in its unit: m, rad, or plain numbers.
    higher_is_better
        A bound is the least that is wanted; else the most, of the metric's absolute value.
    kind
        Which rows it is made of: each source that counts, each frame, each observer's sequence of frames, or
        each packet that an observer could see.
    root
        Whether the metric is the root of the mean of the terms, or the mean.
    term
        What each row adds, shape (rows,); NaN where it adds nothing.
    limit
        The same of a perfect estimator, at the Cramér–Rao bound of the same rows; None where it has no such
        limit.
    """

    name: str
    title: str
    explained: str
    quantity: Quantity
    higher_is_better: bool
    kind: Literal["source", "frame", "sequence", "packet"]
    root: bool
    term: Callable[[Rows], Values]
    limit: Callable[[Rows], Values] | None = None

    def value(self, total: Any, count: Any) -> Values:
        """Return the metric of sums of terms and of how many there are; NaN of none."""
        totals, counts = np.asarray(total, dtype=np.float64), np.asarray(count, dtype=np.float64)
        mean: Values = np.full(np.broadcast(totals, counts).shape, np.nan)
        np.divide(totals, counts, out=mean, where=counts > 0.0)
        return np.sqrt(mean, out=mean) if self.root else mean

    def holds(self, value: Any, bound: float) -> NDArray[np.bool_]:
        """Tell where a value keeps a bound; one that is not defined does not."""
        values = np.asarray(value, dtype=np.float64)
        kept = values >= bound if self.higher_is_better else np.abs(values) <= bound
        return np.asarray(kept & np.isfinite(values))


@dataclass(frozen=True)
class Bound:
    """What a metric must keep: at least `value` where higher is better, else at most.

    `value` is in the metric's unit (m, rad, plain numbers and shares); `text` is how it was written.
    """

    metric: str
    value: float
    text: str = ""


def _column(name: str) -> Callable[[Rows], Values]:
    """Return the term that is a column as it stands."""
    return lambda rows: rows[name].astype(np.float64)


def _errors_m(rows: Rows) -> Values:
    return np.where(rows["ranged"].astype(bool), rows["range_error_m"], np.nan)


def _limits_m(rows: Rows) -> Values:
    """Return the limit of each range that was said; NaN where there is none."""
    limit_m = rows["range_limit_m"]
    return np.where(np.isfinite(_errors_m(rows)) & (limit_m > 0.0), limit_m, np.nan)


def _angles_rad(rows: Rows) -> Values:
    return np.radians(np.where(rows["found"].astype(bool), rows["bearing_error_deg"], np.nan))


def _angle_limits_rad(rows: Rows) -> Values:
    return np.radians(np.where(np.isfinite(_angles_rad(rows)), rows["bearing_limit_deg"], np.nan))


def _pulls(rows: Rows) -> Values:
    return _errors_m(rows) / _limits_m(rows)


_ALL = (
    Metric(
        "recall", "recall", "share of the countable sources that were found",
        FRACTION, True, "source", False, _column("found"),
    ),
    Metric(
        "ranged", "sources ranged", "share of the countable sources that were found and given a range",
        FRACTION, True, "source", False, lambda rows: np.isfinite(_errors_m(rows)).astype(np.float64),
    ),
    Metric(
        "range_rmse", "range RMSE", "root mean square of the range errors, of the sources given a range",
        LENGTH, False, "source", True, lambda rows: _errors_m(rows) ** 2, lambda rows: _limits_m(rows) ** 2,
    ),
    Metric(
        "range_mae", "range MAE", "mean absolute range error, of the sources given a range",
        LENGTH, False, "source", False, lambda rows: np.abs(_errors_m(rows)),
        # The mean absolute value of a Gaussian is √(2/π) of its σ.
        lambda rows: math.sqrt(2.0 / math.pi) * _limits_m(rows),
    ),
    Metric(
        "range_bias", "range bias", "mean range error, said − true; a bound is on its absolute value",
        LENGTH, False, "source", False, _errors_m,
    ),
    Metric(
        "range_rmse_share", "range RMSE, relative", "root mean square of range error over true range",
        FRACTION, False, "source", True, lambda rows: (_errors_m(rows) / rows["true_range_m"]) ** 2,
        lambda rows: (_limits_m(rows) / rows["true_range_m"]) ** 2,
    ),
    Metric(
        "range_pull", "range error / limit",
        "root mean square of each range error over its own Cramér–Rao limit; 1 is at the limit",
        FRACTION, False, "source", True, lambda rows: _pulls(rows) ** 2,
        lambda rows: np.where(np.isfinite(_pulls(rows)), 1.0, np.nan),
    ),
    Metric(
        "bearing_rms", "bearing RMS",
        "root mean square angle between said and true bearing, of what was found",
        ANGLE, False, "source", True, lambda rows: _angles_rad(rows) ** 2,
        lambda rows: _angle_limits_rad(rows) ** 2,
    ),
    Metric(
        "false_alarms", "false alarms per frame",
        "mean number of things reported where nothing is; ghosts and lamps are counted apart",
        FRACTION, False, "frame", False, _column("frame_false_alarms"),
    ),
    Metric(
        "hota", "HOTA", "how well robots were followed: detection and association in three dimensions",
        FRACTION, True, "sequence", False, _column("track_hota"),
    ),
    Metric(
        "idf1", "IDF1", "share of robots and tracks that belong to each other over the whole sequence",
        FRACTION, True, "sequence", False, _column("track_idf1"),
    ),
    Metric(
        "switches", "identity switches", "times that a robot was followed by another track, per sequence",
        FRACTION, False, "sequence", False, _column("track_switches"),
    ),
    Metric(
        "received", "packets received", "share of the packets in view that were received as they were sent",
        FRACTION, True, "packet", False, _column("received"),
    ),
    Metric(
        "wrong_messages", "wrong messages", "messages that nobody sent, per sequence",
        FRACTION, False, "sequence", False, _column("message_wrong"),
    ),
    Metric(
        "bit_errors", "bit error rate", "share of single bits that are wrong, each decided by itself",
        FRACTION, False, "sequence", False, _column("message_bit_error_rate"),
    ),
)  # fmt: skip

METRICS: Mapping[str, Metric] = MappingProxyType({metric.name: metric for metric in _ALL})

SHARES = ("recall", "ranged", "hota", "idf1", "received")
"""The metrics that lie between 0 and 1, of which a bound is the least."""

COUNTS = ("false_alarms", "switches", "wrong_messages", "bit_errors")
"""The metrics that count what should not be, of which a bound is the most, and may be 0."""


def known_metric(name: str) -> str:
    """Return the name of a metric if it is one.

    Raises
    ------
    ValueError
        It is none; with the nearest name.
    """
    if name in METRICS:
        return name
    near = difflib.get_close_matches(name, METRICS, n=1, cutoff=0.5)
    meant = f"; did you mean {near[0]!r}?" if near else "."
    raise ValueError(f"there is no figure {shown(name)}{meant} Known are {', '.join(METRICS)}")


def parse_bound(metric: str, text: object) -> Bound:
    """Read a bound as a campaign document writes it, such as "5 cm", "95 %", "0.1 deg" or 0.01.

    Raises
    ------
    ValueError
        An unknown metric; a wrong or missing unit; a share beyond 1; a bound that nothing can keep or miss.
    """
    known = METRICS[known_metric(metric)]
    # 95 × 0.01 is not the 0.95 that 19 of 20 gives: a decimal is read as the number nearest to it.
    value = float(f"{parse_quantity(text, known.quantity):.12g}")
    if metric in SHARES and not 0.0 < value <= 1.0:
        raise ValueError(
            f"{shown(text)} is no share that {known.title} could reach; write one up to 1, such as '95 %'"
        )
    if metric in COUNTS and value < 0.0:
        most = (
            "the most false alarms per frame" if metric == "false_alarms" else f"the most: {known.explained}"
        )
        raise ValueError(f"{shown(text)} is below 0; write {most}, such as 0.01")
    if metric not in (*SHARES, *COUNTS) and value <= 0.0:
        example = {"range_rmse_share": "2 %", "range_pull": "1.5"}.get(metric, known.quantity.example)
        raise ValueError(
            f"{shown(text)} is nothing that an error stays below; write one above 0, such as {example!r}"
        )
    return Bound(metric, value, str(text).strip())
