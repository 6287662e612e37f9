"""Birth, confirmation and death of tracks, what is said of ghosts, and tracks as they leave the tracker."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from perception.odometry import Pose
from perception.track.bank import Bank
from perception.track.settings import TrackerSettings
from perception.types import Ghost, Track

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_ODDS = -1.0
"""A tentative track below is none."""

_SETS_UNSEEN = 2.5

_MERGED_MOST = 10.0
"""Times `merged_life_s`: longer than this no track lives on a shared flare."""

MOST_GHOST, GHOST_STEP, GHOST_SAID = 6.0, 1.0, 2.0
"""Log-odds of being a mirror image: floor and ceiling, what one set may add, from where on it is said.

Sets that follow each other repeat each other's errors, so none counts for more than e : 1; and a label that
was wrong can be mended within a dozen sets.
"""


def survivors(bank: Bank, time_s: float, period_s: float, settings: TrackerSettings) -> Bank:
    """Return the tracks that are alive at a time: by seconds unseen, and by odds while tentative.

    Where sets are rare (`period_s` apart) seconds are few, and two sets without it are what ends a track.
    """
    unseen_s = time_s - bank.seen_s
    confirmed = bank.number > 0
    lives_s = np.where(confirmed, settings.life_s, settings.tentative_life_s)
    if math.isfinite(period_s):
        lives_s = np.maximum(lives_s, _SETS_UNSEEN * period_s)
    # Who was seen alone for long is there for sure, and may stand behind another for as long.
    merged_s = np.clip(
        bank.alone_s - bank.born_s, settings.merged_life_s, _MERGED_MOST * settings.merged_life_s
    )
    alive = (unseen_s <= lives_s) & (time_s - bank.alone_s <= np.maximum(merged_s, lives_s))
    return bank.taken(alive & (confirmed | (bank.odds > LEAST_ODDS)))


def scored(bank: Bank, hit: Indices, gain: Array, after_s: float, settings: TrackerSettings) -> Bank:
    """Add what a set says to the log-odds of tentative tracks (Wald's sequential test).

    A hit adds its likelihood ratio against clutter. What was not seen pays by the time, not by the set: dark
    runs are as long at 100 frames per second as at 30.
    """
    change = np.full(len(bank.odds), -settings.unseen_cost_per_s * after_s)
    change[hit] = gain
    return bank._replace(odds=bank.odds + change)


def confirmed(bank: Bank, following: int, settings: TrackerSettings) -> tuple[Bank, int]:
    """Give numbers to tracks that have passed the test, from a number on; return also the number after."""
    passed = (bank.odds >= settings.confirm_odds) & (bank.hits >= settings.confirm_hits)
    new = np.flatnonzero(passed & (bank.number == 0))
    number = bank.number.copy()
    number[new] = following + np.arange(len(new))
    return bank._replace(number=number), following + len(new)


def judged_ghosts(bank: Bank, tracks: Indices, probability: Array) -> Bank:
    """Add what measurements say of tracks' being mirror images."""
    p = np.clip(probability, 1e-3, 1.0 - 1e-3)
    step = np.clip(np.log(p / (1.0 - p)), -GHOST_STEP, GHOST_STEP)
    ghost = bank.ghost.copy()
    ghost[tracks] = np.clip(ghost[tracks] + step, -MOST_GHOST, MOST_GHOST)
    return bank._replace(ghost=ghost)


def ghost_label(log_odds: float) -> Ghost:
    """Say it in the contract's words."""
    if abs(log_odds) < GHOST_SAID:
        return "possible"
    return "yes" if log_odds > 0.0 else "no"


def tracks(
    bank: Bank,
    robot: str,
    time_s: float,
    pose: Pose,
    detections: Mapping[int, tuple[tuple[str, int, int], ...]],
) -> tuple[Track, ...]:
    """Return the confirmed tracks of a bank, which stands at `time_s`, in body axes.

    The observer's own place and tilt at that time are known no better than their σ, and add to theirs.
    """
    rows = np.flatnonzero(bank.number > 0)
    turn = pose.rotation.T
    place = (bank.mean[rows, :3] - pose.position_m) @ turn.T
    velocity = bank.mean[rows, 3:] @ turn.T
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = turn
    covariance = both @ bank.covariance[rows] @ both.T
    if pose.position_sigma_m or pose.rotation_sigma_rad:
        across = np.sum(place**2, axis=1)[:, None, None] * np.eye(3) - place[:, :, None] * place[:, None, :]
        covariance[:, :3, :3] += pose.position_sigma_m**2 * np.eye(3) + pose.rotation_sigma_rad**2 * across
    numbers, seen_s, ghosts = (column[rows].tolist() for column in (bank.number, bank.seen_s, bank.ghost))
    found = []
    for k, number in enumerate(numbers):
        unseen_s = 0.0 if number in detections else max(time_s - seen_s[k], 0.0)
        found.append(
            Track(
                robot=robot,
                time_s=time_s,
                track=number,
                position_body_m=place[k],
                velocity_body_m_per_s=velocity[k],
                covariance=covariance[k],
                detections=detections.get(number, ()),
                unseen_s=unseen_s,
                ghost=ghost_label(ghosts[k]),
            )
        )
    return tuple(found)
