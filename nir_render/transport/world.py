"""A scene's bodies at one time as a Mitsuba scene."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.geometry import perpendiculars
from nir_render.scene.load import Scene
from nir_render.scene.motion import robot_pose, rotation_of
from nir_render.scene.world import Box, Cylinder, Diffuse, Mesh, Rectangle, ShapeDocument, Sphere
from nir_render.transport.backend import backend


def not_rendered(scene: Scene) -> list[str]:
    """Return a line for each part of the scene whose light this version does not render yet.

    Bodies that reflect nothing are rendered: they hide what is behind them.
    """
    lines = [
        f"lamps.{name}: the light of lamps is not rendered yet; remove the lamp"
        for name in scene.document.lamps
    ]
    for name, shape in scene.document.shapes.items():
        material = scene.document.materials[shape.material]
        if not (isinstance(material, Diffuse) and material.reflectance == 0.0):
            lines.append(
                f"shapes.{name}: light by way of the material {shape.material!r} ({material.type}) is not "
                "rendered yet; use the preset 'black', which only hides what is behind it"
            )
    return lines


def source_positions_m(scene: Scene, time_s: float) -> dict[str, NDArray[np.float64]]:
    """Return the centre of each source in the world, by group name."""
    positions = {}
    for name, (robot, source) in scene.sources().items():
        pose = robot_pose(robot, time_s)
        positions[name] = pose.rotation @ np.array(source.position_m) + pose.position_m
    return positions


def build(scene: Scene, time_s: float) -> Any:
    """Return the Mitsuba scene of all bodies, the spheres of the sources included, at one time."""
    bodies: dict[str, Any] = {"type": "scene"}
    for name, shape in scene.document.shapes.items():
        for part, body in enumerate(_bodies(shape)):
            bodies[f"shape_{name}_{part}"] = body
    sources = scene.sources()
    for index, (name, centre_m) in enumerate(source_positions_m(scene, time_s).items()):
        radius_m = sources[name][1].radius_m
        bodies[f"source_{index}"] = {"type": "sphere", "center": centre_m.tolist(), "radius": radius_m}
    # optimize=False: merging equal spectra would tie sources together that must be changed apart.
    return backend().mi.load_dict(bodies, optimize=False)


def source_spheres(bodies: Any) -> list[Any]:
    """Return the spheres of the sources of a built scene, in the order of the scene's light groups."""
    spheres = {shape.id(): shape for shape in bodies.shapes() if shape.id().startswith("source_")}
    return [spheres[f"source_{index}"] for index in range(len(spheres))]


def check_meshes(scene: Scene, point_m: NDArray[np.float64], what: str) -> None:
    """Raise InputError where a point is inside a closed mesh: a ray leaves it an odd number of times."""
    for name, shape in scene.document.shapes.items():
        if isinstance(shape, Mesh) and _crossings(shape, point_m) % 2 == 1:
            raise InputError(f"{scene.path}: {what} is inside shapes.{name}; move one of them")


def _crossings(shape: Mesh, point_m: NDArray[np.float64]) -> int:
    mi = backend().mi
    body = mi.load_dict({"type": "scene", "mesh": _bodies(shape)[0]})
    direction = mi.Vector3f(
        0.2672612, 0.5345225, 0.8017837
    )  # a direction that axis-aligned edges do not share
    origin = mi.Point3f(*point_m.tolist())
    for count in range(1000):
        hit = body.ray_intersect(mi.Ray3f(origin, direction))
        if not np.all(np.array(hit.is_valid())):
            return count
        origin = hit.p + 1e-5 * direction
    return 0


def _bodies(shape: ShapeDocument) -> list[dict[str, Any]]:
    match shape:
        case Rectangle():
            return [{"type": "rectangle", "to_world": _matrix(*_rectangle_frame(shape))}]
        case Box():
            rotation = rotation_of(shape.orientation)
            return [
                {
                    "type": "cube",
                    "to_world": _matrix(rotation * (0.5 * np.array(shape.size_m)), shape.center_m),
                }
            ]
        case Sphere():
            return [{"type": "sphere", "center": list(shape.center_m), "radius": shape.radius_m}]
        case Cylinder():
            return _closed_cylinder(shape)
        case Mesh():
            kind = shape.file.rsplit(".", 1)[1].lower()
            placed = _matrix(rotation_of(shape.orientation) * shape.scale, shape.position_m)
            return [{"type": kind, "filename": shape.file, "to_world": placed}]


def _rectangle_frame(shape: Rectangle) -> tuple[NDArray[np.float64], tuple[float, float, float]]:
    """Return half width, half height and normal as columns, and the centre."""
    normal = np.array(shape.normal) / np.linalg.norm(shape.normal)
    across = np.cross([0.0, 0.0, 1.0], normal)
    if np.linalg.norm(across) < 1e-9:
        across = np.array([1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    c, s = np.cos(shape.rotation_rad), np.sin(shape.rotation_rad)
    width, height = 0.5 * shape.size_m[0], 0.5 * shape.size_m[1]
    return np.stack(
        [width * (c * across + s * up), height * (c * up - s * across), normal], axis=1
    ), shape.center_m


def _closed_cylinder(shape: Cylinder) -> list[dict[str, Any]]:
    start, end = np.array(shape.start_m), np.array(shape.end_m)
    axis = (end - start) / np.linalg.norm(end - start)
    x_axis, y_axis = perpendiculars(axis)
    radius = shape.radius_m
    caps = [
        {
            "type": "disk",
            "to_world": _matrix(
                np.stack([radius * x_axis, sign * radius * y_axis, sign * axis], axis=1), centre
            ),
        }
        for centre, sign in ((start, -1.0), (end, 1.0))
    ]
    return [{"type": "cylinder", "p0": start.tolist(), "p1": end.tolist(), "radius": radius}, *caps]


def _matrix(linear: NDArray[np.float64], position_m: Any) -> Any:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = position_m
    return backend().mi.ScalarTransform4f(matrix)
