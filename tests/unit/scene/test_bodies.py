"""Bodies of robots and shapes that move: where they are in a snapshot, and who may not sit in them."""

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.geometry import rectangle_frame
from nir_render.scene.bodies import carried
from nir_render.scene.documents.shapes import Box, Cylinder, Rectangle, Sphere
from nir_render.scene.pose import Pose, rotation_of
from nir_render.scene.scene import Scene, parse_scene

HULL = {"type": "box", "center": "[-0.2, 0, 0.1] m", "size": "[0.1, 0.2, 0.2] m", "material": "black"}
POSE = Pose.of((1.0, -2.0, 0.5), yaw_rad=0.7, pitch_rad=-0.4, roll_rad=1.1)


def _scene(body: dict[str, object], **parts: object) -> Scene:
    robots = {
        "r1": {"rig": "infra_swarm"},
        "r2": {"rig": {"preset": "infra_swarm", "body": body}, "position": "[2, 0, 0] m",
               "orientation": {"yaw": "90 deg"}},
    }  # fmt: skip
    return parse_scene({"format": 1, "observe": ["r1.front"], "robots": robots, **parts})


def test_a_body_stands_in_the_world_where_its_robot_is() -> None:
    world = _scene({"hull": HULL}).at(0.0)
    hull = world.shapes["r2.body.hull"]
    assert isinstance(hull, Box)
    np.testing.assert_allclose(hull.center_m, [2.0, -0.2, 0.1], atol=1e-12)
    assert hull.orientation.yaw_rad == pytest.approx(np.pi / 2.0)
    moved = world.moved({"r2": Pose.of((5.0, 0.0, 0.0))}).shapes["r2.body.hull"]
    assert isinstance(moved, Box)
    np.testing.assert_allclose(moved.center_m, [4.8, 0.0, 0.1], atol=1e-12)


def test_shapes_are_carried_whole() -> None:
    """What lies in a corner of a shape lies there still when the frame turns about all three axes."""
    plain = {"center": "[0.3, 0.1, 0.2] m", "material": "black"}
    rectangle = Rectangle.model_validate(
        {"type": "rectangle", "size": "[2, 1] m", "normal": [1, 2, 3], "rotation": "20 deg", **plain}
    )
    turned = carried(rectangle, POSE)
    assert isinstance(turned, Rectangle)
    corner = np.array([1.0, 1.0, 0.0])
    frame = rectangle_frame(rectangle.normal, rectangle.size_m, rectangle.rotation_rad)
    frame_turned = rectangle_frame(turned.normal, turned.size_m, turned.rotation_rad)
    before_m = POSE.rotation @ (frame @ corner + rectangle.center_m) + POSE.position_m
    np.testing.assert_allclose(frame_turned @ corner + turned.center_m, before_m, atol=1e-12)
    box = Box.model_validate(
        {"type": "box", "size": "[1, 2, 3] m", "orientation": {"yaw": "30 deg", "roll": "10 deg"}, **plain}
    )
    other = carried(box, POSE)
    assert isinstance(other, Box)
    np.testing.assert_allclose(
        rotation_of(other.orientation), POSE.rotation @ rotation_of(box.orientation), atol=1e-12
    )
    tube = Cylinder.model_validate(
        {"type": "cylinder", "start": "[0, 0, 0] m", "end": "[0, 0, 1] m", "radius": "0.1 m",
         "material": "black"}
    )  # fmt: skip
    stood = carried(tube, POSE)
    assert isinstance(stood, Cylinder)
    np.testing.assert_allclose(stood.end_m, POSE.rotation[:, 2] + POSE.position_m, atol=1e-12)


def test_a_door_turns_about_its_hinge() -> None:
    """A leaf written from the hinge on swings with the frame; what stands beside it stays the same object."""
    door = {
        "type": "rectangle", "center": "[0.5, 0, 1] m", "size": "[1, 2] m", "normal": [0, 1, 0],
        "material": "black",
        "motion": [
            {"time": "0 s", "position": "[3, 1, 0] m"},
            {"time": "2 s", "position": "[3, 1, 0] m", "orientation": {"yaw": "90 deg"}},
        ],
    }  # fmt: skip
    ball = {"type": "sphere", "center": "[0, 3, 0] m", "radius": "0.1 m", "material": "black"}
    scene = _scene({}, shapes={"door": door, "ball": ball})
    leaf = scene.at(1.0).shapes["door"]
    assert isinstance(leaf, Rectangle)
    half = 0.5 * np.sqrt(0.5)
    np.testing.assert_allclose(leaf.center_m, [3.0 + half, 1.0 + half, 1.0], atol=1e-12)
    np.testing.assert_allclose(leaf.normal, [-np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-12)
    assert isinstance(scene.at(1.0).shapes["ball"], Sphere)
    assert scene.at(1.0).shapes["ball"] is scene.document.shapes["ball"]


@pytest.mark.parametrize(
    ("body", "shapes", "told"),
    [
        ({"hull": {**HULL, "center": "[-0.06, 0, 0.2] m"}}, {}, "rig.cameras.back: is inside the robot's own"),
        ({"hull": {**HULL, "center": "[0, 0, 0.3] m"}}, {}, "rig.sources.top: is inside the robot's own"),
        ({"hull": {**HULL, "material": "gold"}}, {}, "robots.r2.rig.body.hull.material: there is no material"),
        ({"hull": {**HULL, "motion": [{"time": "0 s", "position": "[0, 0, 0] m"}]}}, {}, "moves with its"),
        (
            {"long": {**HULL, "center": "[0, 2, 0.2] m"}},  # r2 is turned to the left: at [0, 0, 0.2] m
            {},
            "the camera is inside robots.r2.rig.body.long at 0 s",
        ),
        (
            {},
            {"man": {"type": "sphere", "center": "[0, 0, 0.2] m", "radius": "0.1 m", "material": "black",
                     "motion": [{"time": "0 s", "position": "[0, -1, 0] m"},
                                {"time": "1 s", "position": "[0, 0, 0] m"}]}},
            "the camera is inside shapes.man at 1 s",
        ),
    ],
)  # fmt: skip
def test_cameras_and_sources_are_not_shut_in(
    body: dict[str, object], shapes: dict[str, object], told: str
) -> None:
    with pytest.raises(InputError) as raised:
        _scene(body, shapes=shapes, clock={"frames": 2, "frame_rate": "1 Hz"})
    assert told in str(raised.value)
