"""Which surface each pixel shows: the sharp edges of an image, from its geometry alone.

A label stands for all that is seen in a place: a shape or one face of a box, and, where that is flat and
smooth, what it mirrors and what is seen through it. Sources' bodies and lamps have labels of their own; a
curved shape or a mesh has one label, folds and what it mirrors or bends left out.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.enlargement import Labels
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.kernel.types import Interaction, Mask, UInt
from nir_render.transport.world.emitters import RECTANGLE
from nir_render.transport.world.facets import PANE
from perception.compiled import compiled

_PLACES = 32  # in a pixel where labels meet
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_FACES = 8  # at least the faces of a box


def labels_of(built: DeviceScene, origin_m: NDArray[np.float64], corners: NDArray[np.float64]) -> Labels:
    """Return what the pixels of a camera show.

    Parameters
    ----------
    origin_m
        The lens, shape (3,).
    corners
        Directions at the corners of the pixels, any length, shape (rows + 1, columns + 1, 3).
    """
    rows, columns = (count - 1 for count in corners.shape[:2])
    small = corners.astype(np.float32)
    middles = small[:-1, :-1] + small[:-1, 1:] + small[1:, :-1] + small[1:, 1:]
    middle, nearness_per_m = _view_key(built, origin_m, middles.reshape(-1, 3))
    edge = np.flatnonzero(_has_other_neighbour(middle.reshape(rows, columns)))
    fine, _ = _view_key(built, origin_m, _directions(small, edge))
    # Numbered by where they are first seen: Mitsuba's own numbers change from one scene built to the next.
    labels, keys = _numbered(np.concatenate([np.zeros(1, np.int64), middle, fine]))
    return Labels(
        middle=labels[1 : 1 + rows * columns].reshape(rows, columns),
        edge=edge,
        within=labels[1 + rows * columns :].reshape(edge.size, _PLACES),
        nearness_per_m=nearness_per_m.reshape(rows, columns),
        shining=_shows_lamp(built, keys),
        even=_is_even(built, keys),
    )


@compiled
def _numbered(keys: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Give keys, none below 0, numbers by where they are first seen; return these, and the key of each."""
    labels = np.empty(len(keys), dtype=np.int32)
    # A table of twice as many places as there may be keys; each is at the first free one from its own.
    size = 256
    at, seen, known = np.full(size, -1, dtype=np.int32), np.empty(size // 2, dtype=np.int64), 0
    for one in range(len(keys)):
        key = keys[one]
        if one > 0 and key == keys[one - 1]:
            labels[one] = labels[one - 1]
            continue
        if known == size // 2:
            size *= 2
            at, larger = np.full(size, -1, dtype=np.int32), np.empty(size // 2, dtype=np.int64)
            larger[:known] = seen
            seen = larger
            for number in range(known):
                at[_place(seen[number], at, seen)] = number
        place = _place(key, at, seen)
        if at[place] < 0:
            at[place], seen[known] = known, key
            known += 1
        labels[one] = at[place]
    return labels, seen[:known].copy()


@compiled
def _place(key: int, at: NDArray[np.int32], seen: NDArray[np.int64]) -> int:
    """Return where in a table a key is, or belongs."""
    place = ((key ^ (key >> 17)) & 0xFFFFFFFF) * 40503 & (len(at) - 1)
    while at[place] >= 0 and seen[at[place]] != key:
        place = (place + 1) & (len(at) - 1)
    return place


def _directions(corners: NDArray[np.float32], pixels: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return directions at places spread evenly over pixels, shape (pixels · places, 3)."""
    row, column = np.divmod(pixels, corners.shape[1] - 1)
    # A lattice all of whose rows and columns differ, so that level edges too find their place.
    steps = np.arange(_PLACES) + 0.5
    down = (steps / _PLACES).astype(np.float32)[:, None]
    across = ((steps * _GOLDEN) % 1.0).astype(np.float32)[:, None]
    above, above_right, below, below_right = (
        corners[row + i, column + j][:, None, :] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    top, bottom = above + (above_right - above) * across, below + (below_right - below) * across
    return np.asarray(top + (bottom - top) * down, dtype=np.float32).reshape(-1, 3)


def _has_other_neighbour(label: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which pixels have a neighbour, corners counted, of another label."""
    beside = np.zeros(label.shape, dtype=bool)
    rows, columns = label.shape
    for down, across in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = label[: rows - down, max(-across, 0) : columns - max(across, 0)]
        neighbour = label[down:, max(across, 0) : columns + min(across, 0)]
        differ = here != neighbour
        beside[: rows - down, max(-across, 0) : columns - max(across, 0)] |= differ
        beside[down:, max(across, 0) : columns + min(across, 0)] |= differ
    return beside


def _view_key(
    built: DeviceScene, origin_m: NDArray[np.float64], directions: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return a number for what is seen along directions, and one over its distance; 0 for nothing."""
    if not len(directions):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.float32)
    surfaces = built.surfaces
    direction = dr.normalize(mi.Vector3f(np.ascontiguousarray(directions.T)))
    ray = mi.Ray3f(mi.Point3f(*origin_m.tolist()), direction)
    si = built.bodies.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True)
    shape, part = _shape_part(si)
    box = dr.gather(mi.Bool, surfaces.box_of_shape, shape, si.is_valid())
    parts = [dr.select(box, part + (si.prim_index >> 1), part)]
    if surfaces.facet_count:
        facet = dr.gather(mi.Int32, surfaces.facet_of_shape, shape, si.is_valid())
        flat = si.is_valid() & (facet >= 0)
        turned = direction - 2.0 * dr.dot(direction, si.n) * si.n
        parts.append(_part_along(built, si.spawn_ray(turned), flat))
        if surfaces.pane_count:
            kind = dr.gather(mi.UInt32, surfaces.kind, mi.UInt32(dr.maximum(facet, 0)), flat)
            parts.append(_part_along(built, si.spawn_ray(direction), flat & (kind == PANE)))
    base = dr.opaque(mi.Int64, _key_base(built))
    key = mi.Int64(0)
    for part in reversed(parts):
        key = key * base + mi.Int64(part)
    nearness_per_m = dr.select(si.is_valid(), 1.0 / si.t, 0.0)
    dr.eval(key, nearness_per_m)  # at once: each alone would trace the rays again
    return np.array(key), np.array(nearness_per_m)


def _part_along(built: DeviceScene, ray: Any, active: Mask) -> UInt:
    """Return the number of what rays meet, 0 for nothing."""
    si = built.bodies.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True, active=active)
    return dr.select(active, _shape_part(si)[1], 0)


def _shape_part(si: Interaction) -> tuple[UInt, UInt]:
    """Return the number of the shape that a ray meets, and that of its part, 0 for nothing."""
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    return shape, dr.select(si.is_valid(), shape * _FACES + 1, 0)


def _key_base(built: DeviceScene) -> int:
    """Return a number above all parts of a key."""
    return _FACES * (len(built.surfaces.light_of_shape) + 1)


def _shows_lamp(built: DeviceScene, keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell in which keys a lamp has a part."""
    light = np.array(built.surfaces.light_of_shape, dtype=np.int64)
    kind = np.array(built.lights.kind, dtype=np.int64)
    lamp = (light >= 0) & (kind[np.maximum(light, 0)] == RECTANGLE)
    shows = np.zeros(len(keys), dtype=bool)
    rest = keys
    while rest.any():
        rest, part = np.divmod(rest, _key_base(built))
        shows |= (part > 0) & lamp[np.maximum(part - 1, 0) // _FACES]
    return shows


def _is_even(built: DeviceScene, keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which keys are those of flat matt surfaces of one reflectance alone, or of nothing."""
    behind, part = np.divmod(keys, _key_base(built))
    shape = np.maximum(part - 1, 0) // _FACES
    return np.asarray((behind == 0) & ((part == 0) | built.even_shapes[shape]))
