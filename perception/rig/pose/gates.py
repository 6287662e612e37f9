"""Which two flares may be which two sources, and how turned, by how they stand apart: a compiled loop."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.likelihood.products import invert
from perception.rig.pose.sights import Carried, Sights

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

GATE_CHI2 = 30.0
"""More χ² than this beyond its degrees of freedom is another robot: less than once in a million."""

HEADINGS = 72
SLACK = 0.05  # of the distance between two sources: half a step of the headings above
STRETCH, NOISES, MOST_NOISE_M, NEAREST_M = 1.5, 6.0, 0.1, 0.05


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
    """Tell whether flares i < j may be sources a and b of a robot at some heading, shape (f, f, s, s, 72)."""
    flares, sources = len(places.row), len(layout.log_flux)
    fits = np.zeros((flares, flares, sources, sources, HEADINGS), dtype=np.bool_)
    cosine, sine = np.empty(HEADINGS), np.empty(HEADINGS)
    for k in range(HEADINGS):
        cosine[k], sine[k] = math.cos(k * 2.0 * math.pi / HEADINGS), math.sin(k * 2.0 * math.pi / HEADINGS)
    longest_m = 0.0
    for a in range(sources):
        for b in range(a):
            longest_m = max(longest_m, _distance_m(layout.place_m[a], layout.place_m[b]))
    # A source of less flux seems farther off by the root of it, and so farther from others.
    longest_m *= STRETCH * math.exp(0.5 * (layout.log_flux.max() - layout.log_flux.min()))
    stand_m, noise_m2 = np.empty((2, 3)), np.empty((2, 3, 3))
    apart_m, covariance = np.empty(3), np.empty((3, 3))
    for i in range(flares):
        for j in range(i + 1, flares):
            if not _stand(places, sights, i, j, stand_m, noise_m2):
                fits[i, j] = True  # bearings alone tell nothing apart
                continue
            if not _near(stand_m, noise_m2, longest_m):
                continue
            for a in range(sources):
                for b in range(sources):
                    if a == b:
                        continue
                    arm_m = layout.place_m[b] - layout.place_m[a]
                    slack_m = SLACK * math.sqrt(arm_m[0] ** 2 + arm_m[1] ** 2 + arm_m[2] ** 2)
                    rows = places.row[i], places.row[j]
                    _apart(stand_m, noise_m2, sights, rows, layout, (a, b), apart_m, covariance)
                    for k in range(3):
                        covariance[k, k] += slack_m**2
                    invert(covariance)
                    z = apart_m[2] - arm_m[2]
                    for k in range(HEADINGS):
                        x = apart_m[0] - (cosine[k] * arm_m[0] - sine[k] * arm_m[1])
                        y = apart_m[1] - (sine[k] * arm_m[0] + cosine[k] * arm_m[1])
                        chi2 = covariance[0, 0] * x * x + covariance[1, 1] * y * y + covariance[2, 2] * z * z
                        chi2 += 2.0 * (
                            covariance[0, 1] * x * y + (covariance[0, 2] * x + covariance[1, 2] * y) * z
                        )
                        if chi2 < GATE_CHI2:  # at a heading in between it may be less than at either
                            fits[i, j, a, b, k - 1] = fits[i, j, a, b, k] = True
                            fits[i, j, a, b, (k + 1) % HEADINGS] = True
    return fits


@compiled
def _stand(places: Places, sights: Sights, i: int, j: int, stand_m: Array, noise_m2: Array) -> bool:
    """Write where two flares stand, shape (2, 3), and its noise, (2, 3, 3); False where no range is known.

    One of unknown range is put where its ray comes nearest to the other.
    """
    for flare, other, number in ((i, j, 0), (j, i, 1)):
        stand_m[number] = places.place_m[flare]
        noise_m2[number] = places.noise_m2[flare]
        if not math.isnan(stand_m[number, 0]):
            continue
        if math.isnan(places.place_m[other, 0]):
            return False
        row, range_m = places.row[flare], 0.0
        axes = sights.axes[row]
        for k in range(3):
            range_m += axes[2, k] * (places.place_m[other, k] - sights.origin_m[row, k])
        range_m = max(range_m, NEAREST_M)
        for k in range(3):
            stand_m[number, k] = sights.origin_m[row, k] + range_m * axes[2, k]
            for m in range(3):
                noise_m2[number, k, m] = 0.0
                for c in range(3):
                    for d in range(3):
                        noise_m2[number, k, m] += range_m**2 * axes[c, k] * sights.own[row, c, d] * axes[d, m]
    return True


@compiled
def _apart(
    stand_m: Array,
    noise_m2: Array,
    sights: Sights,
    rows: tuple[int, int],
    layout: Carried,
    sources: tuple[int, int],
    apart_m: Array,
    covariance: Array,
) -> None:
    """Write how the second of two flares stands from the first, as these sources, and its covariance.

    The range constant's error may be anything here; fluxes count as the layout has them.
    """
    covariance[:] = 0.0
    apart_m[:] = 0.0
    towards, from_m, turned_m = np.zeros(3), np.empty(3), np.empty(3)
    own2 = (0.5 * layout.flux_sigma_own) ** 2
    for number in range(2):
        row, sign = rows[number], 2.0 * number - 1.0
        factor = math.exp(0.5 * sights.by_flux[row] * layout.log_flux[sources[number]])
        constant, range2 = sights.constant[row], 0.0
        if not math.isnan(layout.flux_sigma_common):
            constant = 0.5 * layout.flux_sigma_common * sights.by_flux[row]
        for k in range(3):
            from_m[k] = stand_m[number, k] - sights.origin_m[row, k]
            apart_m[k] += sign * (sights.origin_m[row, k] + factor * from_m[k])
            towards[k] += sign * constant * factor * from_m[k]
            range2 += from_m[k] ** 2
        for k in range(3):
            for m in range(3):
                covariance[k, m] += factor**2 * noise_m2[number, k, m] + own2 * from_m[k] * from_m[m]
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
def _near(stand_m: Array, noise_m2: Array, longest_m: float) -> bool:
    """Tell whether two flares are not too far apart across the line of sight to be of one robot."""
    middle2, along_m, apart2, noise2_i, noise2_j = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        off_m = stand_m[0, k] - stand_m[1, k]
        middle_m = 0.5 * (stand_m[0, k] + stand_m[1, k])
        middle2 += middle_m**2
        along_m += off_m * middle_m
        apart2 += off_m**2
        noise2_i += noise_m2[0, k, k]
        noise2_j += noise_m2[1, k, k]
    across2 = apart2 - along_m**2 / max(middle2, 1e-18)
    # In sight's axes angles' noise is the least of the three, and K's error stretches all alike.
    noise_m = math.sqrt(max(noise2_i, 0.0)) + math.sqrt(max(noise2_j, 0.0))
    return across2 <= (longest_m + NOISES * min(noise_m, MOST_NOISE_M)) ** 2


@compiled
def _distance_m(one: Array, other: Array) -> float:
    return math.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)
