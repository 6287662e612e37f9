"""Laws of flocking and formation: from neighbours as they are seen to a velocity.

All of it happens in the plane, in the axes of the robot's body, which the base keeps in place. A neighbour's
velocity is that over ground.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.types import Message, Track

Array = NDArray[np.float64]

_PAPERS_SPACING_M = 1.0
_PREDICTED_MOST_S = 2.0  # a neighbour that was not seen for longer steers nobody


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Where another robot is from one's own place, and how it moves over ground, shape (2,) each."""

    place_m: Array
    velocity_m_per_s: Array


Law = Callable[[Sequence[Neighbour], float, float], Array]
"""From neighbours, the wished spacing in metres and the highest speed to a velocity over ground."""


def neighbours_of(tracks: Sequence[Track]) -> list[Neighbour]:
    """Return the robots that tracks follow: no mirror images, none unseen for long."""
    return [
        Neighbour(track.position_body_m[:2], track.velocity_body_m_per_s[:2])
        for track in tracks
        if track.ghost != "yes" and track.unseen_s < _PREDICTED_MOST_S
    ]


def reynolds(neighbours: Sequence[Neighbour], spacing_m: float, most_m_per_s: float) -> Array:
    """Return what the paper's law asks for: separation 0.8 m, alignment 1.3 m, cohesion 3.0 m.

    The paper gives ranges and weights (1.0, 0.8, 3.0; its Flocking section), not the forms. Of the forms that
    were tried these come nearest to what it reports: separation 1/d − 1/0.8 m away from each nearer than
    0.8 m, alignment the velocity of those nearer than 1.3 m, cohesion d − 1.3 m towards each between 1.3 m
    and 3.0 m, all as means. The law has no spacing of its own: a wished one scales its ranges.
    """
    scale = spacing_m / _PAPERS_SPACING_M
    velocity = np.zeros(2)
    apart = [(float(np.hypot(*one.place_m)), one) for one in neighbours]
    near = [(d, one) for d, one in apart if 0.0 < d < 0.8 * scale]
    aligned = [one for d, one in apart if d < 1.3 * scale]
    far = [(d, one) for d, one in apart if 1.3 * scale < d < 3.0 * scale]
    if near:
        velocity -= 1.0 * np.mean(
            [(1.0 / d - 1.0 / (0.8 * scale)) * one.place_m / d for d, one in near], axis=0
        )
    if aligned:
        velocity += 0.8 * np.mean([one.velocity_m_per_s for one in aligned], axis=0)
    if far:
        velocity += 3.0 * np.mean([(d - 1.3 * scale) * one.place_m / d for d, one in far], axis=0)
    return clipped(velocity, most_m_per_s)


_STIFFNESS_PER_S = 1.0
_PULL_M = 0.2
_FULL, _NONE = 1.2, 1.3  # times the spacing: who is nearer counts fully, who is farther not at all
_GATHER_M_PER_S = 0.05
_FEWEST = 2


def springs(neighbours: Sequence[Neighbour], spacing_m: float, most_m_per_s: float) -> Array:
    """Return a velocity whose rest lies at the wished spacing: v = k Σ g f(d − d₀) û + Σ g v̂ / Σ g + gather.

    g is 1 up to 1.2 d₀ and falls to 0 at 1.3 d₀; f is bounded by 0.2 m as a pull, not as a push. Who has
    fewer than two neighbours goes towards the nearest of the others, at 0.05 m/s.
    """
    velocity, weights = np.zeros(2), 0.0
    aligned = np.zeros(2)
    outside: list[tuple[float, Neighbour]] = []
    for one in neighbours:
        distance_m = float(np.hypot(*one.place_m))
        if distance_m == 0.0:
            continue
        weight = float(np.clip((_NONE - distance_m / spacing_m) / (_NONE - _FULL), 0.0, 1.0))
        if distance_m > _FULL * spacing_m:
            outside.append((distance_m, one))
        if weight > 0.0:
            pull_m = min(distance_m - spacing_m, _PULL_M)
            velocity += _STIFFNESS_PER_S * weight * pull_m * one.place_m / distance_m
            aligned += weight * one.velocity_m_per_s
            weights += weight
    if weights > 0.0:
        velocity += aligned / weights
    if len(neighbours) - len(outside) < _FEWEST and outside:
        distance_m, nearest = min(outside, key=lambda each: each[0])
        velocity += _GATHER_M_PER_S * nearest.place_m / distance_m
    return clipped(velocity, most_m_per_s)


def clipped(velocity: Array, most_m_per_s: float) -> Array:
    """Return a velocity of no more than so much speed, in the same direction."""
    speed = float(np.hypot(*velocity))
    return velocity if speed <= most_m_per_s else velocity * (most_m_per_s / speed)


COMMANDED_M = {"disperse": 1.2, "aggregate": 0.6, "recover": _PAPERS_SPACING_M}
"""The spacing that each command sets (the paper's Exp. 4)."""

_ON_ITS_WAY_M_PER_S = 0.09  # a little below the base's 0.1 m/s: who stands a spacing from the leader keeps up


class Formation:
    """A controller that keeps a commanded spacing by `springs`: a command sets it, once.

    The wished spacing goes from the old one to the new one at 0.09 m/s, and with it the reach of the springs,
    1.3 times itself. A reach that stayed at 1.3 times the larger one would take in, at 0.6 m after 1.2 m, the
    next but one at 1.04 m, and rest elsewhere.

    Attributes
    ----------
    obeyed
        When what was obeyed.
    """

    def __init__(self, spacing_m: float = _PAPERS_SPACING_M) -> None:
        self.obeyed: list[tuple[float, str]] = []
        self._old_m = self._new_m = spacing_m
        self._since_s = -np.inf

    def hear(self, messages: Sequence[Message], time_s: float) -> None:
        """Take in what was said. What sets the spacing that is set already changes nothing."""
        for message in messages:
            new_m = COMMANDED_M.get(message.command)
            if new_m is not None and new_m != self._new_m:
                self._old_m, self._new_m, self._since_s = self.wished_m(time_s), new_m, time_s
                self.obeyed.append((time_s, message.command))

    def wished_m(self, time_s: float) -> float:
        """Return the wished spacing, on its way from the old one to the new one."""
        gone_m = _ON_ITS_WAY_M_PER_S * (time_s - self._since_s)
        return self._new_m + float(np.sign(self._old_m - self._new_m)) * max(
            abs(self._new_m - self._old_m) - gone_m, 0.0
        )

    def velocity(self, neighbours: Sequence[Neighbour], time_s: float, most_m_per_s: float) -> Array:
        """Return the wished velocity over ground."""
        return springs(neighbours, self.wished_m(time_s), most_m_per_s)


LAWS: dict[str, Law] = {"paper": reynolds, "robust": springs}
