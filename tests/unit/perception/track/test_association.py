"""The assignment, the likelihood, and the paper's cost, each against what can be worked out by hand."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from perception.odometry import poses_at
from perception.track.association import RANGE_NATS, Pairs, assigned, gated_pairs, paper_pairs
from perception.track.bank import Bank, newborn
from perception.track.observations import Observations, observed
from perception.track.settings import TrackerSettings
from tests.unit.perception.simulation import random
from tests.unit.perception.track.world import Array, measurement

HOW = TrackerSettings(direction_weight=0.0)


def _seen(*places: list[float]) -> Observations:
    measurements = [measurement(np.array(place), 0.0, random(1640, k)) for k, place in enumerate(places)]
    return observed(measurements, poses_at((), np.zeros(len(places))), 0.0, HOW)


def test_assignment_is_the_best_of_all() -> None:
    rng = random(1641)
    for _ in range(20):
        gain = rng.normal(1.0, 3.0, (4, 5))
        rows, columns = (grid.ravel() for grid in np.indices(gain.shape))
        pairs = Pairs(rows, columns, gain.ravel(), np.zeros(20), np.zeros(20, dtype=np.int64))
        chosen = assigned(pairs)
        best = max(
            sum(max(gain[r, c], 0.0) for r, c in enumerate(p)) for p in itertools.permutations(range(5), 4)
        )
        assert pairs.gain[chosen].sum() == pytest.approx(best)
        assert (pairs.gain[chosen] > 0.0).all()


def test_gain_is_the_likelihood_ratio() -> None:
    seen = _seen([2.0, 0.3, 0.1])
    bank = newborn(_seen([2.01, 0.301, 0.1]), 0.0, HOW)
    pairs = gated_pairs(bank, seen, np.zeros(3), 7.0, HOW)
    # In the world's axes: the place, measured with noise, the shared error of the range the same in both.
    axes = seen.axes[0]
    far = np.linalg.norm(bank.mean[0, :3])
    growth = axes[2] @ bank.mean[0, :3] / seen.range_m[0]
    noise = np.diag([seen.angle_rad2[0, 0, 0] * far**2] * 2 + [seen.noise_m2[0] * growth**6])
    load = seen.common_m[0] * growth * axes[2]
    spread = bank.covariance[0, :3, :3] + axes.T @ noise @ axes + np.outer(load, load)
    spread += np.outer(bank.common[0, :3], load) + np.outer(load, bank.common[0, :3])
    bias = 1.5 * seen.noise_m2[0] * growth**6 / far
    z = seen.place_m[0] - bias * axes[2] - bank.mean[0, :3]
    density = stats.multivariate_normal(np.zeros(3), spread).logpdf(z)
    false = 7.0 / HOW.clutter_solid_angle_sr / RANGE_NATS / seen.range_m[0] ** 3
    assert pairs.gain[0] == pytest.approx(density + math.log(HOW.seen_probability / false), abs=0.02)
    assert pairs.chi2[0] == pytest.approx(z @ np.linalg.solve(spread, z), rel=0.02)


def test_the_gate_keeps_999_in_a_thousand_and_not_what_is_far() -> None:
    rng = random(1642)
    place = np.array([2.0, 0.5, 0.1])
    n = 2000
    both = [measurement(place, 0.0, rng, common=0.0, claimed_common=0.0) for _ in range(2 * n)]
    seen = observed(both, poses_at((), np.zeros(2 * n)), 0.0, HOW)
    bank = newborn(seen.taken(np.arange(n)), 0.0, HOW)
    kept = 0
    chi2: list[float] = []
    for k in range(n):
        pairs = gated_pairs(bank.taken(np.array([k])), seen.taken(np.array([n + k])), np.zeros(3), 1.0, HOW)
        kept += len(pairs.track)
        chi2 += pairs.chi2.tolist()
    assert kept >= 0.999 * n
    # A χ² of three degrees of freedom has variance 6.
    assert np.mean(chi2) == pytest.approx(3.0, abs=4.0 * math.sqrt(6.0 / n))
    away = _seen([2.0, 0.9, 0.1], [2.8, 0.7, 0.14], [-2.0, -0.5, -0.1])
    assert len(gated_pairs(bank.taken(np.arange(3)), away, np.zeros(3), 1.0, HOW).track) == 0


def _moving(bank: Bank, velocity: Array) -> Bank:
    anchor = bank.anchor_mean.copy()
    anchor[:, 3:] = velocity
    return bank._replace(anchor_mean=anchor, anchor_covariance=1e-12 * bank.anchor_covariance)


def test_the_papers_cost() -> None:
    side = HOW.paper_box_rad
    ahead = measurement(np.array([2.0, 0.0, 0.0]), 0.0, random(1643), bearing_sigma_rad=0.0)
    seen = observed([ahead], poses_at((), np.zeros(1)), 0.0, HOW)._replace(range_m=np.array([2.3]))
    bank = newborn(seen, 0.0, HOW)
    bank = bank._replace(
        mean=np.array([[2.0, side, 0.0, 0.0, 0.0, 0.0]]),
        anchor_mean=np.array([[2.3, -1.0, 0.0, 0.0, 0.0, 0.0]]),
    )
    bank = _moving(bank, np.array([1.0, 0.0, 0.0]))
    pairs = paper_pairs(bank, seen._replace(noise_m2=np.array([1e-16])), HOW)
    # Boxes overlap by half their width: IoU = ½ / (2 − ½). The way goes to the left, the velocity ahead: ½.
    cost = (1.0 - 1.0 / 3.0) + 0.5 + (1.0 - math.exp(-0.3))
    assert 3.0 - pairs.gain[0] == pytest.approx(cost, abs=2e-3)
