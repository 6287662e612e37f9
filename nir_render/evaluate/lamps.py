"""Where lamps and the sun stand in a frame: detections there are neither hits nor false alarms."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.camera.lens import intrinsics_of
from nir_render.geometry import cone_directions, cone_versine, rectangle_frame
from nir_render.scene.load import Scene
from nir_render.scene.motion import Pose, camera_pose
from nir_render.transport.facets import facets
from nir_render.transport.rays import crossing
from nir_render.transport.ways import ghosts, small_lights, straight
from perception.types import Detection

_EDGE_POINTS = 32
_MARGIN_PX = 5.0


def lamp_outlines_px(scene: Scene, camera: str, time_s: float) -> list[NDArray[np.float32]]:
    """Return the outline of each lamp that a camera sees from in front, as pixels (u, v), shape (n, 2).

    The sun's disc follows, and its images in flat smooth surfaces. An outline is many points, of which those
    in front of the lens are kept: a lamp that reaches behind the camera keeps the part that is seen. What
    hides a lamp is not looked at.
    """
    robot, device = scene.camera(camera)
    pose = camera_pose(robot, device, time_s)
    lens = intrinsics_of(device)
    outlines = []
    for lamp in scene.document.lamps.values():
        across, up, normal = rectangle_frame(lamp.normal, lamp.size_m, 0.0).T
        if float(normal @ (pose.position_m - np.array(lamp.center_m))) <= 0.0:
            continue
        steps = np.linspace(-1.0, 1.0, _EDGE_POINTS)[:, None]
        edges = np.concatenate(
            [steps * across - up, across + steps * up, -steps * across + up, -across - steps * up]
        )
        local_m = pose.to_local(edges + np.array(lamp.center_m))
        seen = local_m[local_m[:, 2] > 0.01]
        if len(seen) >= 3:
            outlines.append(lens.project(seen).astype(np.float32))
    if scene.document.sun is not None:
        outlines += [lens.project(edge).astype(np.float32) for edge in _suns(scene, pose, time_s)]
    return outlines


def _suns(scene: Scene, pose: Pose, time_s: float) -> list[NDArray[np.float64]]:
    """Return directions around the sun's disc and around each of its images, in camera axes, shape (n, 3)."""
    lights, surfaces = small_lights(scene, time_s), facets(scene)
    azimuth_rad = 2.0 * np.pi * np.arange(_EDGE_POINTS) / _EDGE_POINTS
    edges = []
    for ways in (straight(lights, pose), ghosts(lights, surfaces, pose)):
        suns = ways[lights.endless[ways.light]]
        for facet, direction, radius_rad in zip(
            suns.facet, suns.direction, suns.angular_radius_rad, strict=True
        ):
            edge = cone_directions(direction, np.full(_EDGE_POINTS, cone_versine(radius_rad)), azimuth_rad)
            ahead = edge[edge[:, 2] > 0.01]
            start_m = np.broadcast_to(pose.position_m, edge.shape)
            if len(ahead) >= 3 and (
                facet < 0 or crossing(surfaces, facet, start_m, edge @ pose.rotation.T)[1].any()
            ):
                edges.append(ahead)
    return edges


def on_a_lamp(detection: Detection, outlines_px: Sequence[NDArray[np.float32]]) -> bool:
    """Tell whether a detection lies on a lamp, or within 5 px of one."""
    place = (detection.u_px, detection.v_px)
    return any(
        cv2.pointPolygonTest(cv2.convexHull(outline), place, measureDist=True) >= -_MARGIN_PX
        for outline in outlines_px
    )
