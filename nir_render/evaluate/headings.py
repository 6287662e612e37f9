"""How well a stack tells how robots stand whose layout of sources it knows, against their poses."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from nir_render.evaluate.sets import SetScore, Stand
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
        true = ways.relative(told.robot, next(iter(of)) or "", told.time_s) if len(of) == 1 else None
        stands.append(Stand(number_of.get(told.flares[0][:2], -1), told, true, len(of) > 1))
    return tuple(stands)


def heading_numbers(stands: Sequence[Stand]) -> dict[str, Any]:
    """Return the `set_robots_…` and `set_heading_…` numbers of one estimator in `summary.json`.

    The heading's error is that of the best hypothesis, or of another that truth is nearer to if it has at
    least half the odds of the best: symmetric layouts are so scored modulo their symmetry. `wrong` has none
    of these within 5 σ of truth, `unsaid` none at all.
    """
    errors, pulls2, wrong, unsaid = [], [], 0, 0
    for told, true in ((each.told, each.true) for each in stands):
        if true is None:
            continue
        position_m, heading_rad = true
        offs = [
            np.append(
                np.array(each.position_body_m) - position_m,
                (each.heading_rad - heading_rad + math.pi) % (2.0 * math.pi) - math.pi,
            )
            for each in told.hypotheses
        ]
        sigmas = [math.sqrt(each.covariance[3, 3]) for each in told.hypotheses]
        said = [k for k, off in enumerate(offs) if abs(off[3]) < SAID_SIGMAS * sigmas[k]]
        best = told.hypotheses[0].odds
        even = [k for k in said if told.hypotheses[k].odds >= 0.5 * best]
        unsaid += not said
        wrong += not even
        k = min(even or [0], key=lambda k: abs(float(offs[k][3])))
        errors.append(math.degrees(offs[k][3]))
        pulls2.append(float(offs[k] @ np.linalg.solve(told.hypotheses[k].covariance, offs[k])) / 4.0)
    return {
        "set_robots_told": len(stands),
        "set_robots_mixed": sum(each.mixed for each in stands),
        "set_heading_rms_deg": math.sqrt(float(np.mean(np.square(errors)))) if errors else None,
        "set_heading_nees": float(np.mean(pulls2)) if pulls2 else None,
        "set_heading_wrong": wrong,
        "set_heading_unsaid": unsaid,
    }
