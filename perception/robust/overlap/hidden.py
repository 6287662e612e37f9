"""What pixels expect of spheres that hide parts of each other: compiled.

Each quadrature node of a farther one counts by how much of it stands out from behind all nearer ones.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import Known, Sources, Structure, View
from perception.model.normal import shares
from perception.model.spread import spread_nodes

Array = NDArray[np.float64]

RAMP_PX = 0.4
"""Over so much what is hidden begins: about as far as nodes lie apart."""


@compiled
def expectation_behind(
    values: Array, hides: NDArray[np.int64], flux: Array, away: Array, turn: Array, radius_rad: Array,
    view: View, sources: Sources, structure: Structure, known: Known, expected: Array, jacobian: Array,
) -> None:  # fmt: skip
    """Compute λ and its derivatives, as `pixels.expectation`, of spheres, some of them before others.

    Parameters
    ----------
    values, view, sources, structure, known
        As there; nothing moves.
    hides
        Which nearer one hides a part of which farther one, shape (pairs, 2).
    flux
        Of each sphere, were it whole, shape (sources,).
    away
        Of the farther's nodes, pair by pair, the unit directions less that of the nearer, shape (nodes, 3).
    turn, radius_rad
        How directions turn with pixels about each sphere (`bearing.pixel_turn`), and its radius, shapes
        (sources, 2, 3) and (sources,).
    expected, jacobian
        Shape (pixels,), written, and (unknowns, pixels), zeros that are added to.
    """
    has_slack, has_width = known.tie_spread > 0.0, known.width_spread > 0.0
    step = 3 + has_slack
    width = len(flux) * step
    background = width + has_width
    expected[:], jacobian[background] = values[background] + view.known_e.ravel(), 1.0
    for wave in range(len(structure.columns)):
        expected += values[background + 1 + wave] * structure.columns[wave]
        jacobian[background + 1 + wave] = structure.columns[wave]
    sigma_px = known.psf_sigma_px
    if has_width:
        sigma_px *= math.exp(known.width_spread * values[width])
    seen, hidden = _behind(values, hides, step, away, turn, radius_rad, view, sources, sigma_px)
    image = np.empty((5, *view.image_e.shape))
    flat, changes = image.reshape(5, -1), hidden.reshape(len(hides), 4, -1)
    for source in range(len(flux)):
        at = source * step
        image[:] = 0.0
        place = (values[at] - view.left, values[at + 1] - view.top)
        spread_nodes(seen, source, place, 1.0, (0.0, 0.0), sigma_px, image)
        for pixel in range(len(expected)):
            expected[pixel] += flux[source] * flat[0, pixel]
            jacobian[at, pixel] += flux[source] * flat[1, pixel]
            jacobian[at + 1, pixel] += flux[source] * flat[2, pixel]
            jacobian[at + 2, pixel] -= flux[source] * (2.0 * flat[0, pixel] + flat[3, pixel])
            if has_slack:
                jacobian[at + 3, pixel] += known.tie_spread * flux[source] * flat[3, pixel]
            if has_width:
                jacobian[width, pixel] += known.width_spread * flux[source] * flat[4, pixel]
    for pair in range(len(hides)):
        near, far = hides[pair]
        own, other, flux_e = far * step, near * step, flux[far]
        for pixel in range(len(expected)):
            by_u, by_v = flux_e * changes[pair, 0, pixel], flux_e * changes[pair, 1, pixel]
            grown, near_grown = flux_e * changes[pair, 2, pixel], flux_e * changes[pair, 3, pixel]
            jacobian[own, pixel] += by_u
            jacobian[own + 1, pixel] += by_v
            jacobian[own + 2, pixel] -= grown
            jacobian[other, pixel] -= by_u
            jacobian[other + 1, pixel] -= by_v
            jacobian[other + 2, pixel] -= near_grown
            if has_slack:
                jacobian[own + 3, pixel] += known.tie_spread * grown
                jacobian[other + 3, pixel] += known.tie_spread * near_grown


@compiled
def _behind(
    values: Array, hides: NDArray[np.int64], step: int, away: Array, turn: Array, radius_rad: Array,
    view: View, sources: Sources, sigma_px: float,
) -> tuple[Sources, Array]:  # fmt: skip
    """Return of the farther sources what stands out, and how that changes with each pair.

    The changes, shape (pairs, 4, rows, columns), are those of the farther one's share of light in each pixel
    by its own column, row and ln size, and by the ln size of the nearer, for what is hidden alone; by the
    nearer's place it changes as by its own, the other way.
    """
    rows, columns = view.image_e.shape
    changes, weight = np.zeros((len(hides), 4, rows, columns)), sources.weight.copy()
    stands_out, first_away = np.empty(len(away)), np.zeros(len(hides), dtype=np.int64)
    ramp_rad, at = np.empty(len(hides)), 0
    for pair in range(len(hides)):
        near, far = hides[pair]
        # Squares of angles over pixels, and the greatest that a step of one may turn by.
        uu, vv = (turn[near, 0] ** 2).sum(), (turn[near, 1] ** 2).sum()
        uv = (turn[near, 0] * turn[near, 1]).sum()
        ramp_rad[pair] = RAMP_PX * math.sqrt(0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv))
        first_away[pair] = at
        for node in range(sources.first_node[far], sources.first_node[far + 1]):
            apart_rad = 2.0 * math.asin(0.5 * math.sqrt((away[at] ** 2).sum()))
            beyond = 0.5 + (apart_rad - radius_rad[near]) / ramp_rad[pair]
            stands_out[at] = min(max(beyond, 0.0), 1.0)
            weight[node] *= stands_out[at]
            at += 1
    across, down, by = np.empty((3, columns)), np.empty((3, rows)), np.empty(4)
    for pair in range(len(hides)):
        near, far = hides[pair]
        first = sources.first_node[far]
        place = (values[far * step] - view.left, values[far * step + 1] - view.top)
        for node in range(first, sources.first_node[far + 1]):
            at = first_away[pair] + node - first
            if not 0.0 < stands_out[at] < 1.0:
                continue
            light = sources.weight[node]
            for other in range(len(hides)):
                if other != pair and hides[other, 1] == far:
                    light *= stands_out[first_away[other] + node - first]
            if light == 0.0:
                continue
            out_u, out_v, turned = sources.node_u_px[node], sources.node_v_px[node], away[at]
            turn_u, turn_v = (turned * turn[near, 0]).sum(), (turned * turn[near, 1]).sum()
            apart_rad = 2.0 * math.asin(0.5 * math.sqrt((turned**2).sum()))
            # By how much more of a node stands out as it moves away, by column and row.
            per_px = 1.0 / (max(apart_rad, 1e-12) * ramp_rad[pair])
            by[0] = light * per_px * turn_u
            by[1] = light * per_px * turn_v
            by[2] = by[0] * out_u + by[1] * out_v
            by[3] = -light * radius_rad[near] / ramp_rad[pair]
            left, right = shares(place[0] + out_u, columns, sigma_px, across)
            top, bottom = shares(place[1] + out_v, rows, sigma_px, down)
            for one in range(4):
                for row in range(top, bottom):
                    shown, line = by[one] * down[0, row], changes[pair, one, row]
                    for column in range(left, right):
                        line[column] += shown * across[0, column]
    seen = Sources(
        sources.first_node, sources.node_u_px, sources.node_v_px, sources.half_px, sources.tilt, sources.bend,
        sources.node_along, weight, sources.log_range_at, sources.log_flux_at_1_m,
    )  # fmt: skip
    return seen, changes
