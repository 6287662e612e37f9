"""How thick the fog is, by what flux and size say of near sources; and ranges corrected for it.

With D what flux says in clear air and d what size says, ln D − ln d = σ d/2 + k: a line over d, of slope σ/2,
that passes through an error k of the range constant. Flux alone tells nothing: N robots, N + 1 unknowns.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.fog import extinction_sigma_per_m, ranged_in_fog
from perception.model.ranging import constant_spread, flux_at_one_metre_dn
from perception.rig.frame_sets import Exposed
from perception.types import Calibration, Detection

Array = NDArray[np.float64]

OUTLIER_SIGMAS = 4.0
DETERMINED = 0.7
"""An estimate that leaves more than this of the σ that was known before tells nothing."""

Key = tuple[str, int, int]


@dataclass(frozen=True)
class Extinction:
    """Light lost per metre, and its standard deviation."""

    per_m: float
    sigma_per_m: float


def clear_air_ranges_m(found: Sequence[Detection], frame: Exposed, calibration: Calibration) -> Array:
    """Return what flux says of ranges in clear air, NaN where it cannot, shape (detections,)."""
    u_px, v_px, flux_dn, sigma_dn = np.array(
        [[hit.u_px, hit.v_px, hit.flux_dn, hit.flux_sigma_dn] for hit in found]
    ).T
    at_1_m_dn = flux_at_one_metre_dn(u_px, v_px, frame.exposure_s, frame.gain, calibration)
    relative = np.where(flux_dn > 0.0, sigma_dn / np.where(flux_dn > 0.0, flux_dn, 1.0), np.nan)
    range2 = at_1_m_dn / np.where(flux_dn > 0.0, flux_dn, np.nan)
    # Noise in flux makes a root of its inverse too long, as in `range_from_flux`.
    return np.asarray(np.sqrt(range2) / (1.0 + 0.375 * np.minimum(relative, 1.0) ** 2))


def estimated_extinction(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    images: Collection[Key] = (),
) -> Extinction | None:
    """Estimate the extinction of fog from a set's detections.

    Least squares for σ and the error k of the range constant, each with its prior; a source whose own flux
    differs (σ_K once more) is one of many. What is off by 4 σ is left out. It may be an odd source, or fog
    that is thinner on its way: then what it is off by counts in σ. Less than that is not seen, and not in σ.

    Parameters
    ----------
    frames, detections, calibrations
        Of the set; the calibrations say what is known of the extinction beforehand.
    images
        Camera, index and number of detections of mirror images, which are dimmer for another reason.

    Returns
    -------
    The estimate; None where the set does not determine it.
    """
    half_m, excess, noise2, constant = [], [], [], 0.0
    prior: Extinction | None = None
    for frame, found in zip(frames, detections, strict=True):
        calibration = calibrations[frame.camera]
        sigma = extinction_sigma_per_m(calibration)
        if not found or not sigma > 0.0:
            continue
        if prior is None or sigma < prior.sigma_per_m:
            prior = Extinction(calibration.extinction_per_m, sigma)
        constant = 0.5 * constant_spread(calibration)
        by_flux_m = clear_air_ranges_m(found, frame, calibration)
        for number, (hit, flux_m) in enumerate(zip(found, by_flux_m.tolist(), strict=True)):
            sized = math.isfinite(hit.range_by_size_sigma_m) and math.isfinite(flux_m)
            if sized and not (hit.merged or hit.saturated or (hit.camera, hit.index, number) in images):
                relative = hit.range_by_size_sigma_m / hit.range_by_size_m
                half_m.append(0.5 * hit.range_by_size_m)
                # E[ln d] of a range that scatters is less than ln of its mean.
                excess.append(math.log(flux_m / hit.range_by_size_m) + 0.5 * relative**2)
                noise2.append(relative**2 + (0.5 * hit.flux_sigma_dn / hit.flux_dn) ** 2)
    if prior is None or not half_m:
        return None
    slope, said = np.array(half_m), np.array(excess)
    variance = np.array(noise2) + constant**2
    kept = np.ones(len(said), dtype=bool)
    for _ in range(3):
        estimate, k = _line(slope[kept], said[kept], variance[kept], prior, constant)
        off = said - slope * estimate.per_m - k
        expected2 = variance + (slope * estimate.sigma_per_m) ** 2
        again = off**2 < OUTLIER_SIGMAS**2 * expected2
        if not again.any():
            return None
        if (again == kept).all():
            break
        kept = again
    uneven_per_m = _unevenness_per_m(slope, off, expected2, kept, prior)
    if not (uneven_per_m > 0.0 or estimate.sigma_per_m < DETERMINED * prior.sigma_per_m):
        return None
    return replace(estimate, sigma_per_m=math.hypot(estimate.sigma_per_m, uneven_per_m))


def _unevenness_per_m(
    slope: Array, off: Array, expected2: Array, kept: NDArray[np.bool_], prior: Extinction
) -> float:
    """Return what the extinction of ways differs by, as far as sources that were left out tell of it.

    One that would need more than 4 σ of what was known before is an odd source, not odd fog. Others count by
    the lengths of ways.
    """
    fog = ~kept & (abs(off) < OUTLIER_SIGMAS * prior.sigma_per_m * slope)
    return math.sqrt(float((off**2 - expected2)[fog].sum() / (slope**2).sum()))


def _line(
    slope: Array, said: Array, variance: Array, prior: Extinction, constant: float
) -> tuple[Extinction, float]:
    """Fit σ and k by least squares with their priors; returns the extinction, and k."""
    columns = np.column_stack([slope, np.ones(len(slope))])
    known = np.array([1.0 / prior.sigma_per_m**2, 1.0 / max(constant, 1e-9) ** 2])
    information = columns.T @ (columns / variance[:, None]) + np.diag(known)
    covariance = np.linalg.inv(information)
    per_m, k = covariance @ (columns.T @ (said / variance) + known * [prior.per_m, 0.0])
    return Extinction(float(per_m), math.sqrt(covariance[0, 0])), float(k)


def corrected(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    extinction: Extinction,
) -> list[list[Detection]]:
    """Return detections with ranges by an extinction that has been found; bounds stay as they are."""
    result: list[list[Detection]] = []
    for frame, found in zip(frames, detections, strict=True):
        if not found:
            result.append([])
            continue
        calibration = calibrations[frame.camera]
        known = replace(
            calibration,
            extinction_per_m=extinction.per_m,
            sigma={**calibration.sigma, "extinction_per_m": extinction.sigma_per_m},
        )
        by_flux_m = clear_air_ranges_m(found, frame, calibration)
        size_m, size_sigma_m = np.array([[hit.range_by_size_m, hit.range_by_size_sigma_m] for hit in found]).T
        share = np.array([hit.flux_sigma_dn / hit.flux_dn for hit in found])
        usable = np.isfinite(by_flux_m) & np.isfinite([hit.range_sigma_m for hit in found])
        by_flux_m = np.where(usable, by_flux_m, 1.0)
        before = ranged_in_fog(by_flux_m, share, size_m, size_sigma_m, calibration)
        stated_m, common_m = np.array([[hit.range_sigma_m, hit.range_sigma_common_m] for hit in found]).T
        ranges = ranged_in_fog(by_flux_m, share, size_m, size_sigma_m, known).doubted(
            _beyond(stated_m, before.range_sigma_m, before.range_m, usable),
            _beyond(common_m, before.range_sigma_common_m, before.range_m, usable),
        )
        result.append(
            [
                replace(
                    hit,
                    range_m=float(ranges.range_m[k]),
                    range_sigma_m=float(ranges.range_sigma_m[k]),
                    range_sigma_common_m=float(ranges.range_sigma_common_m[k]),
                )
                if usable[k]
                else hit
                for k, hit in enumerate(found)
            ]
        )
    return result


def _beyond(stated_m: Array, of_fog_m: Array, range_m: Array, usable: NDArray[np.bool_]) -> Array:
    """Return what stated σ hold, relatively, beyond what comes of fog, flux and size: what sources hide."""
    beyond2 = np.where(usable & np.isfinite(stated_m), stated_m**2 - of_fog_m**2, 0.0)
    return np.asarray(
        np.where(beyond2 > 1e-9 * of_fog_m**2, np.sqrt(np.maximum(beyond2, 0.0)), 0.0) / range_m
    )
