import numpy as np
import pytest

from nir_render import InputError
from nir_render.spectra.curve import Curve, constant_curve
from nir_render.spectra.illuminants import gaussian_spectrum


@pytest.fixture
def triangle() -> Curve:
    return Curve(np.array([900e-9, 940e-9, 1000e-9]), np.array([0.0, 2.0, 0.0]), "triangle")


def test_a_curve_is_linear_between_its_points(triangle: Curve) -> None:
    np.testing.assert_allclose(triangle([920e-9, 940e-9, 970e-9]), [1.0, 2.0, 1.0])
    assert triangle.integral() == pytest.approx(100e-9)
    assert triangle.normalised().integral() == pytest.approx(1.0)


@pytest.mark.parametrize("wavelength_m", [899e-9, 1001e-9])
def test_a_curve_is_never_extrapolated(triangle: Curve, wavelength_m: float) -> None:
    with pytest.raises(InputError, match="triangle covers 900 to 1000 nm, but is needed"):
        triangle([940e-9, wavelength_m])


def test_a_dark_spectrum_cannot_be_normalised() -> None:
    with pytest.raises(InputError, match="nothing is zero everywhere"):
        constant_curve(0.0, 900e-9, 1000e-9, "nothing").normalised()


def test_a_gaussian_led_has_the_centroid_and_width_of_its_data_sheet() -> None:
    led = gaussian_spectrum(940e-9, 42e-9, "LED")
    assert led.integral() == pytest.approx(1.0, rel=1e-6)
    centroid_m = np.trapezoid(led.value * led.wavelength_m, led.wavelength_m)
    assert centroid_m == pytest.approx(940e-9, rel=1e-9)
    above_half = led.wavelength_m[led.value >= 0.5 * led.value.max()]
    assert above_half[-1] - above_half[0] == pytest.approx(42e-9, abs=2 * 0.21e-9)
