"""The likelihood of pixels: what clips, and the logarithms of variances."""

import math

import numpy as np
import pytest
from scipy.special import log_ndtr, ndtr
from scipy.stats import norm

from perception.model.layout import CLIPPED, SEEN, UNUSABLE, View
from perception.model.likelihood.pixels import log_variances
from perception.model.normal import kept_of_clipping, log_upper_tail, of_clipped


def test_what_a_clipped_pixel_tells() -> None:
    """ln Q, φ/Q, how ln Q bends, and what such a pixel keeps of the information: Φ - z φ + φ²/Q."""
    for z in np.linspace(-40.0, 35.0, 1501).tolist():
        mills = math.exp(norm.logpdf(z) - log_ndtr(-z))
        kept = ndtr(z) - z * norm.pdf(z) + mills * norm.pdf(z) if z < 8.0 else 1.0
        assert log_upper_tail(z) == pytest.approx(log_ndtr(-z), rel=1e-8, abs=1e-15)
        told = *of_clipped(z), kept_of_clipping(z)
        if z < 8.0:  # beyond it differences of large numbers are left
            assert told == pytest.approx((mills, mills * (mills - z), kept), rel=1e-6, abs=1e-12)
        assert told[0] == pytest.approx(mills, rel=1e-7, abs=1e-15)


@pytest.mark.parametrize("scale", [1e-140, 1e-3, 1.0, 5e3, 1e140])
def test_logarithms_of_variances_are_those_of_each(scale: float) -> None:
    """Of pixels that are seen alone."""
    variance = scale * np.random.default_rng(5).uniform(0.5, 2.0, 35)
    state = np.full((5, 7), SEEN, dtype=np.uint8)
    state[0, 2], state[3, 3], state[4, 6] = CLIPPED, UNUSABLE, CLIPPED
    nothing_e = np.zeros((5, 7))
    told = log_variances(View(0, 0, nothing_e, state, 1.0, nothing_e), variance)
    assert told == pytest.approx(float(np.log(variance[state.ravel() == SEEN]).sum()), rel=1e-12)
