"""Perception's lens models, against OpenCV's own projections."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.fisher import flare_limit
from perception.model.flare import PixelBox, flare_image, has_image, image_radius_px
from perception.model.lens import distortion_of, project, stretch
from perception.types import Calibration
from tests.unit.perception.simulation import calibration

Array = NDArray[np.float64]

CAMERAS = {
    "rectilinear": calibration(),
    "barrel": calibration(lens_model="brown_conrady", distortion=(-0.1, 0.012, 2e-4, 3e-4, -5e-4), fy_px=490.0),
    "rational": calibration(
        lens_model="brown_conrady", distortion=(0.5, 0.08, 4e-4, -2e-4, 2e-3, 0.8, 0.2, 0.012), cx_px=652.3
    ),
    "fisheye": calibration(lens_model="fisheye", distortion=(-0.03, 0.005, -0.004, 4e-4), fx_px=590.0, fy_px=585.0),
    "fisheye of 80°": calibration(lens_model="fisheye", distortion=(0.05, -0.02, 0.01, -0.002), fx_px=600.0, fy_px=600.0),
}  # fmt: skip


def _grid(camera: Calibration) -> Array:
    u, v = np.meshgrid(np.linspace(-0.5, 1279.5, 33), np.linspace(-0.5, 959.5, 25))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize("name", CAMERAS)
def test_directions_are_those_that_opencv_projects_there(name: str) -> None:
    """All over the sensor, to 1e-6 px: our directions by cv2's projection, and by our own."""
    camera = CAMERAS[name]
    pixel = _grid(camera)
    direction = direction_camera(pixel, camera)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(project(2.5 * direction, camera), pixel, atol=1e-6)
    np.testing.assert_allclose(_opencv_places(direction, camera), pixel, atol=1e-6)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("place", [(639.5, 479.5), (800.0, 600.0), (1200.0, 100.0)])
