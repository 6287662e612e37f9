"""The likelihood of pixels: what clips, and the logarithms of variances."""

import math

import numpy as np
import pytest
from scipy.special import log_ndtr, ndtr
from scipy.stats import norm

from perception.model.layout import CLIPPED, SEEN, UNUSABLE, View, even
from perception.model.likelihood.pixels import log_variances, objective, slopes
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


@pytest.mark.parametrize("of_average", [False, True])
def test_what_each_pixel_tells(of_average: bool) -> None:
    """Of one unknown, that each pixel's light is in proportion to: by SciPy's Φ, as far as 40 σ from clipping."""
    clip_e, count = 3000.0, 400
    expected = np.linspace(100.0, 8000.0, count)
    variance = expected + 50.0
    image = np.minimum(expected + 3.0 * np.sqrt(variance) * np.sin(np.arange(count)), clip_e)
    state = np.where(image < clip_e, SEEN, CLIPPED).astype(np.uint8)
    state[::7], image[::7] = UNUSABLE, np.nan
    view = View(0, 0, image.reshape(20, 20), state.reshape(20, 20), 50.0, np.zeros((20, 20)))
    jacobian, precision, values = np.ones((1, count)), np.array([[0.1]]), np.array([2.0])
    gradient, information = np.empty(1), np.empty((1, 1))
    slopes(
        view, even(count), 1, values, expected, jacobian, variance, precision, clip_e, of_average, gradient,
        information,
    )  # fmt: skip
    z = (clip_e - expected) / np.sqrt(variance)
    mills = np.exp(norm.logpdf(z) - log_ndtr(-z))
    seen, clipped = state == SEEN, state == CLIPPED
    if of_average:
        near = np.clip(z, -30.0, 8.0)
        kept = (
            ndtr(near) - near * norm.pdf(near) + norm.pdf(near) * np.exp(norm.logpdf(near) - log_ndtr(-near))
        )
        told = (kept / variance)[seen | clipped].sum()
    else:
        told = (1.0 / variance)[seen].sum() + (mills * (mills - z) / variance)[clipped].sum()
        pull = ((image - expected) / variance)[seen].sum() + (mills / np.sqrt(variance))[clipped].sum()
        assert gradient[0] == pytest.approx(pull - 0.1 * 2.0, rel=1e-7)
    assert information[0, 0] == pytest.approx(told + 0.1, rel=1e-7)
    chi2 = ((image - expected) ** 2 / variance)[seen].sum() - 2.0 * log_ndtr(-z[clipped]).sum() + 0.1 * 4.0
    assert objective(view, values, expected, variance, precision, clip_e) == pytest.approx(chi2, rel=1e-9)
