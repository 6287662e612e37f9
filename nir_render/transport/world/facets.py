"""The flat smooth surfaces of a scene, each of which shows one image of every light before it.

A smooth dielectric reflects by Fresnel's equations; a thin pane by both its faces and all that goes to and
fro between them, R' = R + T² R (1 + R² + …) = 2R/(1 + R).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nir_render.geometry import rectangle_frame
from nir_render.scene.bodies import place_of_shape
from nir_render.scene.documents.materials import Dielectric, MaterialDocument, Mirror, Pane, Plastic, number
from nir_render.scene.documents.shapes import Box, Rectangle, ShapeDocument
from nir_render.scene.pose import rotation_of
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.nodes import BAND_M

Array = NDArray[np.float64]

MIRROR, COAT, PANE = 0, 1, 2

# The faces of Mitsuba's cube in the order of its triangles, two to a face: outward axis, and the two others.
_BOX_FACES = (
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
)


@dataclass(frozen=True, eq=False)
class Facets:
    """Flat smooth surfaces: center + a half_u + b half_v with |a|, |b| ≤ 1.

    Attributes
    ----------
    name
        `shapes.mirror`, or `shapes.crate.3` for a face of a box.
    center_m, half_u_m, half_v_m
        Shape (n, 3).
    normal
        Unit vectors, outward for the faces of boxes, shape (n, 3).
    kind
        MIRROR (one reflectance for all angles), COAT (one Fresnel surface: a smooth clear coat, a face of
        solid glass), or PANE (a thin clear sheet), shape (n,).
    index
        Refractive index, 1 where the kind is MIRROR, shape (n,).
    factor
        Reflectance of a MIRROR, 1 for others, shape (n,).
    transmission
        Share that a PANE passes of what it does not reflect, 0 for others, shape (n,).
    two_sided
        Whether it reflects on the side away from its normal too, shape (n,).
    """

    name: tuple[str, ...]
    center_m: Array
    half_u_m: Array
    half_v_m: Array
    normal: Array
    kind: NDArray[np.int64]
    index: Array
    factor: Array
    transmission: Array
    two_sided: NDArray[np.bool_]


def facets(snapshot: Snapshot) -> Facets:
    """Return the flat smooth surfaces of a scene: shapes in the document's order, six faces to a box."""
    snapshot = snapshot.at_wavelength(BAND_M)  # who carries several wavelengths comes with the world at one
    names: list[str] = []
    frames: list[Array] = []
    optics: list[tuple[int, float, float, float, bool]] = []
    for name, shape in snapshot.shapes.items():
        surface = _surface(snapshot.materials[shape.material], shape)
        if surface is None:
            continue
        parts = _frames(shape)
        names += [f"{place_of_shape(name)}{suffix}" for suffix in parts]
        frames += parts.values()
        optics += [(*surface, isinstance(shape, Rectangle))] * len(parts)
    return _table(names, frames, optics)


def no_facets() -> Facets:
    """Return the facets of a scene that has none."""
    return _table([], [], [])


def _table(
    names: list[str], frames: list[Array], optics: list[tuple[int, float, float, float, bool]]
) -> Facets:
    geometry = np.array(frames, dtype=np.float64).reshape(-1, 4, 3)
    columns = np.array(optics, dtype=np.float64).reshape(-1, 5).T
    return Facets(
        name=tuple(names),
        center_m=geometry[:, 0],
        half_u_m=geometry[:, 1],
        half_v_m=geometry[:, 2],
        normal=geometry[:, 3],
        kind=columns[0].astype(np.int64),
        index=columns[1],
        factor=columns[2],
        transmission=columns[3],
        two_sided=columns[4].astype(bool),
    )


def fresnel(cos_incidence: ArrayLike, index: ArrayLike) -> Array:
    """Return the reflectance of a dielectric's face for unpolarised light from outside.

    R = (r_s² + r_p²)/2 with r_s = (cos θ − n cos θ')/(cos θ + n cos θ') and r_p = (n cos θ − cos θ')/
    (n cos θ + cos θ'); sin θ = n sin θ'. The arguments broadcast; `index` ≥ 1.
    """
    cosine = np.clip(np.asarray(cos_incidence, dtype=np.float64), 0.0, 1.0)
    n = np.asarray(index, dtype=np.float64)
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / n**2)
    with np.errstate(invalid="ignore"):  # 0/0 at grazing incidence on index 1, where nothing is reflected
        across = (cosine - n * inside) / (cosine + n * inside)
        along = (n * cosine - inside) / (n * cosine + inside)
    return np.where(n == 1.0, 0.0, 0.5 * (across**2 + along**2))


def reflectance(surfaces: Facets, facet: ArrayLike, cos_incidence: ArrayLike) -> Array:
    """Return the share of light that facets (indices) reflect; `facet` and `cos_incidence` broadcast."""
    which = np.asarray(facet)
    kind = surfaces.kind[which]
    face = fresnel(cos_incidence, surfaces.index[which])
    both_faces = 2.0 * face / (1.0 + face)
    return np.where(kind == MIRROR, surfaces.factor[which], np.where(kind == PANE, both_faces, face))


def pane_transmittance(surfaces: Facets, facet: ArrayLike, cos_incidence: ArrayLike) -> Array:
    """Return the share of light that passes panes (indices of facets) straight; the arguments broadcast."""
    passed = 1.0 - reflectance(surfaces, facet, cos_incidence)
    return np.asarray(passed * surfaces.transmission[np.asarray(facet)])


def _surface(material: MaterialDocument, shape: ShapeDocument) -> tuple[int, float, float, float] | None:
    """Return kind, index, factor and transmission of a shape's flat faces; None where it has none."""
    flat = isinstance(shape, Rectangle | Box)
    match material:
        case Mirror() if flat:
            return MIRROR, 1.0, number(material.reflectance), 0.0
        case Plastic() if flat and material.roughness == 0.0:
            return COAT, material.index, 1.0, 0.0
        case Dielectric() if isinstance(shape, Box):
            return COAT, material.index, 1.0, 0.0
        case Pane() if isinstance(shape, Rectangle):
            return PANE, material.index, 1.0, number(material.transmission)
    return None


def _frames(shape: ShapeDocument) -> dict[str, Array]:
    """Return centre, half width, half height and normal of each face, shape (4, 3), by its suffix."""
    if isinstance(shape, Rectangle):
        frame = rectangle_frame(shape.normal, shape.size_m, shape.rotation_rad)
        return {"": np.stack([np.array(shape.center_m), *frame.T])}
    assert isinstance(shape, Box)  # nothing else has flat faces
    rotation = rotation_of(shape.orientation)
    half_m = 0.5 * np.array(shape.size_m)
    faces = {}
    for face, (outward, across, up) in enumerate(_BOX_FACES):
        normal, u, v = (np.array(axis, dtype=np.float64) for axis in (outward, across, up))
        local = np.stack([half_m * normal, half_m * u, half_m * v, normal])
        faces[f".{face}"] = local @ rotation.T + np.array([shape.center_m, *np.zeros((3, 3))])
    return faces
