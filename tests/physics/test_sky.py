"""The sky as a light: against quadratures of its formula, written again here; a furnace in fog."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import render
from tests.physics.conftest import Loader
from tests.physics.documents import (
    camera_document,
    group_radiance,
    pixel_rays,
    rectangle_document,
    scene_document,
    tile_means,
)

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

Array = NDArray[np.float64]

REFLECTANCE = 0.6
FOCAL_PX, COLUMNS, ROWS = 32.0, 32, 24
SUN = {"azimuth": "30 deg", "elevation": "35 deg", "irradiance": "0.305 W/m^2/nm"}
TO_SUN = np.array(
    [
        math.cos(math.radians(35.0)) * math.cos(math.radians(30.0)),
        math.cos(math.radians(35.0)) * math.sin(math.radians(30.0)),
        math.sin(math.radians(35.0)),
    ]
)
# CIE S 011/E:2003, table 1: a, b, c, d, e of the overcast, the clear and the white-blue sky.
PARAMETERS = {
    1: (4.0, -0.70, 0.0, -1.0, 0.0),
    12: (-1.0, -0.32, 10.0, -3.0, 0.45),
    15: (-1.0, -0.15, 24.0, -2.8, 0.15),
}


def _bright(number: int, directions: Array) -> Array:
    """Return the standard's φ(Z) f(χ), 0 below the horizon."""
    a, b, c, d, e = PARAMETERS[number]
    zenith = np.arccos(np.clip(directions[..., 2], -1.0, 1.0))
    from_sun = np.arccos(np.clip(directions @ TO_SUN, -1.0, 1.0))
    with np.errstate(divide="ignore", over="ignore"):
        gradation = 1.0 + a * np.exp(b / np.cos(zenith))
    scattering = 1.0 + c * (np.exp(d * from_sun) - math.exp(d * math.pi / 2)) + e * np.cos(from_sun) ** 2
    return np.where(directions[..., 2] > 0.0, gradation * scattering, 0.0)


def _irradiance(number: int, normal: Array) -> float:
    """Return ∫ φ f cos dω over the sky and a plane's half space, midpoints of 900 × 3600 in angles."""
    zenith = (np.arange(900) + 0.5) * (0.5 * math.pi / 900)
    turn = (np.arange(3600) + 0.5) * (2.0 * math.pi / 3600)
    total = 0.0
    for part in np.array_split(turn, 8):
        sines, cosines = np.sin(zenith)[:, None], np.cos(zenith)[:, None]
        sky = np.stack(np.broadcast_arrays(sines * np.cos(part), sines * np.sin(part), cosines), axis=-1)
        total += float(np.sum(_bright(number, sky) * np.clip(sky @ normal, 0.0, None) * sines))
    return total * (0.5 * math.pi / 900) * (2.0 * math.pi / 3600)


def _yard(
    number: int, shapes: dict[str, Any], *, samples: int = 1024, reflectance: float = REFLECTANCE, **more: Any
) -> dict[str, Any]:
    return scene_document(
        {"c": camera_document(COLUMNS, ROWS, FOCAL_PX)}, {}, samples=samples, max_depth=more.pop("max_depth", 2), sun=SUN,
        sky={"cie": number, "irradiance": "0.012 W/m^2/nm"}, shapes=shapes,
        materials={"paint": {"type": "diffuse", "reflectance": reflectance}, **more.pop("materials", {})}, **more,
    )  # fmt: skip


@pytest.mark.parametrize("number", [1, 5, 12, 15])
def test_the_sky_brings_its_irradiance_to_a_floor(make: Loader, number: int) -> None:
    """One unit of the sky is 1 W/m² on a horizontal plane: L = ρ/π. Expected: the frame to 0.1 %, tiles to 1 %."""
    data = _yard(number, {"floor": rectangle_document((0, 0, -1), (400, 400), (0, 0, 1), "paint")})
    data["robots"]["eye"]["orientation"] = {"pitch": "60 deg"}
    sun, sky = group_radiance(make(data))
    assert sky.mean() == pytest.approx(REFLECTANCE / math.pi, rel=0.001)
    np.testing.assert_allclose(tile_means(sky, 8), REFLECTANCE / math.pi, rtol=0.01)
    assert sun.mean() == pytest.approx(REFLECTANCE / math.pi * math.sin(math.radians(35.0)), rel=0.001)


