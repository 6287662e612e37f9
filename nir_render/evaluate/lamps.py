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

_EDGE_POINTS = 128
_MARGIN_PX = 5.0
_NEAREST_M = 0.01  # along the axis


def lamp_outlines_px(scene: Scene, camera: str, time_s: float) -> list[NDArray[np.float32]]:
    """Return the outline of each lamp that a camera sees from in front, as pixels (u, v), shape (n, 2).

    The sun's disc follows, and its images in flat smooth surfaces. An outline is a polygon of many points in
    order, concave where the lens bends it so; a lamp that reaches behind the camera is cut off there. What
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
        steps = np.linspace(-1.0, 1.0, _EDGE_POINTS, endpoint=False)[:, None]
        edges = np.concatenate(
            [steps * across - up, across + steps * up, -steps * across + up, -across - steps * up]
        )
        seen = _in_front(pose.to_local(edges + np.array(lamp.center_m)))
        if len(seen):
            outlines.append(lens.project(seen).astype(np.float32))
    if scene.document.sun is not None:
        outlines += [lens.project(edge).astype(np.float32) for edge in _suns(scene, pose, time_s)]
    return outlines


def _in_front(outline_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the part of a convex outline in camera axes, points in order, that is in front of the lens.

    Where it is cut, it goes on along the cut, in many points, for a lens may bend that too.
    """
    ahead = outline_m[:, 2] > _NEAREST_M
    if ahead.all() or not ahead.any():
        return outline_m[ahead]
    last = int(np.flatnonzero(ahead & ~np.roll(ahead, -1))[0])
    turned = np.roll(outline_m, -1 - last, axis=0)  # those behind come first, those in front after them
    behind, seen = turned[: int((~ahead).sum())], turned[int((~ahead).sum()) :]
    start_m, end_m = (
        inner + (inner[2] - _NEAREST_M) / (inner[2] - outer[2]) * (outer - inner)
        for inner, outer in ((seen[-1], behind[0]), (seen[0], behind[-1]))
    )
    steps = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None]
    return np.concatenate([seen, start_m + steps * (end_m - start_m)])


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
        cv2.pointPolygonTest(outline, place, measureDist=True) >= -_MARGIN_PX for outline in outlines_px
    )
