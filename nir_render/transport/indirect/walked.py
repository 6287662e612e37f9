"""The world in which paths are walked for several wavelengths, and what each keeps of their light."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.materials import (
    MaterialDocument,
    Pane,
    Plastic,
    Retroreflector,
    curves_of,
    number,
)
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.world.facets import MIRROR, PANE, Facets, facets

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Walked:
    """A world of materials of numbers alone, at the brightest node each.

    Attributes
    ----------
    snapshot
        The world.
    kept
        What each node keeps of what a material scatters there, by material, shape (nodes,); of those alone
        that vary.
    of_facets
        What it keeps of what a mirror reflects and a pane passes, shape (facets, nodes).
    """

    snapshot: Snapshot
    kept: dict[str, Array]
    of_facets: Array


def walked(snapshot: Snapshot, wavelengths_m: tuple[float, ...]) -> Walked:
    """Return the world to walk in."""
    worlds = [snapshot.at_wavelength(wavelength_m) for wavelength_m in wavelengths_m]
    kept, materials = {}, dict(worlds[0].materials)
    for name, written in snapshot.materials.items():
        for field in curves_of(written):
            values = np.array([number(getattr(world.materials[name], field)) for world in worlds])
            materials[name] = materials[name].model_copy(update={field: float(values.max())})
            kept[name] = _over_largest(values)
    world = worlds[0] if len(worlds) == 1 else replace(worlds[0], materials=materials)
    factors = np.array([_factors(facets(one)) for one in worlds])
    return Walked(world, kept, _over_largest(factors).T)


def is_coated(material: MaterialDocument) -> bool:
    """Tell whether a surface's sharp reflection is the same at all wavelengths, whatever else varies."""
    return isinstance(material, Pane) or (isinstance(material, Plastic) and material.roughness == 0.0)


def is_glossy(material: MaterialDocument) -> bool:
    """Tell whether it is so of a blurred reflection, or a lobe back, over a ground that varies."""
    return isinstance(material, Retroreflector) or (
        isinstance(material, Plastic) and material.roughness > 0.0
    )


def _factors(flat: Facets) -> Array:
    mirror, pane = flat.kind == MIRROR, flat.kind == PANE
    return np.select([mirror, pane], [flat.factor, flat.transmission], 1.0)


def _over_largest(values: Array) -> Array:
    """Return values over the largest along the first axis; where all are 0, 0."""
    largest = values.max(axis=0)
    return np.asarray(values / np.where(largest > 0.0, largest, 1.0))
