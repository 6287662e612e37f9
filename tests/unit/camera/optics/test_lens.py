"""The lens: OpenCV as the judge of its models, closed forms as the judge of how much a pixel sees."""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from nir_render.camera.optics.lens import (
    Intrinsics,
    aperture_area_m2,
    corner_directions,
    field_of,
    intrinsics_of,
)
from nir_render.geometry import cone_directions, cone_versine
from perception.model.lens import Distortion
from tests.unit.camera.conftest import CameraMaker

Array = NDArray[np.float64]

WIDE = {"focal_length": "1.8 mm"}  # 480 px: the corner of 1280 × 960 is 59° off the axis
LONG = {"focal_length": "6 mm"}  # 1600 px: 27°
# Barrels, pincushions and moustaches, with and without tangential terms.
LENSES: dict[str, dict[str, Any]] = {
    "rectilinear": {**WIDE},
    "barrel of 4": {**LONG, "model": "brown_conrady", "distortion": [-0.35, 0.15, 1e-3, -7e-4]},
    "pincushion of 5": {**LONG, "model": "brown_conrady", "distortion": [0.2, 0.1, -2e-3, 1e-3, 0.05]},
    "wide barrel of 5": {**WIDE, "model": "brown_conrady", "distortion": [-0.1, 0.012, 2e-4, 3e-4, -5e-4]},
    "rational of 8": {
        **WIDE, "model": "brown_conrady", "distortion": [0.5, 0.08, 4e-4, -2e-4, 2e-3, 0.8, 0.2, 0.012],
        "principal_point": "[652.3, 471.8] px",
    },
    "equidistant": {"focal_length": "2 mm", "model": "fisheye", "distortion": [0, 0, 0, 0]},
    "fisheye": {
        "focal_length": "2.2 mm", "model": "fisheye", "distortion": [-0.03, 0.005, -0.004, 4e-4],
        "principal_point": "[630, 488.5] px",
    },
    "fisheye of 78°": {"focal_length": "2.4 mm", "model": "fisheye", "distortion": [0.05, -0.02, 0.01, -0.002]},
}  # fmt: skip
BENT = [name for name in LENSES if name != "rectilinear"]
# Its image circle, 300 π/2 = 471 px, lies on the sensor.
CIRCLE = {"focal_length": f"{300 * 3.75e-3} mm", "model": "fisheye", "distortion": [0, 0, 0, 0]}


def sensor_grid(lens: Intrinsics) -> Array:
    """Pixels (u, v) over the whole sensor out to its corners, shape (n, 2)."""
    u, v = np.meshgrid(
        np.linspace(-0.5, lens.width_px - 0.5, 41), np.linspace(-0.5, lens.height_px - 0.5, 31)
    )
    return np.stack([u.ravel(), v.ravel()], axis=1)


def cv2_project(lens: Intrinsics, direction: Array) -> Array:
    """OpenCV's pixels of directions, shape (n, 2)."""
    none, matrix = np.zeros(3), _matrix(lens)
    numbers = np.array(lens.distortion.coefficients or (0.0,) * 4)
    if lens.distortion.model == "fisheye":
        return np.asarray(cv2.fisheye.projectPoints(direction[:, None], none, none, matrix, numbers)[0][:, 0])
    return np.asarray(cv2.projectPoints(direction[:, None], none, none, matrix, numbers)[0][:, 0])


def cv2_undistort(lens: Intrinsics, pixel: Array) -> Array:
    """OpenCV's directions of pixels, of depth 1, shape (n, 3)."""
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    inverse = cv2.fisheye.undistortPoints if lens.distortion.model == "fisheye" else cv2.undistortPoints
    numbers = np.array(lens.distortion.coefficients or (0.0,) * 4)
    flat = inverse(pixel[:, None], _matrix(lens), numbers, criteria=criteria)[:, 0]
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)


def _matrix(lens: Intrinsics) -> Array:
    return np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])


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


