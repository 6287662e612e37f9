"""Small sources on pixels: energy, place, and agreement with an independent model of the same image."""

import math

import numpy as np
import pytest

from nir_render.camera.optics.lens import Intrinsics
from nir_render.camera.optics.otf import Core
from nir_render.camera.optics.psf import Window, source_window
from nir_render.geometry import sunflower
from perception.model.flare import PixelBox, flare_image
from perception.types import Calibration

LENS = Intrinsics(640, 480, 480.0, 480.0, 319.5, 239.5)


def _even(cosine: np.ndarray) -> np.ndarray:
    return np.asarray(1.0e5 * cosine)


def _direction(u_px: float, v_px: float) -> np.ndarray:
    return LENS.unproject(np.array([u_px, v_px]))


def _frame(window: Window) -> np.ndarray:
    image = np.zeros((LENS.height_px, LENS.width_px))
    window.add_into(image)
    return image


def _centroid(image: np.ndarray) -> tuple[float, float]:
    rows, columns = np.indices(image.shape)
    return float((columns * image).sum() / image.sum()), float((rows * image).sum() / image.sum())


PLACES = [(319.5, 239.5), (320.0, 240.0), (319.87, 239.61), (100.3, 77.7), (600.25, 440.75)]


@pytest.mark.parametrize("angular_radius_rad", [0.0, 0.001, 0.01, 0.03])
@pytest.mark.parametrize("sigma_px", [0.3, 0.7, 2.0])
@pytest.mark.parametrize("place", PLACES)
def test_energy_and_centroid_are_those_of_the_projection(
    place: tuple[float, float], sigma_px: float, angular_radius_rad: float
) -> None:
    """Weighted cos θ dΩ, a sphere's flux is Φ cos θ of its centre, and its centroid is its centre's projection.

    For a cone of half angle α the mean of cos ψ over its solid angle is (1 + cos α)/2: the flux carries it.
    Pixels sample the blurred image, which moves a centroid by up to exp(−2π²σ²)/π: 2e-5 px at σ = 0.7.
    """
    direction = _direction(*place)
    image = _frame(source_window(LENS, Core(sigma_px), direction, angular_radius_rad, _even))
    expected = 1.0e5 * direction[2] * 0.5 * (1.0 + np.cos(angular_radius_rad))
    assert image.sum() == pytest.approx(expected, rel=1e-6)
    assert _centroid(image) == pytest.approx(place, abs=1e-7 + np.exp(-2.0 * np.pi**2 * sigma_px**2) / np.pi)


@pytest.mark.parametrize("place", [(319.87, 239.61), (600.25, 440.75)])
def test_a_partly_hidden_source_is_where_its_visible_part_is(place: tuple[float, float]) -> None:
    """Of a disc of 9.6 px radius the right half, 2048 of 4096 rays: by its rays, and by their mean place.

    Each ray has an equal share of the solid angle and the weight cos θ; off the axis by 4r/(3π), within what the
    rays' own unevenness leaves, 2 · 1.5/4096^(3/4) of it.
    """
    direction = _direction(*place)
    rays = sunflower(direction, 0.02, 4096)
    pixels = LENS.project(rays)
    right = pixels[:, 0] > place[0]
    assert right.mean() == pytest.approx(0.5, abs=0.01)
    image = _frame(source_window(LENS, Core(0.7), direction, 0.02, _even, rays[right]))
    weight = rays[right, 2]
    assert image.sum() == pytest.approx(1.0e5 * weight.mean(), rel=1e-9)
    assert _centroid(image) == pytest.approx(
        tuple(np.average(pixels[right], axis=0, weights=weight)), abs=5e-5
    )
    if place[0] < 400.0:
        radius_px = 480.0 * np.tan(0.02)
        assert _centroid(image)[0] - place[0] == pytest.approx(4.0 * radius_px / (3.0 * np.pi), rel=0.006)
    whole = _frame(source_window(LENS, Core(0.7), direction, 0.02, _even, rays))
    exact = _frame(source_window(LENS, Core(0.7), direction, 0.02, _even))
    # At the rim the rays' grain shows: half a ray's power, of which a pixel takes 0.2756 at most.
    np.testing.assert_allclose(whole / whole.sum(), exact / exact.sum(), atol=0.5 / 4096 * 0.2756)


