"""Wavefront OBJ: vertices, normals, polygons, and `usemtl`, the slots; what is wrong is told by its line.

Curves, lines, points and the file of materials are passed over.
"""

import re
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.meshes.mesh import MeshPart

Array = NDArray[np.float64]

_COMMENT = re.compile(r"(?:^|(?<=\s))#")  # within a word it is part of a name

_Corner = tuple[int, int, int]  # of a vertex, its normal and its uv, from 0; -1 where there is none


def read_obj(text: str) -> list[MeshPart]:
    """Return the parts of a file, a slot each, in the order in which they come.

    Raises
    ------
    ValueError
        A line that cannot be read; it is named.
    """
    vertices: list[tuple[float, ...]] = []
    normals: list[tuple[float, ...]] = []
    uvs: list[tuple[float, ...]] = []
    slots: dict[str, list[tuple[_Corner, ...]]] = {}
    slot = ""
    for number, line in _lines(text):
        word, _, rest = line.partition(" ")
        try:
            if word == "v":
                vertices.append(_numbers(rest))
            elif word == "vn":
                normals.append(_numbers(rest))
            elif word == "vt":
                uvs.append(_numbers(rest, 2))
            elif word == "usemtl":
                slot = rest.strip()
            elif word == "f":
                corners = [_corner(one, len(vertices), len(normals), len(uvs)) for one in rest.split()]
                slots.setdefault(slot, []).extend(_triangles(corners, vertices))
        except ValueError as error:
            raise ValueError(f"line {number}: {line[:60]!r}: {error}; export the mesh again") from None
    return [_part(name, found, vertices, normals, uvs) for name, found in slots.items()]


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield what is written, with the line where it begins; a backslash at its end joins it to the next."""
    begun, kept = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        begun = begun if kept else number
        kept += _COMMENT.split(line, maxsplit=1)[0].replace("\t", " ").strip()
        if kept.endswith("\\"):
            kept = kept[:-1] + " "
            continue
        if kept:
            yield begun, kept
        kept = ""
    if kept:
        yield begun, kept.strip()


def _numbers(rest: str, count: int = 3) -> tuple[float, ...]:
    values = tuple(_number(one, float) for one in rest.split()[:count])
    if len(values) < count:
        raise ValueError(f"{'three' if count == 3 else 'two'} numbers are wanted")
    if not np.isfinite(values).all():
        raise ValueError("the numbers must be finite")
    return values


def _number(written: str, kind: type[float]) -> float:
    try:
        return kind(written)
    except (ValueError, OverflowError):
        what = "whole number" if kind is int else "number"
        raise ValueError(f"{written[:20]!r} is no {what}") from None


def _corner(written: str, vertices: int, normals: int, uvs: int) -> _Corner:
    parts = written.split("/")
    vertex = _index(parts[0], vertices, "vertex", "vertices")
    normal = _index(parts[2], normals, "normal", "normals") if len(parts) > 2 and parts[2] else -1
    uv = _index(parts[1], uvs, "uv", "uvs") if len(parts) > 1 and parts[1] else -1
    return vertex, normal, uv


def _index(written: str, count: int, one: str, many: str) -> int:
    """Return an index from 0: a file counts from 1, and back from the last where it is negative."""
    index = int(_number(written, int))
    if not 1 <= abs(index) <= count:
        raise ValueError(f"there is no {one} {index}: {count} {many} stand above this line")
    return index - 1 if index > 0 else count + index


def _triangles(corners: list[_Corner], vertices: list[tuple[float, ...]]) -> list[tuple[_Corner, ...]]:
    """Return a polygon as triangles: a fan about a corner that sees all others.

    Raises
    ------
    ValueError
        There are fewer than three corners, or no such one among them.
    """
    if len(corners) < 3:
        raise ValueError("a face has three corners or more")
    if len(corners) == 3:
        return [tuple(corners)]
    if len(corners) == 4 and _parts_well(*(vertices[vertex] for vertex, *_ in corners)):
        return [(corners[0], corners[1], corners[2]), (corners[0], corners[2], corners[3])]
    place = np.array([vertices[vertex] for vertex, *_ in corners])
    normal = np.cross(place, np.roll(place, -1, axis=0)).sum(axis=0)  # Newell's: twice the area
    for first in range(len(corners)):
        rolled, turned = corners[first:] + corners[:first], np.roll(place, -first, axis=0)
        across = np.cross(turned[1:-1] - turned[0], turned[2:] - turned[0])
        if (across @ normal >= -1e-9 * (normal @ normal)).all():
            return [(rolled[0], *pair) for pair in pairwise(rolled[1:])]
    raise ValueError("the face has an outline that turns inwards: export with faces made triangles")


def _parts_well(
    a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...], d: tuple[float, ...]
) -> bool:
    """Tell whether the diagonal a c parts a quad into two that face one way; plain numbers are faster."""
    ux, uy, uz = (c[k] - a[k] for k in range(3))
    vx, vy, vz = (b[k] - a[k] for k in range(3))
    wx, wy, wz = (d[k] - a[k] for k in range(3))
    first = (vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux)
    second = (uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx)
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2] > 0.0


def _part(
    slot: str,
    triangles: list[tuple[_Corner, ...]],
    vertices: list[tuple[float, ...]],
    normals: list[tuple[float, ...]],
    uvs: list[tuple[float, ...]],
) -> MeshPart:
    """Return the triangles of a slot with vertices of their own.

    A corner without a normal makes all flat; one without a uv leaves all without.
    """
    corners = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    flat, unlaid = (bool((corners[:, column] < 0).any()) for column in (1, 2))
    if flat:
        corners[:, 1] = -1
    if unlaid:
        corners[:, 2] = -1
    used, faces = np.unique(corners, axis=0, return_inverse=True)
    return MeshPart(
        slot,
        np.array(vertices)[used[:, 0]],
        None if flat else np.array(normals)[used[:, 1]],
        faces.reshape(-1, 3).astype(np.uint32),
        None if unlaid else np.array(uvs)[used[:, 2]],
    )
