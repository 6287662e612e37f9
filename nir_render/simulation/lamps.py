"""Where lamps, beacons and the sun stand in a frame."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.lens import Intrinsics, intrinsics_of
from nir_render.geometry import cone_directions, cone_versine, rectangle_frame
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.direct.rays import crossing
from nir_render.transport.direct.ways import ghosts, small_lights, straight
from nir_render.transport.world.facets import facets
from nir_render.truth.lamps import LampTruth, Outline

_EDGE_POINTS = 128
_OUTLINE_PX = 1e-3  # by so much an outline may leave the true one
_FAR_PX = 1e6  # outside any image
_NEAREST_M = 0.01  # along the axis


def lamp_truth(snapshot: Snapshot, camera: str, index: int) -> Iterator[LampTruth]:
    """Yield the outline of each lamp that a camera sees from in front, then of beacons, sun, their images.

    An outline is a polygon, concave where the lens bends it so; a lamp that reaches behind the camera is cut
    off there. What hides a lamp is not looked at.
    """
    placed = snapshot.camera(camera)
    lens, pose = intrinsics_of(placed.camera), placed.pose
    for name, lamp in snapshot.lamps.items():
        across, up, normal = rectangle_frame(lamp.normal, lamp.size_m, 0.0).T
        if float(normal @ (pose.position_m - np.array(lamp.center_m))) <= 0.0:
            continue
        steps = np.linspace(-1.0, 1.0, _EDGE_POINTS, endpoint=False)[:, None]
        edges = np.concatenate(
            [steps * across - up, across + steps * up, -steps * across + up, -across - steps * up]
        )
        seen = _in_front(pose.to_local(edges + np.array(lamp.center_m)))
        if len(seen):
            yield LampTruth(camera, index, f"lamps.{name}", _outline_px(lens, seen))
    if snapshot.sun is not None or snapshot.beacons:
        for name, edge in _discs(snapshot, pose):
            yield LampTruth(camera, index, name, _outline_px(lens, edge))


def _outline_px(lens: Intrinsics, points: NDArray[np.float64]) -> Outline:
    """Return where points of an outline are in the image, without those that lie on the way of others."""
    pixels = np.clip(np.nan_to_num(lens.project(points), posinf=_FAR_PX, neginf=-_FAR_PX), -_FAR_PX, _FAR_PX)
    kept = cv2.approxPolyDP(pixels.astype(np.float32)[:, None], _OUTLINE_PX, closed=True)[:, 0]
    kept = kept if len(kept) >= 3 else pixels
    return tuple((round(float(u_px), 3), round(float(v_px), 3)) for u_px, v_px in kept)


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


def _discs(snapshot: Snapshot, pose: Pose) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield beacons, the sun and their images: name, directions around it in camera axes, shape (n, 3)."""
    lights, surfaces = small_lights(snapshot), facets(snapshot)
    azimuth_rad = 2.0 * np.pi * np.arange(_EDGE_POINTS) / _EDGE_POINTS
    strange = np.array([name not in snapshot.carried_sources for name in lights.name])
    for ways in (straight(lights, pose), ghosts(lights, surfaces, pose)):
        shown = ways[strange[ways.light]]
        for light, facet, direction, radius_rad in zip(
            shown.light, shown.facet, shown.direction, shown.angular_radius_rad, strict=True
        ):
            edge = cone_directions(direction, np.full(_EDGE_POINTS, cone_versine(radius_rad)), azimuth_rad)
            ahead = edge[edge[:, 2] > 0.01]
            start_m = np.broadcast_to(pose.position_m, edge.shape)
            if len(ahead) >= 3 and (
                facet < 0 or crossing(surfaces, facet, start_m, edge @ pose.rotation.T)[1].any()
            ):
                yield lights.name[light], ahead
