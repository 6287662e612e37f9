"""The sun and lights with an emission pattern in the arrays, against closed forms; scenes without any light."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import expected_electrons, expose, render
from nir_render.transport.indirect.kernel import leaving
from tests.physics.conftest import Loader
from tests.physics.documents import (
    camera_document,
    group_radiance,
    pixel_rays,
    rectangle_document,
    scene_document,
    source_document,
    tile_means,
)

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.vectorised,
]

Array = NDArray[np.float64]

REFLECTANCE = 0.6
FOCAL_PX, COLUMNS, ROWS = 32.0, 32, 24
PAINT = {"paint": {"type": "diffuse", "reflectance": REFLECTANCE}}
POLAR_DEG, AZIMUTH_DEG = [0.0, 60.0, 120.0, 180.0], [0.0, 90.0, 200.0]
VALUES = [[1.0, 1.0, 1.0], [0.5, 2.0, 0.3], [3.0, 0.2, 1.0], [0.0, 0.0, 0.0]]
YAW_DEG, PITCH_DEG, ROLL_DEG = 40.0, 25.0, 70.0


def _about(axis: int, angle_deg: float) -> Array:
    """Return the right-handed rotation about an axis of the world."""
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    turn = np.eye(3)
    one, other = (axis + 1) % 3, (axis + 2) % 3
    turn[[one, other], [one, other]] = cosine
    turn[one, other], turn[other, one] = -sine, sine
    return turn


def _relative(directions: Array) -> Array:
    """Return the pattern, linear between its points in both angles, in directions of the source's own axes."""
    polar_deg = np.degrees(np.arccos(np.clip(directions[..., 2], -1.0, 1.0)))
    turn_deg = np.degrees(np.arctan2(directions[..., 1], directions[..., 0])) % 360.0
    rows = np.stack([np.interp(turn_deg, AZIMUTH_DEG, row, period=360.0) for row in VALUES])
    weights = np.stack([np.interp(polar_deg, POLAR_DEG, one) for one in np.eye(len(POLAR_DEG))])
    return np.asarray((rows * weights).sum(axis=0))


def _pattern(directions: Array) -> Array:
    """Return 4π I/Φ: the pattern over its mean on the sphere."""
    height = (np.arange(1000) + 0.5) / 500.0 - 1.0
    turn = 2.0 * math.pi * (np.arange(720) + 0.5) / 720.0
    flat = np.sqrt(1.0 - height**2)[:, None]
    sphere = np.stack([flat * np.cos(turn), flat * np.sin(turn), height[:, None] + 0.0 * turn], axis=-1)
    return np.asarray(_relative(directions) / _relative(sphere).mean())


def test_a_turned_pattern_falls_on_a_wall(make: Loader) -> None:
    """A source with a lopsided pattern, turned by yaw, pitch and roll: L = (ρ/π) cos θ / d² · I(ω)/Φ.

    ω in the source's axes is (R_z R_y R_x)ᵀ of the direction to the wall. Over the part that is seen the pattern
    goes from 0.4 to 1.8; another order of the turns, or one the other way round, puts pixels off by 10 % and more.
    Expected: the frame to 0.1 %, every pixel beside the source's body to 0.5 %.
    """
    place_m, parts = np.array([1.5, 0.3, 0.8]), 4
    robot = source_document(tuple(place_m.tolist()), 0.01)
    robot["orientation"] = {"yaw": f"{YAW_DEG} deg", "pitch": f"{PITCH_DEG} deg", "roll": f"{ROLL_DEG} deg"}
    robot["rig"]["sources"]["s"]["pattern"] = {
        "grid": {
            "polar": f"{POLAR_DEG} deg", "azimuth": f"{AZIMUTH_DEG} deg", "values": [f"{row}" for row in VALUES],
        }
    }  # fmt: skip
    scene = make(
        scene_document(
            {"c": camera_document(COLUMNS, ROWS, FOCAL_PX)}, {"r": robot}, samples=1024, max_depth=2, materials=PAINT,
            shapes={"wall": rectangle_document((3, 0, 0), (40, 40), (-1, 0, 0), "paint")},
        )
    )  # fmt: skip
    radiance = group_radiance(scene)[0]
    rays = pixel_rays(COLUMNS, ROWS, FOCAL_PX, parts=parts)
    offset_m = rays * (3.0 / rays[..., :1]) - place_m
    distance_m = np.linalg.norm(offset_m, axis=-1)
    turn = _about(2, YAW_DEG) @ _about(1, PITCH_DEG) @ _about(0, ROLL_DEG)
    leaving = offset_m / distance_m[..., None]
    fine = (
        REFLECTANCE / math.pi * leaving[..., 0] / distance_m**2 / (4.0 * math.pi) * _pattern(leaving @ turn)
    )
    expected = tile_means(fine, parts)
    beside = np.linalg.norm(np.cross(pixel_rays(COLUMNS, ROWS, FOCAL_PX), place_m), axis=-1) > 0.2
    assert radiance[beside].mean() == pytest.approx(expected[beside].mean(), rel=0.001)
    np.testing.assert_allclose(radiance[beside], expected[beside], rtol=0.005)