@pytest.mark.parametrize("number", [1, 12, 15])
@pytest.mark.parametrize("facing_deg", [30.0, 150.0, 260.0])
def test_the_sky_brings_to_a_wall_what_its_formula_does(make: Loader, number: int, facing_deg: float) -> None:
    """A vertical plane before the camera, no floor: E by quadrature over that on a horizontal plane, to 0.3 %."""
    turn = math.radians(facing_deg)
    normal = np.array([math.cos(turn), math.sin(turn), 0.0])
    data = _yard(
        number,
        {
            "wall": rectangle_document(
                tuple((-2.0 * normal).tolist()), (80, 80), tuple(normal.tolist()), "paint"
            )
        },
    )
    data["robots"]["eye"]["orientation"] = {"yaw": f"{facing_deg + 180.0} deg"}
    expected = _irradiance(number, normal) / _irradiance(number, np.array([0.0, 0.0, 1.0]))
    sky = group_radiance(make(data))[1]
    assert sky.mean() * math.pi / REFLECTANCE == pytest.approx(expected, rel=0.003)


def test_the_camera_sees_the_sky_itself_and_its_image_in_a_mirror(make: Loader) -> None:
    """Above the horizon the formula's own radiance; in a level mirror, of reflectance 0.8, that of the ray turned up."""
    mirror = {"mirror": {"type": "mirror", "reflectance": 0.8}}
    shapes = {"pond": rectangle_document((0, 0, -1), (4000, 4000), (0, 0, 1), "mirror")}
    sky = group_radiance(make(_yard(12, shapes, samples=256, materials=mirror)))[1]
    parts = 8
    rays = pixel_rays(COLUMNS, ROWS, FOCAL_PX, parts)
    turned = rays * np.array([1.0, 1.0, -1.0])
    fine = np.where(rays[..., 2] > 0.0, _bright(12, rays), 0.8 * _bright(12, turned))
    expected = tile_means(fine, parts) / _irradiance(12, np.array([0.0, 0.0, 1.0]))
    beside = np.abs(np.arange(ROWS) - 11.5) > 1.0  # the pond ends before the horizon
    np.testing.assert_allclose(sky[beside], expected[beside], rtol=0.01)
    assert sky[beside].mean() == pytest.approx(expected[beside].mean(), rel=0.001)


def test_a_sky_that_shines_alone_through_fog_has_samples_enough(make: Loader) -> None:
    """The furnace under clouds that no sun comes through: the sky's light is known to 0.4 %, as beside a sun."""
    floor = {"floor": rectangle_document((0, 0, -1), (2000, 2000), (0, 0, 1), "paint")}
    phase = {"type": "henyey_greenstein", "g": 0.85}
    fog = {"extinction": "0.2 /m", "albedo": 1.0, "top": "3 m", "phase": phase}
    data = _yard(5, floor, samples=256, reflectance=1.0, max_depth=64, fog=fog)
    data["sun"] = {**data["sun"], "irradiance": "1e-6 W/m^2/nm"}
    data["robots"]["eye"]["orientation"] = {"pitch": "30 deg"}
    scene = make(data)
    light = render(scene, camera=scene.cameras()[0], time_s=0.0, seed=1)
    assert light.indirect is not None
    sky, variance = light.indirect.radiance_per_w[1, 0], light.indirect.variance[1, 0].astype(float)
    assert np.sqrt(variance.sum()) < 0.004 * sky.sum()
    assert sky.mean() == pytest.approx(1.0 / math.pi, rel=0.012)


@pytest.mark.parametrize(("extinction_per_m", "g"), [(0.05, 0.85), (0.2, 0.0)])
def test_under_an_even_sky_a_white_world_in_fog_is_even(
    make: Loader, extinction_per_m: float, g: float
) -> None:
    """A furnace: a floor of reflectance 1 and fog of albedo 1, lit evenly from above, are as bright as the sky.

    Whatever the fog, 1/π everywhere: a path counted twice, or not at all, would show. Expected: the frame to
    0.4 %; what is lost to the longest path, 64 stretches, is less.
    """
    floor = {"floor": rectangle_document((0, 0, -1), (2000, 2000), (0, 0, 1), "paint")}
    phase = {"type": "henyey_greenstein", "g": g}
    fog = {"extinction": f"{extinction_per_m} /m", "albedo": 1.0, "top": "3 m", "phase": phase}
    data = _yard(5, floor, samples=512, reflectance=1.0, max_depth=64, fog=fog)
    data["robots"]["eye"]["orientation"] = {"pitch": "30 deg"}
    sky = group_radiance(make(data))[1]
    assert sky.mean() == pytest.approx(1.0 / math.pi, rel=0.004)
    np.testing.assert_allclose(tile_means(sky, 8), 1.0 / math.pi, rtol=0.04)
