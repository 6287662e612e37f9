"""How well a stack tells how robots stand whose layout of sources it knows, against their poses."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from nir_render.evaluate.sets import SetScore, Stand, Values
from nir_render.evaluate.track_errors import TrueWays
from nir_render.truth.poses import PoseTruth
from perception.types import FrameKey, RobotPose

SAID_SIGMAS = 5.0
"""A hypothesis whose heading is within so many of its σ of the true one says it."""


def stands_of(
    robots: Sequence[RobotPose],
    sets: Sequence[Sequence[FrameKey]],
    scores: Sequence[SetScore],
    name: str,
    poses: Iterable[PoseTruth],
) -> tuple[Stand, ...]:
    """Return how robots are said to stand, and how they do.

    A robot is who truth says that its flares are of; flares of several are a robot put together wrongly.

    Parameters
    ----------
    robots
        As `robots.NAME.jsonl` has them.
    sets
        Camera and index of the frames of each set.
    scores, name
        Sources with what this estimator measured of them.
    poses
        Of all robots.
    """
    ways = TrueWays(poses)
    number_of = {key: number for number, keys in enumerate(sets) for key in keys}
    owner = {
        key: score.truth.robot
        for score in scores
        if name in score.measurements and not score.is_ghost
        for key in score.measurements[name].detections
    }
    stands = []
    for told in robots:
        of = {owner.get(flare) for flare in told.flares}
        robot = (next(iter(of)) or "") if len(of) == 1 else ""
        true = ways.relative(told.robot, robot, told.time_s) if len(of) == 1 else None
        stands.append(Stand(number_of.get(told.flares[0][:2], -1), told, true, len(of) > 1, robot))
    return tuple(stands)


def heading_numbers(stands: Sequence[Stand]) -> dict[str, Any]:
    """Return the `set_robots_…` and `set_heading_…` numbers of one estimator in `summary.json`.

    The heading's error is that of the best hypothesis, or of another that truth is nearer to if it has at
    least half the odds of the best: symmetric layouts are so scored modulo their symmetry. `wrong` has none
    of these within 5 σ of truth, `unsaid` none at all.
    """
    errors, pulls2, wrong, unsaid = [], [], 0, 0
    for stand in stands:
        if stand.true is None:
            continue
        k, off, is_even, is_said = _held_against(stand, stand.true)
        unsaid += not is_said
        wrong += not is_even
        errors.append(math.degrees(off[3]))
        pulls2.append(float(off @ np.linalg.solve(stand.told.hypotheses[k].covariance, off)) / 4.0)
    return {
        "set_robots_told": len(stands),
        "set_robots_mixed": sum(each.mixed for each in stands),
        "set_heading_rms_deg": math.sqrt(float(np.mean(np.square(errors)))) if errors else None,
        "set_heading_nees": float(np.mean(pulls2)) if pulls2 else None,
        "set_heading_wrong": wrong,
        "set_heading_unsaid": unsaid,
    }


def heading_error_rad(stand: Stand) -> float:
    """Return by how much a heading is off, scored as in `heading_numbers`; NaN where truth is not known."""
    return math.nan if stand.true is None else float(_held_against(stand, stand.true)[1][3])


def _held_against(stand: Stand, true: tuple[Values, float]) -> tuple[int, Values, bool, bool]:
    """Return which hypothesis is scored, its errors, whether it is as good as the best, and truth is said.

    Errors are x, y, z, heading, shape (4,).
    """
    position_m, heading_rad = true
    hypotheses = stand.told.hypotheses
    offs = [
        np.append(
            np.array(each.position_body_m) - position_m,
            (each.heading_rad - heading_rad + math.pi) % (2.0 * math.pi) - math.pi,
        )
        for each in hypotheses
    ]
    sigmas = [math.sqrt(each.covariance[3, 3]) for each in hypotheses]
    said = [k for k, off in enumerate(offs) if abs(off[3]) < SAID_SIGMAS * sigmas[k]]
    even = [k for k in said if hypotheses[k].odds >= 0.5 * hypotheses[0].odds]
    k = min(even or [0], key=lambda k: abs(float(offs[k][3])))
    return k, offs[k], bool(even), bool(said)
