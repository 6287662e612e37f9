"""Robots at random places: as many as are asked for, each where nothing else is, by outlines of the test's own."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from numpy.typing import NDArray
from scipy import stats

from nir_render import load_scene
from nir_render.errors import InputError
from nir_render.scene.documents.shapes import Box, Cylinder, Rectangle, Sphere
from nir_render.scene.scatter.outline import hull_of, outlines
from nir_render.scene.scene import Scene, parse_scene
from tests.paths import SCENES

EVERYWHERE = np.array([[-99.0, -99.0], [99.0, 99.0]])
RIG = {
    "preset": "infra_swarm",
    "body": {
        "hull": {"type": "cylinder", "start": "[0.02, 0, 0] m", "end": "[0.02, 0, 0.15] m", "radius": "0.1 m", "material": "dark"}
    },
}  # fmt: skip
ROOM: dict[str, Any] = {
    "format": 1,
    "observe": ["r1", "crowd_2.front"],
    "clock": {"frames": 3, "frame_rate": "1 Hz"},
    "robots": {
        "r1": {"rig": RIG},
        "runner": {
            "rig": RIG,
            "motion": [
                {"time": "0 s", "position": "[-2, -1, 0] m"},
                {"time": "2 s", "position": "[2, -1, 0] m"},
            ],
        },
    },
    "materials": {"dark": {"type": "diffuse", "reflectance": 0.1}},
    "shapes": {
        "floor": {"type": "rectangle", "center": "[0, 0, 0] m", "size": "[9, 9] m", "material": "dark"},
        "wall": {"type": "rectangle", "center": "[1, 0.7, 1] m", "size": "[2, 2] m", "normal": [1, 0.4, 0], "material": "dark"},
        "crate": {"type": "box", "center": "[-1.5, 0.8, 0.2] m", "size": "[0.8, 0.5, 0.4] m", "orientation": {"yaw": "30 deg", "pitch": "20 deg"}, "material": "dark"},
        "pipe": {"type": "cylinder", "start": "[-2, -0.2, 0.1] m", "end": "[-0.5, -0.5, 0.5] m", "radius": "0.06 m", "material": "dark"},
        "ball": {"type": "sphere", "center": "[1.8, 1.2, 0.5] m", "radius": "0.4 m", "material": "dark"},
        "duct": {"type": "box", "center": "[0, 0, 1.79] m", "size": "[9, 9, 3] m", "material": "dark"},
    },
    "scatter": {
        "crowd": {"rig": RIG, "count": 20, "center": "[0, 0, 0] m", "size": "[5, 3.4, 0] m", "clearance": "4 cm"},
        "few": {"rig": RIG, "count": 3, "center": "[0, 0, 0] m", "size": "[5, 3.4, 0] m", "orientation": {"yaw": "10 deg"}},
    },
}  # fmt: skip
RADIUS_M, HIGH_M = 0.12, 0.29  # of the rig: its body's farther rim; its source's top


def places_m(scene: Scene, group: str) -> NDArray[np.float64]:
    robots = scene.document.robots
    found = [robots[name].position_m for name in robots if name.startswith(f"{group}_")]
    return np.array(found).reshape(-1, 3)


def surface_points_m(scene: Scene) -> dict[str, NDArray[np.float64]]:
    """Return points on the shapes, a centimetre apart, by trimesh."""
    points = {}
    for name, shape in scene.document.shapes.items():
        match shape:
            case Box():
                mesh = trimesh.creation.box(shape.size_m)
                angles = (shape.orientation.yaw_rad, shape.orientation.pitch_rad, shape.orientation.roll_rad)
                mesh.apply_transform(trimesh.transformations.euler_matrix(*angles, axes="rzyx"))
                mesh.apply_translation(shape.center_m)
            case Sphere():
                mesh = trimesh.creation.icosphere(subdivisions=4, radius=shape.radius_m)
                mesh.apply_translation(shape.center_m)
            case Cylinder():
                mesh = trimesh.creation.cylinder(shape.radius_m, segment=[shape.start_m, shape.end_m])
            case Rectangle():
                across = np.cross([0.0, 0.0, 1.0], shape.normal)
                if not across.any():  # the floor, which is touched everywhere
                    continue
                across /= np.linalg.norm(across)
                u, v = np.meshgrid(np.linspace(-1, 1, 201), np.linspace(-1, 1, 201))
                points[name] = np.array(shape.center_m) + u.reshape(-1, 1) * across + v.reshape(-1, 1) * [0, 0, 1]  # fmt: skip
                continue
            case _:
                raise AssertionError(shape)
        points[name] = np.asarray(trimesh.sample.sample_surface_even(mesh, 20_000, seed=1)[0])
    return points


@pytest.fixture(scope="module")
def room() -> Scene:
    return parse_scene(ROOM)


def test_as_many_as_are_wanted_within_the_box_apart_and_clear_of_all(room: Scene) -> None:
    crowd_m, few_m = places_m(room, "crowd"), places_m(room, "few")
    assert (len(crowd_m), len(few_m)) == (20, 3)
    hull = hull_of(room.document.robots["r1"].rig, np.eye(3))
    assert (hull.radius_m, hull.low_m, hull.high_m) == pytest.approx((RADIUS_M, 0.0, HIGH_M), abs=1e-9)
    all_m = np.concatenate([crowd_m, few_m])
    assert (np.abs(all_m[:, 0]) <= 2.5 - RADIUS_M).all()
    assert (np.abs(all_m[:, 1]) <= 1.7 - RADIUS_M).all()
    assert not all_m[:, 2].any()
    runner_m = [[-2.0, -1.0, 0.0], [0.0, -1.0, 0.0], [2.0, -1.0, 0.0]]
    known_m = np.concatenate([all_m, [[0.0, 0.0, 0.0]], runner_m])
    for number, place_m in enumerate(all_m):
        off_m = np.linalg.norm(np.delete(known_m, number, axis=0) - place_m, axis=1)
        assert off_m.min() >= 2.0 * RADIUS_M  # `few` want no more
        if number < 20:  # `few` were put after them
            assert np.linalg.norm(np.delete(known_m[:20], number, axis=0) - place_m, axis=1).min() >= 0.28
            assert np.linalg.norm(known_m[23:] - place_m, axis=1).min() >= 0.28
    points_m = surface_points_m(room)
    for name, of_shape_m in points_m.items():
        beside_m = of_shape_m[(of_shape_m[:, 2] > 0.0) & (of_shape_m[:, 2] < HIGH_M)]
        if name == "duct":
            assert not len(beside_m)
            continue
        off_m = np.linalg.norm(all_m[:, None, :2] - beside_m[:, :2], axis=-1)
        assert off_m[:20].min() >= RADIUS_M + 0.04 - 1e-3, name
        assert off_m[20:].min() >= RADIUS_M - 1e-3, name


def test_outlines_are_no_wider_than_what_is_there(room: Scene) -> None:
    """Against points of the surfaces, from places all around: what is free is not refused."""
    rng = np.random.default_rng(1)
    around_m = rng.uniform(-3.0, 3.0, (200, 2))
    for name, points_m in surface_points_m(room).items():
        if name == "duct":
            continue
        shape = room.document.shapes[name]
        beside_m = points_m[(points_m[:, 2] > 0.0) & (points_m[:, 2] < HIGH_M)][:, :2]
        nearest_m = np.linalg.norm(around_m[:, None] - beside_m, axis=-1).min(axis=1)
        said_m = np.min(
            [one.distances_m(around_m) for one in outlines(shape, 0.0, HIGH_M, EVERYWHERE)], axis=0
        )
        outside = said_m > 0.03
        assert np.abs(said_m - nearest_m)[outside].max() < 0.02, name


def test_a_place_is_the_same_whatever_the_count_and_free_ones_are_as_likely_as_each_other() -> None:
    alone = {"rig": "infra_swarm", "center": "[1, 2, 0] m", "size": "[8, 4, 1] m"}
    bare = {"format": 1, "observe": ["a_1"], "scatter": {"a": {**alone, "count": 7}}}
    few = parse_scene(bare)
    many = few.with_({"scatter.a.count": 9})
    assert (places_m(many, "a")[:7] == places_m(few, "a")).all()
    assert (places_m(few.with_({"scatter.a.seed": 2}), "a") != places_m(few, "a")).all()
    assert (places_m(few.with_({"seed": 2}), "a") == places_m(few, "a")).all()
    seeds = [few.with_({"scatter.a.count": 1, "scatter.a.seed": seed}) for seed in range(300)]
    first_m = np.concatenate([places_m(one, "a") for one in seeds])
    # Its cameras are 6 cm from its axis; its source ends 29 cm above its origin.
    for axis, (low_m, high_m) in enumerate([(-2.94, 4.94), (0.06, 3.94), (-0.5, 0.21)]):
        assert stats.kstest(first_m[:, axis], stats.uniform(low_m, high_m - low_m).cdf).pvalue > 1e-3
    yaw_rad = [one.document.robots["a_1"].orientation.yaw_rad for one in seeds]
    assert stats.kstest(yaw_rad, stats.uniform(-math.pi, 2.0 * math.pi).cdf).pvalue > 1e-3


def test_the_resolved_document_has_them_where_they_stand(room: Scene) -> None:
    again = parse_scene(yaml.safe_load(room.resolved_yaml()))
    assert again.document.scatter is None
    assert again.document.robots == room.document.robots
    assert "crowd_2.front" in again.cameras()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"count": 400}, r"scatter.crowd: \d+ of 400 robots have found a free place, crowd_\d+ has not in 1000"),
        ({"size": "[0.2, 3, 0] m"}, "a robot is 0.24 m wide and 0.29 m high"),
        ({"size": "[3, 3, 0.2] m"}, "a robot is 0.24 m wide and 0.29 m high"),
        ({"size": "[3, -3, 0] m"}, "scatter.crowd.size: an extent is negative"),
        ({"rig": "nope"}, "scatter.crowd.rig: there is no preset 'nope'"),
        ({"count": 1}, "there is no robot or camera 'crowd_2.front'"),
    ],
)  # fmt: skip
def test_what_cannot_be_scattered_says_why(room: Scene, change: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        room.with_({f"scatter.crowd.{key}": value for key, value in change.items()})


def test_names_that_are_taken_and_scenes_without_robots_are_refused(room: Scene) -> None:
    with pytest.raises(InputError, match="there is a robot 'crowd_3' already; rename one of them"):
        room.with_({"robots.crowd_3": {"rig": "infra_swarm"}})
    with pytest.raises(InputError, match="robots: there is none; write such as"):
        parse_scene({"format": 1, "observe": ["r1"]})


def test_a_mesh_is_in_the_way() -> None:
    scene = load_scene(SCENES / "crowd.yaml")
    plant = scene.document.shapes["plant"]
    near = list(outlines(plant, 0.0, HIGH_M, EVERYWHERE))
    assert len(near) > 6  # the stem's sides at least
    crowd_m = places_m(scene, "crowd")
    off_m = np.min([one.distances_m(crowd_m[:, :2]) for one in near], axis=0)
    assert off_m.min() >= 0.06 + 0.1
    assert all(
        np.linalg.norm(np.subtract(one, other)) >= 0.12 + 0.1
        for one, other in itertools.combinations(crowd_m, 2)
    )


@pytest.mark.parametrize(
    ("kind", "thing"),
    [
        ("robots", {"rig": RIG, "position": "[{x} + 0.12, 0, 0] m"}),
        ("shapes", {"type": "box", "center": "[{x} + 0.5, 0.3, 0.3] m", "size": "[1, 1, 0.1] m", "material": "dark"}),
        ("shapes", {"type": "rectangle", "center": "[{x}, 0, 0.3] m", "size": "[1, 0.1] m", "normal": [1, 0, 0], "material": "dark"}),
        ("shapes", {"type": "cylinder", "start": "[{x} + 0.06, 0, 0.1] m", "end": "[{x} + 0.06, 0, 0.2] m", "radius": "0.06 m", "material": "dark"}),
        # 0.29 m up, where the robot ends, the sphere is 0.3 m wide to either side.
        ("shapes", {"type": "sphere", "center": "[{x} + 0.3, 0, 0.69] m", "radius": "0.5 m", "material": "dark"}),
    ],
    ids=["robot", "box", "rectangle", "cylinder", "sphere"],
)  # fmt: skip
def test_a_thing_is_in_the_way_from_the_clearance_on(kind: str, thing: dict[str, Any]) -> None:
    """The box leaves one place alone, its middle: there a robot fits beside a thing, or it does not."""
    only = {"rig": RIG, "count": 1, "center": "[0, 0, 0] m", "size": "[0.24, 0.24, 0] m", "clearance": "4 cm"}
    bare = {**{key: ROOM[key] for key in ("format", "materials")}, "observe": ["a_1"], "scatter": {"a": only}}

    def fits(x_m: float) -> bool:
        """Tell whether the thing's nearest point may be at x."""
        written = {key: _placed(value, x_m) for key, value in thing.items()}
        try:
            parse_scene({**bare, kind: {"thing": written}})
        except InputError as error:
            if "0 of 1 robots have found a free place" not in str(error):
                raise
            return False
        return True

    assert fits(RADIUS_M + 0.04 + 2e-4)
    assert not fits(RADIUS_M + 0.04 - 2e-4)


def _placed(value: Any, x_m: float) -> Any:
    """Write "[{x} + 0.5, 0, 0] m" out."""
    if not isinstance(value, str) or "{x}" not in value:
        return value
    first, rest = value[1:].split(",", 1)
    return f"[{x_m + float(first.partition('+')[2] or 0.0)},{rest}"
