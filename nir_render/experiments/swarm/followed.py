"""Whom each track follows, by truth, over time."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.match import GATE_PX
from perception import Calibration, Track
from perception.model.ranging import angular_radius_rad

Array = NDArray[np.float64]

_GATE_CHI2 = 25.0
_FLOOR_M = 0.02  # a track is not held to a place better than that


class Whom(NamedTuple):
    """Whom a track follows, None if nobody; `off` if it is on its bearing, and not where it is."""

    robot: str | None
    off: bool


class Followed:
    """Whom each track followed in a run so far: the likeliest robot, where one is within five σ.

    Else it is who stands on its bearing and is partly hidden, or merged with another: such a flux says too
    large a range, or too small a one, and nothing in a frame tells that from a robot which is there.

    Parameters
    ----------
    names, places_body_m
        The others, and where their sources are in the observer's axes, shape (robots, 3): all stand.
    unlike
        By camera the names of those whose flare is not their whole light alone: partly hidden, or merged.
    known
        The cameras.
    """

    def __init__(
        self,
        names: Sequence[str],
        places_body_m: Array,
        unlike: Mapping[str, Sequence[str]],
        known: Mapping[str, Calibration],
    ) -> None:
        self._names, self._places_m = names, places_body_m
        number = {name: index for index, name in enumerate(names)}
        self._unlike = [
            (known[camera], np.array([number[name] for name in some]))
            for camera, some in unlike.items()
            if some
        ]
        self._since: dict[int, list[tuple[float, str | None]]] = defaultdict(list)
        self._now: list[Whom] = []

    def update(self, tracks: Iterable[Track]) -> None:
        """Take in the tracks of a set of frames; those of mirror images follow nobody, and are left out."""
        self._now.clear()
        for track in tracks:
            if track.ghost == "yes":
                continue
            whom, so_far = self._whom(track), self._since[track.track]
            if not so_far or so_far[-1][1] != whom.robot:
                so_far.append((track.time_s, whom.robot))
            self._now.append(whom)

    def now(self) -> list[Whom]:
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

    def _whom(self, track: Track) -> Whom:
        off_m = self._places_m - track.position_body_m
        covariance = track.covariance[:3, :3] + _FLOOR_M**2 * np.eye(3)
        chi2 = np.einsum("ni,ij,nj->n", off_m, np.linalg.inv(covariance), off_m)
        best = int(np.argmin(chi2))
        if chi2[best] < _GATE_CHI2:
            return Whom(self._names[best], off=False)
        return Whom(self._on_its_bearing(track), off=True)

    def _on_its_bearing(self, track: Track) -> str | None:
        """Return whose flare is not its own within 3 px of a track, or its own disc, as a camera sees it."""
        found: list[tuple[float, int]] = []
        for known, some in self._unlike:
            towards_m = self._places_m[some] - known.position_body_m
            far_m = np.linalg.norm(towards_m, axis=1)
            along = track.position_body_m - known.position_body_m
            cos = np.clip(towards_m @ along / (far_m * np.linalg.norm(along)), -1.0, 1.0)
            gate_rad = np.maximum(GATE_PX / known.fx_px, angular_radius_rad(far_m, known.source_radius_m))
            within = np.arccos(cos) / gate_rad
            best = int(np.argmin(within))
            found.append((float(within[best]), int(some[best])))
        within_best, number = min(found, default=(np.inf, -1))
        return self._names[number] if within_best <= 1.0 else None
