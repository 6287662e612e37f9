"""Defocus of a thin lens, against figures worked out by hand."""

import math

import pytest

from nir_render.camera.optics.focus import blur_circle_px
from tests.unit.camera.conftest import CameraMaker

# f = 8 mm, f/2: a pupil of 4 mm; pixels of 3.75 µm.
LENS = {"focal_length": "8 mm", "f_number": 2.0, "focus_distance": "3 m"}


@pytest.mark.parametrize(
    ("distance_m", "circle_px"),
    [
        (3.0, 0.0),
        # c = 4 mm · 8 mm · |d − 3 m| / (d · 2.992 m): 32e-6/2.992 = 10.695 µm at infinity.
        (math.inf, 10.69519 / 3.75),
        (1.5, 10.69519 / 3.75),
        (1.0, 2.0 * 10.69519 / 3.75),
        (12.0, 0.75 * 10.69519 / 3.75),
    ],
)
def test_the_circle_of_confusion(camera_with: CameraMaker, distance_m: float, circle_px: float) -> None:
    assert blur_circle_px(camera_with(lens=LENS), distance_m) == pytest.approx(circle_px, rel=1e-6, abs=1e-12)


def test_the_hyperfocal_distance_blurs_half_of_it_as_much_as_infinity(camera_with: CameraMaker) -> None:
    """Focused at H = f²/(N c) + f, what lies at H/2 and at infinity has the circle c."""
    circle_m = 2.0 * 3.75e-6
    hyperfocal_m = 0.008**2 / (2.0 * circle_m) + 0.008
    camera = camera_with(lens={**LENS, "focus_distance": f"{hyperfocal_m!r} m"})
    for distance_m in (0.5 * hyperfocal_m, math.inf):
        assert blur_circle_px(camera, distance_m) == pytest.approx(2.0, rel=1e-9)


def test_heat_moves_the_image(camera_with: CameraMaker) -> None:
    """5 µm/K over 4 K is 20 µm: at the focus c = 20 µm/N · f/v = 10 µm · (1 − f/d) = 9.9733 µm; what is farther, imaged
    32e-6 m²/2.992 m /4 mm · 8 mm = 21.39 µm nearer to the lens, comes into focus where the image has moved as far."""
    warm = camera_with(lens={**LENS, "thermal_focus_shift": "5 um/K"})
    assert blur_circle_px(warm, 3.0) == 0.0
    assert blur_circle_px(warm, 3.0, 302.15) == pytest.approx(10.0 * (1.0 - 0.008 / 3.0) / 3.75, rel=1e-9)
    assert blur_circle_px(warm, 3.0, 294.15) == pytest.approx(10.0 * (1.0 - 0.008 / 3.0) / 3.75, rel=1e-9)
    at_infinity = 298.15 + 0.008**2 / 2.992 / 5e-6
    assert blur_circle_px(warm, math.inf, at_infinity) == pytest.approx(0.0, abs=1e-9)


def test_without_a_focus_all_is_sharp(camera_with: CameraMaker) -> None:
    assert blur_circle_px(camera_with(), 0.1) == 0.0
