"""The compiled Gaussian blur, against SciPy's."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from nir_render.camera.optics.gaussian import gaussian_blur
from nir_render.randomness import generator


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (37, 41), (96, 128)])
@pytest.mark.parametrize("sigma_px", [0.05, 0.3, 0.7, 1.9, 6.0])
def test_it_is_scipys_to_the_bit(shape: tuple[int, int], sigma_px: float) -> None:
    image = generator(1, "test", "blur", 0).lognormal(0.0, 3.0, shape)
    wanted = gaussian_filter(image, sigma_px, mode="nearest", truncate=6.0)
    np.testing.assert_array_equal(gaussian_blur(image, sigma_px, 6.0), wanted)
    np.testing.assert_array_equal(gaussian_blur(image.T, sigma_px, 6.0), gaussian_filter(
        image.T, sigma_px, mode="nearest", truncate=6.0
    ))  # fmt: skip
