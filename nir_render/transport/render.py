"""From a scene to the light that reaches one camera."""

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.emission import emission_units
from nir_render.camera.response import response
from nir_render.errors import InputError
from nir_render.scene.checks import indivisible_sensor, solid_around
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose
from nir_render.transport import groups, stock, world
from nir_render.transport.backend import backend
from nir_render.transport.direct import direct_table
from nir_render.transport.facets import facets
from nir_render.transport.light import Light

_STEP, _STEPS = 4, 6


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
    grouped = backend().vectorised
    direct = direct_table(scene, pose, time_s, specular=grouped)
    names = world.groups(scene)
    if not grouped:
        light = stock.indirect(scene, camera, device, pose, time_s, seed, direct)
        return Light(camera, time_s, seed, names, (940e-9,), direct, light)
    key = groups.light_seed(seed, "indirect", camera, time_s)
    power = _power(scene, device)
    light = groups.indirect(scene, groups.rays_of(device, pose), time_s, key, power)
    return Light(camera, time_s, seed, names, (940e-9,), direct, light, facets(scene).name)


def _power(scene: Scene, camera: Camera) -> NDArray[np.float64]:
    """Return what each group counts when lights are chosen: the electrons that it brings, roughly.

    In steps of 4 below the strongest: so a light is rendered anew seldom when a source's power, the spectrum or
    the filter change, which otherwise matter only afterwards. It moves nothing but noise.
    """
    known = scene.emitters().values()
    brought = np.array([emission_units(one) * float(response(camera, one)(0.0)) for one in known])
    strongest = brought.max() if brought.size else 1.0
    steps = np.round(np.log(np.maximum(brought, 1e-30) / max(strongest, 1e-30)) / np.log(_STEP))
    return np.asarray(float(_STEP) ** np.maximum(steps, -_STEPS))
