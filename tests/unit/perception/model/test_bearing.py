import numpy as np
import pytest

from perception.model.bearing import bearing_body, direction_camera, field_angle_rad
from tests.unit.perception.simulation import calibration

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_axes_of_a_camera_that_looks_forward() -> None:
    camera = calibration(rotation_body_camera=FORWARD)
    points = [[639.5, 479.5], [639.5 + 480.0, 479.5], [639.5, 479.5 - 480.0]]
    expected = np.array([[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, 0.0, 1.0]])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(bearing_body(points, camera), expected, atol=1e-15)


def test_unequal_focal_lengths() -> None:
    camera = calibration(fx_px=400.0, fy_px=500.0)
    direction = direction_camera([[639.5 + 100.0, 479.5 + 250.0]], camera)[0]
    np.testing.assert_allclose(direction / direction[2], [0.25, 0.5, 1.0], rtol=1e-14)
    assert field_angle_rad([[639.5 + 100.0, 479.5 + 250.0]], camera)[0] == pytest.approx(
        np.arctan(np.hypot(0.25, 0.5)), rel=1e-14
    )


def test_wrong_shape() -> None:
    with pytest.raises(ValueError, match=r"\(n, 2\)"):
        direction_camera([1.0, 2.0], calibration())
