"""A scene's bodies seen from outside, as grey at 940 nm: one ray a pixel, no light but the looker's own.

Rectangles and meshes are open from behind, so that one looks into a room through its walls and its ceiling.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    texture_of,
)
from nir_render.scene.documents.matter.retroreflection import reflected_share
from nir_render.scene.documents.shapes import Mesh, Rectangle
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.nodes import BAND_M
from nir_render.transport.backend.variant import backend, dr, mi, shape_number
from nir_render.transport.world import mitsuba_scene

Array = NDArray[np.float64]

_LAYERS = 16  # of rectangles, one behind another, that a ray looks through from behind
_NEAREST_M = 1e-4
_AMBIENT = 0.35  # of what a surface shows on which that light falls edge-on
_LIGHT = np.array([-0.5, -0.6, -0.62])  # towards it: left, above and behind the looker


@dataclass(frozen=True, eq=False)
class Outlook:
    """From where a scene is looked at.

    Attributes
    ----------
    position_m
        The eye; of parallel rays the middle of the picture, shape (3,).
    rotation
        Axes right, down and forward as columns, shape (3, 3).
    per_px
        What a pixel spans: of the tangent, or metres where rays are parallel.
    width_px, height_px
        Of the picture.
    parallel
        Whether all rays go one way.
    """

    position_m: Array
    rotation: Array
    per_px: float
    width_px: int
    height_px: int
    parallel: bool

    def project_px(self, points_m: Array) -> tuple[Array, Array]:
        """Return the places of points, shape (..., 3), in the picture, (..., 2), and their depth in m."""
        local = (points_m - self.position_m) @ self.rotation
        depth = local[..., 2]
        scale = self.per_px * (np.ones_like(depth) if self.parallel else np.maximum(depth, 1e-9))
        middle = (0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1))
        return local[..., :2] / scale[..., None] + middle, depth

    def rays(self) -> tuple[Array, Array]:
        """Return start and unit direction of the ray of each pixel, shape (rows × columns, 3) each."""
        u, v = np.meshgrid(np.arange(self.width_px), np.arange(self.height_px))
        x = (u.ravel() - 0.5 * (self.width_px - 1)) * self.per_px
        y = (v.ravel() - 0.5 * (self.height_px - 1)) * self.per_px
        if self.parallel:
            start = self.position_m + np.outer(x, self.rotation[:, 0]) + np.outer(y, self.rotation[:, 1])
            return start, np.broadcast_to(self.rotation[:, 2], start.shape)
        direction = np.stack([x, y, np.ones_like(x)], axis=1) @ self.rotation.T
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.broadcast_to(self.position_m, direction.shape), direction


@dataclass(frozen=True, eq=False)
class Bodies:
    """A snapshot's bodies, to be looked at: Mitsuba's scene, each shape's grey, and which are open behind.

    `numbers` is how Mitsuba's shapes are counted, by their ids; `bounds_m` the lowest and highest corner
    of each, shape (n, 2, 3).
    """

    scene: Any
    numbers: Mapping[str, int]
    grey: Mapping[int, float]
    open_behind: frozenset[int]
    bounds_m: Array


@dataclass(frozen=True, eq=False)
class _Met:
    """What rays meet: distance (infinite of nothing), the normal there, and the shape's number."""

    distance_m: Array
    normal: Array
    shape: NDArray[np.int64]


def bodies_of(snapshot: Snapshot) -> Bodies:
    """Return the bodies of a snapshot as they are at 940 nm."""
    snapshot = snapshot.at_wavelength(BAND_M)
    scene = mitsuba_scene.build(snapshot)
    grey, numbers = {}, {}
    open_behind, bounds = set(), []
    for order, body in enumerate(scene.shapes()):
        name = mitsuba_scene.shape_of_body(snapshot, body.id())
        key = order
        if backend().vectorised:  # as rays that meet it tell it
            key = shape_number(body)
        numbers[body.id()] = key
        if name is not None:
            shape = snapshot.shapes[name]
            grey[key] = _grey(snapshot.materials[shape.material])
            bounds.append([np.array(body.bbox().min).ravel(), np.array(body.bbox().max).ravel()])
            if isinstance(shape, Rectangle | Mesh):
                open_behind.add(key)
        else:
            grey[key] = 1.0
            if body.id().startswith("lamp_"):
                open_behind.add(key)
    return Bodies(
        scene, numbers, grey, frozenset(open_behind), np.array(bounds, dtype=float).reshape(-1, 2, 3)
    )


