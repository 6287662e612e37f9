"""How well a swarm keeps its spacing: the paper claims "spacing error < 5 cm" and does not say of what."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pair = tuple[str, str]

COUNTED_S = 60.0
"""The end of a run that counts."""

NEIGHBOURS = 1.2
"""Pairs whose mean distance is below so many spacings are neighbours."""


@dataclass(frozen=True)
class Spacing:
    """Spacing over the last minute of a run.

    Attributes
    ----------
    error_m
        Mean of |d − d₀| over time and over neighbours, d₀ the wished spacing.
    bias_m
        Mean of d − d₀ over the same.
    spread_m
        Largest less smallest of the neighbours' mean distances.
    worst_m
        Largest |d − d₀| of any neighbours at any instant.
    all_pairs_m
        Mean distance of all pairs.
    nearest_m
        Least distance of any pair over the whole run.
    joined
        Whether neighbours join all robots, each by some way over others.
    touched
        Whether two bodies touched.
    """

    error_m: float
    bias_m: float
    spread_m: float
    worst_m: float
    all_pairs_m: float
    nearest_m: float
    joined: bool
    touched: bool

    @property
    def valid(self) -> bool:
        """Whether the error says anything: all robots in one flock, and no bump."""
        return self.joined and not self.touched


def spacing(
    times_s: NDArray[np.float64],
    distances_m: Mapping[Pair, NDArray[np.float64]],
    wished_m: float,
    diameter_m: float,
) -> Spacing:
    """Return how well a wished spacing was kept; distances of each pair over time, shape (times,)."""
    counted = times_s > times_s[-1] - COUNTED_S
    means_m = {pair: float(d_m[counted].mean()) for pair, d_m in distances_m.items()}
    near = [pair for pair, mean_m in means_m.items() if mean_m < NEIGHBOURS * wished_m]
    off_m = np.array([distances_m[pair][counted] - wished_m for pair in near])
    nearest_m = min(float(d_m.min()) for d_m in distances_m.values())
    names = {name for pair in distances_m for name in pair}
    of_near = [means_m[pair] for pair in near]
    return Spacing(
        error_m=float(np.abs(off_m).mean()) if near else math.nan,
        bias_m=float(off_m.mean()) if near else math.nan,
        spread_m=max(of_near) - min(of_near) if near else math.nan,
        worst_m=float(np.abs(off_m).max()) if near else math.nan,
        all_pairs_m=float(np.mean(list(means_m.values()))),
        nearest_m=nearest_m,
        joined=_are_joined(names, near),
        touched=nearest_m < diameter_m,
    )


def _are_joined(names: set[str], pairs: Sequence[Pair]) -> bool:
    reached, more = set(), {next(iter(sorted(names)))}
    while more:
        reached |= more
        more = {name for pair in pairs if reached & set(pair) for name in pair} - reached
    return reached == names
