"""From a scene to the light that reaches one camera."""

from nir_render.errors import InputError
from nir_render.scene.checks import indivisible_sensor, solid_around
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose
from nir_render.transport import stock, world
from nir_render.transport.direct import direct_table
from nir_render.transport.light import Light


def render(scene: Scene, camera: str, time_s: float, seed: int) -> Light:
    """Return the light that reaches a camera, `robot.camera`, with the geometry at a time.

    Raises
    ------
    InputError
        No such camera, or the camera is inside a body.
    """
    robot, device = scene.camera(camera)
    pose = camera_pose(robot, device, time_s)
    inside = solid_around(scene.document, pose.position_m)
    if inside is not None:
        raise InputError(
            f"{scene.path}: the camera {camera} is inside shapes.{inside} at {time_s:g} s; move one"
        )
    indivisible = indivisible_sensor(scene.document, camera)
    if indivisible is not None:
        raise InputError(f"{scene.path}: {indivisible}")
    world.check_meshes(scene, pose.position_m, f"the camera {camera} at {time_s:g} s")
    direct = direct_table(scene, pose, time_s, specular=False)
    indirect = stock.indirect(scene, camera, device, pose, time_s, seed, direct)
    return Light(camera, time_s, seed, world.groups(scene), (940e-9,), direct, indirect)
