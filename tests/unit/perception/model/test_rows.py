"""Images in rows of strips, as fits use them, against points and a sum by hand."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.discs.nodes import DiscNodes, disc_nodes
from perception.model.discs.rows import disc_rows
from perception.model.layout import Sources
from perception.model.lens import project
from perception.model.ranging import angular_radius_rad
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.image import spread_nodes
from perception.types import Calibration
from tests.unit.perception.simulation import calibration

Array = NDArray[np.float64]

FALLING: Array = np.linspace(0.0, 1.2, 121)
LENSES: dict[str, dict[str, Any]] = {
    "rectilinear": {},
    "sharp": {"psf_sigma_px": 0.4},
    "fisheye": {"lens_model": "fisheye", "distortion": (-0.02, 0.003, 0.0, 0.0)},
    "brown_conrady": {"lens_model": "brown_conrady", "distortion": (-0.2, 0.05, 0.001, -0.001)},
    "vignetted": {"response_angle_rad": FALLING, "response_relative": np.cos(FALLING) ** 2},
}


def _laid(
    lay: Any, u_px: float, v_px: float, radius_rad: float, camera: Calibration, finer: float, moved_px: float
) -> DiscNodes:
    place = np.array([[u_px, v_px]])
    nodes = lay(
        place[:, 0], place[:, 1], direction_camera(place, camera), np.array([radius_rad]), camera,
        np.array([moved_px]) if moved_px else None, np.array([finer]),
    )  # fmt: skip
    assert isinstance(nodes, DiscNodes)
    return nodes


def _image(
    nodes: DiscNodes, u_px: float, v_px: float, half_px: int, sigma_px: float, motion: tuple[float, float],
    growth: float = 1.02,
) -> Array:  # fmt: skip
    source = Sources.of(nodes, np.zeros(1), np.zeros(1))
    side = 2 * half_px + 1
    image = np.zeros((7 if any(motion) else 5, side, whole_lanes(side)))
    place = (half_px + u_px % 1.0, half_px + v_px % 1.0)
    spread_nodes(source, 0, place, growth, motion, blur_of(sigma_px, side), side, image)
    return image[:, :, :side]


@pytest.mark.parametrize("lens", list(LENSES))
@pytest.mark.parametrize("range_m", [200.0, 24.0, 5.0, 1.2, 0.4, 0.16])
@pytest.mark.parametrize(("u_px", "v_px"), [(639.8, 479.3), (1000.3, 700.7)])
def test_rows_say_the_same_as_points(lens: str, range_m: float, u_px: float, v_px: float) -> None:
    """Sources of 0.02 to 60 px radius: shares to 1e-4 of the greatest, slopes as well as points know them."""
    camera = calibration(**LENSES[lens])
    radius_rad = float(angular_radius_rad(range_m, 0.01))
    half_px = math.ceil(1500.0 * radius_rad + 6.0 * camera.psf_sigma_px) + 3
    points, rows = (
        _image(
            _laid(lay, u_px, v_px, radius_rad, camera, finer, 0.0), u_px, v_px, half_px, camera.psf_sigma_px, (0.0, 0.0)
        )
        for lay, finer in ((disc_nodes, 2.0), (disc_rows, 1.0))
    )  # fmt: skip
    for plane, most in enumerate((1e-4, 5e-4, 5e-4, 5e-4, 3e-3)):
        greatest = float(np.abs(points[plane]).max())
        # What a point's size changes is next to nothing.
        least = 1e-3 * float(np.abs(points[4]).max()) if plane == 3 else 0.0
        assert float(np.abs(rows[plane] - points[plane]).max()) < most * max(greatest, least), plane


@pytest.mark.parametrize("psf_sigma_px", [0.4, 0.7, 1.4])
@pytest.mark.parametrize("radius_px", [1.0, 5.0, 25.0, 70.0])
def test_images_may_grow(psf_sigma_px: float, radius_px: float) -> None:
    """By e^.15, as fits keep them: to 5e-4 of the greatest of what six times as many rows say."""
    camera = calibration(psf_sigma_px=psf_sigma_px)
    half_px, place = math.ceil(1.2 * radius_px + 6.0 * psf_sigma_px) + 3, (900.2, 700.3)
    few, many = (
        _image(
            _laid(disc_rows, *place, radius_px / camera.fx_px, camera, finer, 0.0),
            *place, half_px, psf_sigma_px, (0.0, 0.0), math.exp(0.15),
        )[0]
        for finer in (1.0, 6.0)
    )  # fmt: skip
    assert np.abs(few - many).max() < 5e-4 * many.max()


def test_what_moves_is_the_mean_of_what_stands_still() -> None:
    """4.8 px in radius, moved by 5 px: 200 still images of points along its way, to 1e-4 of the greatest."""
    camera, radius_rad = calibration(), float(angular_radius_rad(1.0, 0.01))
    moving = _image(
        _laid(disc_rows, 700.4, 300.2, radius_rad, camera, 1.0, 6.0), 700.4, 300.2, 20, 0.7, (3.0, 4.0)
    )
    still = _laid(disc_nodes, 700.4, 300.2, radius_rad, camera, 2.0, 0.0)
    along = (np.arange(200) + 0.5) / 200.0 - 0.5
    places = [(700.4 + 3.0 * each, 300.2 + 4.0 * each) for each in along.tolist()]
    images = [_shifted(still, u - 700.4, v - 300.2) for u, v in places]
    mean = np.mean(images, axis=0)
    of_motion = [
        np.mean([each * one[plane] for each, one in zip(along, images, strict=True)], axis=0)
        for plane in (1, 2)
    ]
    for plane, expected in enumerate([*mean, *of_motion]):
        greatest = float(np.abs(expected).max())
        assert float(np.abs(moving[plane] - expected).max()) < 3e-4 * greatest, plane


def _shifted(still: DiscNodes, by_u_px: float, by_v_px: float) -> Array:
    image = np.zeros((5, 41, whole_lanes(41)))
    place = 20.0 + 700.4 % 1.0 + by_u_px, 20.0 + 300.2 % 1.0 + by_v_px
    source = Sources.of(still, np.zeros(1), np.zeros(1))
    spread_nodes(source, 0, place, 1.02, (0.0, 0.0), blur_of(0.7, 41), 41, image)
    return image[:, :, :41]


def test_rows_are_few() -> None:
    """Of 4.8 px: a strip for each half pixel of its height, where points take 220."""
    camera, radius_rad = calibration(), float(angular_radius_rad(1.0, 0.01))
    assert len(_laid(disc_rows, 640.0, 480.0, radius_rad, camera, 1.0, 0.0).weight) <= 19


FOLDING = calibration(lens_model="brown_conrady", distortion=(-0.3, 0.0, 0.0, 0.0))
"""Its image folds 46.5° from the axis, where it is 2/3 of the focal length high."""


def test_what_a_lens_folds_away_is_of_points() -> None:
    """A sphere across the fold: the part that has no image counts as light, and falls nowhere."""
    u_px = FOLDING.cx_px + FOLDING.fx_px * 0.66  # 39.8° from the axis
    rows = _laid(disc_rows, u_px, 479.5, 0.15, FOLDING, 1.0, 0.0)
    assert not rows.half_px.any()
    assert 0.01 < rows.weight[np.isinf(rows.u_px)].sum() < 0.5
    assert rows.weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("before_rad", "radius_rad"), [(0.004, 0.0033), (0.004, 0.0), (0.021, 0.02), (0.05, 0.02), (0.15, 0.1)]
)
@pytest.mark.parametrize("azimuth_rad", [0.0, 1.4])
def test_beside_a_fold_images_are_right(before_rad: float, radius_rad: float, azimuth_rad: float) -> None:
    """Light grows without end towards it: no parabola, and half a pixel beside the middle there may be none."""
    angle_rad = 0.8117261 - before_rad
    towards = np.array([[math.sin(angle_rad), 0.0, math.cos(angle_rad)]])
    turned = [towards[0, 0] * math.cos(azimuth_rad), towards[0, 0] * math.sin(azimuth_rad), towards[0, 2]]
    ((u_px, v_px),) = project(np.array([turned]), FOLDING)
    half_px = math.ceil(700.0 * radius_rad) + 8
    points, rows = (
        _image(_laid(lay, u_px, v_px, radius_rad, FOLDING, finer, 0.0), u_px, v_px, half_px, 0.7, (0.0, 0.0))
        for lay, finer in ((disc_nodes, 2.0), (disc_rows, 1.0))
    )
    assert np.abs(rows[0] - points[0]).max() < 2e-4 * points[0].max()


@pytest.mark.parametrize("angle_rad", [0.0, 0.3, 0.55, 0.6])
def test_where_the_response_bends_images_are_right(angle_rad: float) -> None:
    """Few knots, steep between them, and nothing at all from one on."""
    camera = calibration(
        response_angle_rad=np.array([0.0, 0.3, 0.5, 0.6, 0.9]),
        response_relative=np.array([1.0, 0.9, 0.8, 0.0, 0.0]),
    )
    ((u_px, v_px),) = project(np.array([[math.sin(angle_rad), 0.05, math.cos(angle_rad)]]), camera)
    points, coarse, rows = (
        _image(_laid(lay, u_px, v_px, 0.02, camera, finer, 0.0), u_px, v_px, 30, 0.7, (0.0, 0.0))[0]
        for lay, finer in ((disc_nodes, 3.0), (disc_nodes, 1.0), (disc_rows, 1.0))
    )
    # Where half of a disc is dark as many points as others need are off by a thousandth themselves.
    least = max(2e-4 * float(points.max()), float(np.abs(coarse - points).max()))
    assert np.abs(rows - points).max() <= least < 2e-3 * points.max()
