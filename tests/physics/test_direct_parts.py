"""What fog, emission patterns, the sun and occlusion make of the direct light, against closed forms.

Set up: the front camera of r1 at (0.06, 0, 0.2) m looks along x, without a filter. Only the direct table is
exposed, or read.

Why: the direct part is the signal that everything ranges by. Fog of 0.01 /m that is left out biases a range of
10 m by 5 %; a pattern read at the wrong angle, or an image that stays where its hidden half would be, by more.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from nir_render import Scene
from nir_render.scene.emission import emission_spectrum, emission_units
from tests.physics.conftest import SceneMaker, source_at
from tests.physics.direct_light import (
    APERTURE_M2,
    CX_PX,
    CY_PX,
    ELECTRONS_PER_J,
    FOCAL_PX,
    PLAIN,
    direct_light,
    flare,
    fresnel_by_hand,
    only,
    pixel_of,
    rows_of,
)

pytestmark = pytest.mark.mitsuba

LENS_M = np.array([0.06, 0.0, 0.2])


def _per_w(scene: Scene, group: str = "r2.top", mirror: str | None = None) -> float:
    light = direct_light(scene)
    return float(light.direct.irradiance_per_w[only(light, group, mirror), 0])


# --- fog ---


def _transmitted(extinction_per_m: float, fog_m: float, radius_m: float, is_reached: bool) -> float:
    """exp(−σ ℓ), ℓ up to the sphere's surface: a disc's rays end √(r² − ρ²) before its middle."""
    if not is_reached:
        return math.exp(-extinction_per_m * fog_m)
    # Evenly over the disc: ∫₀¹ exp(σ r √(1 − q)) dq, q = ρ²/r².
    saved, _ = quad(lambda q: math.exp(extinction_per_m * radius_m * math.sqrt(1.0 - q)), 0.0, 1.0)
    return math.exp(-extinction_per_m * fog_m) * saved


FOGS: dict[str, tuple[dict[str, Any], float, bool]] = {
    # The source stands 5 m ahead, 0.4 m left of the axis and 0.5 m above it: d = √(25 + 0.16 + 0.25).
    "everywhere": ({}, 1.0, True),
    "below 0.3 m: a fifth of the way": ({"top": "0.3 m"}, 0.2, False),
    "below the lens": ({"top": "0.1 m"}, 0.0, False),
    "above both": ({"top": "2 m"}, 1.0, True),
    "a bank from x = 1.06 to 2.06 m": ({"center": "[1.56, 0, 0] m", "size": "[1, 9, 9] m"}, 0.2, False),
    "a bank around the source": ({"center": "[5.06, 0, 0] m", "size": "[2, 9, 9] m"}, 0.2, True),
    "a bank around the lens": ({"center": "[0, 0, 0] m", "size": "[1.12, 9, 9] m"}, 0.1, False),
    "a bank beside the way": ({"center": "[2.5, 3, 0] m", "size": "[9, 2, 9] m"}, 0.0, False),
    "a bank with the way's second half": ({"center": "[2.5, 1.2, 0] m", "size": "[9, 2, 9] m"}, 0.5, True),
}  # fmt: skip


@pytest.mark.parametrize("place", FOGS)
@pytest.mark.parametrize("extinction_per_m", [0.02, 0.4])
def test_fog_takes_its_share_by_beer_and_lambert(
    scene_with: SceneMaker, place: str, extinction_per_m: float
) -> None:
    """E = exp(−σ ℓ)/(4π d²) per watt, ℓ the way within the fog; to 0.1 %.

    A source of 20 mm: where the fog begins at 0.2 m beside the way, its rays' shares differ by 5 %, and the mean of
    their exponentials from that of their middle by σ d/2 · 1.5 · 0.05²/4 = 0.09 % at most.
    """
    where, share, is_reached = FOGS[place]
    fog = {"extinction": f"{extinction_per_m!r} /m", **where}
    scene = scene_with(
        {
            **PLAIN, "robots.r2.position": "[5.06, 0.4, 0.42] m", "robots.r2.rig.sources.top.radius": "20 mm",
            "fog": fog,
        }
    )  # fmt: skip
    distance_m = math.sqrt(25.0 + 0.16 + 0.25)
    expected = _transmitted(extinction_per_m, share * distance_m, 0.02, is_reached) / (
        4.0 * math.pi * distance_m**2
    )
    assert _per_w(scene) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("droplets", "ratio"), [("advection_heavy", 1.0126), ("radiation_moderate", 1.0433), (None, 1.0275)]
)
def test_visibility_is_3_912_over_the_extinction(
    scene_with: SceneMaker, droplets: str | None, ratio: float
) -> None:
    """Visibility 50 m, 5 m ahead, 10 mm: 2 % contrast is left at 50 m and 550 nm, so exp(−0.3912 σ(940)/σ(550)) at 5 m."""
    scene = scene_with({**source_at(5.0), "fog": {"visibility": "50 m", "droplets": droplets}})
    left = math.exp(-0.3912 * ratio)
    assert _per_w(scene) * 4.0 * math.pi * 25.0 == pytest.approx(left, rel=1e-3)


def test_fog_lies_on_both_legs_of_a_ghost(scene_with: SceneMaker) -> None:
    """Mirror at y = 2 m, source at (3, 0.5): the way is that to the image at (3, 3.5). A bank from y = 1 m on
    holds 2 of its 3.5 parts: 1 on the way up, 1 … 0.5 of the way down from 2 to 1."""
    wall = {
        "type": "rectangle", "center": "[2.5, 2, 0.5] m", "size": "[5, 3] m", "normal": [0, -1, 0],
        "material": "silver",
    }  # fmt: skip
    scene = scene_with(
        {
            **PLAIN, "robots.r2.position": "[3, 0.5, -0.08] m", "shapes.wall": wall,
            "materials": {"silver": {"type": "mirror", "reflectance": 0.9}},
        }
    )  # fmt: skip
    way_m = math.hypot(2.94, 3.5)
    for fog, share, is_reached in (
        ({"extinction": "0.3 /m"}, 1.0, True),
        ({"extinction": "0.3 /m", "center": "[3, 2, 0] m", "size": "[20, 2, 20] m"}, 2.0 / 3.5, False),
    ):
        expected = 0.9 * _transmitted(0.3, share * way_m, 0.01, is_reached) / (4.0 * math.pi * way_m**2)
        assert _per_w(scene.with_({"fog": fog}), "r2.top", "shapes.wall") == pytest.approx(expected, rel=1e-3)


# --- emission patterns ---


def _pattern_scene(scene_with: SceneMaker, pattern: dict[str, Any], **more: Any) -> Scene:
    """The source straight ahead at 4 m, robot upright: light leaves it along its own −x, polar 90°, azimuth 180°."""
    changes = {f"robots.r2.rig.sources.top.{key}": value for key, value in more.items()}
    return scene_with({**PLAIN, **source_at(4.0), "robots.r2.rig.sources.top.pattern": pattern, **changes})


SLOPE = {"points": [["0 deg", 1.0], ["180 deg", 0.0]]}


@pytest.mark.parametrize(
    ("pitch_deg", "polar_deg"), [(0.0, 90.0), (-30.0, 60.0), (-90.0, 0.0), (45.0, 135.0)]
)
def test_flux_goes_with_the_intensity_in_the_direction_of_leaving(
    scene_with: SceneMaker, pitch_deg: float, polar_deg: float
) -> None:
    """I ∝ 1 − θ/π has the mean ½ over the sphere: 4π I/Φ = 2 (1 − θ/π). Pitch turns the nose, the own x axis,
    down, and with it the z axis forward, away from the lens; so θ to the lens is 90° + pitch."""
    scene = _pattern_scene(scene_with, SLOPE, orientation={"pitch": f"{pitch_deg} deg"})
    isotropic = 1.0 / (4.0 * math.pi * 16.0)
    # The lens is looked at from within 0.14° of the disc's rays: 2.5 mm/m of a slope of 2/π per rad is linear,
    # but for the pole, where the cone's mean polar angle is 2/3 of its 0.14°.
    expected = 2.0 * (1.0 - polar_deg / 180.0)
    assert _per_w(scene) / isotropic == pytest.approx(expected, rel=2e-3)


def test_a_grid_is_read_at_its_azimuth(scene_with: SceneMaker, tmp_path: Path) -> None:
    """I ∝ 2 + cos(φ), φ from the own x axis: 1 towards the lens where the robot looks along x, 3 turned by 180°,
    2 by ±90°; and 2 + sin(φ) is 1 and 3 there: left is where y is. Linear between its 2° points: to 0.05 %."""

    def rows(turned_rad: float) -> str:
        lines = [
            f"{polar},{azimuth},{2.0 + math.cos(math.radians(azimuth) - turned_rad)!r}"
            for polar in range(0, 181, 2)
            for azimuth in range(0, 360, 2)
        ]
        return "\n".join(["polar_deg,azimuth_deg,value", *lines])

    isotropic = 1.0 / (4.0 * math.pi * 16.0)
    for turned_deg, yaw_deg, expected in (
        (0.0, 0.0, 0.5), (0.0, 180.0, 1.5), (0.0, 90.0, 1.0), (90.0, 90.0, 1.5), (90.0, -90.0, 0.5), (0.0, 120.0, 1.25),
    ):  # fmt: skip
        path = tmp_path / "pattern.csv"
        path.write_text(rows(math.radians(turned_deg)))
        scene = _pattern_scene(scene_with, {"file": str(path)}, orientation={"yaw": f"{yaw_deg} deg"})
        assert _per_w(scene) / isotropic == pytest.approx(expected, rel=2e-3), (turned_deg, yaw_deg)
        # The same by turning the robot about its axis instead of the source on it.
        turned = scene.with_(
            {"robots.r2.orientation": {"yaw": f"{yaw_deg} deg"}, "robots.r2.rig.sources.top.orientation": {}}
        )
        assert _per_w(turned) / isotropic == pytest.approx(expected, rel=2e-3)


def test_a_ghost_shows_the_other_side_of_a_source(scene_with: SceneMaker) -> None:
    """A source that shines one way only, towards the mirror behind it: its ghost has all the light, 4π I/Φ = 2.

    A step at 90°: sampled in steps of 1°, so that it slopes from 90° to 91°; 0.5 % of the flux lies beyond 90°.
    """
    end = {
        "type": "rectangle", "center": "[6, 0, 0] m", "size": "[3, 3] m", "normal": [-1, 0, 0], "material": "silver",
    }  # fmt: skip
    scene = _pattern_scene(
        scene_with,
        {"points": [["0 deg", 1.0], ["90 deg", 1.0], ["90.001 deg", 0.0], ["180 deg", 0.0]]},
        orientation={"pitch": "90 deg"},
    ).with_(
        {
            "robots.r2.position": "[4.06, 0.2, -0.08] m", "shapes.end": end,
            "materials": {"silver": {"type": "mirror", "reflectance": 0.9}},
        }
    )  # fmt: skip
    assert _per_w(scene) == 0.0
    image_m = np.array([7.94, 0.2, 0.2]) - LENS_M
    expected = 0.9 * 2.0 / (1.0 + math.sin(math.radians(0.5))) / (4.0 * math.pi * float(image_m @ image_m))
    assert _per_w(scene, "r2.top", "shapes.end") == pytest.approx(expected, rel=1e-3)


# --- occlusion ---


@pytest.mark.parametrize("camera", ["r1.front", "r1.left"])
@pytest.mark.parametrize("side", ["below", "above", "left"])
def test_a_half_hidden_source_moves_to_the_middle_of_its_visible_half(
    scene_with: SceneMaker, camera: str, side: str
) -> None:
    """The centroid of a half disc lies 4r/(3π) from its edge, its flux is half: 12 px of radius move it by 5.1 px.

    Seen by a camera that looks along x and by one that looks along y; an upright panel's edge runs through the
    source's middle. 16384 rays share out the disc's halves to 1e-3, which moves the centroid by up to twice that,
    0.01 px; a source at 2 m on the axis is stretched by 1 + α² = 1.0006.
    """
    ahead, left = (np.array([1.0, 0, 0]), np.array([0, 1.0, 0])) if camera == "r1.front" else (
        np.array([0, 1.0, 0]), np.array([-1.0, 0, 0]),
    )  # fmt: skip
    lens_m = 0.06 * ahead + np.array([0.0, 0.0, 0.2])
    at_m = lens_m + 2.0 * ahead - np.array([0.0, 0.0, 0.28])
    off = {"below": [0.0, 0.0, -0.5], "above": [0.0, 0.0, 0.5], "left": list(0.5 * left)}[side]
    panel = {
        "type": "rectangle", "center": f"{(lens_m + ahead + np.array(off)).tolist()} m", "size": "[1, 1] m",
        "normal": ahead.tolist(), "material": "black",
    }  # fmt: skip
    scene = scene_with(
        {
            f"robots.r1.rig.cameras.{camera[3:]}.filter": None, "observe": [camera],
            "robots.r2.position": f"{at_m.tolist()} m", "robots.r2.rig.sources.top.radius": "50 mm",
            "shapes.panel": panel, "render.visibility_rays": 16384,
        }
    )  # fmt: skip
    light = direct_light(scene, camera)
    electrons, u_px, v_px = flare(scene, light, (CX_PX, CY_PX), 1e-4, half_px=24)
    radius_px = FOCAL_PX * math.tan(math.asin(0.05 / 2.0))
    shift_px = 4.0 * radius_px / (3.0 * math.pi)
    moved = {"below": (0.0, -shift_px), "above": (0.0, shift_px), "left": (shift_px, 0.0)}[side]
    assert (u_px - CX_PX, v_px - CY_PX) == pytest.approx(moved, abs=0.015)
    whole_e = 0.2 / (4.0 * math.pi * 4.0) * APERTURE_M2 * ELECTRONS_PER_J * 1e-4
    assert electrons == pytest.approx(0.5 * whole_e, rel=3e-3)


# --- the sun ---

SUN = {"azimuth": "10 deg", "elevation": "20 deg", "irradiance": "0.305 W/m^2/nm"}
TO_SUN = np.array(
    [
        math.cos(math.radians(20.0)) * math.cos(math.radians(10.0)),
        math.cos(math.radians(20.0)) * math.sin(math.radians(10.0)),
        math.sin(math.radians(20.0)),
    ]
)
# A flat spectrum from 300 to 1100 nm: 0.305 W/m² per nm over 800 nm, photons of 700 nm on average.
SUN_W_PER_M2 = 0.305 * 800.0
SUN_ELECTRONS_PER_J = ELECTRONS_PER_J * 700.0 / 940.0


def _sun_e(direction: np.ndarray, share: float, exposure_s: float) -> float:
    return float(SUN_W_PER_M2 * share * APERTURE_M2 * direction[0] * SUN_ELECTRONS_PER_J * exposure_s)


def test_the_suns_disc_has_its_place_its_size_and_its_flux(scene_with: SceneMaker) -> None:
    """To 0.01 px and 0.1 %."""
    scene = scene_with({**PLAIN, "robots.r2.position": "[9, 9, 0] m", "sun": SUN})
    light = direct_light(scene)
    place = pixel_of(TO_SUN)
    electrons, u_px, v_px = flare(scene, light, place, 1e-6)
    assert (u_px, v_px) == pytest.approx(place, abs=0.01)
    assert electrons == pytest.approx(_sun_e(TO_SUN, 1.0, 1e-6), rel=1e-3)
    row = only(light, "sun")
    assert light.direct.distance_m[row] == np.inf
    assert math.degrees(light.direct.angular_radius_rad[row]) == pytest.approx(0.2666, rel=1e-9)
    assert light.direct.irradiance_per_w[row, 0] == pytest.approx(1.0, rel=1e-12)


def test_the_sun_sends_3_watts_per_square_metre_into_ten_nanometres(scene_with: SceneMaker) -> None:
    """ASTM G173: 3.05 W/m² from 935 to 945 nm."""
    sun = scene_with({"sun": SUN}).document.sun
    assert sun is not None
    density_per_m = float(emission_spectrum(sun)(940e-9))
    assert emission_units(sun) * density_per_m * 10e-9 == pytest.approx(3.05, rel=1e-9)


def test_the_sun_is_mirrored_dimmed_and_hidden(scene_with: SceneMaker) -> None:
    """Its ghost in a smooth floor stands as far below the horizon; fog below 4 m is crossed for 3.8 m / sin 20°; a
    body hides it, however far; a wall that ends at its middle leaves half."""
    floor = {
        "type": "rectangle", "center": "[2, 0, 0] m", "size": "[8, 8] m", "normal": [0, 0, 1], "material": "gloss",
    }  # fmt: skip
    materials = {"gloss": {"type": "plastic", "index": 1.5, "reflectance": 0.3, "roughness": 0.0}}
    scene = scene_with(
        {
            **PLAIN,
            "robots.r2.position": "[9, 9, 0] m",
            "sun": SUN,
            "materials": materials,
            "shapes.floor": floor,
        }
    )
    light = direct_light(scene)
    below = TO_SUN * np.array([1.0, 1.0, -1.0])
    electrons, u_px, v_px = flare(scene, light, pixel_of(below), 1e-6)
    assert (u_px, v_px) == pytest.approx(pixel_of(below), abs=0.01)
    assert electrons == pytest.approx(_sun_e(below, fresnel_by_hand(70.0, 1.5), 1e-6), rel=1e-3)

    foggy = scene.with_({"fog": {"extinction": "0.1 /m", "top": "4 m"}})
    up_m = 3.8 / math.sin(math.radians(20.0))
    assert _per_w(foggy, "sun") == pytest.approx(math.exp(-0.1 * up_m), rel=1e-3)
    down_m = (0.2 + 4.0) / math.sin(math.radians(20.0))
    lost = math.exp(-0.1 * down_m) * fresnel_by_hand(70.0, 1.5)
    assert _per_w(foggy, "sun", "shapes.floor") == pytest.approx(lost, rel=1e-3)

    ball = {
        "type": "sphere", "center": f"{(LENS_M + 500.0 * TO_SUN).tolist()} m", "radius": "5 m", "material": "black",
    }  # fmt: skip
    hidden = scene.with_({"shapes.ball": ball})
    assert _per_w(hidden, "sun") == 0.0
    assert rows_of(direct_light(hidden), "sun", "shapes.floor") == []

    top_m = 0.2 + 3.0 * math.tan(math.radians(20.0)) / math.cos(math.radians(10.0))
    wall = {
        "type": "rectangle", "center": f"[3.06, 0, {top_m - 1.0!r}] m", "size": "[4, 2] m", "normal": [-1, 0, 0],
        "material": "black",
    }  # fmt: skip
    assert _per_w(scene.with_({"shapes.wall": wall}), "sun") == pytest.approx(0.5, abs=0.008)
