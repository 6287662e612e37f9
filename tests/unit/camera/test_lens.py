import numpy as np
import pytest

from nir_render.camera.lens import aperture_area_m2, intrinsics_of
from tests.unit.camera.conftest import CameraMaker


def test_the_papers_camera_sees_106_by_90_degrees(camera_with: CameraMaker) -> None:
    lens = intrinsics_of(camera_with())
    assert (lens.fx_px, lens.cx_px, lens.cy_px) == pytest.approx((480.0, 639.5, 479.5))
    assert 2 * np.degrees(np.arctan(640 / lens.fx_px)) == pytest.approx(106.3, abs=0.05)
    assert 2 * np.degrees(np.arctan(480 / lens.fy_px)) == pytest.approx(90.0, abs=1e-9)
    assert np.degrees(lens.corner_angle_rad) == pytest.approx(np.degrees(np.arctan(800 / 480)), abs=1e-9)


def test_projection_and_its_inverse(camera_with: CameraMaker) -> None:
    lens = intrinsics_of(camera_with())
    pixel = lens.project(np.array([0.5, -0.25, 2.0]))
    np.testing.assert_allclose(pixel, [639.5 + 120.0, 479.5 - 60.0])
    back = lens.unproject(pixel)
    np.testing.assert_allclose(back, np.array([0.5, -0.25, 2.0]) / np.linalg.norm([0.5, -0.25, 2.0]))
    assert np.isnan(lens.project(np.array([0.0, 0.0, -1.0]))).all()


@pytest.mark.parametrize(
    ("u_px", "inside"), [(-0.5, True), (-0.51, False), (1279.5, True), (1279.51, False), (np.nan, False)]
)
def test_the_sensor_ends_at_the_outer_edges_of_its_pixels(
    camera_with: CameraMaker, u_px: float, inside: bool
) -> None:
    assert intrinsics_of(camera_with()).contains(u_px, 0.0) is inside


def test_the_aperture_of_f_2(camera_with: CameraMaker) -> None:
    """A pupil of 0.9 mm: π/4 (0.9 mm)² = 0.6362 mm²."""
    assert aperture_area_m2(camera_with()) == pytest.approx(0.63617e-6, rel=1e-5)
