"""Which two flares may be which two sources, by how they stand apart: a compiled loop of `robots`."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.pose.sights import Carried, Sights

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GATE_CHI2 = 30.0
"""More χ² than this beyond its degrees of freedom is another robot: less than once in a million."""

HEADINGS = 72
SLACK = 0.05  # of the distance between two sources: half a step of the headings above
STRETCH, NOISES, MOST_NOISE_M = 1.5, 6.0, 0.1


class Places(NamedTuple):
    """Flares, f of them.

    Attributes
    ----------
    row
        The sighting of each whose range is the most precise, shape (f,).
    place_m
        Roughly where it is, NaN where no range is known, shape (f, 3).
    noise_m2
        How well that is known but for what all share, shape (f, 3, 3).
    """

    row: Indices
    place_m: Array
    noise_m2: Array


@compiled
def fitting(places: Places, sights: Sights, layout: Carried) -> NDArray[np.bool_]:
    """Tell whether flares i < j may be sources a and b, shape (f, f, s, s)."""
    flares, sources = len(places.row), len(layout.log_flux)
    fits = np.zeros((flares, flares, sources, sources), dtype=np.bool_)
    cosine, sine = np.empty(HEADINGS), np.empty(HEADINGS)
    for k in range(HEADINGS):
        cosine[k], sine[k] = math.cos(k * 2.0 * math.pi / HEADINGS), math.sin(k * 2.0 * math.pi / HEADINGS)
    longest_m = 0.0
    for a in range(sources):
        for b in range(a):
            longest_m = max(longest_m, _distance_m(layout.place_m[a], layout.place_m[b]))
    # A source of less flux seems farther off by the root of it, and so farther from others.
    longest_m *= STRETCH * math.exp(0.5 * (layout.log_flux.max() - layout.log_flux.min()))
    apart_m, covariance = np.empty(3), np.empty((3, 3))
    for i in range(flares):
        for j in range(i + 1, flares):
            if not _near(places, i, j, longest_m):
                continue
            for a in range(sources):
                for b in range(sources):
                    if a == b:
                        continue
                    arm_m = layout.place_m[b] - layout.place_m[a]
                    slack_m = SLACK * math.sqrt(arm_m[0] ** 2 + arm_m[1] ** 2 + arm_m[2] ** 2)
                    _apart(places, sights, layout, i, j, a, b, apart_m, covariance)
                    if not math.isfinite(apart_m[0] + apart_m[1] + apart_m[2]):
                        fits[i, j, a, b] = True
                        continue
                    for k in range(3):
                        covariance[k, k] += slack_m**2
                    _invert(covariance)
                    z = apart_m[2] - arm_m[2]
                    for k in range(HEADINGS):
                        x = apart_m[0] - (cosine[k] * arm_m[0] - sine[k] * arm_m[1])
                        y = apart_m[1] - (sine[k] * arm_m[0] + cosine[k] * arm_m[1])
                        chi2 = covariance[0, 0] * x * x + covariance[1, 1] * y * y + covariance[2, 2] * z * z
                        chi2 += 2.0 * (
                            covariance[0, 1] * x * y + (covariance[0, 2] * x + covariance[1, 2] * y) * z
                        )
                        if chi2 < GATE_CHI2:
                            fits[i, j, a, b] = True
                            break
    return fits


@compiled
def _apart(
    places: Places,
    sights: Sights,
    layout: Carried,
    i: int,
    j: int,
    a: int,
    b: int,
    apart_m: Array,
    covariance: Array,
) -> None:
    """Write how flare j stands from flare i, if they are sources b and a, and its covariance.

    The range constant's error may be anything here; fluxes count as the layout has them.
    """
    covariance[:] = 0.0
    apart_m[:] = 0.0
    towards, from_m, turned_m = np.zeros(3), np.empty(3), np.empty(3)
    for sign, flare, source in ((-1.0, i, a), (1.0, j, b)):
        row = places.row[flare]
        factor = math.exp(0.5 * sights.by_flux[row] * layout.log_flux[source])
        range2 = 0.0
        for k in range(3):
            from_m[k] = places.place_m[flare, k] - sights.origin_m[row, k]
            apart_m[k] += sign * (sights.origin_m[row, k] + factor * from_m[k])
            towards[k] += sign * sights.constant[row] * factor * from_m[k]
            range2 += from_m[k] ** 2
        own = (0.5 * layout.flux_sigma_own) ** 2
        for k in range(3):
            for m in range(3):
                covariance[k, m] += factor**2 * places.noise_m2[flare, k, m] + own * from_m[k] * from_m[m]
        for error in range(sights.shared.shape[2]):
            for k in range(3):
                turned_m[k] = 0.0
                for c in range(3):
                    turned_m[k] += sights.shared[row, c, error] * sights.axes[row, c, k]
            for k in range(3):
                for m in range(3):
                    covariance[k, m] += range2 * turned_m[k] * turned_m[m]
    for k in range(3):
        for m in range(3):
            covariance[k, m] += towards[k] * towards[m]


@compiled
def _near(places: Places, i: int, j: int, longest_m: float) -> bool:
    """Tell whether two flares are not too far apart across the line of sight to be of one robot."""
    middle2, along_m, apart2, noise2_i, noise2_j = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        apart_m = places.place_m[i, k] - places.place_m[j, k]
        middle_m = 0.5 * (places.place_m[i, k] + places.place_m[j, k])
        middle2 += middle_m**2
        along_m += apart_m * middle_m
        apart2 += apart_m**2
        noise2_i += places.noise_m2[i, k, k]
        noise2_j += places.noise_m2[j, k, k]
    across2 = apart2 - along_m**2 / max(middle2, 1e-18)
    # In sight's axes angles' noise is the least of the three, and K's error stretches all alike.
    noise_m = math.sqrt(max(noise2_i, 0.0)) + math.sqrt(max(noise2_j, 0.0))
    reach_m = longest_m + NOISES * min(noise_m, MOST_NOISE_M)
    return not across2 > reach_m**2  # what has no range is not told apart


@compiled
def _distance_m(one: Array, other: Array) -> float:
    return math.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)


@compiled
def _invert(matrix: Array) -> None:
    """Invert a small positive definite matrix in place, by elimination."""
    size = len(matrix)
    for pivot in range(size):
        scale = 1.0 / matrix[pivot, pivot]
        matrix[pivot, pivot] = 1.0
        for column in range(size):
            matrix[pivot, column] *= scale
        for row in range(size):
            if row != pivot:
                factor = matrix[row, pivot]
                matrix[row, pivot] = 0.0
                for column in range(size):
                    matrix[row, column] -= factor * matrix[pivot, column]