def grey_picture(bodies: Bodies, outlook: Outlook) -> Array:
    """Return how bodies look, shape (rows, columns): reflectance at 940 nm, in a light beside the looker.

    Surfaces that are seen edge-on are darker, and so are edges between bodies. NaN is where there is nothing.
    """
    start_m, direction = (np.array(one) for one in outlook.rays())
    grey = np.full(len(start_m), np.nan)
    shape = np.full(len(start_m), -1)
    rest = np.arange(len(start_m))
    greys = np.ones(max(bodies.grey, default=0) + 1)
    greys[list(bodies.grey)] = list(bodies.grey.values())
    lit_from = outlook.rotation @ _LIGHT
    for _ in range(_LAYERS):
        if not len(rest):
            break
        met = _meet(bodies, start_m[rest], direction[rest])
        cosine = (met.normal * direction[rest]).sum(axis=1)
        hit = np.isfinite(met.distance_m)
        through = hit & (cosine > 0.0) & np.isin(met.shape, list(bodies.open_behind))
        shown = rest[hit & ~through]
        facing = np.abs(met.normal[hit & ~through] @ lit_from)
        grey[shown] = greys[met.shape[hit & ~through]] * (_AMBIENT + (1.0 - _AMBIENT) * facing)
        shape[shown] = met.shape[hit & ~through]
        start_m[rest[through]] += (met.distance_m[through] + _NEAREST_M)[:, None] * direction[rest[through]]
        rest = rest[through]
    size = (outlook.height_px, outlook.width_px)
    return _outlined(grey.reshape(size), shape.reshape(size))


def _outlined(grey: Array, shape: NDArray[np.int64]) -> Array:
    edge = np.zeros(shape.shape, dtype=bool)
    edge[:, 1:] |= shape[:, 1:] != shape[:, :-1]
    edge[1:] |= shape[1:] != shape[:-1]
    return np.where(edge, 0.6 * grey, grey)


def _grey(material: MaterialDocument) -> float:
    """Return what share of light a material sends back, about, where one looks straight at it."""
    texture = texture_of(material)
    if texture is not None:
        return float(texture.reflectance().mean())
    match material:
        case Diffuse() | Mirror():
            return number(material.reflectance)
        case Retroreflector():
            return number(material.reflectance) + reflected_share(material.table())
        case RoughConductor():
            n, k = material.index, material.extinction_index
            share = 1.0 if material.share is None else material.share
            return share * ((n - 1.0) ** 2 + k**2) / ((n + 1.0) ** 2 + k**2)
        case Plastic():
            coat = ((material.index - 1.0) / (material.index + 1.0)) ** 2
            return coat + (1.0 - coat) * number(material.reflectance)
        case Dielectric() | Pane():
            face = ((material.index - 1.0) / (material.index + 1.0)) ** 2
            return 2.0 * face / (1.0 + face)


def _meet(bodies: Bodies, start_m: Array, direction: Array) -> _Met:
    if backend().vectorised:
        ray = mi.Ray3f(mi.Point3f(start_m.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32)))
        found = bodies.scene.ray_intersect(ray)
        distance_m = np.where(np.array(found.is_valid()), np.array(found.t, dtype=float), np.inf)
        shape = np.array(dr.reinterpret_array(mi.UInt32, found.shape)).astype(np.int64)
        return _Met(distance_m, np.array(found.n, dtype=float).T.reshape(-1, 3), shape)
    distance_m, shape = np.full(len(start_m), np.inf), np.full(len(start_m), -1)
    normal = np.zeros((len(start_m), 3))
    for index, (start, towards) in enumerate(zip(start_m, direction, strict=True)):
        ray = mi.Ray3f(mi.Point3f(*map(float, start)), mi.Vector3f(*map(float, towards)))
        one = bodies.scene.ray_intersect(ray)
        if one.is_valid():
            distance_m[index], normal[index] = float(one.t), np.array(one.n)
            shape[index] = bodies.numbers[one.shape.id()]
    return _Met(distance_m, normal, shape)
