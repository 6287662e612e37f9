"""Mitsuba's own shapes as triangles, and the transforms that place them.

Disks, spheres and cylinders have as many triangles as leave 0.2 % of their radius off, and their areas right;
normals shade them as if they were round. Cylinders are open, as Mitsuba's are.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from nir_render.geometry import perpendiculars
from nir_render.scene.meshes.mesh import Array, MeshPart, moved
from nir_render.scene.meshes.xml import Element, numbers_of, vector_of

_SIDES = 96
_ROUNDS = 4  # of dividing an icosahedron's triangles by four
_LEAST_LENGTH, _LARGEST = 1e-12, 1e12


def transform_of(shape: Element) -> Array:
    """Return where a shape stands, shape (4, 4): its steps one after the other, as they are written."""
    given = shape.named("to_world")
    whole = np.eye(4)
    if given is None:
        return whole
    for step in given.children:
        make = _STEPS.get(step.tag.lower())
        if make is None:
            raise step.wrong(f"<{step.tag}> is no step of a transform; known: {', '.join(_STEPS)}")
        whole = make(step) @ whole
        if not np.abs(whole).max() <= _LARGEST:
            raise step.wrong("up to here the transform is of more than 1e12; give smaller numbers")
    if not abs(np.linalg.det(whole[:3, :3])) > 0.0 or not np.allclose(whole[3], (0.0, 0.0, 0.0, 1.0)):
        raise given.wrong(
            "the transform flattens the shape, or is of perspective; give one that can be undone"
        )
    return whole


def _translate(step: Element) -> Array:
    return _affine(np.eye(3), vector_of(step))


def _scale(step: Element) -> Array:
    return _affine(np.diag(vector_of(step, 1.0)))


def _rotate(step: Element) -> Array:
    axis = _unit(step, vector_of(step), "the axis")
    (angle_deg,) = numbers_of(step, step.attributes.get("angle", "0"))[:1]
    return _affine(Rotation.from_rotvec(angle_deg * axis, degrees=True).as_matrix())


def _look_at(step: Element) -> Array:
    origin, target, up = (_triple(step, name) for name in ("origin", "target", "up"))
    ahead = _unit(step, target - origin, "the way from origin to target")
    left = _unit(step, np.cross(up, ahead), "what is across to up")
    return _affine(np.stack([left, np.cross(ahead, left), ahead], axis=1), origin)


def _matrix(step: Element) -> Array:
    numbers = numbers_of(step, step.attributes.get("value", ""))
    if numbers.size == 16:
        return numbers.reshape(4, 4)
    if numbers.size == 9:
        return _affine(numbers.reshape(3, 3))
    raise step.wrong(f"a matrix has 16 numbers, or 9; this one {numbers.size}: write all")


_STEPS: Mapping[str, Callable[[Element], Array]] = {
    "translate": _translate,
    "rotate": _rotate,
    "scale": _scale,
    "lookat": _look_at,
    "matrix": _matrix,
}


def _rectangle(_shape: Element) -> MeshPart:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    vertices = np.column_stack([corners, np.zeros(4)])
    return MeshPart(
        "",
        vertices,
        None,
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
        0.5 * (1.0 + corners * (1.0, -1.0)),
    )


def _cube(_shape: Element) -> MeshPart:
    from trimesh.creation import box

    body = box((2.0, 2.0, 2.0))
    return MeshPart("", np.array(body.vertices), None, np.array(body.faces, dtype=np.uint32))


def _disk(_shape: Element) -> MeshPart:
    radius = np.sqrt(2.0 * np.pi / (_SIDES * np.sin(2.0 * np.pi / _SIDES)))  # of the disk's area
    ring = radius * _circle()
    at = np.arange(1, _SIDES + 1)
    faces = np.column_stack([np.zeros(_SIDES, dtype=np.int64), at, at % _SIDES + 1])
    return MeshPart("", np.vstack([np.zeros(3), ring]), None, faces.astype(np.uint32))


def _sphere(shape: Element) -> MeshPart:
    from trimesh.creation import icosphere

    body = icosphere(subdivisions=_ROUNDS)
    normals = np.array(body.vertices)
    radius = _radius(shape) * np.sqrt(4.0 * np.pi / body.area)
    return MeshPart(
        "", _triple(shape, "center") + radius * normals, normals, np.array(body.faces, dtype=np.uint32)
    )


def _cylinder(shape: Element) -> MeshPart:
    low, high = _triple(shape, "p0"), _triple(shape, "p1", (0.0, 0.0, 1.0))
    along = _unit(shape, high - low, "the way from p0 to p1")
    normals = _circle()
    ring = _radius(shape) * np.pi / (_SIDES * np.sin(np.pi / _SIDES)) * normals  # as long as the circle
    at, after = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    faces = np.vstack(
        [np.column_stack([at, after, after + _SIDES]), np.column_stack([at, after + _SIDES, at + _SIDES])]
    )
    upright = MeshPart(
        "",
        np.vstack([ring, ring + np.array([0.0, 0.0, np.linalg.norm(high - low)])]),
        np.vstack([normals, normals]),
        faces.astype(np.uint32),
    )
    return moved(upright, _affine(np.stack([*perpendiculars(along), along], axis=1), low))


SHAPES: Mapping[str, Callable[[Element], MeshPart]] = {
    "rectangle": _rectangle,
    "cube": _cube,
    "disk": _disk,
    "sphere": _sphere,
    "cylinder": _cylinder,
}
"""By Mitsuba's names of types."""


def _circle() -> Array:
    """Return points around z at a distance of 1, shape (_SIDES, 3)."""
    around_rad = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    return np.column_stack([np.cos(around_rad), np.sin(around_rad), np.zeros(_SIDES)])


def _radius(shape: Element) -> float:
    given = shape.named("radius")
    if given is None:
        return 1.0
    (radius,) = numbers_of(given, given.attributes.get("value", ""))[:1]
    if not radius > 0.0:
        raise given.wrong(f"the radius is {radius:g}; wanted more than 0")
    return float(radius)


def _triple(element: Element, name: str, default: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    """Return three numbers that are an attribute, or a property of its own."""
    if name in element.attributes:
        numbers = numbers_of(element, element.attributes[name])
        if numbers.size != 3:
            raise element.wrong(f"{name} is {element.attributes[name]!r}; wanted three numbers")
        return numbers
    given = element.named(name)
    return np.array(default) if given is None else vector_of(given)


def _unit(element: Element, vector: Array, what: str) -> Array:
    length = float(np.linalg.norm(vector))
    if not length > _LEAST_LENGTH:
        raise element.wrong(f"{what} has no direction; give another")
    return vector / length


def _affine(linear: Array, offset: Array | None = None) -> Array:
    whole = np.eye(4)
    whole[:3, :3] = linear
    if offset is not None:
        whole[:3, 3] = offset
    return whole
