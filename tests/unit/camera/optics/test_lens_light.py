"""How much light a pixel gets behind any lens: sources that fill it and surfaces that fill it must agree."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from nir_render.camera.beams import Beam, beam_electrons, beam_window, diffuse_electrons
from nir_render.camera.optics.lens import aperture_area_m2, field_of, intrinsics_of
from nir_render.camera.optics.response import response, response_map
from nir_render.scene.documents.emitters import Source
from tests.unit.camera.conftest import CameraMaker
from tests.unit.camera.optics.test_lens import CIRCLE, LENSES

Array = NDArray[np.float64]

DARK_RIM = {"vignetting": [["0 deg", 1.0], ["30 deg", 0.9], ["45 deg", 0.6], ["90 deg", 0.1]]}


@pytest.mark.parametrize("name", LENSES)
def test_a_disc_that_fills_a_pixel_is_as_bright_as_a_surface(
    camera_with: CameraMaker, source: Source, name: str
) -> None:
    """A sphere of 15 px radius shows the radiance L = E/(π sin² α): the pixels about its middle hold what a
    surface of that radiance everywhere gives them, to 1e-4, through filter and vignetting."""
    camera = camera_with(lens={**LENSES[name], **DARK_RIM})
    lens = intrinsics_of(camera)
    alpha_rad, irradiance = 15.0 / lens.fx_px, 0.02
    radiance = np.full((lens.height_px, lens.width_px), irradiance / (np.pi * np.sin(alpha_rad) ** 2))
    surface_e = diffuse_electrons(camera, radiance, source, 1e-3)
    for column, row in ((700, 500), (1050, 300), (90, 880)):
        direction = lens.unproject(np.array([column, row], dtype=float))
        window = beam_window(camera, Beam(direction, alpha_rad, irradiance, response(camera, source)), 1e-3)
        disc_e = window.values[row - window.row - 2 :, column - window.column - 2 :][:5, :5]
        patch_e = surface_e[row - 2 : row + 3, column - 2 : column + 3]
        np.testing.assert_allclose(disc_e, patch_e, rtol=1e-4)


@pytest.mark.parametrize(
    ("lens", "relative"),
    [
        (LENSES["rectilinear"], lambda r: (1.0 + r**2) ** -2.0),
        (LENSES["equidistant"], lambda r: np.cos(r) * np.sinc(r / np.pi)),
        # x = a (1 − 0.1 a²) along the row, and the same growth across it.
        (
            {"focal_length": "6 mm", "model": "brown_conrady", "distortion": [-0.1, 0, 0, 0]},
            lambda r: _barrel_weight(r),
        ),
    ],
)
def test_extended_light_falls_off_as_the_closed_form_says(
    camera_with: CameraMaker, source: Source, lens: dict[str, Any], relative: Any
) -> None:
    """Along the row through the axis, without a filter, to 1e-9 of cos θ · Ω/Ω_axis at r = u/f:
    1/(1 + r²)² rectilinear, cos r sin r / r equidistant, cos⁴ θ / ((1 − 0.3 a²)(1 − 0.1 a²)) for the barrel."""
    camera = camera_with(lens=lens, filter=None, sensor={"columns": 1281, "rows": 961})
    image = response_map(camera, source)
    r = (np.arange(1281) - 640.0) / intrinsics_of(camera).fx_px
    np.testing.assert_allclose(image[480] / image[480, 640], relative(np.abs(r)), rtol=1e-9)


def _barrel_weight(r: Array) -> Array:
    a = r.copy()
    for _ in range(60):
        a = r + 0.1 * a**3
    return np.asarray((1.0 + a**2) ** -2.0 / ((1.0 - 0.3 * a**2) * (1.0 - 0.1 * a**2)))


def test_outside_the_image_circle_no_light_falls(camera_with: CameraMaker, source: Source) -> None:
    image = response_map(camera_with(lens=CIRCLE), source)
    v, u = np.indices(image.shape)
    height_px = np.hypot(u - 639.5, v - 479.5)
    assert not image[height_px > 471.3].any()
    assert (image[height_px < 471.2] > 0.0).all()


def test_vignetting_dims_sources_and_surfaces_alike(camera_with: CameraMaker, source: Source) -> None:
    """0.6 at 45°, 0.9 at 30° and, by a monotone curve between, neither less nor more; on the axis nothing."""
    plain, dim = camera_with(), camera_with(lens=DARK_RIM)
    for angle_deg, low, high in ((0.0, 1.0, 1.0), (30.0, 0.9, 0.9), (38.0, 0.6, 0.9), (45.0, 0.6, 0.6)):
        angle = np.radians(angle_deg)
        direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
        electrons = [
            beam_window(camera, Beam(direction, 0.0, 1.0, response(camera, source)), 1.0).total
            for camera in (plain, dim)
        ]
        assert low - 1e-5 <= electrons[1] / electrons[0] <= high + 1e-5
    maps = [response_map(camera, source) for camera in (plain, dim)]
    field = field_of(intrinsics_of(dim))
    at_45 = np.abs(field.angle_rad - np.pi / 4.0) < 5e-4
    np.testing.assert_allclose((maps[1] / maps[0])[at_45], 0.6, rtol=3e-3)
    assert dim.lens.transmission == plain.lens.transmission


def test_the_pupil_of_a_wide_lens_may_grow(camera_with: CameraMaker, source: Source) -> None:
    """Throughput 1/cos θ takes the tilt of the aperture away: E A_ap C t at any angle, to 1e-4."""
    angles_deg = np.arange(0.0, 62.0, 2.0)
    points = [[f"{angle} deg", float(1.0 / np.cos(np.radians(angle)))] for angle in angles_deg]
    camera = camera_with(lens={"vignetting": points}, filter=None)
    towards = np.array([np.sin(0.7), 0.0, np.cos(0.7)])
    image_e = beam_electrons(camera, [Beam(towards, 0.0, 1e-6, response(camera, source))], 1e-3)
    per_j = 0.9 * 0.15 * 4.7320e18
    assert image_e.sum() == pytest.approx(1e-6 * aperture_area_m2(camera) * per_j * 1e-3, rel=3e-4)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([["0 deg", 1.0], ["59 deg", 0.5]], r"ends at 59 deg, but the image reaches 59\.04 deg"),
        ([["0 deg", 0.9], ["60 deg", 0.5]], "begins with 0.9 at 0 deg"),
        ([["5 deg", 1.0], ["60 deg", 0.5]], "begins with 1 at 5 deg"),
        ([["0 deg", 1.0], ["60 deg", -0.1]], "not negative"),
        ([["0 deg", 1.0], [60, 0.5]], "wanted a list of"),
    ],
)
def test_vignetting_that_tells_too_little_is_refused(
    camera_with: CameraMaker, points: list[list[Any]], reason: str
) -> None:
    with pytest.raises(ValidationError, match=reason):
        camera_with(lens={"vignetting": points})
