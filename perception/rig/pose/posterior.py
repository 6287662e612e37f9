"""Where a robot stands and whither it heads, from the flares of its sources: the posterior, as hypotheses.

Unknown are the robot's place (three coordinates) and its heading about z: robots are taken to stand upright,
their z axes along the observer's. A flare says two angles and the logarithm of a range, once for each camera
that sees it. Errors that flares share (range constant, the camera's pose) are part of one joint covariance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.pose.problem import problem_of
from perception.rig.pose.search import nodes_of, place_node
from perception.rig.pose.sights import Carried, Sights

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MERGED = 0.1
"""Two modes with a valley between them of more than this share of the lower are one hypothesis."""

LEAST_ODDS = 1e-6
"""Hypotheses below are left out."""

_LOG_TURN = math.log(2.0 * math.pi)
_POINT = Carried(np.zeros((1, 3)), np.zeros(1), math.nan, 0.0)


@dataclass(frozen=True, eq=False)
class Mode:
    """One peak of the posterior of a pose: its share, the mean, and the covariance of x, y, z, heading."""

    share: float
    position_m: Array
    heading_rad: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class Posterior:
    """Peaks of a pose, the most probable first, and ln of the evidence (per m³ of prior density)."""

    modes: tuple[Mode, ...]
    log_evidence: float

    def turned(self, turn_rad: float) -> "Posterior":
        """Return that of a robot whose sources stand as another's do, but for such a turn of its axes."""
        modes = tuple(
            replace(mode, heading_rad=(mode.heading_rad + turn_rad + math.pi) % (2.0 * math.pi) - math.pi)
            for mode in self.modes
        )
        return Posterior(modes, self.log_evidence)


def posterior(
    sights: Sights,
    rows: Indices,
    layout: Carried,
    source: Indices,
    headings: NDArray[np.bool_],
    worth_chi2: float,
) -> Posterior | None:
    """Return the posterior of the pose, all headings and places alike beforehand.

    `source`, shape (n,), says which source of the layout each of the rows of sightings shows, `headings` at
    which of a turn's the robot may head (`gates`). None where no pose has a χ² of less than `worth_chi2`.
    """
    problem = problem_of(sights, rows, layout, source)
    nodes = nodes_of(problem, headings, worth_chi2)
    if not len(nodes):
        return None
    found, log_mass = modes_of(nodes)
    found = found[np.argsort(-found[:, 0], kind="stable")]
    modes = tuple(
        Mode(share, one[1:4], (heading + math.pi) % (2.0 * math.pi) - math.pi, one[5:].reshape(4, 4))
        for one, share, heading in zip(found, found[:, 0].tolist(), found[:, 4].tolist(), strict=True)
    )
    return Posterior(modes, problem.log_norm + 1.5 * _LOG_TURN + log_mass - _LOG_TURN)


def evidence_alone(sights: Sights, rows: Sequence[int]) -> float:
    """Return ln of the evidence, as of a `Posterior`, that sightings are of one source by itself."""
    problem = problem_of(sights, np.array(rows), _POINT, np.zeros(len(rows), dtype=np.int64))
    node = place_node(problem)
    return float(problem.log_norm - 0.5 * node[4] - 0.5 * node[5] + 1.5 * _LOG_TURN)


@compiled
def modes_of(nodes: Array) -> tuple[Array, float]:
    """Return the peaks of a posterior, given nodes over a turn by heading (`search`); ln of its integral.

    Returns
    -------
    Share, place, heading and covariance of each, shape (modes, 21); ln ∫ exp(−χ²/2) / √det over the turn.
    """
    count = len(nodes)
    cut = 0  # a turn begins where the robot heads least
    for k in range(1, count):
        if nodes[k, 4] > nodes[cut, 4]:
            cut = k
    heading, density, mass = np.empty(count), np.empty(count), np.empty(count)
    least = nodes[:, 4].min()
    for k in range(count):
        node = nodes[(cut + k) % count]
        heading[k] = node[0] + (2.0 * math.pi if cut + k >= count else 0.0)
        density[k] = math.exp(-0.5 * (node[4] - least) - 0.5 * node[5])
    total = 0.0
    for k in range(count):
        after, before = heading[min(k + 1, count - 1)], heading[max(k - 1, 0)]
        mass[k] = 0.5 * (after - before) * density[k]
        total += mass[k]
    begin, parts = _peaks(density)
    found, modes = np.empty((parts, 21)), 0
    for part in range(parts):
        share = mass[begin[part] : begin[part + 1]].sum() / total
        if share <= LEAST_ODDS:
            continue
        mean, covariance = np.zeros(4), np.zeros((4, 4))
        for step in range(2):
            for k in range(begin[part], begin[part + 1]):
                node = nodes[(cut + k) % count]
                weight = mass[k] / (share * total)
                if step == 0:
                    for c in range(3):
                        mean[c] += weight * node[1 + c]
                    mean[3] += weight * heading[k]
                    continue
                number = 6
                for c in range(4):
                    off_c = (node[1 + c] if c < 3 else heading[k]) - mean[c]
                    for d in range(c, 4):
                        off_d = (node[1 + d] if d < 3 else heading[k]) - mean[d]
                        covariance[c, d] += weight * off_c * off_d
                        if d < 3:
                            covariance[c, d] += weight * node[number]
                            number += 1
        for c in range(4):
            for d in range(c):
                covariance[c, d] = covariance[d, c]
        found[modes, 0] = share
        found[modes, 1:5] = mean
        found[modes, 5:] = covariance.ravel()
        modes += 1
    return found[:modes], math.log(total) - 0.5 * least


@compiled
def _peaks(density: Array) -> tuple[Indices, int]:
    """Return where stretches of a density begin that each hold one peak, valleys between, and how many."""
    begin, parts = np.empty(len(density) + 1, dtype=np.int64), 1
    begin[0] = 0
    peak, low = 0, 0
    for k in range(1, len(density)):
        if density[low] < MERGED * min(density[peak], density[k]):
            begin[parts] = low
            parts += 1
            peak = low = k
        elif density[k] > density[peak]:
            peak = low = k
        elif density[k] < density[low]:
            low = k
    begin[parts] = len(density)
    return begin, parts
