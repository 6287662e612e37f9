"""Lights of one wavelength each become one of several nodes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nir_render.light.light import Edges, Indirect, Light


def over_nodes(lights: Sequence[Light]) -> Light:
    """Return the light whose nodes are those of some lights of one geometry, in the order of wavelengths.

    Raises
    ------
    ValueError
        Their direct tables have other rows: they are of unlike geometries.
    """
    first = lights[0]
    if len(lights) == 1:
        return first
    tables = [light.direct for light in lights]
    if any(not np.array_equal(table.facet, tables[0].facet) for table in tables):
        raise ValueError(f"the lights of {first.camera} at several wavelengths have unlike rows")
    direct = replace(
        tables[0], irradiance_per_w=np.concatenate([table.irradiance_per_w for table in tables], axis=1)
    )
    wavelengths_m = tuple(wavelength_m for light in lights for wavelength_m in light.wavelengths_m)
    parts = [light.indirect for light in lights]
    known = next((part for part in parts if part is not None), None)
    indirect = None if known is None else _joined(known, parts)
    return replace(first, wavelengths_m=wavelengths_m, direct=direct, indirect=indirect)


def _joined(known: Indirect, parts: Sequence[Indirect | None]) -> Indirect:
    """Return parts joined along their nodes; where nothing reflects there is nothing."""
    edges = None
    if known.edges is not None:
        # Surfaces meet at the same places at every wavelength.
        of_parts = [None if part is None else part.edges for part in parts]
        edges = Edges(known.edges.enlargement, *_arrays(known.edges, of_parts))
    radiance_per_w, variance = _arrays(known, parts)
    return replace(known, radiance_per_w=radiance_per_w, variance=variance, edges=edges)


def _arrays(
    known: Indirect | Edges, parts: Sequence[Indirect | Edges | None]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return radiance and variance of all parts, along their nodes."""
    nothing = np.zeros_like(known.radiance_per_w)
    radiance = [nothing if part is None else part.radiance_per_w for part in parts]
    variance = [nothing if part is None else part.variance for part in parts]
    return np.concatenate(radiance, axis=1), np.concatenate(variance, axis=1)