SUN = {"azimuth": "30 deg", "elevation": "35 deg", "irradiance": "0.305 W/m^2/nm"}
ELEVATION_RAD, AZIMUTH_RAD, PITCH_DOWN_DEG = math.radians(35.0), math.radians(30.0), 60.0


def _sunny(reflectance: float, **more: Any) -> dict[str, Any]:
    """Return a camera 1 m above an endless floor, which fills its view."""
    data = scene_document(
        {"c": camera_document(COLUMNS, ROWS, FOCAL_PX)}, {}, samples=1024, max_depth=2, sun=SUN,
        materials={"paint": {"type": "diffuse", "reflectance": reflectance}},
        shapes={"floor": rectangle_document((0, 0, -1), (400, 400), (0, 0, 1), "paint")}, **more,
    )  # fmt: skip
    data["robots"]["eye"]["orientation"] = {"pitch": f"{PITCH_DOWN_DEG} deg"}
    return data


def _views(parts: int = 1) -> Array:
    return pixel_rays(COLUMNS, ROWS, FOCAL_PX, parts) @ _about(1, PITCH_DOWN_DEG).T


def test_the_sun_lights_a_floor(make: Loader) -> None:
    """One unit of the sun, 1 W/m² across its direction, falls on a level floor as sin h: L = (ρ/π) sin h.

    The same in every pixel, to 0.1 %. In black fog of a top 3 m above the floor exp(−σ_t 3 m / sin h) of it gets
    down, and Beer–Lambert's share of that to the lens: the frame to 0.05 %, pixels to 0.2 %.
    """
    clear = REFLECTANCE / math.pi * math.sin(ELEVATION_RAD)
    np.testing.assert_allclose(group_radiance(make(_sunny(REFLECTANCE)))[0], clear, rtol=0.001)
    fog = {"extinction": "0.2 /m", "albedo": 0.0, "top": "2 m"}
    way_m = -1.0 / _views(parts=4)[..., 2]
    foggy = tile_means(clear * np.exp(-0.2 * (way_m + 3.0 / math.sin(ELEVATION_RAD))), 4)
    radiance = group_radiance(make(_sunny(REFLECTANCE, fog=fog)))[0]
    assert radiance.mean() == pytest.approx(foggy.mean(), rel=0.0005)
    np.testing.assert_allclose(radiance, foggy, rtol=0.002)


def test_the_sun_shines_in_fog(make: Loader) -> None:
    """Single scattering of the sun in fog with a top: L = ∫ σ_s p(θ) exp(−σ_t (s + (z_top − z)/sin h)) ds.

    Over a black floor. Expected: the frame to 0.1 %, 8 × 8 tiles to 0.2 %.
    """
    asymmetry, extinction_per_m, albedo, top_m = 0.5, 0.2, 0.9, 2.0
    fog = {
        "extinction": f"{extinction_per_m} /m", "albedo": albedo, "top": f"{top_m} m",
        "phase": {"type": "henyey_greenstein", "g": asymmetry},
    }  # fmt: skip
    radiance = group_radiance(make(_sunny(0.0, fog=fog)))[0]
    views = _views()
    sun = np.array([
        math.cos(ELEVATION_RAD) * math.cos(AZIMUTH_RAD), math.cos(ELEVATION_RAD) * math.sin(AZIMUTH_RAD), math.sin(ELEVATION_RAD),
    ])  # fmt: skip
    phase = (1.0 - asymmetry**2) / (
        4.0 * math.pi * (1.0 + asymmetry**2 - 2.0 * asymmetry * views @ sun) ** 1.5
    )
    # The exponent is linear in s: −σ_t (z_top / sin h + s (1 − v_z / sin h)).
    rate_per_m = extinction_per_m * (1.0 - views[..., 2] / math.sin(ELEVATION_RAD))
    along = (1.0 - np.exp(rate_per_m / views[..., 2])) / rate_per_m
    expected = (
        albedo
        * extinction_per_m
        * phase
        * along
        * math.exp(-extinction_per_m * top_m / math.sin(ELEVATION_RAD))
    )
    assert radiance.mean() == pytest.approx(expected.mean(), rel=0.001)
    np.testing.assert_allclose(tile_means(radiance, 8), tile_means(expected, 8), rtol=0.002)


