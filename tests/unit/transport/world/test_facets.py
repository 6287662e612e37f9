"""Flat smooth surfaces: their places against rays that Mitsuba traces, their optics against its materials."""

import math
from typing import Any

import numpy as np
import pytest

from nir_render import Scene, load_scene
from nir_render.transport.backend.variant import backend
from nir_render.transport.world import mitsuba_scene as world
from nir_render.transport.world.facets import (
    COAT,
    MIRROR,
    PANE,
    facets,
    fresnel,
    pane_transmittance,
    reflectance,
)
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

BOX = {
    "type": "box", "center": "[3, 1, 0.5] m", "size": "[0.4, 0.6, 0.8] m",
    "orientation": {"yaw": "30 deg", "pitch": "20 deg", "roll": "-50 deg"},
}  # fmt: skip
SHEET = {
    "type": "rectangle", "center": "[2, 0, 1] m", "size": "[2, 1] m", "normal": [-1, 2, 0.5], "rotation": "15 deg",
}  # fmt: skip
MATERIALS = {
    "silver": {"type": "mirror", "reflectance": 0.9},
    "pane": {"type": "pane", "index": 1.5, "transmission": 0.8},
    "gloss": {"type": "plastic", "index": 1.4, "reflectance": 0.3, "roughness": 0.0},
    "rough": {"type": "plastic", "index": 1.4, "reflectance": 0.3, "roughness": 0.1},
    "glass": {"type": "dielectric", "index": 1.6},
    "paint": {"type": "diffuse", "reflectance": 0.5},
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


def _with(scene: Scene, **shapes: Any) -> Scene:
    return scene.with_({"materials": MATERIALS, "shapes": shapes, "robots.r2": {"rig": "infra_swarm"}})


def test_which_surfaces_show_images(scene: Scene) -> None:
    """Rectangles and boxes that are smooth; six faces to a box; only rectangles reflect on both sides."""
    ball = {"type": "sphere", "center": "[9, 9, 9] m", "radius": "0.1 m"}
    flat = facets(
        _with(
            scene,
            a={**SHEET, "material": "pane"},
            b={**BOX, "material": "gloss"},
            c={**SHEET, "material": "rough"},
            d={**BOX, "material": "paint"},
            e={**ball, "material": "silver"},
            f={**SHEET, "material": "gloss"},
            g={**SHEET, "material": "silver"},
            h={**BOX, "material": "glass"},
        ).at(0.0)
    )
    boxes = [f"shapes.b.{face}" for face in range(6)]
    glass = [f"shapes.h.{face}" for face in range(6)]
    assert flat.name == ("shapes.a", *boxes, "shapes.f", "shapes.g", *glass)
    assert flat.kind.tolist() == [PANE, *[COAT] * 7, MIRROR, *[COAT] * 6]
    assert flat.index.tolist() == [1.5, *[1.4] * 7, 1.0, *[1.6] * 6]
    assert flat.factor.tolist() == [*[1.0] * 8, 0.9, *[1.0] * 6]
    assert flat.transmission.tolist() == [0.8, *[0.0] * 14]
    assert flat.two_sided.tolist() == [True, *[False] * 6, True, True, *[False] * 6]
    assert facets(scene.at(0.0)).name == ()
    assert facets(scene.at(0.0)).normal.shape == (0, 3)


@pytest.mark.parametrize("kind", ["box", "rectangle"])
def test_facets_lie_where_mitsuba_has_them(scene: Scene, kind: str) -> None:
    """Rays onto points of each facet, just within its four corners and just beyond: the first hit is there, on the
    triangle pair of that number, with that normal; beyond, none."""
    shape = {**(BOX if kind == "box" else SHEET), "material": "silver"}
    changed = _with(scene, body=shape)
    flat, bodies, mi = facets(changed.at(0.0)), world.build(changed.at(0.0)), backend().mi
    assert len(flat.name) == (6 if kind == "box" else 1)
    for face in range(len(flat.name)):
        for a, b in ((0.97, 0.97), (-0.97, 0.97), (0.97, -0.97), (-0.97, -0.97), (0.3, 0.1)):
            point_m = flat.center_m[face] + a * flat.half_u_m[face] + b * flat.half_v_m[face]
            start_m, towards = point_m + 0.01 * flat.normal[face], -flat.normal[face]
            hit = bodies.ray_intersect(mi.Ray3f(mi.Point3f(start_m.tolist()), mi.Vector3f(towards.tolist())))
            assert float(np.array(hit.t).ravel()[0]) == pytest.approx(0.01, abs=1e-5)
            assert int(np.array(hit.prim_index).ravel()[0]) // 2 == face
            np.testing.assert_allclose(np.array(hit.n).ravel(), flat.normal[face], atol=1e-5)
            beyond_m = (
                flat.center_m[face] + 1.03 / 0.97 * (point_m - flat.center_m[face]) + 0.01 * flat.normal[face]
            )
            ray = mi.Ray3f(mi.Point3f(beyond_m.tolist()), mi.Vector3f(towards.tolist()))
            ray.maxt = 0.011
            if (a, b) != (0.3, 0.1):
                assert not np.array(bodies.ray_test(ray)).any()


@pytest.mark.parametrize(
    ("angle_deg", "expected"),
    [(0.0, 0.04), (60.0, 0.0891867), (math.degrees(math.atan(1.5)), 0.0739645), (90.0, 1.0)],
)
def test_fresnel_by_hand(angle_deg: float, expected: float) -> None:
    """n = 1.5: 4 % at normal incidence; at Brewster's angle r_s² = ((n² − 1)/(n² + 1))² = 0.1479 halved."""
    assert float(fresnel(math.cos(math.radians(angle_deg)), 1.5)) == pytest.approx(expected, abs=1e-6)


def test_fresnel_is_mitsubas() -> None:
    mi = backend().mi
    cosines = np.linspace(0.01, 1.0, 50)
    for index in (1.1, 1.5, 3.5):
        theirs = np.array(
            [np.array(mi.fresnel(mi.Float(float(cosine)), index)[0]).ravel()[0] for cosine in cosines]
        )
        np.testing.assert_allclose(fresnel(cosines, index), theirs, rtol=2e-5, atol=1e-6)
    np.testing.assert_array_equal(fresnel(cosines, 1.0), 0.0)
    assert fresnel(0.0, 1.0) == 0.0


@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 75.0])
def test_panes_coats_and_mirrors_reflect_as_in_mitsuba(scene: Scene, angle_deg: float) -> None:
    """What our Mitsuba materials sample as mirror reflection and as straight passage, weight × probability."""
    mi = backend().mi
    names = ("pane", "silver", "glass")
    shapes = {name: {**(BOX if name == "glass" else SHEET), "material": name} for name in names}
    changed = _with(scene, **shapes)
    flat, bodies = facets(changed.at(0.0)), world.build(changed.at(0.0))
    angle = math.radians(angle_deg)
    for name in names:
        shape = next(body for body in bodies.shapes() if body.id() == f"shape_{name}_0")
        which = next(index for index, known in enumerate(flat.name) if known.startswith(f"shapes.{name}"))
        local = mi.Vector3f(math.sin(angle), 0.0, math.cos(angle))
        si = mi.SurfaceInteraction3f()
        si.wi = local
        found = {"reflected": 0.0, "passed": 0.0}
        for number in (1e-6, 1.0 - 1e-6):  # one of the two lobes each
            sample, weight = shape.bsdf().sample(mi.BSDFContext(), si, mi.Float(number), mi.Point2f(0.5, 0.5))
            out = np.array(sample.wo).ravel()
            share = float(np.array(weight).ravel()[0]) * float(np.array(sample.pdf).ravel()[0])
            if out[2] > 0.0:
                found["reflected"] = share
            elif name == "pane":
                np.testing.assert_allclose(out, [-math.sin(angle), 0.0, -math.cos(angle)], atol=1e-6)
                found["passed"] = share
        assert float(reflectance(flat, which, math.cos(angle))) == pytest.approx(
            found["reflected"], rel=1e-4
        ), name
        if name == "pane":
            passed = float(pane_transmittance(flat, which, math.cos(angle)))
            assert passed == pytest.approx(found["passed"], rel=1e-4)
            assert passed == pytest.approx(0.8 * (1.0 - found["reflected"]), rel=1e-4)


def test_facets_and_angles_broadcast(scene: Scene) -> None:
    flat = facets(_with(scene, a={**SHEET, "material": "pane"}, b={**SHEET, "material": "silver"}).at(0.0))
    table = reflectance(flat, np.array([[0], [1]]), np.array([1.0, 0.5]))
    np.testing.assert_allclose(table, [[0.08 / 1.04, 2 * 0.08918671 / 1.08918671], [0.9, 0.9]], rtol=1e-6)
