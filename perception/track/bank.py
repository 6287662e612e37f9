"""All tracks of an observer as arrays: what a tracker remembers from set to set."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.track.kalman import States
from perception.track.observations import LEAST_RANGE_M, Observations
from perception.track.settings import TrackerSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Bank(NamedTuple):
    """Of n tracks, confirmed or not.

    Attributes
    ----------
    mean, covariance, common
        As in `States`, at the tracker's time.
    number
        Its number once it is confirmed, 0 before, shape (n,).
    odds
        Log-odds that it is of a source, shape (n,).
    hits
        In how many sets it was seen, shape (n,).
    born_s, seen_s, alone_s
        When it was seen first, last, and last not merged with another, shape (n,).
    ghost
        Log-odds that it is a mirror image, shape (n,).
    anchor_mean, anchor_covariance, anchor_common
        Its state when it was last seen: where a virtual trajectory through a gap begins.
    """

    mean: Array
    covariance: Array
    common: Array
    number: Indices
    odds: Array
    hits: Indices
    born_s: Array
    seen_s: Array
    alone_s: Array
    ghost: Array
    anchor_mean: Array
    anchor_covariance: Array
    anchor_common: Array

    @property
    def states(self) -> States:
        """What the filter works on."""
        return States(self.mean, self.covariance, self.common)

    @property
    def anchors(self) -> States:
        """The states when the tracks were last seen."""
        return States(self.anchor_mean, self.anchor_covariance, self.anchor_common)

    def taken(self, rows: Indices | NDArray[np.bool_]) -> "Bank":
        """Return some of them."""
        return Bank._make(column[rows] for column in self)

    def joined(self, others: "Bank") -> "Bank":
        """Return these and others."""
        return Bank._make(np.concatenate(pair) for pair in zip(self, others, strict=True))

    def with_states(self, states: States) -> "Bank":
        """Return the same tracks in other states."""
        return self._replace(mean=states.mean, covariance=states.covariance, common=states.common)


def taken_states(states: States, rows: Indices | NDArray[np.bool_]) -> States:
    """Return some states."""
    return States(states.mean[rows], states.covariance[rows], states.common[rows])


def replaced(states: States, rows: Indices, others: States) -> States:
    """Return states with some of them replaced."""
    copies = [column.copy() for column in states]
    for copy, column in zip(copies, others, strict=True):
        copy[rows] = column
    return States(*copies)


def newborn(seen: Observations, time_s: float, settings: TrackerSettings) -> Bank:
    """Return a track for each measurement of its own: there, at rest, as well as it is measured.

    One without a range is put at a guess.
    """
    m = len(seen.range_m)
    ranged = np.isfinite(seen.range_m)
    guess_m = np.where(seen.saturated, 0.3 * settings.range_guess_m, settings.range_guess_m)
    range_m = np.where(ranged, np.maximum(seen.range_m, LEAST_RANGE_M), guess_m)
    own_m2 = np.where(ranged, seen.noise_m2, settings.range_guess_sigma_m**2)
    load_m = np.where(ranged, seen.common_m, 0.0)
    noise = np.zeros((m, 3, 3))
    noise[:, :2, :2] = seen.angle_rad2 * (range_m**2)[:, None, None]
    noise[:, 2, 2] = own_m2 + load_m**2
    noise += seen.shaken_m2[:, None, None] * np.eye(3)
    mean, covariance, common = np.zeros((m, 6)), np.zeros((m, 6, 6)), np.zeros((m, 6))
    mean[:, :3] = seen.origin_m + range_m[:, None] * seen.bearing
    covariance[:, :3, :3] = seen.axes.transpose(0, 2, 1) @ noise @ seen.axes
    covariance[:, 3:, 3:] = settings.speed_sigma_m_per_s**2 * np.eye(3)
    # It was there at its own time: since then, or until then, it moved with a velocity that is not known.
    drift = -seen.after_s[:, None, None] * covariance[:, 3:, 3:]
    covariance[:, :3, :3] -= seen.after_s[:, None, None] * drift
    covariance[:, :3, 3:] = covariance[:, 3:, :3] = drift
    # A range that came out too long by its shared error, u = +1, puts the estimate beyond the truth.
    common[:, :3] = -load_m[:, None] * seen.bearing
    at = np.full(m, time_s)
    return Bank(
        mean, covariance, common,
        np.zeros(m, dtype=np.int64), np.zeros(m), np.ones(m, dtype=np.int64),
        at, at, at, np.zeros(m), mean, covariance, common,
    )  # fmt: skip
