"""Flares' apertures: which pixels, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import load_scene
from nir_render.camera.optics.apertures import Aperture, aperture_weights, flare_aperture
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.light.enlarge import enlarge, without_edges
from nir_render.scene.documents.camera import Camera
from tests.paths import SCENES


@pytest.fixture(scope="module")
def camera() -> Camera:
    """1280 × 960, focal length 480 px, σ of the point spread 0.7 px."""
    return load_scene(SCENES / "one_source.yaml").camera("r1.front")[1]


def _towards(camera: Camera, u_px: float, v_px: float) -> NDArray[np.float64]:
    return np.asarray(intrinsics_of(camera).unproject(np.array([u_px, v_px])))


def test_a_point_gets_three_pixels_around_its_place(camera: Camera) -> None:
    """Centred on a pixel: 29 pixels lie within 3 px of it. 3 σ are 2.1 px, less than 3."""
    aperture = flare_aperture(camera, _towards(camera, 700.0, 500.0), 0.0)
    assert aperture is not None
    row, column = aperture.pixels()
    assert row.size == 29
    assert set(zip(row.tolist(), column.tolist(), strict=True)) == {
        (500 + v, 700 + u) for v in range(-3, 4) for u in range(-3, 4) if u * u + v * v <= 9
    }


def test_a_disc_gets_its_radius_and_three_sigma(camera: Camera) -> None:
    """On the axis 0.05 rad are 480 tan 0.05 = 24.02 px; with 2.1 px the area is π 26.12² = 2143 px."""
    aperture = flare_aperture(camera, np.array([0.0, 0.0, 1.0]), 0.05)
    assert aperture is not None
    assert aperture.inside.sum() == pytest.approx(np.pi * 26.12**2, rel=0.005)


def test_off_the_axis_the_image_is_larger(camera: Camera) -> None:
    """At 45° a rectilinear image is stretched by 1/cos² = 2 along the radius."""
    aperture = flare_aperture(camera, np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0), 0.01)
    assert aperture is not None
    assert aperture.columns.stop - aperture.columns.start == pytest.approx(2 * (9.6 + 2.1), abs=1.0)


def test_it_ends_with_the_sensor(camera: Camera) -> None:
    corner = flare_aperture(camera, _towards(camera, -1.0, -1.0), 0.0)
    assert corner is not None
    row, column = corner.pixels()
    assert (row.min(), column.min()) == (0, 0)
    assert row.size == 4  # (0, 0), (0, 1), (1, 0) and (1, 1): √8 px away at most
    assert flare_aperture(camera, _towards(camera, -5.0, 300.0), 0.0) is None
    assert flare_aperture(camera, _towards(camera, 640.0, 966.0), 0.0) is None
    assert flare_aperture(camera, np.array([0.0, 0.0, -1.0]), 0.0) is None


def test_the_sum_is_over_the_disc(camera: Camera) -> None:
    aperture = flare_aperture(camera, _towards(camera, 700.0, 500.0), 0.0)
    assert aperture is not None
    image = np.zeros((960, 1280))
    image[500, 700] = 2.0
    image[503, 703] = 100.0  # in the rectangle, √18 px away
    assert aperture.sum(image) == 2.0


def test_what_blocks_count_in_a_sum_is_how_they_are_enlarged() -> None:
    """The weighted sum over two overlapping discs of an enlarged image, with two pixels rendered one by one."""
    rows, columns, scale = 24, 32, 4
    how = replace(
        without_edges(rows, columns), patch=np.array([10 * columns + 12, 13 * columns + 3], np.int32)
    )
    disc = np.hypot(*np.mgrid[-3:4, -3:4]) <= 3.0
    apertures = [Aperture(slice(8, 15), slice(first, first + 7), disc) for first in (8, 11)]
    rng = np.random.default_rng(4)
    blocks, patch, per_pixel = rng.random((6, 8)), rng.random(2), rng.random((rows, columns))
    image = per_pixel * enlarge(blocks, rows, columns, how, patch)
    of_blocks, of_patch = aperture_weights(apertures, per_pixel, scale, how)
    sums = of_blocks @ blocks.ravel() + of_patch @ patch
    np.testing.assert_allclose(sums, [one.sum(image) for one in apertures])
    # The first patched pixel lies in both discs, the second in none.
    np.testing.assert_array_equal(of_patch.toarray() > 0.0, [[True, False], [True, False]])
    of_blocks, of_patch = aperture_weights([], per_pixel, scale, how)
    assert (of_blocks.shape, of_patch.shape) == ((0, 48), (0, 2))


def test_what_stands_straight_beside_the_camera_has_none(camera: Camera) -> None:
    """At 90° off the axis, to its rounding, the projection is 10¹⁶ pixels away."""
    for direction in ([1.0, 0.0, 1e-17], [0.0, -1.0, 3e-17], [-1.0, 0.0, 0.0]):
        assert flare_aperture(camera, np.array(direction), 0.0047) is None