def test_a_point_is_a_gaussian_integrated_over_pixels() -> None:
    """σ = 0.7 px on a pixel's centre: that pixel holds erf(0.5/(0.7 √2))² = 0.27557 of the light."""
    image = _frame(source_window(LENS, Core(0.7), _direction(100.0, 80.0), 0.0, np.ones_like))
    assert image[80, 100] == pytest.approx(0.275572, abs=2e-6)
    assert image[80, 101] == pytest.approx(0.116257, abs=2e-6)


def test_an_image_is_cut_at_the_sensor_edge_where_the_light_is() -> None:
    """A point on the outer edge of the corner pixel leaves a quarter of its light on the sensor."""
    image = _frame(source_window(LENS, Core(0.7), _direction(-0.5, -0.5), 0.0, np.ones_like))
    assert image.sum() == pytest.approx(0.25, abs=1e-6)
    assert source_window(LENS, Core(0.7), _direction(-30.0, 50.0), 0.0, np.ones_like).values.size == 0
    assert source_window(LENS, Core(0.7), np.array([0.0, 0.0, -1.0]), 0.0, np.ones_like).values.size == 0


@pytest.mark.parametrize("angular_radius_rad", [0.0, 0.0005, 0.01, 0.04])
@pytest.mark.parametrize("place", PLACES)
def test_two_independent_models_of_the_image_agree(
    place: tuple[float, float], angular_radius_rad: float
) -> None:
    """The model that perception fits was written apart from this one; they agree within 1e-5 of the flux."""
    calibration = Calibration(
        camera="r.c", width_px=640, height_px=480, fx_px=480.0, fy_px=480.0, cx_px=319.5, cy_px=239.5,
        rotation_body_camera=np.eye(3), position_body_m=np.zeros(3), system_gain_dn_per_e=1.0, read_noise_e=1.0,
        black_level_dn=0.0, saturation_dn=4095, bit_depth=12, psf_sigma_px=0.7,
        response_angle_rad=np.array([0.0, 1.5]), response_relative=np.ones(2), range_constant_dn_m2_per_s=1.0,
        range_constant_paper_dn_m2_per_s=1.0, source_radius_m=0.01, wavelength_m=940e-9,
    )  # fmt: skip
    ours = source_window(LENS, Core(0.7), _direction(*place), angular_radius_rad, _even)
    window = PixelBox(ours.row, ours.column, *ours.values.shape)
    theirs = flare_image(*place, angular_radius_rad, window, calibration)
    np.testing.assert_allclose(ours.values / ours.values.sum(), theirs.fraction, atol=1e-5)


@pytest.mark.parametrize("beside_px", [40.0, 200.0])
def test_what_is_far_beyond_a_corner_brings_nothing_and_keeps_its_total(beside_px: float) -> None:
    """A point beyond the right edge by less and by more than the margin; and a disc across the lens's plane.

    By less, the window is made and empty; by more, it is not made: light and total are the same.
    """
    lens = Intrinsics(1280, 960, 480.0, 480.0, 639.5, 479.5)
    towards = np.array([(1279.5 + beside_px - 639.5) / 480.0, 0.0, 1.0])
    core = Core(sigma_px=0.7)
    window = source_window(lens, core, towards / np.linalg.norm(towards), 0.0, np.ones_like)
    assert window.values.sum() == 0.0
    assert window.total == 1.0
    across = np.array([math.cos(0.01), 0.0, math.sin(0.01)])
    disc = source_window(lens, core, across, 0.05, lambda cosine: cosine)
    assert disc.values.size == 0
    # Of a cap of 0.05 rad, whose middle is 0.01 rad before the plane, the part in front: its mean cosine is
    # that of a flat disc cut by a line 0.2 radii from its middle.
    h = 0.01 / 0.05
    front = (h * (math.pi / 2 + math.asin(h)) + math.sqrt(1 - h * h) * (2 + h * h) / 3.0) / math.pi * 0.05
    assert disc.total == pytest.approx(front, rel=2e-2)
