"""One source over time, as one estimator's tracks followed it: what the plots of this room draw."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.presence import SourceName
from nir_render.evaluate.tracks import Moment
from perception.types import Track

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Lane:
    """One source in all instants of its observer.

    `place_m`, shape (n, 3), is its true place in body axes, NaN where it is not there; `counts` whether it
    counts, `lit` whether its light was on for half of the exposure. `track`, shape (n,), is the number of the
    track that follows it, −1 for none; `said_m` that track's place, `seen` whether it is measured rather than
    predicted, `range_sigma_m` and `bearing_sigma_deg` what it claims, the latter the RMS over all directions.
    """

    name: SourceName
    time_s: Values
    place_m: Values
    counts: Flags
    lit: Flags
    track: NDArray[np.int64]
    said_m: Values
    seen: Flags
    range_sigma_m: Values
    bearing_sigma_deg: Values

    @property
    def label(self) -> str:
        """Robot and source, and whose image it is where it is one."""
        robot, source, ghost_of = self.name
        return f"{robot}.{source}" + (f"' of {ghost_of}" if ghost_of else "")

    @property
    def range_error_m(self) -> Values:
        """Range said − true range, from the body's origin."""
        return np.asarray(np.linalg.norm(self.said_m, axis=1) - np.linalg.norm(self.place_m, axis=1))

    @property
    def bearing_error_deg(self) -> Values:
        """Angle between the bearing said and the true one, from the body's origin."""
        across = np.linalg.norm(np.cross(self.said_m, self.place_m), axis=1)
        return np.asarray(np.degrees(np.arctan2(across, (self.said_m * self.place_m).sum(axis=1))))

    def of_track(self, number: int) -> Values:
        """Return the places that one track said, shape (n, 3), NaN where it did not follow."""
        return np.where((self.track == number)[:, None], self.said_m, np.nan)

    def switches(self) -> list[int]:
        """Return the instants in which another track follows it than the last one that did."""
        found = np.flatnonzero(self.track >= 0)
        return [int(b) for a, b in pairwise(found) if self.track[a] != self.track[b]]


def lanes_of(moments: Sequence[Moment], observer: str, name: str) -> list[Lane]:
    """Return the sources that an observer ever has to count, by name."""
    own = [moment for moment in moments if moment.robot == observer]
    names = {one.name for moment in own for one in moment.present if one.life is not None}
    return [_lane(own, source, name) for source in sorted(names, key=_in_order)]


def _in_order(source: SourceName) -> list[tuple[str, int]]:
    """Return what sorts names as a person would: r2 before r10."""
    parts = re.findall(r"(\D*)(\d*)", f"{source[0]}.{source[1]}")
    return [(text, int(digits or -1)) for text, digits in parts]


def spans(time_s: Values, where: Flags) -> list[tuple[float, float]]:
    """Return from when to when a flag holds; an instant lasts until the next."""
    if not where.any():
        return []
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    ends_s = np.append(time_s, time_s[-1] + step_s)
    return [(float(ends_s[a]), float(ends_s[b])) for a, b in edges.reshape(-1, 2)]


def _lane(moments: Sequence[Moment], source: SourceName, name: str) -> Lane:
    rows = []
    for moment in moments:
        there = next((one for one in moment.present if one.name == source), None)
        track = next((track for track, who in moment.tracks.get(name, ()) if who == source), None)
        rows.append((
            moment.time_s, (math.nan,) * 3 if there is None else there.position_body_m,
            there is not None and there.life is not None, there is not None and there.lit >= 0.5,
            -1 if track is None else track.track, (math.nan,) * 3 if track is None else track.position_body_m,
            track is not None and bool(track.detections), *_sigmas(track),
        ))  # fmt: skip
    columns = list(zip(*rows, strict=True))
    return Lane(
        source, np.array(columns[0]), np.array(columns[1], dtype=np.float64).reshape(-1, 3),
        np.array(columns[2], dtype=bool), np.array(columns[3], dtype=bool), np.array(columns[4], np.int64),
        np.array(columns[5], dtype=np.float64).reshape(-1, 3), np.array(columns[6], dtype=bool),
        np.array(columns[7], dtype=np.float64), np.array(columns[8], dtype=np.float64),
    )  # fmt: skip


def _sigmas(track: Track | None) -> tuple[float, float]:
    """Return the σ of range (m) and of bearing (degrees) that a track claims."""
    if track is None:
        return math.nan, math.nan
    range_m = float(np.linalg.norm(track.position_body_m))
    along = track.position_body_m / range_m if range_m > 0.0 else np.array([1.0, 0.0, 0.0])
    of_place = track.covariance[:3, :3]
    along_m2 = float(along @ of_place @ along)
    across_m2 = max(float(np.trace(of_place)) - along_m2, 0.0)
    return math.sqrt(max(along_m2, 0.0)), math.degrees(math.sqrt(across_m2) / max(range_m, 1e-9))
