"""What pixels expect of spheres, one of which hides a part of another: compiled.

Each quadrature node of the farther counts by how much of it stands out from behind the nearer.
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
def expectation_of_two(
    values: Array, near: int, far: int, flux: Array, away: Array, turn: Array, radius_rad: float, view: View,
    sources: Sources, structure: Structure, known: Known, expected: Array, jacobian: Array,
) -> None:  # fmt: skip
    """Compute λ and its derivatives, as `pixels.expectation`, of spheres, one of them before another.

    Parameters
    ----------
    values, view, sources, structure, known
        As there; nothing moves.
    near, far, flux
        Which one hides a part of which; the flux of each, were it whole, shape (sources,).
    away, turn, radius_rad
        Of the farther's nodes, the unit directions less that of the nearer, shape (nodes, 3); how directions
        turn with pixels about the nearer (`bearing.pixel_turn`); and the nearer's radius.
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
    seen, hidden = _behind(values, far, step, away, turn, radius_rad, view, sources, sigma_px)
    image = np.empty((5, *view.image_e.shape))
    flat, changes = image.reshape(5, -1), hidden.reshape(4, -1)
    for source in range(len(flux)):
        at, of_near, is_far = source * step, near * step, source == far
        image[:] = 0.0
        place = (values[at] - view.left, values[at + 1] - view.top)
        spread_nodes(seen, source, place, 1.0, (0.0, 0.0), sigma_px, image)
        for pixel in range(len(expected)):
            by_u, by_v, grown = flat[1, pixel], flat[2, pixel], flat[3, pixel]
            if is_far:
                by_u += changes[0, pixel]
                by_v += changes[1, pixel]
                grown += changes[2, pixel]
                jacobian[of_near, pixel] -= flux[source] * changes[0, pixel]
                jacobian[of_near + 1, pixel] -= flux[source] * changes[1, pixel]
                jacobian[of_near + 2, pixel] -= flux[source] * changes[3, pixel]
                if has_slack:
                    jacobian[of_near + 3, pixel] += known.tie_spread * flux[source] * changes[3, pixel]
            expected[pixel] += flux[source] * flat[0, pixel]
            jacobian[at, pixel] += flux[source] * by_u
            jacobian[at + 1, pixel] += flux[source] * by_v
            jacobian[at + 2, pixel] -= flux[source] * (2.0 * flat[0, pixel] + grown)
            if has_slack:
                jacobian[at + 3, pixel] += known.tie_spread * flux[source] * grown
            if has_width:
                jacobian[width, pixel] += known.width_spread * flux[source] * flat[4, pixel]


@compiled
def _behind(
    values: Array, far: int, step: int, away: Array, turn: Array, radius_rad: float, view: View,
    sources: Sources, sigma_px: float,
) -> tuple[Sources, Array]:  # fmt: skip
    """Return of the farther source what stands out, and how that changes.

    The changes, shape (4, rows, columns), are those of its share of light in each pixel by its own column,
    row and ln size, and by the ln size of the nearer, for what is hidden alone; by the nearer's place it
    changes as by its own, the other way.
    """
    rows, columns = view.image_e.shape
    changes, weight = np.zeros((4, rows, columns)), sources.weight.copy()
    across, down, by = np.empty((3, columns)), np.empty((3, rows)), np.empty(4)
    place = (values[far * step] - view.left, values[far * step + 1] - view.top)
    # Squares of angles over pixels, and the greatest that a step of one may turn by.
    uu, uv, vv = (turn[0] ** 2).sum(), (turn[0] * turn[1]).sum(), (turn[1] ** 2).sum()
    ramp_rad = RAMP_PX * math.sqrt(0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv))
    first = sources.first_node[far]
    for node in range(first, sources.first_node[far + 1]):
        out_u, out_v, turned = sources.node_u_px[node], sources.node_v_px[node], away[node - first]
        turn_u, turn_v = (turned * turn[0]).sum(), (turned * turn[1]).sum()
        apart_rad = 2.0 * math.asin(0.5 * math.sqrt((turned**2).sum()))
        stands_out = 0.5 + (apart_rad - radius_rad) / ramp_rad
        if stands_out <= 0.0:
            weight[node] = 0.0
        if not 0.0 < stands_out < 1.0:
            continue
        # By how much more of a node stands out as it moves away, by column and row.
        per_px = 1.0 / (max(apart_rad, 1e-12) * ramp_rad)
        by[0] = weight[node] * per_px * turn_u
        by[1] = weight[node] * per_px * turn_v
        by[2] = by[0] * out_u + by[1] * out_v
        by[3] = -weight[node] * radius_rad / ramp_rad
        left, right = shares(place[0] + out_u, columns, sigma_px, across)
        top, bottom = shares(place[1] + out_v, rows, sigma_px, down)
        for one in range(4):
            for row in range(top, bottom):
                light, line = by[one] * down[0, row], changes[one, row]
                for column in range(left, right):
                    line[column] += light * across[0, column]
        weight[node] *= stands_out
    seen = Sources(
        sources.first_node, sources.node_u_px, sources.node_v_px, sources.half_px, sources.tilt, sources.bend,
        sources.node_along, weight, sources.log_range_at, sources.log_flux_at_1_m,
    )  # fmt: skip
    return seen, changes
