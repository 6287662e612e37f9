"""The filter against closed forms, and its claims against truth drawn from its own model."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import expm

from perception.track.kalman import Innovations, States, predicted, process_noise, updated, updated_paper
from perception.track.observations import Observations, innovations
from perception.types import bearing_axes
from tests.unit.perception.simulation import random

Array = NDArray[np.float64]


def test_process_noise_is_the_integral() -> None:
    # Van Loan: exp of [[-A, G q Gᵀ], [0, Aᵀ]] Δt holds F⁻¹ Q and Fᵀ.
    q, after_s = 0.07, 0.83
    drift, noise = np.zeros((6, 6)), np.zeros((6, 6))
    drift[:3, 3:], noise[3:, 3:] = np.eye(3), q * np.eye(3)
    block = expm(after_s * np.block([[-drift, noise], [np.zeros((6, 6)), drift.T]]))
    expected = block[6:, 6:].T @ block[:6, 6:]
    np.testing.assert_allclose(process_noise(after_s, q), expected, rtol=1e-12, atol=1e-15)


def test_backwards_and_forwards_again() -> None:
    state = States(np.arange(6.0)[None], np.eye(6)[None], np.ones((1, 6)))
    there = predicted(predicted(state, -0.4, 0.0), 0.4, 0.0)
    for one, other in zip(there, state, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def _some_states(n: int) -> tuple[States, Innovations]:
    rng = random(1610)
    root = rng.normal(size=(n, 7, 7))
    joint = root @ root.transpose(0, 2, 1)
    joint /= joint[:, 6:, 6:]  # the consider state has unit variance
    rows = rng.normal(size=(n, 3, 6))
    noise = rng.normal(size=(n, 3, 3))
    return (
        States(rng.normal(size=(n, 6)), joint[:, :6, :6], joint[:, :6, 6]),
        Innovations(rows, rng.normal(size=(n, 3)), noise @ noise.transpose(0, 2, 1), rng.normal(size=(n, 3))),
    )


def test_consider_update_is_the_joint_one_with_no_gain_for_u() -> None:
    states, found = _some_states(5)
    after = updated(states, found)
    for k in range(5):
        joint = np.block(
            [[states.covariance[k], states.common[k][:, None]], [states.common[k][None], np.ones((1, 1))]]
        )
        rows = np.hstack([found.rows[k], found.load_m[k][:, None]])
        known = joint[:6, :6] - np.outer(joint[:6, 6], joint[6, :6])
        spread = found.rows[k] @ known @ found.rows[k].T + found.noise_m2[k]
        gain = np.vstack([known @ found.rows[k].T @ np.linalg.inv(spread), np.zeros((1, 3))])
        left = np.eye(7) - gain @ rows
        expected = left @ joint @ left.T + gain @ found.noise_m2[k] @ gain.T
        np.testing.assert_allclose(after.covariance[k], expected[:6, :6], atol=1e-9)
        np.testing.assert_allclose(after.common[k], expected[:6, 6], atol=1e-9)
        np.testing.assert_allclose(after.mean[k], states.mean[k] + gain[:6] @ found.residual_m[k], atol=1e-9)


def test_a_range_that_is_not_known_leaves_the_range() -> None:
    far = np.array([[3.0, 1.0, 0.2, 0.0, 0.0, 0.0]])
    states = States(far, np.diag([0.04] * 3 + [0.01] * 3)[None], np.zeros((1, 6)))
    seen = _observations(far[:, :3] + 0.01, np.array([1e-6]), np.array([np.inf]))._replace(
        range_m=np.array([np.nan])
    )
    after = updated(states, innovations(states, seen))
    along, left = bearing_axes(far[0, :3] / np.linalg.norm(far[0, :3]))[[2, 0]]
    assert along @ after.covariance[0, :3, :3] @ along == pytest.approx(0.04, rel=2e-3)
    assert left @ after.covariance[0, :3, :3] @ left == pytest.approx(
        1e-6 * 10.04 / (1 + 1e-6 * 10.04 / 0.04), rel=0.02
    )


# --- truth from its own model ---


@dataclass(frozen=True)
class Case:
    """How far, how fast; flux noise at 1 m (it grows as r²), bearing noise; when it is seen."""

    name: str
    range_m: float
    speed_m_per_s: float
    psd: float
    flux_noise_at_1_m: float
    bearing_rad: float
    interval_s: float
    steps: int


CASES = [
    Case("near slow", 1.5, 0.1, 0.01, 0.01, 1e-4, 1 / 30, 90),
    Case("far fast", 8.0, 1.0, 0.1, 0.05 / 64, 1e-4, 1 / 30, 90),
    # Some wander off to 10 m: there the flux is still five times its noise, or nothing would be found.
    Case("long gaps", 3.0, 0.1, 0.002, 0.002, 1e-4, 0.967, 20),
]
RUNS = 200


def _observations(place_m: Array, bearing2: Array, range2: Array) -> Observations:
    n = len(place_m)
    range_m = np.linalg.norm(place_m, axis=1)
    return Observations(
        np.zeros((n, 3)), bearing_axes(place_m / range_m[:, None]), range_m,
        bearing2[:, None, None] * np.eye(2), np.zeros((n, 2)), range2, np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros(n), np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), np.zeros(n),
    )  # fmt: skip


def measured(truth_m: Array, case: Case, rng: np.random.Generator) -> Observations:
    """Draw bearing and flux; the range and what it claims come of the flux."""
    n = len(truth_m)
    far = np.linalg.norm(truth_m, axis=1)
    axes = bearing_axes(truth_m / far[:, None])
    off = rng.normal(0.0, case.bearing_rad, (n, 2))
    bearing = axes[:, 2] + np.einsum("ni,nij->nj", off, axes[:, :2])
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    # No detection has a flux near 0.
    flux = np.maximum(1.0 + case.flux_noise_at_1_m * far**2 * rng.normal(size=n), 0.05)
    range_m = far / np.sqrt(flux)
    claimed = 0.5 * case.flux_noise_at_1_m * range_m**3
    return _observations(range_m[:, None] * bearing, np.full(n, case.bearing_rad**2), claimed**2)


@dataclass(frozen=True, eq=False)
class Runs:
    """What came of the runs of one case: truth and estimates, shape (steps, runs, 6), and what was measured."""

    nees: Array
    rmse_m: float
    bound_m: float
    first: Array
    truth: Array
    estimates: Array
    bearing: Array
    range_m: Array


START = np.diag([0.05**2] * 3 + [0.1**2] * 3)


def simulated(case: Case, form: str, key: int, epsilon_m2: float = 1e-6) -> Runs:
    """Return the mean NEES at each step, the RMSE of the place, and the root of its mean bound."""
    rng = random(1611, key)
    truth = np.tile([case.range_m, 0.0, 0.1, 0.0, case.speed_m_per_s, 0.0], (RUNS, 1))
    first = truth + rng.multivariate_normal(np.zeros(6), START, RUNS)
    states = States(first, np.tile(START, (RUNS, 1, 1)), np.zeros((RUNS, 6)))
    bound = states.covariance
    walk = process_noise(case.interval_s, case.psd)
    nees, least_m2 = [], []
    kept: tuple[list[Array], list[Array], list[Array], list[Array]] = ([], [], [], [])
    for _ in range(case.steps):
        truth = predicted(States(truth, bound, states.common), case.interval_s, 0.0).mean
        truth = truth + rng.multivariate_normal(np.zeros(6), walk, RUNS)
        states = predicted(states, case.interval_s, case.psd)
        seen = measured(truth[:, :3], case, rng)
        if form == "paper":
            states = updated_paper(
                states, seen.bearing, seen.range_m, seen.angle_rad2[:, 0, 0], seen.noise_m2, epsilon_m2
            )
        else:
            states = updated(states, innovations(states, seen))
        bound = predicted(States(truth, bound, states.common), case.interval_s, case.psd).covariance
        far = np.linalg.norm(truth[:, :3], axis=1)
        axes = bearing_axes(truth[:, :3] / far[:, None])
        weights = np.stack(
            [1 / (far * case.bearing_rad) ** 2] * 2 + [4.0 / (case.flux_noise_at_1_m * far**3) ** 2], axis=1
        )
        information = np.linalg.inv(bound)
        information[:, :3, :3] += axes.transpose(0, 2, 1) @ (weights[:, :, None] * axes)
        bound = np.linalg.inv(information)
        error = states.mean - truth
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(states.covariance), error).mean())
        least_m2.append(np.trace(bound[:, :3, :3], axis1=1, axis2=2).mean())
        for column, value in zip(kept, (truth, states.mean, seen.bearing, seen.range_m), strict=True):
            column.append(value)
    truths, estimates, bearing, range_m = (np.array(column) for column in kept)
    error_m = np.sqrt(np.sum((estimates - truths)[..., :3] ** 2, axis=2).mean())
    return Runs(
        np.array(nees),
        float(error_m),
        float(np.sqrt(np.mean(least_m2))),
        first,
        truths,
        estimates,
        bearing,
        range_m,
    )


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_nees_and_bound(case: Case) -> None:
    # The NEES of steps that follow each other is correlated: five times 200 runs, each with its own band.
    low, high = (stats.chi2.ppf(p, 6 * RUNS) / RUNS for p in (0.025, 0.975))
    all_of = [simulated(case, "sound", key) for key in range(5)]
    nees = np.array([one.nees for one in all_of])
    assert np.mean((nees > low) & (nees < high)) >= 0.9
    error_m2 = sum(one.rmse_m**2 for one in all_of)
    assert error_m2 <= 1.05**2 * sum(one.bound_m**2 for one in all_of)


@pytest.mark.parametrize("case", CASES[:2], ids=lambda case: case.name)
def test_the_papers_form_is_not_consistent(case: Case) -> None:
    low, high = (stats.chi2.ppf(p, 6 * RUNS) / RUNS for p in (0.025, 0.975))
    for epsilon_m2 in (1e-8, 1e-6, 1e-4):
        nees = simulated(case, "paper", 2, epsilon_m2).nees
        assert np.mean((nees > low) & (nees < high)) < 0.5
