"""The tracker: sets of measurements in, tracks out."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.odometry import Pose, pose_at, poses_at
from perception.track import life
from perception.track.association import Pairs, assigned, gated_pairs, paper_pairs
from perception.track.bank import Bank, newborn, replaced, taken_states
from perception.track.fed import fed, swerved
from perception.track.kalman import predicted, wandered
from perception.track.merging import Shared, Sums, dimmed, shared_flares, split_in_doubt
from perception.track.observations import Beat, Observations, beaten, observed, usable
from perception.track.rejoin import continued, rejoined
from perception.track.settings import TrackerSettings
from perception.types import Measurement, Odometry, Track

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Keys = tuple[tuple[str, int, int], ...]

LEAST_CLUTTER = 0.5
SWERVE_COST = 4.0
"""What it costs a measurement, in log-odds, that its track must have turned on the spot."""
CLUTTER_MEMORY_S = 1.0

SURE_ODDS = 6.0
"""A track that was unseen takes at once what is its own for sure; else it waits for a track that begins.

In a crowd of false detections the gate of a dark track holds some soon, and one that follows such is lost.
"""

_SETS = ""
"""In the rhythm, what stands for all cameras."""

DAWN_S = 0.06
"""In sets that follow each other faster, of the first light after darkness only the bearing counts.

