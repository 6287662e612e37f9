"""Light rendered through bent lenses, against OpenCV's projections and closed forms.

Set up: a camera of 96 × 72 pixels with a rectilinear, a brown_conrady and a fisheye lens, and a source of 10 mm.

Why: rays start where the lens says, and pixels collect over the solid angle that it gives them; a fault in
either would shift or shade every wall, and no flare would tell.
"""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import Scene, expected_electrons, render
from tests.physics.conftest import Loader
from tests.physics.direct_light import ELECTRONS_PER_J
from tests.physics.documents import (
    camera_document,
    rectangle_document,
    scene_document,
    source_document,
    tile_means,
)

pytestmark = pytest.mark.mitsuba

Array = NDArray[np.float64]

COLUMNS, ROWS = 96, 72
MIDDLE_PX = np.array([49.3, 33.8])
LENSES: dict[str, tuple[float, dict[str, Any]]] = {
    "rectilinear": (60.0, {}),
    "brown_conrady": (60.0, {"model": "brown_conrady", "distortion": [-0.18, 0.03, 4e-3, -3e-3, -1e-3]}),
    "fisheye": (50.0, {"model": "fisheye", "distortion": [-0.04, 0.01, -0.004, 3e-4]}),
}


def _directions(name: str, pixel: Array) -> Array:
    """Unit directions of pixels by OpenCV's inverse, x ahead, y left, z up, shape (..., 3)."""
    focal_px, lens = LENSES[name]
    matrix = np.array([[focal_px, 0.0, MIDDLE_PX[0]], [0.0, focal_px, MIDDLE_PX[1]], [0.0, 0.0, 1.0]])
    inverse = cv2.fisheye.undistortPoints if name == "fisheye" else cv2.undistortPoints
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    numbers = np.array(lens.get("distortion", [0.0] * 4))
    flat = inverse(pixel.reshape(-1, 1, 2), matrix, numbers, criteria=criteria).reshape(pixel.shape)
    ahead = np.stack([np.ones(pixel.shape[:-1]), -flat[..., 0], -flat[..., 1]], axis=-1)
    return np.asarray(ahead / np.linalg.norm(ahead, axis=-1, keepdims=True))


def _solid_angles_sr(name: str) -> Array:
    """What each pixel sees, from the directions of its four corners: half the cross product of the diagonals."""
    v, u = np.meshgrid(np.arange(ROWS + 1) - 0.5, np.arange(COLUMNS + 1) - 0.5, indexing="ij")
    corner = _directions(name, np.stack([u, v], axis=-1))
    falling, rising = corner[1:, 1:] - corner[:-1, :-1], corner[:-1, 1:] - corner[1:, :-1]
    return np.asarray(0.5 * np.linalg.norm(np.cross(falling, rising), axis=-1))


def _scene(make: Loader, name: str, place_m: tuple[float, ...], **more: Any) -> Scene:
    focal_px, lens = LENSES[name]
    camera = camera_document(COLUMNS, ROWS, focal_px)
    camera["lens"] |= {**lens, "principal_point": f"{MIDDLE_PX.tolist()} px"}
    sources = {"r": source_document(place_m, 0.01)}
    return make(scene_document({"c": camera}, sources, samples=256, max_depth=2, **more))


@pytest.mark.vectorised
@pytest.mark.parametrize("name", LENSES)
def test_a_wall_is_lit_and_shaded_as_the_closed_forms_say(make: Loader, name: str) -> None:
    """A diffuse wall, 2 m ahead, lit by a source 0.5 m behind the lens and aside of it: L = ρ/π · Φ cos ψ/(4π d²)
    where the ray of a pixel meets it, and L · A_ap cos θ · Ω · C · t electrons, over tiles of 8 px to 1e-3."""
    place_m = (-0.5, 0.3, -0.2)
    wall = rectangle_document((2.0, 0.0, 0.0), (60.0, 60.0), (-1.0, 0.0, 0.0), "white")
    white = {"white": {"type": "diffuse", "reflectance": 0.5}}
    scene = _scene(make, name, place_m, materials=white, shapes={"wall": wall})
    light = render(scene, "eye.c", seed=3)
    assert light.indirect is not None
    parts = 4
    v, u = np.meshgrid(np.arange(parts * ROWS), np.arange(parts * COLUMNS), indexing="ij")
    rays = _directions(name, (np.stack([u, v], axis=-1) + 0.5) / parts - 0.5)
    to_wall_m = 2.0 / rays[..., :1] * rays - place_m
    distance_m = np.linalg.norm(to_wall_m, axis=-1)
    radiance = 0.5 / np.pi * (2.5 / distance_m) / (4.0 * np.pi * distance_m**2)
    radiance = radiance.reshape(ROWS, parts, COLUMNS, parts).mean(axis=(1, 3))
    np.testing.assert_allclose(
        tile_means(light.indirect.radiance_per_w[0, 0], 8), tile_means(radiance, 8), rtol=1e-3
    )
    pixel = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).astype(float)
    pupil_m2 = np.pi * (LENSES[name][0] * 22.5e-6 / 2.0) ** 2 / 4.0
    collected = pupil_m2 * _directions(name, pixel)[..., 0] * _solid_angles_sr(name)
    electrons = radiance * collected * ELECTRONS_PER_J * 1e-3
    measured = expected_electrons(light, scene)
    np.testing.assert_allclose(
        tile_means(measured, 8)[1:-1, 1:-1], tile_means(electrons, 8)[1:-1, 1:-1], rtol=1e-3
    )


@pytest.mark.parametrize("name", LENSES)
def test_a_source_stands_where_opencv_says(make: Loader, name: str) -> None:
    """A source of 10 mm, 6 m away near the image's corner: centroid to 0.01 px, flux E · A_ap cos θ · C · t to 2e-4."""
    pixel = np.array([80.4, 12.7])
    towards = _directions(name, pixel[None])[0]
    scene = _scene(make, name, tuple((6.0 * towards).tolist()))
    image_e = expected_electrons(render(scene, "eye.c", seed=1), scene)
    v, u = np.indices(image_e.shape)
    total_e = image_e.sum()
    place_px = [(u * image_e).sum() / total_e, (v * image_e).sum() / total_e]
    np.testing.assert_allclose(place_px, pixel, atol=0.01)
    pupil_m2 = np.pi * (LENSES[name][0] * 22.5e-6 / 2.0) ** 2 / 4.0
    flux_e = pupil_m2 * towards[0] / (4.0 * np.pi * 36.0) * ELECTRONS_PER_J * 1e-3
    assert total_e == pytest.approx(flux_e, rel=2e-4)
