"""A scene's bodies at one time as a Mitsuba scene."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.geometry import perpendiculars, rectangle_frame
from nir_render.scene.bodies import place_of_shape
from nir_render.scene.documents.ambient.sun import Sun
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.materials import (
    Dielectric,
    Diffuse,
    MaterialDocument,
    Mirror,
    Pane,
    Plastic,
    Retroreflector,
    RoughConductor,
    number,
)
from nir_render.scene.documents.matter.retroreflection import lobe_of, reflected_share
from nir_render.scene.documents.matter.texture import TextureDocument
from nir_render.scene.documents.shapes import Box, Cylinder, Mesh, Rectangle, Sphere
from nir_render.scene.meshes.mesh import lies_open
from nir_render.scene.pose import rotation_of
from nir_render.scene.snapshot import Snapshot
from nir_render.scene.text.units import LENGTH, format_vector
from nir_render.spectra.nodes import BAND_M
from nir_render.transport.backend.variant import backend, mi
from nir_render.transport.world.retroreflector import retroreflector

SUN_RADIUS_RAD = Sun.angular_radius_rad


def sun_direction(sun: Sun) -> NDArray[np.float64]:
    """Return the unit vector towards the sun's centre in the world, shape (3,)."""
    return np.array(sun.direction)


def extent_m(snapshot: Snapshot) -> float:
    """Return the diagonal of the box that holds all bodies."""
    box = build(snapshot).bbox()
    return float(np.linalg.norm(np.array(box.max).ravel() - np.array(box.min).ravel()))


def has_smooth_surface(snapshot: Snapshot) -> bool:
    """Tell whether any body shows sharp images: a mirror, glass, a pane, a smooth clear coat."""
    materials = [snapshot.materials[shape.material] for shape in snapshot.shapes.values()]
    return any(
        isinstance(material, Mirror | Dielectric | Pane)
        or (isinstance(material, Plastic) and material.roughness == 0.0)
        for material in materials
    )


def build(
    snapshot: Snapshot,
    emitting: str | None = None,
    as_point: bool = False,
    panes: bool = True,
) -> Any:
    """Return the Mitsuba scene of all bodies at one time, lamps and the spheres of the sources included.

    The light group `emitting`, a source or lamp, sends one watt, evenly; nothing else shines. Sources and
    lamps absorb what falls on them. With `as_point` the emitting source is a point without a body. Without
    `panes` these are left out: light passes them straight.
    """
    bodies = described(snapshot, () if emitting is None else (emitting,), as_point, panes)
    # optimize=False: merging equal spectra would tie sources together that must be changed apart.
    try:
        return mi.load_dict(bodies, optimize=False)
    except RuntimeError as error:
        raise InputError(
            f"{snapshot.origin}: Mitsuba refuses the scene: {' '.join(str(error).split())}"
        ) from None


def described(
    snapshot: Snapshot, emitting: Collection[str] = (), as_point: bool = False, panes: bool = True
) -> dict[str, Any]:
    """Return what `build` loads, as Mitsuba's dictionary; any number of groups may be `emitting`."""
    snapshot = snapshot.at_wavelength(BAND_M)  # who carries several wavelengths comes with the world at one
    bodies: dict[str, Any] = {"type": "scene"}
    for name, shape in snapshot.shapes.items():
        material = snapshot.materials[shape.material]
        if isinstance(material, Pane) and not panes:
            continue
        bsdf = _bsdf(material, "repeat" if isinstance(shape, Mesh) else "clamp")
        if isinstance(shape, Mesh):
            key = f"shape_{body_id(name)}_0"
            bodies[key] = _mesh(key, shape, bsdf)
            continue
        for part, body in enumerate(_bodies(shape)):
            bodies[f"shape_{body_id(name)}_{part}"] = {**body, "bsdf": bsdf}
    for index, (name, placed) in enumerate(snapshot.sources.items()):
        centre_m, radius_m = placed.pose.position_m, placed.source.radius_m
        if name in emitting and as_point:
            intensity = _uniform(1.0 / (4.0 * np.pi))  # one watt in all directions
            bodies["point"] = {"type": "point", "position": centre_m.tolist(), "intensity": intensity}
            continue
        sphere = {"type": "sphere", "center": centre_m.tolist(), "radius": radius_m, "bsdf": _BLACK}
        # One watt from the whole sphere: L = 1 / (4π² r²).
        shine = {"emitter": _area_light(1.0 / (4.0 * np.pi**2 * radius_m**2))} if name in emitting else {}
        bodies[f"source_{index}"] = {**sphere, **shine}
    for name, lamp in snapshot.lamps.items():
        center, size = (format_vector(vector_m, LENGTH) for vector_m in (lamp.center_m, lamp.size_m))
        panel = Rectangle.model_validate(
            {"type": "rectangle", "material": "", "center": center, "size": size, "normal": lamp.normal}
        )
        # One watt from one side: L = 1 / (π A).
        area_m2 = lamp.size_m[0] * lamp.size_m[1]
        shine = {"emitter": _area_light(1.0 / (np.pi * area_m2))} if f"lamps.{name}" in emitting else {}
        bodies[f"lamp_{name}"] = {**_bodies(panel)[0], "bsdf": _BLACK, **shine}
    return bodies


