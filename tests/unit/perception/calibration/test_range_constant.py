import math

import numpy as np
import pytest

from perception.calibration.range_constant import (
    RangeConstantFit,
    regress_range_constant,
)
from tests.unit.perception.simulation import random

K = 1.0e9
RANGES_M = np.repeat(np.linspace(1.0, 10.0, 20), 8)
SIGMA = K / RANGES_M**2 * np.linspace(0.002, 0.01, RANGES_M.size)  # as a flux's own σ: from 0.2 % to 1 %


def test_an_exact_line_gives_slope_intercept_and_constant() -> None:
    line = regress_range_constant(K / RANGES_M**2 + 4e4, SIGMA, RANGES_M)
    assert line.slope_dn_m2_per_s == pytest.approx(K, rel=1e-12)
    assert line.intercept_dn_per_s == pytest.approx(4e4, rel=1e-7)
    assert line.reduced_chi2 == pytest.approx(0.0, abs=1e-12)
    assert regress_range_constant(
        K / RANGES_M**2, SIGMA, RANGES_M
    ).range_constant_dn_m2_per_s == pytest.approx(K, rel=1e-12)


def test_the_weighted_line_is_that_of_numpy() -> None:
    m = K / RANGES_M**2 + SIGMA * random(51).normal(size=SIGMA.size)
    sigma = np.sqrt(np.mean(SIGMA.reshape(-1, 8) ** 2, axis=1)).repeat(8)
    line = regress_range_constant(m, SIGMA, RANGES_M)
    (slope, intercept), covariance = np.polyfit(RANGES_M**-2.0, m, 1, w=1.0 / sigma, cov="unscaled")
    assert line.slope_dn_m2_per_s == pytest.approx(slope, rel=1e-9)
    assert line.intercept_dn_per_s == pytest.approx(intercept, rel=1e-6)
    assert line.slope_sigma_dn_m2_per_s == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-9)
    assert line.intercept_sigma_dn_per_s == pytest.approx(np.sqrt(covariance[1, 1]), rel=1e-9)
    assert line.correlation == pytest.approx(
        covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]), rel=1e-9
    )


def _simulated(seed: int, count: int = 200) -> list[RangeConstantFit]:
    rng = random(seed)
    return [
        regress_range_constant(K / RANGES_M**2 + rng.normal(0.0, SIGMA), SIGMA, RANGES_M)
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    ("value", "sigma", "true"),
    [
        ("slope_dn_m2_per_s", "slope_sigma_dn_m2_per_s", K),
        ("intercept_dn_per_s", "intercept_sigma_dn_per_s", 0.0),
        ("range_constant_dn_m2_per_s", "range_constant_sigma_dn_m2_per_s", K),
    ],
)
def test_the_scatter_of_calibrations_is_the_claimed_sigma(value: str, sigma: str, true: float) -> None:
    """Of 200: a standard deviation is known to 1 / √(2 · 199) = 5 %, a mean to σ / √200."""
    lines = _simulated(52)
    claimed = getattr(lines[0], sigma)
    values = np.array([getattr(line, value) for line in lines])
    assert values.std(ddof=1) == pytest.approx(claimed, rel=4 / np.sqrt(398))
    assert values.mean() == pytest.approx(true, abs=4 * claimed / np.sqrt(200))


def test_chi2_is_one_and_the_intercept_zero_as_often_as_they_should() -> None:
    """Of 200: χ² per degree of freedom is 1 ± √(2/158/200); 3 σ of intercept are missed once in 370."""
    lines = _simulated(53)
    chi2 = np.mean([line.reduced_chi2 for line in lines])
    assert chi2 == pytest.approx(1.0, abs=4 * np.sqrt(2 / 158 / 200))
    assert sum(not line.intercept_is_zero for line in lines) <= 4
    assert sum(line.chi2_probability < 0.1 for line in lines) == pytest.approx(20, abs=4 * np.sqrt(18))


def test_weights_make_the_line_better_than_equal_ones() -> None:
    """With equal weights what is near and bright, and errs by most counts, decides."""
    rng = random(54)
    m = [K / RANGES_M**2 + rng.normal(0.0, SIGMA) for _ in range(200)]
    weighted = np.std([regress_range_constant(each, SIGMA, RANGES_M).intercept_dn_per_s for each in m])
    equal = np.std([regress_range_constant(each, 1.0, RANGES_M).intercept_dn_per_s for each in m])
    assert equal > 2.0 * weighted


def test_sigmas_that_follow_the_noise_do_not_pull_the_constant_down() -> None:
    """Some 100 photons each, σ from their own number: weights 1/σ² of each alone would cost 1 %, 2 σ of K."""
    rng = random(55)
    ranges_m = np.repeat([1.0, 2.0, 3.0, 4.0], 64)
    photons = rng.poisson(100.0, (100, ranges_m.size))
    lines = [regress_range_constant(n / ranges_m**2, np.sqrt(n) / ranges_m**2, ranges_m) for n in photons]
    constants = [line.range_constant_dn_m2_per_s for line in lines]
    sigma = lines[0].range_constant_sigma_dn_m2_per_s
    assert np.mean(constants) == pytest.approx(100.0, abs=4 * sigma / np.sqrt(100))


def test_a_gain_fault_of_one_percent_is_seen() -> None:
    """In all frames as 1 % of K; from 5 m on as a line that does not fit."""
    noise = SIGMA * random(56).normal(size=SIGMA.size)
    true = K / RANGES_M**2
    everywhere = regress_range_constant(1.01 * true + noise, SIGMA, RANGES_M)
    error = everywhere.range_constant_dn_m2_per_s / K - 1.0
    assert error == pytest.approx(0.01, abs=4 * everywhere.range_constant_sigma_dn_m2_per_s / K)
    assert error > 10 * everywhere.range_constant_sigma_dn_m2_per_s / K
    sound = regress_range_constant(true + noise, SIGMA, RANGES_M)
    assert sound.intercept_is_zero
    assert sound.chi2_probability > 1e-3
    far = regress_range_constant(np.where(RANGES_M > 5.0, 1.01, 1.0) * true + noise, SIGMA, RANGES_M)
    assert not far.intercept_is_zero
    assert far.chi2_probability < 0.1 * sound.chi2_probability


def test_flux_bad_input() -> None:
    with pytest.raises(ValueError, match="three measurements at two different ranges"):
        regress_range_constant([1.0, 2.0, 3.0], 1.0, 2.0)
    with pytest.raises(ValueError, match="three measurements"):
        regress_range_constant([1.0, 2.0], 1.0, [1.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        regress_range_constant([1.0, math.nan, 1.0], 1.0, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="positive"):
        regress_range_constant([1.0, 2.0, 3.0], 0.0, [1.0, 2.0, 3.0])