@pytest.mark.parametrize("name", LENSES)
def test_opencv_projects_what_we_unproject(camera_with: CameraMaker, name: str) -> None:
    """Pixels all over the sensor become directions, which cv2.projectPoints takes back to 1e-9 px (asked: 0.01)."""
    lens = intrinsics_of(camera_with(lens=LENSES[name]))
    pixel = sensor_grid(lens)
    direction = lens.unproject(pixel)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(cv2_project(lens, direction), pixel, atol=1e-9)
    np.testing.assert_allclose(lens.project(3.7 * direction), pixel, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_opencv_undistorts_what_we_project(camera_with: CameraMaker, name: str) -> None:
    """cv2.undistortPoints turns pixels all over the sensor into directions, which we take back to 1e-6 px."""
    lens = intrinsics_of(camera_with(lens=LENSES[name]))
    pixel = sensor_grid(lens)
    np.testing.assert_allclose(lens.project(cv2_undistort(lens, pixel)), pixel, atol=1e-6)


def test_the_round_trip_holds_right_up_to_the_fold(camera_with: CameraMaker) -> None:
    """k1 = −1.2 folds at r = 1/√3.6, 562 px of 1600 px · r g: the corner at 800 px needs f = 2280 px or more."""
    lens = intrinsics_of(
        camera_with(lens={"focal_length": "8.6 mm", "model": "brown_conrady", "distortion": [-1.2, 0, 0, 0]})
    )
    pixel = sensor_grid(lens)
    assert np.abs(lens.project(cv2_undistort(lens, pixel)) - pixel).max() < 0.01
    np.testing.assert_allclose(cv2_project(lens, lens.unproject(pixel)), pixel, atol=1e-9)


@pytest.mark.parametrize(
    ("lens", "fold_deg"),
    [
        # d(r − 0.3 r³)/dr = 0 at r = 1/√0.9.
        ({**WIDE, "model": "brown_conrady", "distortion": [-0.3, 0, 0, 0]}, np.degrees(np.arctan(0.9**-0.5))),
        # (1 + 0.1 r²)/(1 + r²) turns back where (1 + 0.1 s)(1 + s) = 1.8 s: at s = (0.7 − 0.3)/0.2 = 2.
        ({**WIDE, "model": "brown_conrady", "distortion": [0.1, 0, 0, 0, 0, 1, 0, 0]}, np.degrees(np.arctan(2**0.5))),
        # d(θ − 0.5 θ³)/dθ = 0 at θ = √(2/3).
        ({**WIDE, "model": "fisheye", "distortion": [-0.5, 0, 0, 0]}, np.degrees((2 / 3) ** 0.5)),
    ],
)  # fmt: skip
def test_coefficients_that_fold_within_the_sensor_are_refused(
    camera_with: CameraMaker, lens: dict[str, Any], fold_deg: float
) -> None:
    fold = rf"lens\.distortion: the image folds at a field angle of {fold_deg:.1f} deg, .*give coefficients"
    with pytest.raises(ValidationError, match=fold):
        camera_with(lens=lens)
    model = Distortion(lens["model"], tuple(float(one) for one in lens["distortion"]))
    assert np.degrees(model.fold_rad) == pytest.approx(fold_deg, abs=1e-6)
    # The same coefficients serve a sensor that ends before the fold.
    assert intrinsics_of(camera_with(lens={**lens, "focal_length": "9 mm"})).corner_angle_rad < 0.5


def test_a_pole_is_no_fold(camera_with: CameraMaker) -> None:
    """1/(1 − r²) takes all that is within 45° to infinity: the sensor is covered, and nothing turns back."""
    pole = {**WIDE, "model": "brown_conrady", "distortion": [0, 0, 0, 0, 0, -1, 0, 0]}
    lens = intrinsics_of(camera_with(lens=pole))
    pixel = sensor_grid(lens)
    np.testing.assert_allclose(cv2_project(lens, lens.unproject(pixel)), pixel, atol=1e-9)
    # r/(1 − r²) = 5/3 at r = (√109 − 3)/10.
    assert np.tan(lens.corner_angle_rad) == pytest.approx((109**0.5 - 3.0) / 10.0, rel=1e-12)


def test_tangential_terms_fold_on_one_side_first(camera_with: CameraMaker) -> None:
    """p2 alone: x = a + 3 p2 a² along the row turns back at a = −1/(6 p2)."""
    model = Distortion("brown_conrady", (0.0, 0.0, 0.0, 0.2))
    assert np.tan(model.fold_rad) == pytest.approx(1.0 / 1.2, rel=0.01)
    folding = {**WIDE, "model": "brown_conrady", "distortion": [0, 0, 0, 0.2]}
    with pytest.raises(ValidationError, match="folds at a field angle of 39"):
        camera_with(lens=folding)


@pytest.mark.parametrize(
    "folding",
    [
        {"model": "brown_conrady", "distortion": [-0.35, 0, 0, 0]},
        {"model": "brown_conrady", "distortion": [-0.35, 0, 2e-3, -4e-3]},
        {"model": "fisheye", "distortion": [-0.5, 0, 0, 0]},
    ],
)
def test_what_lies_beyond_the_fold_stays_out_of_the_image(
    camera_with: CameraMaker, folding: dict[str, Any]
) -> None:
    """1 − 0.35 r² is 0 at 59°, 1 − 0.5 θ² at 81°: there OpenCV's polynomial is back in the image's middle, and the lens is not."""
    lens = intrinsics_of(camera_with(lens={**LONG, **folding}))
    angle, turn = (grid.ravel() for grid in np.meshgrid(np.radians(np.linspace(0.0, 89.0, 90)), np.linspace(0.0, 6.2, 40)))  # fmt: skip
    direction = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    ours, theirs = (
        np.array([lens.contains(u, v) for u, v in pixels])
        for pixels in (lens.project(direction), cv2_project(lens, direction))
    )
    assert angle[ours].max() < lens.corner_angle_rad
    assert angle[theirs].max() > np.radians(55.0)


@pytest.mark.parametrize("name", LENSES)
def test_the_pixels_share_out_the_field(camera_with: CameraMaker, name: str) -> None:
    """Their solid angles sum to that within the image's outline, ∮ (1 − cos θ) dφ, to 1e-5 of it."""
    lens = intrinsics_of(camera_with(lens=LENSES[name]))
    columns, rows = np.arange(2 * lens.width_px + 1) / 2 - 0.5, np.arange(2 * lens.height_px + 1) / 2 - 0.5
    ends = (lens.width_px - 0.5, lens.height_px - 0.5)
    outline = np.concatenate(
        [
            np.stack(np.broadcast_arrays(columns, -0.5), axis=1),
            np.stack(np.broadcast_arrays(ends[0], rows), axis=1),
            np.stack(np.broadcast_arrays(columns[::-1], ends[1]), axis=1),
            np.stack(np.broadcast_arrays(-0.5, rows[::-1]), axis=1),
        ]
    )
    around = lens.unproject(outline)
    turn = np.unwrap(np.arctan2(around[:, 1], around[:, 0]))
    versine = 1.0 - around[:, 2]
    within_sr = float(np.sum(0.5 * (versine[1:] + versine[:-1]) * np.diff(turn)))
    field = field_of(lens)
    assert np.sum(field.weight / np.cos(field.angle_rad)) / lens.fx_px**2 == pytest.approx(
        within_sr, rel=1e-5
    )


def test_an_image_circle_holds_half_the_sky(camera_with: CameraMaker) -> None:
    """Equidistant, 300 px: Σ Ω = 2π and Σ cos θ Ω = π over the circle, to the roughness of its rim, 1e-3.

    Outside it there is no light, no direction, and rays that a renderer can still follow.
    """
    camera = camera_with(lens=CIRCLE)
    lens = intrinsics_of(camera)
    field = field_of(lens)
    lit = field.weight > 0.0
    assert lit.sum() == pytest.approx(np.pi * (300.0 * np.pi / 2.0) ** 2, rel=1e-3)
    solid_sr = field.weight[lit] / np.cos(field.angle_rad[lit]) / 300.0**2
    assert solid_sr.sum() == pytest.approx(2.0 * np.pi, rel=1e-3)
    assert field.weight.sum() / 300.0**2 == pytest.approx(np.pi, rel=1e-4)
    assert np.isnan(lens.unproject(np.array([0.0, 0.0]))).all()
    assert lens.corner_angle_rad == pytest.approx(np.pi / 2)
    corners = corner_directions(camera)
    np.testing.assert_allclose(np.linalg.norm(corners, axis=-1), 1.0, rtol=1e-12)
    assert corners[..., 2].min() > 0.0
    assert np.isnan(lens.project(np.array([1.0, 0.0, 0.0]))).all()


@pytest.mark.parametrize("name", BENT)
def test_rays_interpolated_within_a_pixel_go_where_they_should(camera_with: CameraMaker, name: str) -> None:
    """The middle of four corners is the pixel's centre to 0.002 px, anywhere on the sensor."""
    camera = camera_with(lens=LENSES[name])
    lens, corners = intrinsics_of(camera), corner_directions(camera)
    assert corners.shape == (961, 1281, 3)
    middle = 0.25 * (corners[:-1, :-1] + corners[:-1, 1:] + corners[1:, :-1] + corners[1:, 1:])
    v, u = np.indices(middle.shape[:2])
    assert np.abs(lens.project(middle) - np.stack([u, v], axis=-1)).max() < 2e-3
    np.testing.assert_allclose(lens.project(corners[3, 5]), [4.5, 2.5], atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("pixel", [(639.5, 479.5), (800.0, 250.0), (1270.0, 940.0)])
def test_the_image_of_a_small_disc(camera_with: CameraMaker, name: str, pixel: tuple[float, float]) -> None:
    """The larger half axis of the image of 0.1 mrad is how far its rim gets from its centre, to 0.2 %."""
    lens = intrinsics_of(camera_with(lens=LENSES[name]))
    direction = lens.unproject(np.array(pixel))
    rim = cone_directions(
        direction, np.full(720, cone_versine(1e-4)), np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    )
    farthest_px = np.linalg.norm(lens.project(rim) - pixel, axis=1).max()
    assert lens.image_radius_px(direction, 1e-4) == pytest.approx(farthest_px, rel=2e-3)


def test_the_principal_point_moves_the_image(camera_with: CameraMaker) -> None:
    lens = intrinsics_of(camera_with(lens={"principal_point": "[650.25, 470.5] px"}))
    np.testing.assert_allclose(lens.project(np.array([0.0, 0.0, 1.0])), [650.25, 470.5])
    assert lens.corner_angle_rad == pytest.approx(np.arctan(np.hypot(650.75, 489.0) / 480.0), rel=1e-12)


def test_a_pole_with_tangential_terms_makes_no_warning() -> None:
    """1/(1 − r²) has its pole at 45°: the scan for a fold of the tangential terms ends there, in numbers."""
    model = Distortion("brown_conrady", (0.0, 0.0, 1e-4, -2e-4, 0.0, -1.0, 0.0, 0.0))
    with np.errstate(all="raise"):
        assert 0.0 < model.fold_rad <= np.pi / 4.0 + 1e-12
    assert np.degrees(model.fold_rad) == pytest.approx(45.0, abs=0.1)
