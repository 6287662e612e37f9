"""How far to the side things are: shapes between two heights as outlines in the plane, robots as discs.

Touching is not overlapping: a robot stands on a floor, and what ends where it begins is not in its way.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.geometry import rectangle_frame
from nir_render.scene.bodies import carried
from nir_render.scene.documents.camera import Rig
from nir_render.scene.documents.shapes import Box, Cylinder, Mesh, Rectangle, ShapeDocument, Sphere
from nir_render.scene.pose import Pose, rotation_of

Array = NDArray[np.float64]

_TOUCH_M = 1e-9
_SIDES = 48  # of the prism around a cylinder: it is 0.2 % wider
_EDGES_OF_BOX = tuple(
    (one, one | bit) for one in range(8) for bit in (1, 2, 4) if not one & bit
)  # corners are numbered by their three signs


@dataclass(frozen=True, eq=False)
class Hull:
    """An upright cylinder about a robot's origin that holds all that it carries: relative to that origin."""

    radius_m: float
    low_m: float
    high_m: float


@dataclass(frozen=True, eq=False)
class Outline:
    """What is in the way between two heights, seen from above.

    Attributes
    ----------
    points_m
        The corners of a convex polygon in their order, counterclockwise, shape (n, 2); one point or two of
        what has no area.
    radius_m
        What is added around it.
    """

    points_m: Array
    radius_m: float = 0.0

    def distances_m(self, places_m: Array) -> Array:
        """Return how far places, shape (m, 2), are from it, shape (m,); below 0 or 0 within."""
        starts_m, ends_m = self.points_m, np.roll(self.points_m, -1, axis=0)
        along_m = ends_m - starts_m
        squares_m2 = np.maximum((along_m**2).sum(axis=1), np.finfo(float).tiny)
        from_start_m = places_m[:, None, :] - starts_m
        shares = np.clip((from_start_m * along_m).sum(axis=-1) / squares_m2, 0.0, 1.0)
        off_m = np.linalg.norm(from_start_m - shares[..., None] * along_m, axis=-1).min(axis=1)
        if len(starts_m) > 2:
            turn = along_m[:, 0] * from_start_m[..., 1] - along_m[:, 1] * from_start_m[..., 0]
            off_m = np.where((turn >= 0.0).all(axis=1), 0.0, off_m)
        return np.asarray(off_m - self.radius_m)


def hull_of(rig: Rig, rotation: Array) -> Hull:
    """Return the hull of a rig that is turned by a rotation, shape (3, 3), from its origin up and down."""
    pose = Pose(rotation, np.zeros(3))
    radius_m = low_m = high_m = 0.0
    parts = [(source.position_m, source.radius_m) for source in rig.sources.values()]
    parts += [(camera.position_m, 0.0) for camera in rig.cameras.values()]
    spheres = [(rotation @ np.array(position_m), own_m, own_m) for position_m, own_m in parts]
    for shape in rig.body.values():
        spheres += _extents(carried(shape, pose))
    for point_m, aside_m, up_m in spheres:
        radius_m = max(radius_m, math.hypot(point_m[0], point_m[1]) + aside_m)
        low_m, high_m = min(low_m, point_m[2] - up_m), max(high_m, point_m[2] + up_m)
    return Hull(float(radius_m), float(low_m), float(high_m))


def _extents(shape: ShapeDocument) -> list[tuple[Array, float, float]]:
    """Return points of a shape, with how far it reaches around them, to the side and up and down."""
    if isinstance(shape, Sphere):
        return [(np.array(shape.center_m), shape.radius_m, shape.radius_m)]
    if isinstance(shape, Cylinder):
        axis = np.subtract(shape.end_m, shape.start_m)
        level = math.hypot(axis[0], axis[1]) / float(np.linalg.norm(axis))
        ends = (np.array(shape.start_m), np.array(shape.end_m))
        return [(end_m, shape.radius_m, level * shape.radius_m) for end_m in ends]
    if isinstance(shape, Mesh):
        return [(point_m, 0.0, 0.0) for part in _triangles_m(shape) for point_m in part.reshape(-1, 3)]
    return [(point_m, 0.0, 0.0) for point_m in _skeleton(shape)[0]]


