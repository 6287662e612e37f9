import math

import numpy as np
import pytest

from perception.calibrate import regress_paper_range_constant
from tests.unit.perception.simulation import random


def test_exact_line() -> None:
    range_m = np.array([0.5, 1.0, 2.0, 4.0])
    line = regress_paper_range_constant(64 + 1e-3 * (3e5 / range_m**2 + 700.0), 64.0, 1e-3, range_m)
    assert line.slope_dn_m2_per_s == pytest.approx(3e5, rel=1e-12)
    assert line.intercept_dn_per_s == pytest.approx(700.0, rel=1e-9)


def test_standard_errors_are_those_of_repetition() -> None:
    rng = random(5)
    range_m = np.linspace(1.0, 5.0, 12)
    lines = [
        regress_paper_range_constant(
            64.0 + 1e-3 * 3e5 / range_m**2 + rng.normal(0.0, 2.0, 12), np.full(12, 64.0), 1e-3, range_m
        )
        for _ in range(400)
    ]
    for value, sigma in (
        ("slope_dn_m2_per_s", "slope_sigma_dn_m2_per_s"),
        ("intercept_dn_per_s", "intercept_sigma_dn_per_s"),
    ):
        scatter = np.std([getattr(line, value) for line in lines], ddof=1)
        claim = np.sqrt(np.mean([getattr(line, sigma) ** 2 for line in lines]))
        assert scatter == pytest.approx(claim, rel=4 / math.sqrt(800))


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="two different ranges"):
        regress_paper_range_constant([1.0, 2.0], 0.0, 1e-3, [2.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        regress_paper_range_constant([1.0, math.nan], 0.0, 1e-3, [1.0, 2.0])
    with pytest.raises(ValueError, match="positive"):
        regress_paper_range_constant([1.0, 2.0], 0.0, 1e-3, [0.0, 2.0])
    assert math.isnan(regress_paper_range_constant([3.0, 2.0], 0.0, 1e-3, [1.0, 2.0]).slope_sigma_dn_m2_per_s)
