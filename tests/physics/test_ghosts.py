"""Ghosts: the image of a source in one flat smooth surface, against geometry and Fresnel by hand.

Set up: the front camera of r1 at (0.06, 0, 0.2) m looks along x; no filter, so that electrons are E · A_ap ·
cos θ · 0.135 · λ/(hc) · t everywhere. One source of 0.2 W and a surface that shows it. Only the direct table is
exposed. Place and electrons are taken from the noise-free frame, as a photometer would.

Why: to a detector a ghost is a robot that is not there. Its place must be right to a hundredth of a pixel and
its flux to half a per cent, or no one can say whether an estimator was fooled by the optics or by the program.
"""

import math
from typing import Any

import numpy as np
import pytest

from nir_render import Light, Scene
from tests.physics.conftest import SceneMaker
from tests.physics.direct_light import (
    APERTURE_M2,
    ELECTRONS_PER_J,
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
FLUX_W = 0.2
EXPOSURE_S = 1e-3
MATERIALS = {
    "silver": {"type": "mirror", "reflectance": 0.9},
    "glass": {"type": "pane", "index": 1.5},
    "gloss": {"type": "plastic", "index": 1.5, "reflectance": 0.3, "roughness": 0.0},
    "solid": {"type": "dielectric", "index": 1.6},
}


def _wall(material: str, y_m: float = 2.0, **more: Any) -> dict[str, Any]:
    """A wall to the left of the camera, which shows what stands before it."""
    return {
        "type": "rectangle", "center": f"[2.5, {y_m!r}, 0.5] m", "size": "[5, 3] m", "normal": [0, -1, 0],
        "material": material, **more,
    }  # fmt: skip


def _source(x_m: float, y_m: float, z_m: float = 0.2) -> dict[str, Any]:
    return {"robots.r2.position": f"[{x_m!r}, {y_m!r}, {z_m - 0.28!r}] m"}


def _expected_e(offset_m: np.ndarray, share: float) -> float:
    """Electrons of a source whose image lies `offset_m` from the lens, of which `share` arrives."""
    distance_m = float(np.linalg.norm(offset_m))
    irradiance = FLUX_W / (4.0 * math.pi * distance_m**2) * share
    cosine = float(offset_m[0]) / distance_m
    return irradiance * APERTURE_M2 * cosine * ELECTRONS_PER_J * EXPOSURE_S


def _assert_flare(scene: Scene, light: Light, offset_m: np.ndarray, share: float) -> None:
    """Place within 0.01 px, electrons within 0.1 %."""
    place = pixel_of(offset_m)
    electrons, u_px, v_px = flare(scene, light, place, EXPOSURE_S)
    assert (u_px, v_px) == pytest.approx(place, abs=0.01)
    assert electrons == pytest.approx(_expected_e(offset_m, share), rel=1e-3)


@pytest.mark.parametrize("x_m", [3.0, 4.0, 4.9])
def test_a_mirror_on_the_wall_shows_the_source_behind_it(scene_with: SceneMaker, x_m: float) -> None:
    """The wall stands at y = 2 m, the source at y = 0.5 m: its image stands at y = 3.5 m, 10 % fainter."""
    scene = scene_with({**PLAIN, **_source(x_m, 0.5), "materials": MATERIALS, "shapes.wall": _wall("silver")})
    light = direct_light(scene)
    image_m = np.array([x_m, 3.5, 0.2])
    row = only(light, "r2.top", "shapes.wall")
    assert light.direct.distance_m[row] == pytest.approx(float(np.linalg.norm(image_m - LENS_M)), rel=1e-12)
    assert light.direct.visible_fraction[row] == 1.0
    _assert_flare(scene, light, image_m - LENS_M, 0.9)
    _assert_flare(scene, light, np.array([x_m, 0.5, 0.2]) - LENS_M, 1.0)  # the source itself is no other


@pytest.mark.parametrize(("kind", "index"), [("glass", 1.5), ("gloss", 1.5)])
@pytest.mark.parametrize("angle_deg", [20.0, 50.0, 56.3, 70.0])
def test_panes_and_coats_reflect_by_fresnel(
    scene_with: SceneMaker, kind: str, index: float, angle_deg: float
) -> None:
    """A surface that makes the ray to the middle of the image meet it at a known angle, Brewster's among them.

    The surface's middle is (2, 0.05, 0.22) m; its normal is turned by the angle from the line of sight; the source
    stands 1.2 m along the mirrored line. A pane reflects 2R/(1 + R), a coat R.
    """
    angle = math.radians(angle_deg)
    hit_m = np.array([2.0, 0.05, 0.22])
    sight = (hit_m - LENS_M) / np.linalg.norm(hit_m - LENS_M)
    across = np.cross(sight, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    normal = -math.cos(angle) * sight + math.sin(angle) * across
    away = sight - 2.0 * float(sight @ normal) * normal
    source_m = hit_m + 1.2 * away
    surface = {
        "type": "rectangle", "center": f"{hit_m.tolist()} m", "size": "[40, 40] cm",
        "normal": normal.tolist(), "material": kind,
    }  # fmt: skip
    scene = scene_with(
        {**PLAIN, **_source(*map(float, source_m)), "materials": MATERIALS, "shapes.s": surface}
    )
    face = fresnel_by_hand(angle_deg, index)
    share = 2.0 * face / (1.0 + face) if kind == "glass" else face
    light = direct_light(scene)
    _assert_flare(scene, light, (float(np.linalg.norm(hit_m - LENS_M)) + 1.2) * sight, share)
    assert light.direct.visible_fraction[only(light, "r2.top", "shapes.s")] == 1.0


def test_a_smooth_floor_shows_what_stands_on_it(scene_with: SceneMaker) -> None:
    """Camera and source 0.2 m above a floor at z = 0, 3 m apart: the image stands at z = −0.2 m, and the ray meets
    the floor at atan(1.5/0.2) from its normal; Fresnel reflects a third there."""
    floor = {
        "type": "rectangle", "center": "[2, 0, 0] m", "size": "[6, 6] m", "normal": [0, 0, 1], "material": "gloss",
    }  # fmt: skip
    scene = scene_with({**PLAIN, **_source(3.06, 0.0), "materials": MATERIALS, "shapes.floor": floor})
    angle_deg = math.degrees(math.atan2(1.5, 0.2))
    share = fresnel_by_hand(angle_deg, 1.5)
    assert 0.3 < share < 0.5
    _assert_flare(scene, direct_light(scene), np.array([3.0, 0.0, -0.4]), share)


def test_the_faces_of_a_box_of_glass_and_of_a_mirror_show_ghosts(scene_with: SceneMaker) -> None:
    """A cube's face towards the camera, at x = 2 m: the source at (1, 0.4) m has its image at x = 3 m."""
    for material in ("silver", "solid"):
        box = {
            "type": "box", "center": "[2.5, 0.2, 0.2] m", "size": "[1, 1, 1] m", "orientation": {"yaw": "180 deg"},
            "material": material,
        }  # fmt: skip
        scene = scene_with({**PLAIN, **_source(1.0, 0.4), "materials": MATERIALS, "shapes.box": box})
        light = direct_light(scene)
        offset_m = np.array([3.0, 0.4, 0.2]) - LENS_M
        angle_deg = math.degrees(math.atan2(offset_m[1], offset_m[0]))
        _assert_flare(
            scene, light, offset_m, 0.9 if material == "silver" else fresnel_by_hand(angle_deg, 1.6)
        )
        seen_in = [light.mirrors[facet] for facet in light.direct.facet if facet >= 0]
        # r2's source once; r1's own, 0.28 m up at x = 0, once more.
        assert len(set(seen_in)) == 1
        assert len(seen_in) == 2


def test_a_mirror_shows_ghosts_on_its_both_sides_but_none_through_itself(scene_with: SceneMaker) -> None:
    """The wall turned the other way still shows the source; with camera and source on two sides it shows none."""
    turned = {
        **PLAIN,
        **_source(3.0, 0.5),
        "materials": MATERIALS,
        "shapes.wall": _wall("silver", normal=[0, 1, 0]),
    }
    light = direct_light(scene_with(turned))
    assert light.direct.irradiance_per_w[only(light, "r2.top", "shapes.wall"), 0] > 0.0
    apart = scene_with(
        {**PLAIN, **_source(3.0, 0.5), "materials": MATERIALS, "shapes.wall": _wall("glass", 0.25)}
    )
    assert rows_of(direct_light(apart), "r2.top", "shapes.wall") == []


BODY = {"type": "box", "size": "[10, 10, 60] cm", "material": "black"}


def _disc_share(height: float) -> float:
    """Share of a disc above a line at `height` of its radius."""
    return (math.acos(height) - height * math.sqrt(1.0 - height**2)) / math.pi


@pytest.mark.parametrize(
    ("where", "center"),
    [
        ("between lens and mirror", "[0.86, 0.9, 0.2] m"),
        ("between mirror and source", "[2.2, 1.5, 0.2] m"),
    ],
)
def test_a_body_on_either_leg_hides_a_ghost(scene_with: SceneMaker, where: str, center: str) -> None:
    """Source at (3, 0.5), image at (3, 3.5): the ray leaves the lens towards it, meets the wall at x = 1.74, and
    comes down to the source. A body on one leg hides the ghost and not the source."""
    # On the first leg: a point at y = 0.9 lies at x = 0.06 + 2.94 · 0.9/3.5 = 0.816; on the second, y = 1.5 at
    # x = 1.74 + 2.94/3.5 · 0.5 = 2.16.
    scene = scene_with(
        {
            **PLAIN, **_source(3.0, 0.5), "materials": MATERIALS, "shapes.wall": _wall("silver"),
            "shapes.body": {**BODY, "center": center},
        }
    )  # fmt: skip
    light = direct_light(scene)
    assert rows_of(light, "r2.top", "shapes.wall") == [], where
    assert light.direct.visible_fraction[only(light, "r2.top")] == 1.0


def test_a_source_hides_its_own_ghost(scene_with: SceneMaker) -> None:
    """Lens, source and mirror in one line: the image stands wholly behind the source's own body."""
    end = {
        "type": "rectangle", "center": "[4, 0, 0.2] m", "size": "[2, 2] m", "normal": [-1, 0, 0], "material": "silver",
    }  # fmt: skip
    straight = scene_with({**PLAIN, **_source(2.0, 0.0), "materials": MATERIALS, "shapes.end": end})
    assert rows_of(direct_light(straight), "r2.top", "shapes.end") == []
    beside = direct_light(straight.with_(_source(2.0, 0.1)))
    assert beside.direct.visible_fraction[only(beside, "r2.top", "shapes.end")] == 1.0


@pytest.mark.parametrize("height", [-0.5, 0.0, 0.6])
def test_a_mirrors_edge_cuts_a_ghost(scene_with: SceneMaker, height: float) -> None:
    """A mirror ends where the rays to `height` radii above the middle of the image meet it.

    Image at (3, 3.5, 0.2), radius 50 mm; the mirror at y = 2 m is 2/3.5 of the way. Its share is that of the disc
    below the line, to 1.5/16384^(3/4) = 0.1 % of the whole disc.
    """
    way_m = math.hypot(2.94, 3.5)
    # Tangent rays: the disc's edge as seen from the lens lies tan(asin(r/d)) above the axis, at any distance.
    top_m = 0.2 + height * math.tan(math.asin(0.05 / way_m)) * way_m * 2.0 / 3.5
    # The wall's upper edge runs along the image's own plane only nearly: 50 mm against 4.6 m.
    wall = _wall("silver", center=f"[2.5, 2, {top_m - 1.5!r}] m")
    scene = scene_with(
        {
            **PLAIN, **_source(3.0, 0.5), "robots.r2.rig.sources.top.radius": "50 mm", "materials": MATERIALS,
            "shapes.wall": wall, "render.visibility_rays": 16384,
        }
    )  # fmt: skip
    light = direct_light(scene)
    row = only(light, "r2.top", "shapes.wall")
    assert light.direct.visible_fraction[row] == pytest.approx(1.0 - _disc_share(height), abs=2e-3)
    assert light.direct.irradiance_per_w[row, 0] == pytest.approx(
        0.9 * light.direct.visible_fraction[row] / (4.0 * math.pi * way_m**2), rel=1e-6
    )


def test_light_through_panes_is_dimmed_on_every_leg(scene_with: SceneMaker) -> None:
    """A pane across x = 1 m, tinted to 80 %: the straight ray meets it upright, the two legs of the ghost at
    atan(3.5/2.94), each once or not at all. R = 0.04 at normal incidence: (1 − R)/(1 + R) = 0.92308."""
    pane = {
        "type": "rectangle", "center": "[1, 0, 0.5] m", "size": "[10, 3] m", "normal": [-1, 0, 0], "material": "tint",
    }  # fmt: skip
    materials = {**MATERIALS, "tint": {"type": "pane", "index": 1.5, "transmission": 0.8}}
    # On the axis the pane is met at 0°.
    ahead = scene_with({**PLAIN, **_source(3.0, 0.0), "materials": materials, "shapes.pane": pane})
    _assert_flare(ahead, direct_light(ahead), np.array([2.94, 0.0, 0.0]), 0.8 * 0.96 / 1.04)
    # The first leg of the ghost in the wall at y = 2 crosses x = 1; the second, from x = 1.74 on, does not.
    both = ahead.with_({**_source(3.0, 0.5), "shapes.wall": _wall("silver")})
    light = direct_light(both)
    offset_m = np.array([2.94, 3.5, 0.0])
    face = fresnel_by_hand(math.degrees(math.atan2(3.5, 2.94)), 1.5)
    once = 0.8 * (1.0 - face) / (1.0 + face)
    _assert_flare(both, light, offset_m, 0.9 * once)
    # A second pane at x = 2.4 m is crossed by the second leg too, at the same angle.
    twice = both.with_({"shapes.second": {**pane, "center": "[2.4, 0, 0.5] m"}})
    _assert_flare(twice, direct_light(twice), offset_m, 0.9 * once**2)


def test_a_pane_is_not_crossed_by_the_light_that_it_mirrors(scene_with: SceneMaker) -> None:
    """A pane's ghost has 2R/(1 + R) of the light and no transmittance, however dark the pane is."""
    shares = []
    for transmission in (1.0, 0.1):
        materials = {"tint": {"type": "pane", "index": 1.5, "transmission": transmission}}
        scene = scene_with(
            {**PLAIN, **_source(3.0, 0.5), "materials": materials, "shapes.wall": _wall("tint")}
        )
        light = direct_light(scene)
        row = only(light, "r2.top", "shapes.wall")
        shares.append(
            light.direct.irradiance_per_w[row, 0] * 4.0 * math.pi * light.direct.distance_m[row] ** 2
        )
    face = fresnel_by_hand(math.degrees(math.atan2(2.94, 3.5)), 1.5)
    assert shares[0] == pytest.approx(2.0 * face / (1.0 + face), rel=1e-3)
    assert shares[1] == shares[0]


def test_ghosts_and_sources_add_up(scene_with: SceneMaker) -> None:
    """Electrons of a frame with two sources and their ghosts are the sum of the frames of each alone."""
    from nir_render import expected_electrons

    third = {"rig": "infra_swarm", "position": "[3.5, 0.9, -0.1] m"}
    both = scene_with(
        {**_source(3.0, 0.5), "robots.r3": third, "materials": MATERIALS, "shapes.wall": _wall("silver")}
    )
    light = direct_light(both)
    assert len(light.direct.group) == 4  # two sources and their ghosts; r1's own stand behind its lens
    whole = expected_electrons(light, both, EXPOSURE_S)
    parts = np.zeros_like(whole)
    for name in ("r1", "r2", "r3"):
        others = [other for other in ("r1", "r2", "r3") if other != name]
        alone = both.with_({f"robots.{other}.rig.sources.top.flux": "1e-30 W" for other in others})
        parts += expected_electrons(light, alone, EXPOSURE_S)
    np.testing.assert_allclose(parts, whole, rtol=1e-9, atol=1e-12)
    assert whole.sum() > 1e3
