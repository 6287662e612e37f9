"""Where lamps stand in a frame: detections there are neither hits nor false alarms."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.camera.lens import intrinsics_of
from nir_render.geometry import rectangle_frame
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose
from perception.types import Detection

_EDGE_POINTS = 32
_MARGIN_PX = 5.0


def lamp_outlines_px(scene: Scene, camera: str, time_s: float) -> list[NDArray[np.float32]]:
    """Return the outline of each lamp that a camera sees from in front, as pixels (u, v), shape (n, 2).

    An outline is many points, of which those in front of the lens are kept: a lamp that reaches behind the
    camera keeps the part that is seen. What hides a lamp is not looked at.
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
    return outlines


def on_a_lamp(detection: Detection, outlines_px: Sequence[NDArray[np.float32]]) -> bool:
    """Tell whether a detection lies on a lamp, or within 5 px of one."""
    place = (detection.u_px, detection.v_px)
    return any(
        cv2.pointPolygonTest(cv2.convexHull(outline), place, measureDist=True) >= -_MARGIN_PX
        for outline in outlines_px
    )
