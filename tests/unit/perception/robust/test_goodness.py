"""What fits leave over: its loops over windows against SciPy's."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, correlate1d

from perception.model.layout import CLIPPED, SEEN, UNUSABLE
from perception.robust.goodness import DISC_PX, MODEL_ERROR, REACHED_SIGMAS, left_over
from tests.unit.perception.simulation import random

Array = NDArray[np.float64]

FLOOR_E2, PRNU, PSF_SIGMA_PX = 40.0, 0.01, 0.7


def _window(rows: int, columns: int, key: int) -> tuple[Array, NDArray[np.uint8], Array, Array]:
    """Return what is seen, states, λ and the flares' part of it: a flare in a corner, one pixel too bright."""
    generator, (row, column) = random(111, key), np.indices((rows, columns))
    flares_e = 4000.0 * np.exp(-0.5 * ((row - 0.3 * rows) ** 2 + (column - 0.4 * columns) ** 2) / 1.3**2)
    expected_e = flares_e + 12.0
    image_e = generator.poisson(expected_e) + generator.normal(0.0, math.sqrt(FLOOR_E2), expected_e.shape)
    image_e[rows // 2, columns // 2] += 300.0
    state = np.full(image_e.shape, SEEN, dtype=np.uint8)
    state[generator.random(state.shape) < 0.1] = UNUSABLE
    state[(expected_e > 3500.0) & (state == SEEN)] = CLIPPED
    image_e[state == UNUSABLE] = np.nan
    return image_e, state, expected_e, flares_e


@pytest.mark.parametrize(("rows", "columns"), [(31, 31), (9, 40), (17, 8), (3, 3), (1, 6)])
@pytest.mark.parametrize("key", range(3))
def test_what_is_left_over(rows: int, columns: int, key: int) -> None:
    """χ², what lies around the flare, and the greatest residual matched to a point, with its place."""
    image_e, state, expected_e, flares_e = _window(rows, columns, key)
    left = left_over(image_e, state, expected_e, flares_e, FLOOR_E2, PRNU, PSF_SIGMA_PX)
    noise = expected_e + (PRNU * expected_e) ** 2 + FLOOR_E2
    variance = noise + (MODEL_ERROR * flares_e) ** 2
    residual = np.where(state == UNUSABLE, 0.0, image_e - expected_e)
    as_expected = (state == CLIPPED) & (residual < 0.0)
    residual[as_expected] = 0.0
    counts = (state != UNUSABLE) & (flares_e**2 > noise) & ~as_expected
    assert left.pixels == counts.sum()
    assert left.chi2 == pytest.approx((residual**2 / variance)[counts].sum())
    assert left.noise_chi2 == pytest.approx((residual**2 / noise)[counts].sum())
    reached = binary_dilation(flares_e > REACHED_SIGMAS * np.sqrt(noise), iterations=DISC_PX)
    around = ~reached & (state == SEEN)
    assert left.around_pixels == around.sum()
    assert left.around_chi2 == pytest.approx((residual**2 / noise)[around].sum())
    smooth_px = math.hypot(PSF_SIGMA_PX, math.sqrt(1.0 / 12.0))
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / smooth_px) ** 2)
    weight = np.where(state == UNUSABLE, 0.0, 1.0 / variance)
    matched, power = (
        correlate1d(correlate1d(each, of, axis=0, mode="constant"), of, axis=1, mode="constant")
        for each, of in ((residual * weight, kernel), (weight, kernel**2))
    )
    known = power > 1e-3 * power.max()
    sigmas = np.where(known, matched / np.sqrt(np.where(known, power, 1.0)), 0.0)
    assert left.peak_sigmas == pytest.approx(max(sigmas.max(), 0.0))
    if sigmas.max() > 0.0:
        assert left.peak == divmod(int(sigmas.argmax()), columns)
