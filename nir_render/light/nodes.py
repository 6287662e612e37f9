"""Light of one wavelength each becomes light of several nodes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nir_render.light.light import DirectTable, Edges, Indirect


def direct_over_nodes(tables: Sequence[DirectTable]) -> DirectTable:
    """Return the table whose nodes are those of tables of one geometry, in their order.

    Raises
    ------
    ValueError
        They have unlike rows: they are of unlike geometries.
    """
    first = tables[0]
    if len(tables) == 1:
        return first
    if any(
        not (np.array_equal(table.facet, first.facet) and np.array_equal(table.group, first.group))
        for table in tables
    ):
        raise ValueError("direct tables at several wavelengths have unlike rows; wanted one geometry")
    return replace(first, irradiance_per_w=np.concatenate([table.irradiance_per_w for table in tables], 1))


def indirect_over_nodes(parts: Sequence[Indirect | None]) -> Indirect | None:
    """Return the light whose nodes are those of parts of one geometry and sampling, in their order.

    A part is None where nothing reflects at its wavelength: it is dark there. None where all are.
    """
    first = next((part for part in parts if part is not None), None)
    if first is None or len(parts) == 1:
        return first
    edges = None
    if first.edges is not None:
        # Surfaces meet at the same places at every wavelength.
        of_parts = [None if part is None else part.edges for part in parts]
        edges = Edges(first.edges.enlargement, *_arrays(first.edges, of_parts))
    radiance_per_w, variance = _arrays(first, parts)
    return replace(first, radiance_per_w=radiance_per_w, variance=variance, edges=edges)


def _arrays(
    first: Indirect | Edges, parts: Sequence[Indirect | Edges | None]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return radiance and variance of all parts, along their nodes."""
    dark = np.zeros_like(first.radiance_per_w)
    radiance = [dark if part is None else part.radiance_per_w for part in parts]
    variance = [dark if part is None else part.variance for part in parts]
    return np.concatenate(radiance, axis=1), np.concatenate(variance, axis=1)
