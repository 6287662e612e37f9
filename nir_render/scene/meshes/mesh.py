"""What a mesh file holds: the triangles of each slot, and what must be true of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FARTHEST_UV = 1e4  # beyond, float32 has no place left within a picture


@dataclass(frozen=True, eq=False)
class MeshPart:
    """The triangles that are of one material.

    Attributes
    ----------
    slot
        The material's name in the file, empty where it has none.
    vertices
        Shape (n, 3), z up, in units of the file.
    normals
        Unit vectors at the vertices, shape (n, 3), where the file gives them: between them the surface is
        shaded as if it were round. None is flat triangles.
    faces
        Vertices of each triangle, counterclockwise seen from outside, shape (m, 3).
    uvs
        Where in a picture each vertex is, from 0 to 1 across and up, shape (n, 2); None where the file does
        not say it.
    """

    slot: str
    vertices: Array
    normals: Array | None
    faces: NDArray[np.uint32]
    uvs: Array | None = None


def checked(part: MeshPart) -> MeshPart:
    """Return a part without triangles of no area, which no light can meet.

    Raises
    ------
    ValueError
        A vertex or normal that is not finite, a triangle of a vertex that is not there, none with an area.
    """
    named = f" of the slot {part.slot!r}" if part.slot else ""
    off = np.flatnonzero(~np.isfinite(part.vertices).all(axis=1))
    if len(off):
        raise ValueError(
            f"vertex {off[0] + 1}{named} is not finite: {_row(part.vertices[off[0]])}; export the mesh again"
        )
    beyond = np.flatnonzero((part.faces >= len(part.vertices)).any(axis=1))
    if len(beyond):
        raise ValueError(
            f"triangle {beyond[0] + 1}{named} wants vertex {int(part.faces[beyond[0]].max()) + 1}, but there "
            f"are {len(part.vertices)}; export the mesh again"
        )
    normals = part.normals
    if normals is not None:
        length = np.linalg.norm(normals, axis=1)
        odd = np.flatnonzero(~(np.isfinite(length) & (length > 0.0)))
        if len(odd):
            raise ValueError(
                f"normal {odd[0] + 1}{named} has no direction: {_row(normals[odd[0]])}; export without them"
            )
        normals = normals / length[:, None]
    with np.errstate(over="ignore"):
        has_area = np.linalg.norm(_doubled_areas(part.vertices, part.faces), axis=1) > 0.0
    if not has_area.any():
        raise ValueError(f"there is no triangle{named} with an area; export the surface, not points or edges")
    if part.uvs is not None and not (np.abs(part.uvs) <= _FARTHEST_UV).all():
        raise ValueError(f"a uv coordinate{named} is not finite or beyond {_FARTHEST_UV:g}; unwrap it again")
    return MeshPart(part.slot, part.vertices, normals, part.faces[has_area], part.uvs)


def moved(part: MeshPart, to_world: Array) -> MeshPart:
    """Return a part where an affine transform, shape (4, 4), takes it; mirrored it still looks outwards."""
    if np.array_equal(to_world, np.eye(4)):
        return part
    linear = to_world[:3, :3]
    return MeshPart(
        part.slot,
        part.vertices @ linear.T + to_world[:3, 3],
        None if part.normals is None else part.normals @ np.linalg.inv(linear),
        part.faces[:, ::-1] if np.linalg.det(linear) < 0.0 else part.faces,
        part.uvs,
    )


def with_flat_normals(part: MeshPart) -> MeshPart:
    """Return a part whose triangles have corners and normals of their own; those of no area are left out."""
    doubled = _doubled_areas(part.vertices, part.faces)
    size = np.linalg.norm(doubled, axis=1)
    faces = part.faces[size > 0.0]
    return MeshPart(
        part.slot,
        part.vertices[faces].reshape(-1, 3),
        np.repeat(doubled[size > 0.0] / size[size > 0.0, None], 3, axis=0),
        np.arange(faces.size, dtype=np.uint32).reshape(-1, 3),
        None if part.uvs is None else part.uvs[faces].reshape(-1, 2),
    )


def joined(slot: str, parts: Sequence[MeshPart]) -> MeshPart:
    """Return pieces of one slot as one; flat where any of them is, without uvs where any has none."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return MeshPart(
        slot,
        np.concatenate([part.vertices for part in parts]),
        _of_all([part.normals for part in parts]),
        np.concatenate([part.faces + np.uint32(at) for part, at in zip(parts, first, strict=False)]),
        _of_all([part.uvs for part in parts]),
    )


def _of_all(values: Sequence[Array | None]) -> Array | None:
    given = [one for one in values if one is not None]
    return np.concatenate(given) if len(given) == len(values) else None


def lies_open(parts: Sequence[MeshPart]) -> str | None:
    """Return why parts together have no inside: edges of one triangle alone, faces that look inwards."""
    corners = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in parts])
    _, index = np.unique(corners, axis=0, return_inverse=True)
    triangles = index.reshape(-1, 3).astype(np.int64)
    count = int(index.max()) + 1
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there, back = edges @ (count, 1), edges[:, ::-1] @ (count, 1)
    there = np.sort(there)
    if not np.array_equal(there, np.sort(back)):
        unmatched = max(len(np.setdiff1d(there, back)), 1)
        return f"it is not closed: {unmatched} edges have a triangle on one side alone, or face two ways"
    volume = 0.0
    for part in parts:
        a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
        volume += float((a * np.cross(b, c)).sum())
    return None if volume > 0.0 else "its triangles look inwards: turn its normals over"


def _doubled_areas(vertices: Array, faces: NDArray[np.uint32]) -> Array:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _row(values: Array) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"
