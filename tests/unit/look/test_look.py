"""A scene from outside: what is where in the picture, how grey it is, and what stands in nobody's way."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nir_render as nr
from nir_render.look.outlooks import from_above, from_outside, interest_m
from nir_render.look.sheet import look_png
from nir_render.scene.scene import Scene
from nir_render.transport.outside import Outlook, bodies_of, grey_picture
from tests.system.command import nir_render

pytestmark = pytest.mark.mitsuba


def _room() -> Scene:
    """A floor of 0.36 under a ceiling that looks down; on it a crate of 0.64, 1 m high, its corner at (1, 1)."""
    shapes = {
        "floor": {"type": "rectangle", "center": "[0, 0, 0] m", "size": "[6, 4] m", "material": "grey"},
        "ceiling": {
            "type": "rectangle",
            "center": "[0, 0, 2.5] m",
            "size": "[6, 4] m",
            "normal": [0, 0, -1],
            "material": "grey",
        },
        "crate": {
            "type": "box",
            "center": "[1.5, 1.25, 0.5] m",
            "size": "[1, 0.5, 1] m",
            "material": "light",
        },
    }
    materials = {
        "grey": {"type": "diffuse", "reflectance": 0.36},
        "light": {"type": "diffuse", "reflectance": 0.64},
    }
    robots = {"r1": {"rig": "infra_swarm"}, "r2": {"rig": "infra_swarm", "position": "[-2, 1, 0] m"}}
    document = {"format": 1, "observe": ["r1.front"], "robots": robots}
    return nr.parse_scene({**document, "shapes": shapes, "materials": materials})


@pytest.mark.parametrize("parallel", [True, False])
def test_rays_go_where_points_are_drawn(parallel: bool) -> None:
    box_m = np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 2.5]])
    outlook = from_above(box_m, 90) if parallel else from_outside(box_m, 80, 60)
    start_m, direction = outlook.rays()
    place, depth_m = outlook.project_px(start_m + 3.7 * direction)
    v, u = np.divmod(np.arange(len(start_m)), outlook.width_px)
    assert place == pytest.approx(np.stack([u, v], axis=1), abs=1e-9)
    assert (depth_m > 0.0).all()


def test_the_box_fills_the_picture_and_stays_in_it() -> None:
    box_m = np.array([[-6.0, -5.0, 0.1], [6.5, 5.0, 0.6]])
    outlook = from_outside(box_m, 800, 600)
    corners_m = np.stack(np.meshgrid(*box_m.T, indexing="ij"), axis=-1).reshape(-1, 3)
    place, _ = outlook.project_px(corners_m)
    least, most = place.min(axis=0), place.max(axis=0)
    assert (least > -2.0).all()
    assert (most < [801.0, 601.0]).all()
    assert ((most - least) / [800.0, 600.0]).max() > 0.98
    assert 0.5 * (most + least) == pytest.approx([399.5, 299.5], abs=10.0)


def test_bodies_are_where_they_are_and_as_grey_as_they_reflect() -> None:
    """Through the ceiling, which is open from behind; the crate's top and the floor face the same way."""
    snapshot = _room().at(0.0)
    bodies = bodies_of(snapshot)
    outlook = from_above(np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 2.5]]), 120)
    grey = grey_picture(bodies, outlook)
    assert grey.shape == (80, 120)

    def at(x_m: float, y_m: float) -> float:
        (u, v), _ = outlook.project_px(np.array([x_m, y_m, 0.0]))
        return float(grey[round(v), round(u)])

    assert at(1.5, 1.25) / at(-1.5, 1.25) == pytest.approx(0.64 / 0.36)
    assert at(-1.5, 1.25) == pytest.approx(0.36 * (0.35 + 0.65 * 0.62), rel=1e-3)
    crate = np.isclose(grey, at(1.5, 1.25))
    assert crate.sum() * outlook.per_px**2 == pytest.approx(0.5, rel=0.15)  # less a pixel at each edge
    under = Outlook(np.array([0.0, 0.0, -3.0]), np.diag([1.0, -1.0, 1.0]), 0.05, 120, 80, True)
    assert np.isnan(grey_picture(bodies, under)).sum() == 0  # the floor too is open, the ceiling is not


@pytest.mark.parametrize("size_m", [(1.0, 30.0), (30.0, 1.0), (4.0, 4.0)])
def test_a_picture_from_above_is_never_too_tall(size_m: tuple[float, float]) -> None:
    outlook = from_above(np.array([[0.0, 0.0, 0.0], [*size_m, 2.0]]), 600)
    assert max(outlook.width_px, outlook.height_px) == 600
    assert outlook.per_px * np.array([outlook.width_px, outlook.height_px]) == pytest.approx(size_m, rel=0.05)


def test_far_grounds_do_not_make_robots_small() -> None:
    ground = {"type": "rectangle", "center": "[0, 0, 0] m", "size": "[300, 300] m", "material": "grey"}
    scene = _room().with_({"shapes.ground": ground})
    box_m = interest_m(scene.at(0.0), bodies_of(scene.at(0.0)).bounds_m)
    assert ((box_m[1] - box_m[0])[:2] < 6.0).all()


def test_the_command_draws_every_kind_of_thing(tmp_path: Path) -> None:
    scene = _room().with_(
        {
            "fog": {"visibility": "50 m", "top": "1 m"},
            "sun": {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.287 W/m^2/nm"},
            "lamps": {"one": {"preset": "halogen", "center": "[0, 0, 2.4] m"}},
            "beacons": {"remote": {"preset": "remote_control_940", "position": "[1, -1, 1] m"}},
        }
    )
    size = Image.open(io.BytesIO(look_png(scene))).size
    assert size[0] > 1500
    (tmp_path / "s.yaml").write_text(scene.resolved_yaml(), encoding="utf-8")
    done = nir_render("look", "s.yaml", "-o", "s.png", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "s.png") as picture:
        assert picture.size == size
    assert nir_render("look", "s.yaml", "-o", "s.svg", cwd=tmp_path).returncode == 2