def body_id(name: str) -> str:
    """Return the name of a shape as Mitsuba takes it: a dot would lead into a dictionary within."""
    return name.replace("%", "%25").replace(":", "%3A").replace(".", ":")


def shape_of_body(snapshot: Snapshot, body: str) -> str | None:
    """Return the name of the shape that one of Mitsuba's is of, by its id; None of lamps and sources."""
    name = body.removeprefix("shape_").rpartition("_")[0]
    name = name.replace(":", ".").replace("%3A", ":").replace("%25", "%")
    return name if body.startswith("shape_") and name in snapshot.shapes else None


def source_spheres(bodies: Any) -> list[Any]:
    """Return the spheres of the sources of a built scene, in the order of the scene's light groups."""
    spheres = {shape.id(): shape for shape in bodies.shapes() if shape.id().startswith("source_")}
    return [spheres[f"source_{index}"] for index in range(len(spheres))]


def check_meshes(snapshot: Snapshot, point_m: NDArray[np.float64], what: str) -> None:
    """Raise InputError where a point is inside a closed mesh: a ray leaves it an odd number of times.

    What is open, a roof or a terrain, has no inside, and a room whose walls look inwards is one to be in.
    """
    whole: dict[tuple[Any, ...], list[tuple[str, Mesh]]] = {}
    for name, shape in snapshot.shapes.items():
        if isinstance(shape, Mesh):
            key = (shape.file, shape.up, shape.scale, shape.position_m, str(shape.orientation))
            whole.setdefault(key, []).append((name, shape))
    for parts in whole.values():
        shapes = [shape for _, shape in parts]
        if _crossings(shapes, point_m) % 2 == 0:
            continue
        if lies_open([one for shape in shapes for one in shape.parts()]) is None:
            place = place_of_shape(parts[0][0])
            raise InputError(f"{snapshot.origin}: {what} is inside {place}; move one of them")


def _crossings(shapes: Sequence[Mesh], point_m: NDArray[np.float64]) -> int:
    parts = {f"part_{index}": _mesh(f"part_{index}", shape, _BLACK) for index, shape in enumerate(shapes)}
    body = mi.load_dict({"type": "scene", **parts}, optimize=False)
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


