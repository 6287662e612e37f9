import numpy as np
import pytest

from perception.model.discs import nodes
from perception.model.flare import PixelBox, flare_image, image_radius_px
from perception.model.ranging import angular_radius_rad
from tests.unit.perception.simulation import calibration, expected_e

SMALL: dict[str, int] = {"width_px": 90, "height_px": 80}


@pytest.mark.parametrize(
    ("u_px", "v_px", "range_m", "cx_px", "cy_px"),
    [
        (44.3, 39.8, 10.0, 44.5, 39.5),  # a point, almost
        (44.3, 39.8, 1.0, 44.5, 39.5),  # a disc of 4.8 px
        (44.3, 39.8, 0.3, 44.5, 39.5),  # of 16 px
        (40.2, 35.9, 0.5, -550.0, -400.0),  # far off axis: an ellipse of 9.6 × 22 px
    ],
)
def test_against_brute_force(u_px: float, v_px: float, range_m: float, cx_px: float, cy_px: float) -> None:
    """The image agrees with a fine sampling of the sphere's outline, blurred, to 2e-4 of the peak.

    About 1e-4 of that is the sampled rim's own error; the quadrature is judged on its own below.
    """
    camera = calibration(**SMALL, cx_px=cx_px, cy_px=cy_px)
    window = PixelBox(0, 0, 80, 90)
    image = flare_image(u_px, v_px, float(angular_radius_rad(range_m, 0.01)), window, camera).fraction
    brute = expected_e(camera, [(u_px, v_px, range_m)], 1e-3)
    brute /= brute.sum()
    assert float(np.abs(image - brute).max() / brute.max()) < 2e-4


def test_point_source_is_the_integrated_gaussian() -> None:
    """Sampled 64 × 64 per pixel: agreement to 1e-4 of the peak, asked for by the model's docstring."""
    camera = calibration(**SMALL, cx_px=44.5, cy_px=39.5)
    fine = 64
    grid = (np.arange(90 * fine) + 0.5) / fine - 0.5
    row = np.exp(-0.5 * ((grid - 44.3) / 0.7) ** 2).reshape(90, fine).sum(axis=1)
    column = np.exp(-0.5 * ((grid[: 80 * fine] - 39.8) / 0.7) ** 2).reshape(80, fine).sum(axis=1)
    brute = np.outer(column / column.sum(), row / row.sum())
    image = flare_image(44.3, 39.8, 0.0, PixelBox(0, 0, 80, 90), camera).fraction
    assert float(np.abs(image - brute).max() / brute.max()) < 1e-4


@pytest.mark.parametrize("range_m", [10.0, 1.0, 0.3])
def test_three_times_the_nodes_change_nothing(range_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = calibration()
    radius = float(angular_radius_rad(range_m, 0.01))
    window = PixelBox.around(
        1100.3, 800.7, float(image_radius_px(1100.3, 800.7, radius, camera)) + 6.0, camera
    )
    image = flare_image(1100.3, 800.7, radius, window, camera).fraction
    nodes._cap_rule.cache_clear()
    for name in ("_RINGS_BASE", "_RINGS_SLOPE", "_AROUND_BASE", "_AROUND_SLOPE"):
        monkeypatch.setattr(nodes, name, 3.0 * getattr(nodes, name))
    dense = flare_image(1100.3, 800.7, radius, window, camera).fraction
    nodes._cap_rule.cache_clear()
    assert float(np.abs(image - dense).max() / dense.max()) < 1e-4


def test_flux_centroid_is_the_projection_of_the_centre() -> None:
    """At 45°, 1 m, r = 25 mm: the ellipse's middle is off by 0.6 px, the flux centroid by < 1e-4 px."""
    camera = calibration(source_radius_m=0.025)
    u_px, v_px = 639.5 + 480.0, 479.5
    radius = float(angular_radius_rad(1.0, 0.025))
    window = PixelBox.around(u_px, v_px, 40.0, camera)
    image = flare_image(u_px, v_px, radius, window, camera).fraction
    columns = np.arange(window.left, window.left + window.width)
    assert image.sum() == pytest.approx(1.0, abs=1e-9)
    assert (image.sum(axis=0) @ columns) == pytest.approx(u_px, abs=1e-4)
    # The outline's middle, from the exact field angles of its ends:
    ends = 639.5 + 480.0 * np.tan(np.pi / 4 + np.array([-radius, radius]))
    assert ends.mean() - u_px == pytest.approx(0.6, abs=0.01)


def test_a_response_that_falls_outward_pulls_the_centroid_inward() -> None:
    """For response 1 - a (θ - θ0) the shift is -a/4 · (radius in angle)² · dx/dθ, to first order."""
    a = 4.0
    theta = np.linspace(0.0, 1.0, 2001)
    camera = calibration(response_angle_rad=theta, response_relative=1.0 - a * (theta - np.pi / 6))
    u_px = 639.5 + 480.0 * np.tan(np.pi / 6)
    radius = float(angular_radius_rad(0.5, 0.01))
    window = PixelBox.around(u_px, 479.5, 40.0, camera)
    image = flare_image(u_px, 479.5, radius, window, camera).fraction
    centroid = image.sum(axis=0) @ np.arange(window.left, window.left + window.width) / image.sum()
    expected = -a / 4.0 * radius**2 * 480.0 / np.cos(np.pi / 6) ** 2
    assert centroid - u_px == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("range_m", [10.0, 0.5])
def test_derivatives(range_m: float) -> None:
    """They are those of the image moved as it is: near the axis, where it does not change its shape."""
    camera = calibration()
    radius, step = float(angular_radius_rad(range_m, 0.01)), 1e-4
    window = PixelBox.around(639.8, 479.1, 16.0, camera)
    image = flare_image(639.8, 479.1, radius, window, camera)
    right, left = (flare_image(639.8 + s, 479.1, radius, window, camera).fraction for s in (step, -step))
    below, above = (flare_image(639.8, 479.1 + s, radius, window, camera).fraction for s in (step, -step))
    scale = np.abs(image.d_du).max()
    np.testing.assert_allclose(image.d_du, (right - left) / (2 * step), atol=1e-3 * scale)
    np.testing.assert_allclose(image.d_dv, (below - above) / (2 * step), atol=1e-3 * scale)


def test_window_stays_on_the_sensor() -> None:
    camera = calibration()
    assert PixelBox.around(0.2, 958.9, 2.0, camera) == PixelBox(957, 0, 3, 3)
    assert PixelBox.around(-50.0, 10.0, 2.0, camera).width == 0
    assert image_radius_px(639.5, 479.5, 0.01, camera) == pytest.approx(4.8, rel=1e-3)


def test_a_sphere_beside_the_camera_is_refused() -> None:
    with pytest.raises(ValueError, match="90°"):
        flare_image(639.5 + 4800.0, 479.5, 0.2, PixelBox(0, 0, 5, 5), calibration())