def outlines(shape: ShapeDocument, low_m: float, high_m: float, near_m: Array) -> Iterator[Outline]:
    """Yield what of a shape is between two heights, and not beyond a rectangle of the plane.

    A mesh is its surface: what is within, and touches nothing, is not seen. `near_m` holds the rectangle's
    least and greatest x and y, shape (2, 2); what yields may lie a little beyond it.
    """
    low_m, high_m = low_m + _TOUCH_M, high_m - _TOUCH_M
    if isinstance(shape, Sphere):
        x_m, y_m, z_m = shape.center_m
        off_m = max(low_m - z_m, z_m - high_m, 0.0)
        if off_m < shape.radius_m:
            yield Outline(np.array([[x_m, y_m]]), math.sqrt(shape.radius_m**2 - off_m**2))
        return
    if isinstance(shape, Mesh):
        sides = ((0, 1), (1, 2), (2, 0))
        for triangles_m in _triangles_m(shape):
            lowest_m, highest_m = triangles_m.min(axis=1), triangles_m.max(axis=1)
            met = (lowest_m[:, 2] < high_m) & (highest_m[:, 2] > low_m)
            met &= (lowest_m[:, :2] < near_m[1]).all(axis=1) & (highest_m[:, :2] > near_m[0]).all(axis=1)
            for triangle_m in triangles_m[met]:
                yield from _cut(triangle_m, sides, low_m, high_m)
        return
    yield from _cut(*_skeleton(shape), low_m, high_m)


def _cut(
    corners_m: Array, edges: Sequence[tuple[int, int]], low_m: float, high_m: float
) -> Iterator[Outline]:
    """Yield the outline of what of a convex body is between two heights; none where nothing is."""
    heights_m = corners_m[:, 2]
    within = (heights_m > low_m) & (heights_m < high_m)
    points_m = [corner_m[:2] for corner_m in corners_m[within]]
    for one, other in edges:
        for level_m in (low_m, high_m):
            below_m, above_m = level_m - heights_m[one], heights_m[other] - level_m
            if below_m * above_m > 0.0:
                share = below_m / (below_m + above_m)
                points_m.append(corners_m[one, :2] + share * (corners_m[other, :2] - corners_m[one, :2]))
    if points_m:
        yield Outline(convex_hull(np.array(points_m)))


def _skeleton(shape: Rectangle | Box | Cylinder) -> tuple[Array, Sequence[tuple[int, int]]]:
    """Return corners, shape (n, 3), and edges of a convex body; of a cylinder those of a prism around it."""
    if isinstance(shape, Rectangle):
        frame = rectangle_frame(shape.normal, shape.size_m, shape.rotation_rad)
        around = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        corners_m = np.array([shape.center_m + u * frame[:, 0] + v * frame[:, 1] for u, v in around])
        return corners_m, [(number, (number + 1) % 4) for number in range(4)]
    if isinstance(shape, Box):
        signs = np.array([[1.0 if number & bit else -1.0 for bit in (1, 2, 4)] for number in range(8)])
        own_m = 0.5 * signs * np.array(shape.size_m)
        return own_m @ rotation_of(shape.orientation).T + shape.center_m, _EDGES_OF_BOX
    start_m, end_m = np.array(shape.start_m), np.array(shape.end_m)
    frame = rectangle_frame(tuple((end_m - start_m).tolist()), (2.0, 2.0), 0.0)
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rim = np.cos(angles)[:, None] * frame[:, 0] + np.sin(angles)[:, None] * frame[:, 1]
    rim_m = shape.radius_m / math.cos(math.pi / _SIDES) * rim
    next_of = [(number, (number + 1) % _SIDES) for number in range(_SIDES)]
    edges = next_of + [(one + _SIDES, other + _SIDES) for one, other in next_of]
    edges += [(number, number + _SIDES) for number in range(_SIDES)]
    return np.concatenate([start_m + rim_m, end_m + rim_m]), edges


def _triangles_m(mesh: Mesh) -> Iterator[Array]:
    """Yield the triangles of each part of a mesh where they stand, shape (n, 3, 3)."""
    rotation = rotation_of(mesh.orientation)
    for part in mesh.parts():
        placed_m = mesh.scale * part.vertices @ rotation.T + mesh.position_m
        yield placed_m[part.faces]


def convex_hull(points: Array) -> Array:
    """Return the corners of the convex hull of points, shape (n, 2), counterclockwise.

    By Andrew's monotone chain (Inf. Process. Lett. 9, 216, 1979). Points on a line give its two ends.
    """
    ordered = np.unique(points, axis=0)
    if len(ordered) < 3:
        return ordered
    chains: list[list[Array]] = []
    for rows in (ordered, ordered[::-1]):
        chain: list[Array] = []
        for point in rows:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0.0:
                chain.pop()
            chain.append(point)
        chains.append(chain[:-1])
    return np.array(chains[0] + chains[1])


def _turn(first: Array, second: Array, third: Array) -> float:
    """Return twice the area of a triangle; above 0 where its corners go counterclockwise."""
    one, other = second - first, third - first
    return float(one[0] * other[1] - one[1] * other[0])