def test_the_image_of_a_disc(name: str, place: tuple[float, float]) -> None:
    """Its larger half axis is how far the image of its rim gets from that of its middle, to 0.2 %."""
    camera = CAMERAS[name]
    centre = direction_camera([place], camera)[0]
    across = np.cross(centre, [0.6, 0.8, 0.1])
    across /= np.linalg.norm(across)
    turn = np.linspace(0.0, 2.0 * np.pi, 720)[:, None]
    rim = centre + 1e-4 * (np.cos(turn) * across + np.sin(turn) * np.cross(centre, across))
    farthest_px = np.linalg.norm(project(rim, camera) - place, axis=1).max()
    assert image_radius_px(*place, 1e-4, camera) == pytest.approx(farthest_px, rel=2e-3)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_sphere_is_imaged_as_cap_of_directions(name: str) -> None:
    """A sphere of 2° at 35° off the axis: fine samples of its cap, weighted with cos θ and projected by OpenCV, have the
    centroid and the second moments of the flare model, to 1e-3 px and 1e-3."""
    camera = CAMERAS[name]
    place = project(np.array([[np.sin(0.6) * 0.8, np.sin(0.6) * 0.6, np.cos(0.6)]]), camera)[0]
    centre = direction_camera([place], camera)[0]
    across = np.cross(centre, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    ring, turn = (np.arange(400) + 0.5) / 400, 2.0 * np.pi * np.arange(400) / 400
    versine = (ring * (1.0 - np.cos(np.radians(2.0))))[:, None]
    sine = np.sqrt(versine * (2.0 - versine))
    cap = (
        (1.0 - versine)[..., None] * centre
        + (sine * np.cos(turn))[..., None] * across
        + (sine * np.sin(turn))[..., None] * np.cross(centre, across)
    ).reshape(-1, 3)
    spots, weight = project(cap, camera), cap[:, 2] / cap[:, 2].sum()
    u_px, v_px = (float(value) for value in place)
    window = PixelBox.around(u_px, v_px, 60.0, camera)
    share = flare_image(u_px, v_px, np.radians(2.0), window, camera).fraction
    v, u = np.indices(share.shape)
    at = (window.left + u, window.top + v)
    smoothing = camera.psf_sigma_px**2 + 1.0 / 12.0
    for axis in (0, 1):
        mean = weight @ spots[:, axis]
        assert (share * at[axis]).sum() == pytest.approx(mean, abs=1e-3)
        spread = weight @ (spots[:, axis] - mean) ** 2 + smoothing
        assert (share * (at[axis] - mean) ** 2).sum() == pytest.approx(spread, rel=1e-3)


@pytest.mark.parametrize("name", CAMERAS)
def test_how_far_the_image_moves_is_that_of_small_turns(name: str) -> None:
    """To 1e-5: the greatest of 720 turns of 1e-5 rad, at many directions and on the axis; nothing where there is none."""
    camera = CAMERAS[name]
    direction = np.concatenate([direction_camera(_grid(camera)[::97], camera), [[0.0, 0.0, 1.0]]])
    across = np.cross(direction, [0.6, 0.0, 0.8])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    turn = np.linspace(0.0, np.pi, 720)[:, None, None]
    aside = 1e-5 * (np.cos(turn) * across + np.sin(turn) * np.cross(direction, across))
    moved_px = [project((direction + sign * aside).reshape(-1, 3), camera) for sign in (1.0, -1.0)]
    by_px = np.hypot(*(moved_px[0] - moved_px[1]).T).reshape(720, -1).max(axis=0)
    np.testing.assert_allclose(stretch(direction, camera), by_px / 2e-5, rtol=1e-5)
    assert np.isnan(stretch(np.full((1, 3), np.nan), camera)).all()


def test_beyond_the_image_circle_there_is_no_direction() -> None:
    """480 px · π/2 = 754 px from the middle: corners at 800 px see nothing, and nothing can be claimed there."""
    camera = calibration(lens_model="fisheye", distortion=(0.0, 0.0, 0.0, 0.0))
    inside, outside = direction_camera([[639.5 + 530.0, 479.5 + 530.0], [0.0, 0.0]], camera)
    assert inside[2] == pytest.approx(np.cos(530.0 * 2**0.5 / 480.0), rel=1e-12)
    assert np.isnan(outside).all()
    assert has_image(639.5, 479.5, 0.1, camera)
    assert not has_image(0.0, 0.0, 0.0, camera)
    assert flare_limit(camera, 0.0, 0.0, 2.0, 1e4, 1.0).range_sigma_m == np.inf


FOLDING = (0.3517, -0.0085, 0.0008, -0.0013, -0.0581)


def test_bearings_near_a_fold() -> None:
    """A lens that folds right beyond the corners: all over the sensor, rim included, back to 1e-6 px."""
    camera = calibration(lens_model="brown_conrady", distortion=FOLDING)
    u, v = np.meshgrid(np.linspace(-0.5, 1279.5, 161), np.linspace(-0.5, 959.5, 121))
    pixel = np.stack([u.ravel(), v.ravel()], axis=1)
    direction = direction_camera(pixel, camera)
    np.testing.assert_allclose(project(direction, camera), pixel, atol=1e-6)
    # The image height grows from the middle to the corner on one branch: no field angle jumps.
    along = direction_camera(np.linspace([639.5, 479.5], [1279.5, 959.5], 400), camera)
    angle_rad = np.arccos(along[:, 2])
    assert (np.diff(angle_rad) > 0.0).all()
    assert np.diff(angle_rad).max() < 0.02


def test_beyond_a_fold_there_is_no_direction() -> None:
    """r − 0.3 r³ turns back at r = 1/√0.9, where the image is 2/3 of that high: 337.3 px from the middle."""
    camera = calibration(lens_model="brown_conrady", distortion=(-0.3, 0.0, 0.0, 0.0))
    inside, outside = direction_camera([[639.5 + 337.2, 479.5], [639.5 + 337.5, 479.5]], camera)
    assert np.hypot(*project(inside[None], camera)[0] - [639.5 + 337.2, 479.5]) < 1e-6
    assert inside[0] / inside[2] < 0.9**-0.5
    assert np.isnan(outside).all()


FOLDS = {
    "barrel, within the picture": ("brown_conrady", (-0.3, 0.0, 0.0, 0.0)),
    "barrel, beyond the corners": ("brown_conrady", (-0.2, 0.028, 0.0, 0.0, -0.0013)),
    "tangential": ("brown_conrady", (-0.3, 0.02, 4e-3, -6e-3)),
    "fisheye": ("fisheye", (-0.5, 0.0, 0.0, 0.0)),
    "fisheye, late": ("fisheye", (-0.05, 0.0, 0.0, -0.03)),
}


@pytest.mark.parametrize("name", FOLDS)
def test_what_lies_beyond_a_fold_is_not_in_the_image(name: str) -> None:
    """Directions up to 89.5°, by OpenCV's polynomial back in the picture: ours have a place only before the fold.

    Where they have one, it is OpenCV's, and leads back to the direction.
    """
    model, numbers = FOLDS[name]
    camera = calibration(lens_model=model, distortion=numbers)
    angle, turn = (grid.ravel() for grid in np.meshgrid(np.radians(np.linspace(0.0, 89.5, 180)), np.arange(0.0, 6.2, 0.1)))  # fmt: skip
    direction = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    ours, theirs = project(direction, camera), _opencv_places(direction, camera)
    fold_rad = distortion_of(camera).fold_rad
    assert angle[_in_picture(theirs)].max() > fold_rad + 0.05
    assert angle[_in_picture(ours)].max() < fold_rad
    before = angle < fold_rad - 1e-3
    np.testing.assert_allclose(ours[before], theirs[before], atol=1e-9)
    np.testing.assert_allclose(direction_camera(ours[before], camera), direction[before], atol=1e-6)
    assert np.isnan(ours[angle > fold_rad]).all()
    assert np.isnan(project(-direction[:1], camera)).all()


def test_a_sphere_that_reaches_beyond_a_fold_lights_nothing_there() -> None:
    """A cap of 3° about a direction 0.3° before the fold: less than its whole light falls on the picture, within the
    image height of the fold and 5 σ, and nothing is undefined."""
    camera = calibration(lens_model="brown_conrady", distortion=(-0.3, 0.0, 0.0, 0.0))
    angle_rad = distortion_of(camera).fold_rad - np.radians(0.3)
    u_px, v_px = (
        float(value) for value in project(np.array([[np.sin(angle_rad), 0.0, np.cos(angle_rad)]]), camera)[0]
    )
    share = flare_image(u_px, v_px, np.radians(3.0), PixelBox(0, 0, 960, 1280), camera).fraction
    assert 0.3 < share.sum() < 0.7
    rows, columns = np.indices(share.shape)
    height_px = np.hypot(columns - 639.5, rows - 479.5)
    assert share[height_px > 480.0 * 2.0 / 3.0 * 0.9**-0.5 + 5.0 * camera.psf_sigma_px + 1.0].sum() < 1e-9


def _opencv_places(direction: Array, camera: Calibration) -> Array:
    none = np.zeros(3)
    matrix = np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]])
    forwards = cv2.fisheye.projectPoints if camera.lens_model == "fisheye" else cv2.projectPoints
    numbers = np.array(camera.distortion or (0.0,) * 4)
    return np.asarray(forwards(direction[:, None], none, none, matrix, numbers)[0][:, 0])


def _in_picture(pixel: Array) -> NDArray[np.bool_]:
    return np.asarray(((pixel >= -0.5) & (pixel <= [1279.5, 959.5])).all(axis=1))