@pytest.mark.parametrize("with_source", [False, True])
def test_turns_into_the_suns_glow_move_nothing_but_noise(
    make: Loader, monkeypatch: pytest.MonkeyPatch, with_source: bool
) -> None:
    """Up to 16 turns in the sun's fog, forward-peaked, before a floor and the sun's glow: against plain sampling.

    With no direction drawn into halos, phase function and floor alone turn a path. Expected, of the sun's light: the
    frame to 4 standard errors, which are 0.1 % or less; 8 × 8 tiles by 8 renders each, z² as chance has it.
    """
    fog = {
        "extinction": "0.3 /m",
        "albedo": 0.95,
        "top": "2 m",
        "phase": {"type": "henyey_greenstein", "g": 0.85},
    }
    data = _sunny(0.5, fog=fog)
    data["robots"]["eye"]["orientation"] = {"yaw": f"{math.degrees(AZIMUTH_RAD)} deg", "pitch": "-20 deg"}
    data["render"]["indirect"] |= {"samples": 512, "max_depth": 16}
    if with_source:
        data["robots"]["r"] = source_document((1.0, 0.4, 0.2), 0.02)
    scene = make(data)
    sun = scene.at(0.0).groups.index("sun")

    def rendered(first: int) -> Array:
        return np.stack([tile_means(group_radiance(scene, first + seed)[sun], 8) for seed in range(8)])

    with_halos = rendered(0)
    for name in ("_FROM_FOG", "_FROM_FOG_IN_SUN", "_INTO_SUN", "_FROM_SURFACE"):
        monkeypatch.setattr(leaving, name, 0.0)
    plain = rendered(100)
    off = with_halos.mean() - plain.mean()
    error = math.sqrt(sum(part.mean(axis=(1, 2)).var(ddof=1) / 8 for part in (with_halos, plain)))
    assert error < 0.001 * plain.mean()
    assert abs(off) < 4.0 * error
    z = (with_halos.mean(axis=0) - plain.mean(axis=0)) / np.sqrt(
        (with_halos.var(axis=0, ddof=1) + plain.var(axis=0, ddof=1)) / 8
    )
    # Student's t of some 14 degrees of freedom: the mean of t² is 14/12.
    assert np.mean(z**2) < 14.0 / 12.0 + 4.0 * math.sqrt(3.0 / z.size)


@pytest.mark.parametrize("fog", [{}, {"fog": {"extinction": "0.2 /m"}}])
def test_without_any_light_it_is_dark(make: Loader, fog: dict[str, Any]) -> None:
    """A camera, a grey wall, fog, and no light at all: a scene like any other, whose arrays hold no group."""
    scene = make(
        scene_document(
            {"c": camera_document(16, 12)}, {}, samples=16, max_depth=4, materials=PAINT,
            shapes={"wall": rectangle_document((3, 0, 0), (40, 40), (-1, 0, 0), "paint")}, **fog,
        )
    )  # fmt: skip
    light = render(scene, "eye.c", seed=1)
    assert light.groups == ()
    assert light.direct.irradiance_per_w.size == 0
    assert light.indirect is None or not light.indirect.radiance_per_w.any()
    electrons = expected_electrons(light, scene)
    assert electrons.shape == (12, 16)
    assert (electrons == 0.0).all()
    counts = expose(light, scene, seed=1).data_dn
    assert abs(counts.mean() - 10.0) < 1.0  # the black level
