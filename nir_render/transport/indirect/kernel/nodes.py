"""Several wavelengths along one path, on the device: what each keeps of the light that the path keeps.

Paths are walked where surfaces are brightest of all nodes. At each vertex light of a node keeps a share of
what the path keeps there, its reflectance over that one: directions are drawn alike for all nodes, and their
sums are of the same samples. Of one node there are no shares, and nothing is done for them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.types import Float, Int, Interaction, Mask, Shares, UInt, Vector


@dataclass(frozen=True, eq=False)
class NodeTable:
    """The shares on the device: `of_shape` by Mitsuba's number and `of_facet`, a row for each, nodes in it.

    `coated_of_shape` tells shapes whose sharp reflection has no share, `glossy_of_shape` those whose blurred
    one has none: it lies over a ground that has.
    """

    count: int
    of_shape: Float
    of_facet: Float
    coated_of_shape: Mask
    glossy_of_shape: Mask
    has_glossy: bool


def upload_nodes(
    of_shape: NDArray[np.float64],
    of_facet: NDArray[np.float64],
    coated: NDArray[np.bool_],
    glossy: NDArray[np.bool_],
) -> NodeTable:
    """Bring shares to the device, (shapes, nodes) and (facets, nodes)."""
    return NodeTable(
        count=of_shape.shape[1],
        of_shape=mi.Float(of_shape.astype(np.float32).ravel()),
        of_facet=mi.Float(np.append(of_facet.ravel(), 1.0).astype(np.float32)),
        coated_of_shape=mi.Bool(coated),
        glossy_of_shape=mi.Bool(glossy),
        has_glossy=bool(glossy.any()),
    )


def whole(nodes: NodeTable | None, lanes: int = 1) -> Shares:
    """Return shares of 1."""
    return () if nodes is None else tuple(dr.ones(mi.Float, lanes) for _ in range(nodes.count))


def times(first: Shares, second: Shares) -> Shares:
    """Return what is left after both."""
    return tuple(one * other for one, other in zip(first, second, strict=True))


def where(condition: Mask, first: Shares, second: Shares) -> Shares:
    """Return the first where the condition holds, else the second."""
    return tuple(dr.select(condition, one, other) for one, other in zip(first, second, strict=True))


def off_facet(nodes: NodeTable | None, facet: UInt | Int, active: Mask) -> Shares:
    """Return the shares of a facet: of what a mirror reflects, of what a pane passes."""
    if nodes is None:
        return ()
    first = mi.UInt32(facet) * nodes.count
    return tuple(dr.gather(mi.Float, nodes.of_facet, first + node, active) for node in range(nodes.count))


def off_surface(
    nodes: NodeTable | None, si: Interaction, bsdf: Any, direction: Vector, sharp: Mask, active: Mask
) -> Shares:
    """Return the shares of what a surface scatters from a direction into the path.

    Parameters
    ----------
    sharp
        Whether it is reflected sharply: of a clear coat or pane, which is the same at all wavelengths.
    """
    if nodes is None:
        return ()
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    tinted = dr.select(sharp & dr.gather(mi.Bool, nodes.coated_of_shape, shape, active), 0.0, mi.Float(1))
    if nodes.has_glossy:
        glossy = active & dr.gather(mi.Bool, nodes.glossy_of_shape, shape, active)
        local = si.to_local(direction)
        ground = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.DiffuseReflection))
        under, both = (bsdf.eval(context, si, local, glossy)[0] for context in (ground, mi.BSDFContext()))
        tinted = dr.select(glossy & (both > 0.0), under / both, tinted)
    first = shape * nodes.count
    shares = (dr.gather(mi.Float, nodes.of_shape, first + node, active) for node in range(nodes.count))
    return tuple((1.0 - tinted) + tinted * share for share in shares)