def _mesh(name: str, shape: Mesh, bsdf: dict[str, Any]) -> Any:
    """Return a mesh for Mitsuba, in the world: flat where its file has no normals.

    Mitsuba's own readers of files make normals up where there are none: a box would shine like a ball.
    """
    try:
        parts = shape.parts()
    except (OSError, ValueError) as error:
        raise InputError(f"{shape.file}: cannot be read any more: {error}") from None
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + np.uint32(at) for part, at in zip(parts, first, strict=False)])
    rotation = rotation_of(shape.orientation)
    vertices_m = np.concatenate([part.vertices for part in parts]) @ (shape.scale * rotation.T) + np.array(
        shape.position_m
    )
    given = [part.normals for part in parts if part.normals is not None]
    smooth = len(given) == len(parts)
    laid = [part.uvs for part in parts if part.uvs is not None]
    has_uvs = len(laid) == len(parts)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf, optimize=False)
    properties.set_id(name)
    mesh = mi.Mesh(
        name, len(vertices_m), len(faces),
        props=properties, has_vertex_normals=smooth, has_vertex_texcoords=has_uvs,
    )  # fmt: skip
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = vertices_m.astype(np.float32).ravel()
    arrays["faces"] = faces.ravel()
    if smooth:
        arrays["vertex_normals"] = (np.concatenate(given) @ rotation.T).astype(np.float32).ravel()
    if has_uvs:
        arrays["vertex_texcoords"] = np.concatenate(laid).astype(np.float32).ravel()
    arrays.update()
    return mesh


def _bodies(shape: Rectangle | Box | Sphere | Cylinder) -> list[dict[str, Any]]:
    match shape:
        case Rectangle():
            frame = rectangle_frame(shape.normal, shape.size_m, shape.rotation_rad)
            return [{"type": "rectangle", "to_world": _matrix(frame, shape.center_m)}]
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


def _uniform(value: float) -> dict[str, Any]:
    """Return a spectrum of one value; Mitsuba's other spectra are zero or undefined at 940 nm."""
    return {"type": "uniform", "value": float(value)}


def _share(value: float | CurveDocument) -> dict[str, Any]:
    return _uniform(number(value))


def _laid(value: float | CurveDocument | TextureDocument, wrap: str) -> dict[str, Any]:
    """Return a reflectance; a picture with its lowest row where v is 0, as files of meshes count."""
    if not isinstance(value, TextureDocument):
        return _share(value)
    try:
        picture = value.reflectance()
    except ValueError as error:
        raise InputError(f"{error} (it has changed since the scene was loaded)") from None
    data = mi.TensorXf(np.ascontiguousarray(picture[::-1, :, None], dtype=np.float32))
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear", "wrap_mode": wrap}


_BLACK = {"type": "diffuse", "reflectance": _uniform(0.0)}


def _area_light(radiance: float) -> dict[str, Any]:
    return {"type": "area", "radiance": _uniform(radiance)}


def _bsdf(material: MaterialDocument, wrap: str) -> dict[str, Any]:
    """Return a material; `wrap` tells how a picture goes on beyond its edges."""
    match material:
        case Diffuse():
            surface: Any = {
                "type": "diffuse",
                "reflectance": _laid(material.reflectance, wrap),
            }
        case RoughConductor():
            surface = {
                "type": "roughconductor",
                "distribution": "ggx",
                "alpha": material.roughness,
                "eta": _uniform(material.index),
                "k": _uniform(material.extinction_index),
                **({} if material.share is None else {"specular_reflectance": _uniform(material.share)}),
            }
        case Mirror():
            surface = {
                "type": "conductor",
                "material": "none",
                "specular_reflectance": _share(material.reflectance),
            }
        case Plastic():
            rough = {"type": "roughplastic", "distribution": "ggx", "alpha": material.roughness}
            surface = {
                **(rough if material.roughness > 0.0 else {"type": "plastic"}),
                "int_ior": material.index,
                "ext_ior": 1.0,
                "diffuse_reflectance": _laid(material.reflectance, wrap),
            }
        case Retroreflector():
            surface = _retroreflector(material)
        case Dielectric():
            return {"type": "dielectric", "int_ior": material.index, "ext_ior": 1.0}
        case Pane():
            return {
                "type": "thindielectric",
                "int_ior": material.index,
                "ext_ior": 1.0,
                "specular_transmittance": _share(material.transmission),
            }
    return {"type": "twosided", "nested": surface}


def _retroreflector(material: Retroreflector) -> Any:
    ground = number(material.reflectance)
    if backend().vectorised:
        return retroreflector(lobe_of(material.table()), ground)
    # As a body it is as good; its light is refused where rays go one by one (`indirect.stock`).
    return {"type": "diffuse", "reflectance": _uniform(ground + reflected_share(material.table()))}


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
    return mi.ScalarTransform4f(matrix)
