"""Whom each track follows, by truth, over time."""

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from perception import Track

Array = NDArray[np.float64]

_GATE_CHI2 = 25.0
_FLOOR_M = 0.02  # a track is not held to a place better than that


class Followed:
    """Whom each track followed in a run so far: the likeliest robot, where one is within five σ.

    Parameters
    ----------
    names, places_body_m
        The others, and where their sources are in the observer's axes, shape (robots, 3): all stand.
    """

    def __init__(self, names: Sequence[str], places_body_m: Array) -> None:
        self._names, self._places_m = names, places_body_m
        self._since: dict[int, list[tuple[float, str | None]]] = defaultdict(list)
        self._now: list[str | None] = []

    def update(self, tracks: Iterable[Track]) -> None:
        """Take in the tracks of a set of frames; those of mirror images follow nobody, and are left out."""
        self._now.clear()
        for track in tracks:
            if track.ghost == "yes":
                continue
            robot, so_far = self._nearest(track), self._since[track.track]
            if not so_far or so_far[-1][1] != robot:
                so_far.append((track.time_s, robot))
            self._now.append(robot)

    def now(self) -> list[str | None]:
        """Return whom each track of the last set follows."""
        return list(self._now)

    def during(self, track: int, start_s: float, end_s: float) -> str | None:
        """Return whom a track followed for most of a time, of those that it followed; None if nobody."""
        so_far = self._since.get(track)
        if not so_far:
            return None
        lasted_s: dict[str, float] = defaultdict(float)
        ends_s = [since_s for since_s, _ in so_far[1:]] + [end_s]
        for (since_s, robot), until_s in zip(so_far, ends_s, strict=True):
            both_s = min(until_s, end_s) - max(since_s, start_s)
            if robot is not None and both_s > 0.0:
                lasted_s[robot] += both_s
        return max(lasted_s, key=lambda robot: lasted_s[robot], default=None)

    def _nearest(self, track: Track) -> str | None:
        off_m = self._places_m - track.position_body_m
        covariance = track.covariance[:3, :3] + _FLOOR_M**2 * np.eye(3)
        chi2 = np.einsum("ni,ij,nj->n", off_m, np.linalg.inv(covariance), off_m)
        best = int(np.argmin(chi2))
        return self._names[best] if chi2[best] < _GATE_CHI2 else None