Its exposure may have caught but a part of it, and where a track was unseen for long nothing tells a part of
the light from a robot that went away. Where sets are rarer, too much would be lost.
"""


class Tracker:
    """Follows the sources that one observer sees.

    All that it remembers is its own: two trackers know nothing of each other. Tracks live in the observer's
    odometry frame, which only drifts, and leave it in body axes at the time of the set.

    What it makes of a stream that is not in order: a set older than the newest by up to `late_s` changes
    nothing (tracks as known then come back); older by more, the clock was set back: all tracks end, and
    numbers go on. A clock that jumps ahead is a time without measurements: tracks that outlive it go on.
    A lamp that shines steadily and does not move looks like an idle robot that rests, and becomes a track;
    what tells them apart is the message that it never sends.

    Parameters
    ----------
    settings
        How robots move and blink, and when a track begins and ends.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._robot = ""
        self._time_s = -math.inf
        self._pose = pose_at((), 0.0)
        self._next = 1
        self._clutter = LEAST_CLUTTER
        self._bank = _nobody()
        self._odometry: tuple[Odometry, ...] = ()
        self._sharing: Sums = {}
        self._rhythm: dict[str, Beat] = {}

    def update(
        self, time_s: float, measurements: Sequence[Measurement], odometry: Sequence[Odometry] = ()
    ) -> tuple[Track, ...]:
        """Take a set of measurements, and return the confirmed tracks at its time, seen or not.

        Parameters
        ----------
        time_s
            The set's, to which tracks are predicted; each measurement counts at its own.
        measurements
            Of one robot, in one set of frames.
        odometry
            Its records around that time, by time. Without any the last ones still hold; who never gave any
            stands still.

        Raises
        ------
        ValueError
            If the time is not a number, measurements are of several robots, or odometry is not by time.
        """
        if not math.isfinite(time_s):
            raise ValueError(f"time of a set is {time_s}; wanted seconds")
        measurements = [measurements[k] for k in usable(measurements)]
        self._name(measurements)
        if time_s < self._time_s - self.settings.late_s:
            self._bank, self._time_s, self._rhythm, self._sharing = _nobody(), -math.inf, {}, {}
            self._odometry = ()
        if time_s < self._time_s:
            return self.predicted(time_s, odometry)
        odometry = self._last_known(odometry)
        pose = pose_at(odometry, time_s)
        after_s = time_s - self._time_s if math.isfinite(self._time_s) else 0.0
        self._bank = self._moved(after_s, pose)
        self._time_s, self._pose = time_s, pose
        times_s = np.array([one.time_s for one in measurements], dtype=float)
        cameras = {camera for one in measurements for camera in one.cameras}
        self._rhythm = beaten(self._rhythm, {_SETS} | cameras, time_s)
        seen = observed(measurements, poses_at(odometry, times_s), time_s, self.settings, self._rhythm)
        self._bank = life.survivors(self._bank, time_s, self._rhythm[_SETS].period_s, self.settings)
        which = self._associate(seen, after_s)
        self._bank, self._next = life.confirmed(self._bank, self._next, self.settings)
        keys: dict[int, Keys] = {
            number: measurements[k].detections for number, k in which.items() if number > 0
        }
        return life.tracks(self._bank, self._robot, time_s, pose, keys)

    def predicted(self, time_s: float, odometry: Sequence[Odometry] = ()) -> tuple[Track, ...]:
        """Return where all live confirmed tracks are at a time, by prediction; nothing is changed.

        Parameters
        ----------
        time_s
            At or after the newest set's; shortly before it will do.
        odometry
            As in `update`, around that time.
        """
        pose = pose_at(odometry or self._odometry, time_s)
        after_s = time_s - self._time_s if math.isfinite(self._time_s) else 0.0
        bank = self._moved(after_s, pose)
        return life.tracks(bank.taken(bank.number > 0), self._robot, time_s, pose, {})

    def _last_known(self, odometry: Sequence[Odometry]) -> Sequence[Odometry]:
        """Return the odometry of a set: where a set comes without, the last two records go on."""
        if odometry:
            self._odometry = tuple(odometry[-2:])
        return odometry or self._odometry

    def _name(self, measurements: Sequence[Measurement]) -> None:
        names = sorted({one.robot for one in measurements} | ({self._robot} - {""}))
        if len(names) > 1:
            raise ValueError(
                f"measurements of {' and '.join(names)} in one tracker; give each observer its own"
            )
        self._robot = names[0] if names else self._robot

    def _moved(self, after_s: float, pose: Pose) -> Bank:
        """Return the tracks at another time."""
        bank = self._bank
        states = predicted(bank.states, after_s, self.settings.acceleration_psd_m2_per_s3)
        walk_m2 = pose.position_walk_m_per_sqrt_s**2 * abs(after_s)
        walk_rad2 = pose.rotation_walk_rad_per_sqrt_s**2 * abs(after_s)
        if walk_m2 or walk_rad2:
            states = wandered(states, states.mean[:, :3] - pose.position_m, walk_m2, walk_rad2)
        return bank.with_states(states)

    def _associate(self, seen: Observations, after_s: float) -> dict[int, int]:
        """Feed the tracks; first the confirmed, then the others, then new ones from what is left.

        Returns
        -------
        The measurement of each confirmed track that was seen, by the track's number.
        """
        confirmed = self._bank.number > 0
        old, young = self._bank.taken(confirmed), self._bank.taken(~confirmed)
        free = np.arange(len(seen.range_m))
        old, taken = self._feed_confirmed(old, seen, after_s)
        free = np.setdiff1d(free, taken)
        share = min(after_s / CLUTTER_MEMORY_S, 1.0)
        self._clutter = max(LEAST_CLUTTER, self._clutter + share * (len(free) - self._clutter))
        if len(young.number) or len(free):
            old, young = self._feed_young(old, young, seen, taken, free, after_s)
        self._bank = old.joined(young)
        numbers = old.number.tolist()
        return {number: int(k) for number, k in zip(numbers, taken.tolist(), strict=True) if k >= 0}

    def _feed_young(
        self, old: Bank, young: Bank, seen: Observations, taken: Indices, free: Indices, after_s: float
    ) -> tuple[Bank, Bank]:
        """Feed tracks that are not confirmed with what is free, and begin others; one may go on as an old.

        Which measurement that took is written to `taken`.
        """
        rest = seen.taken(free)
        pairs = self._pairs(young, rest, max(LEAST_CLUTTER, len(free)))
        chosen = assigned(pairs)
        track, measurement = pairs.track[chosen], pairs.measurement[chosen]
        young = fed(young, track, rest.taken(measurement), pairs.chi2[chosen], self._time_s, self.settings)
        young = life.scored(young, track, pairs.gain[chosen], after_s, self.settings)
        young = life.judged_ghosts(young, track, rest.ghost[measurement])
        lost = np.flatnonzero(taken < 0)
        found = rejoined(old.taken(lost), young.taken(track))
        if found:
            ends, begins = (np.array(side, dtype=np.int64) for side in zip(*found, strict=True))
            old = continued(old, lost[ends], young.taken(track[begins]))
            taken[lost[ends]] = free[measurement[begins]]
            young = young.taken(np.setdiff1d(np.arange(len(young.number)), track[begins]))
        left = rest.taken(np.setdiff1d(np.arange(len(free)), measurement))
        born = newborn(left, self._time_s, self.settings)
        born = life.judged_ghosts(born, np.arange(len(left.range_m)), left.ghost)
        return old, young.joined(born)

    def _feed_confirmed(self, old: Bank, seen: Observations, after_s: float) -> tuple[Bank, Indices]:
        """Feed confirmed tracks, and return which measurement each took, −1 for none."""
        pairs = self._pairs(old, seen, self._clutter)
        period_s = np.maximum(seen.period_s, after_s)
        unseen_s = self._time_s - old.seen_s[pairs.track]
        unsure = (unseen_s > 1.5 * period_s[pairs.measurement]) & (pairs.gain < SURE_ODDS)
        pairs = pairs._replace(gain=np.where(unsure, 0.0, pairs.gain))
        chosen = assigned(pairs)
        taken = np.full(len(old.number), -1, dtype=np.int64)
        gain, chi2 = np.zeros(len(taken)), np.zeros(len(taken))
        taken[pairs.track[chosen]] = pairs.measurement[chosen]
        gain[pairs.track[chosen]], chi2[pairs.track[chosen]] = pairs.gain[chosen], pairs.chi2[chosen]
        shared: list[Shared] = []
        doubtful = np.full(len(taken), np.nan)
        if self.settings.overlap == "sound":
            shared, doubtful = shared_flares(
                old, seen, gain, taken, self._time_s, self._clutter, self._sharing, self.settings
            )
        both = np.array([row for one in shared for row in one.tracks], dtype=np.int64)
        light = np.array([one.measurement for one in shared for _ in one.tracks], dtype=np.int64)
        apart = np.array([one.apart_rad for one in shared for _ in one.tracks], dtype=float)
        taken[both] = -1
        alone = np.flatnonzero(taken >= 0)
        when, how = self._time_s, self.settings
        period_s = period_s[taken[alone]]
        dawn = (when - old.seen_s[alone] > 1.5 * period_s) & (period_s < DAWN_S)
        bearing_only = dawn | split_in_doubt(seen, how)[taken[alone]]
        spread = np.where(bearing_only, np.nan_to_num(doubtful[alone]), doubtful[alone])
        old = fed(old, alone, seen.taken(taken[alone]), chi2[alone], when, how, spread)
        old = life.judged_ghosts(old, alone, seen.ghost[taken[alone]])
        if len(both):
            spread = np.maximum(apart, how.resolution_rad / 8.0)
            turned = np.array([row for one in shared if one.swerved for row in one.tracks], dtype=np.int64)
            if len(turned):
                old = old.with_states(replaced(old.states, turned, swerved(old, turned, when, how).states))
            old = fed(old, both, seen.taken(light), np.zeros(len(both)), when, how, spread, alone=False)
            taken[both] = light
        now = {frozenset(old.number[list(one.tracks)].tolist()): one.total for one in shared}
        lately = {who: one for who, one in self._sharing.items() if when - one.time_s < how.life_s}
        self._sharing = lately | now
        dim, edge = dimmed(old, seen, taken, self._clutter, how)
        if len(dim):
            old = fed(old, dim, seen.taken(edge), np.zeros(len(dim)), when, how, np.zeros(len(dim)))
            taken[dim] = edge
        return self._feed_swerved(old, seen, taken, after_s)

    def _feed_swerved(
        self, old: Bank, seen: Observations, taken: Indices, after_s: float
    ) -> tuple[Bank, Indices]:
        """Feed tracks that have turned on the spot: seen a set ago, now a bit beside where they must be."""
        recent_s = 1.5 * float(np.max(seen.period_s, initial=after_s))
        lost = np.flatnonzero((taken < 0) & (self._time_s - old.seen_s < recent_s))
        free = np.setdiff1d(np.arange(len(seen.range_m)), taken)
        if self.settings.filter == "paper" or not (len(lost) and len(free)):
            return old, taken
        turned, there = swerved(old, lost, self._time_s, self.settings), seen.taken(free)
        pairs = self._pairs(turned, there, self._clutter)
        pairs = pairs._replace(gain=pairs.gain - SWERVE_COST)
        chosen = assigned(pairs)
        chosen = chosen[pairs.gain[chosen] > SURE_ODDS]
        if not len(chosen):
            return old, taken
        track, measurement = pairs.track[chosen], pairs.measurement[chosen]
        rows = lost[track]
        old = old.with_states(replaced(old.states, rows, taken_states(turned.states, track)))
        chosen_there = there.taken(measurement)
        old = fed(old, rows, chosen_there, pairs.chi2[chosen], self._time_s, self.settings)
        old = life.judged_ghosts(old, rows, chosen_there.ghost)
        taken = taken.copy()
        taken[rows] = free[measurement]
        return old, taken

    def _pairs(self, bank: Bank, seen: Observations, clutter: float) -> Pairs:
        if self.settings.association == "paper":
            return paper_pairs(bank, seen, self.settings)
        return gated_pairs(bank, seen, self._pose.position_m, clutter, self.settings)


def _nobody() -> Bank:
    nothing = observed((), poses_at((), np.zeros(0)), 0.0, TrackerSettings())
    return newborn(nothing, 0.0, TrackerSettings())
