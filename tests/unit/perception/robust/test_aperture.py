import math

import numpy as np
import pytest

from perception.model.flare import PixelBox, flare_image
from perception.robust.large.aperture import aperture_flux
from tests.unit.perception.simulation import calibration, random

TRIALS = 400


def test_aperture_counts_all_of_a_noiseless_flare() -> None:
    camera = calibration()
    window = PixelBox.around(300.3, 400.6, 20.0, camera)
    image = 5e4 * flare_image(300.3, 400.6, 0.002, window, camera).fraction + 7.0
    measured = aperture_flux(image, 300.3 - window.left, 400.6 - window.top, 6.0, 8.0, 14.0)
    assert measured.flux == pytest.approx(5e4, rel=1e-5)
    assert measured.background == pytest.approx(7.0, abs=1e-6)
    assert measured.flux_sigma == pytest.approx(math.sqrt(5e4), rel=1e-3)


def test_aperture_sigma_is_that_of_repeated_measurements() -> None:
    rng = random(11)
    camera = calibration()
    window = PixelBox(380, 280, 41, 41)
    mean = 3e3 * flare_image(300.0, 400.0, 0.0, window, camera).fraction + 30.0
    found = [
        aperture_flux(rng.poisson(mean) + rng.normal(0, 10.0, mean.shape), 20.0, 20.0, 5.0, 6.0, 9.0)
        for _ in range(TRIALS)
    ]
    scatter = np.std([f.flux for f in found], ddof=1)
    assert scatter == pytest.approx(np.mean([f.flux_sigma for f in found]), rel=4 / math.sqrt(2 * TRIALS))


def test_aperture_radii() -> None:
    with pytest.raises(ValueError, match="ring_outer_px"):
        aperture_flux(np.zeros((5, 5)), 2.0, 2.0, 3.0, 2.0, 4.0)
