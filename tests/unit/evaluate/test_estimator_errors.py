import math

import numpy as np
import pytest

from nir_render.evaluate.estimator_errors import errors_of, excess, honesty, limit_curve
from tests.unit.report.cases import detection, score

NONE = float("nan")


def test_samples_hold_what_was_said_of_the_sources_that_count() -> None:
    tilted = (math.cos(math.radians(0.03)), math.sin(math.radians(0.03)), 0.0)
    samples = errors_of(
        [
            score(2.0, {"robust": detection(range_m=2.03, range_sigma_m=0.02, bearing_body=tilted)}),
            score(3.0, {"robust": detection(range_m=9.0)}, countable=False),
            score(4.0, {"paper": detection(range_m=9.0)}, limit_m=0.05),
            score(5.0, {"robust": detection(range_m=NONE)}),
        ],
        "robust",
    )
    assert samples.found.tolist() == [True, False, True]
    assert samples.range_m.tolist() == [2.0, 4.0, 5.0]
    assert samples.range_limit_m.tolist() == [0.01, 0.05, 0.01]
    np.testing.assert_allclose(samples.error_m, [0.03, NONE, NONE])
    np.testing.assert_allclose(samples.pull, [3.0, NONE, NONE])
    np.testing.assert_allclose(samples.claimed_m[:2], [0.02, NONE])
    np.testing.assert_allclose(samples.bearing_deg, [0.03, NONE, 0.0], atol=1e-12)


def test_without_sources_the_arrays_are_empty() -> None:
    assert errors_of([], "robust").pull.shape == (0,)


def test_excess_compares_the_same_flares_and_leaves_out_what_is_unknown() -> None:
    """Errors 3 and 4 against limits 1 and 2: √12.5 over √2.5. A flare without range, and one whose limit is
    infinite, must change nothing."""
    known = excess(np.array([3.0, -4.0, NONE, 50.0]), np.array([1.0, 2.0, 7.0, math.inf]))
    assert known is not None
    assert known.count == 2
    assert known.ratio == pytest.approx(math.sqrt(5.0))
    assert excess(np.array([NONE]), np.array([1.0])) is None
    assert excess(np.array([1.0]), np.array([math.inf])) is None


@pytest.mark.parametrize("directions", [1, 2])
def test_a_perfect_estimator_stays_below_what_chance_allows_in_975_of_1000_runs(directions: int) -> None:
    """Twenty flares, each with Gaussian errors as large as its limit, in one direction or two; 20 000 runs.

    With equal limits the bound is exact: the share of runs below it is 0.975 ± 0.0011 (1 σ).
    """
    rng = np.random.Generator(np.random.Philox(5))
    each = rng.normal(0.0, 1.0 / math.sqrt(directions), (20_000, 20, directions))
    errors = np.sqrt((each**2).sum(axis=2))
    limit = np.ones(20)
    bound = excess(errors[0], limit, directions)
    assert bound is not None
    ratios = np.sqrt((errors**2).mean(axis=1))
    assert np.mean(ratios <= bound.by_chance) == pytest.approx(0.975, abs=0.0045)


def test_one_far_flare_that_carries_the_error_counts_as_one() -> None:
    """χ² with one degree of freedom exceeds 5.024 once in forty."""
    lone = excess(np.ones(50), np.array([1e3, *[1e-3] * 49]))
    assert lone is not None
    assert lone.by_chance == pytest.approx(math.sqrt(5.0239), rel=1e-4)


def test_honesty_is_the_mean_squared_error_over_claim_with_its_interval() -> None:
    """χ² with ten degrees of freedom lies within 3.247 and 20.483 in 95 of 100 cases (tables)."""
    held = honesty(np.array([*[0.02] * 10, 5.0, NONE]), np.array([*[0.01] * 10, NONE, 1.0]))
    assert held is not None
    assert held.count == 10
    assert held.mean_square == pytest.approx(4.0)
    assert held.low == pytest.approx(0.3247, abs=1e-4)
    assert held.high == pytest.approx(2.0483, abs=1e-4)
    assert honesty(np.ones(3), np.full(3, NONE)) is None


def test_the_limit_as_a_line_is_the_rms_of_each_step_of_range() -> None:
    x, y = limit_curve(np.array([1.0, 1.1, 5.0, 9.0, NONE]), np.array([3.0, 4.0, math.inf, 7.0, 1.0]), bins=4)
    np.testing.assert_allclose(x, [1.05, 9.0])
    np.testing.assert_allclose(y, [math.sqrt(12.5), 7.0])
    assert limit_curve(np.array([2.0]), np.array([0.5]))[1].tolist() == [0.5]
    assert limit_curve(np.empty(0), np.empty(0))[0].size == 0
