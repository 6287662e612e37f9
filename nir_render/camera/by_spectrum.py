"""What the groups of a light send, and sums of them by spectrum: a camera answers a spectrum, not a group."""

from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.response import Response, response
from nir_render.camera.timing.drive import drive_of
from nir_render.errors import InputError
from nir_render.light.light import Indirect, Light
from nir_render.scene.documents.ambient.lamps import Lamp
from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.camera import Camera
from nir_render.scene.emission import Emitter, emission_units
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.nodes import Node

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SpectrumPart:
    """What all groups of one spectrum bring at one wavelength node; `emitter` is any of them."""

    emitter: Emitter
    node: Node
    values: Array


def group_emitters(light: Light, snapshot: Snapshot) -> list[Emitter]:
    """Return what each group of a light is.

    Raises
    ------
    InputError
        The world has no such group: the light was rendered of another one.
    """
    missing = [name for name in light.groups if name not in snapshot.emitters]
    if missing:
        raise InputError(
            f"{snapshot.origin}: the light of {light.camera} knows {missing[0]!r}, which this world does not "
            "have; render it again"
        )
    return [snapshot.emitters[name] for name in light.groups]


def group_fluxes(light: Light, snapshot: Snapshot) -> Array:
    """Return how many units of emission each group sends, shape (groups,).

    A constant one at its level, any other fully lit.
    """
    return np.array([_lit_units(emitter) for emitter in group_emitters(light, snapshot)])


def by_spectrum(
    light: Light, snapshot: Snapshot, per_group: NDArray[np.float32], weights: Array
) -> list[SpectrumPart]:
    """Return weighted sums of arrays, shape (group, node, …), over the groups of each spectrum.

    There is a part for each spectrum with a weight that is not 0, and each node.
    """
    sums: dict[Hashable, SpectrumPart] = {}
    for group, emitter in enumerate(group_emitters(light, snapshot)):
        if weights[group] == 0.0:
            continue
        for node in light.nodes:
            key = spectrum_key(emitter), node
            values = weights[group] * per_group[group, node.index].astype(np.float64)
            known = sums.get(key)
            sums[key] = SpectrumPart(emitter, node, values if known is None else known.values + values)
    return list(sums.values())


def blocks_by_spectrum(
    light: Light, indirect: Indirect, snapshot: Snapshot, weights: Array
) -> list[SpectrumPart]:
    """Return weighted sums of indirect radiance in blocks as frames have it, averaged where it is."""
    parts = by_spectrum(light, snapshot, indirect.radiance_per_w, weights)
    multiple = indirect.multiple
    if multiple is None:
        return parts
    turned = by_spectrum(light, snapshot, multiple.radiance_per_w, weights)
    return [
        replace(part, values=part.values + (multiple.averages.of(some.values) - some.values))
        for part, some in zip(parts, turned, strict=True)
    ]


def row_response(camera: Camera, light: Light, row: int, emitter: Emitter) -> tuple[float, Response]:
    """Return the irradiance that a row of the direct table brings, and how the camera responds to it.

    The irradiance is that of one unit of emission, all nodes together; the response their mean, each by its
    part of the irradiance.
    """
    per_unit = light.direct.irradiance_per_w[row]
    if len(light.nodes) == 1:
        return float(per_unit[0]), response(camera, emitter, light.nodes[0])
    parts = [response(camera, emitter, node) for node in light.nodes]
    shares = per_unit / max(float(per_unit.sum()), 1e-300)
    mean = np.sum([share * part.electrons_per_j for share, part in zip(shares, parts, strict=True)], axis=0)
    # The parts of a spectrum add up: each holds only what its hat function takes of it.
    return float(per_unit.sum()), replace(parts[0], electrons_per_j=mean)


def _lit_units(emitter: Emitter) -> float:
    level = drive_of(emitter).constant
    return emission_units(emitter) * (1.0 if level is None else level)


def spectrum_key(emitter: Emitter) -> Hashable:
    """Return what emitters of one spectrum have in common."""
    if isinstance(emitter, Sun | Skylight):
        return "sun" if isinstance(emitter, Sun) else "sky"
    if isinstance(emitter, Lamp):
        return emitter.temperature_k if emitter.illuminant is None else (emitter.illuminant, emitter.infrared)
    return emitter.spectrum, emitter.unit.wavelength_m
