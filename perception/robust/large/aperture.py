"""How much light a flare gives, by an aperture: for what is too large, or too odd, to be fitted."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.ranging import range_from_flux
from perception.model.sensor import gain_dn_per_e
from perception.robust.clusters import Candidate, Cluster
from perception.robust.flare import MeasuredFlare
from perception.robust.search.blobs import Blob, dilated
from perception.robust.search.prepare import PreparedFrame


@dataclass(frozen=True)
class ApertureFlux:
    """Flux within a circle above the background of a ring, in the unit of the image.

    `background` is per pixel; `flux_sigma` comes from the scatter within the ring and the flux's own shot
    noise (one unit of the image taken as one electron).
    """

    flux: float
    flux_sigma: float
    background: float


def aperture_flux(
    image: NDArray[np.floating],
    u_px: float,
    v_px: float,
    radius_px: float,
    ring_inner_px: float,
    ring_outer_px: float,
    usable: NDArray[np.bool_] | None = None,
) -> ApertureFlux:
    """Sum an image over a circle, above the mean of a ring around it.

    Whole pixels only, by their centres: make the aperture wide enough that nothing of the flare lies on its
    rim (image radius + 5 σ leaves out less than 1e-5).

    Parameters
    ----------
    image
        Electrons (or any linear unit), shape (rows, columns).
    u_px, v_px
        Centre, in pixels of `image`.
    radius_px, ring_inner_px, ring_outer_px
        Radius of the aperture; the ring lies between its two.
    usable
        Pixels that count, shape of `image`; all by default. What is left out of the aperture is missing
        from the flux.

    Returns
    -------
    ApertureFlux
        Background zero, and NaN sigma, if the ring holds fewer than two pixels.

    Raises
    ------
    ValueError
        If the radii do not increase.
    """
    if not 0.0 < radius_px <= ring_inner_px < ring_outer_px:
        raise ValueError(
            "need 0 < radius_px ≤ ring_inner_px < ring_outer_px, "
            f"not {radius_px}, {ring_inner_px}, {ring_outer_px}"
        )
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    distance2 = (columns - u_px) ** 2 + (rows - v_px) ** 2
    inside = distance2 <= radius_px**2
    ring = (distance2 > ring_inner_px**2) & (distance2 <= ring_outer_px**2)
    if usable is not None:
        inside &= usable
        ring &= usable
    ring_values = np.asarray(image[ring], dtype=np.float64)
    background, pixel_variance = 0.0, math.nan
    if ring_values.size >= 2:
        background, pixel_variance = float(ring_values.mean()), float(ring_values.var(ddof=1))
    count = int(inside.sum())
    flux = float(image[inside].sum(dtype=np.float64)) - count * background
    # The background's own error enters once per pixel of the aperture, fully correlated.
    variance = max(flux, 0.0) + count * pixel_variance * (1.0 + count / max(ring_values.size, 1))
    return ApertureFlux(flux, math.sqrt(variance) if variance >= 0.0 else math.nan, background)


def mask_in(top: int, left: int, shape: tuple[int, ...], blob: Blob) -> NDArray[np.bool_]:
    """Mark the blob's pixels in a mask over a window, as far as it holds them."""
    mask = np.zeros(shape, dtype=bool)
    row, column = blob.box.top - top, blob.box.left - left
    down = slice(max(-row, 0), max(min(shape[0] - row, blob.box.height), 0))
    across = slice(max(-column, 0), max(min(shape[1] - column, blob.box.width), 0))
    held = blob.pixels[down, across]
    first_row, first = max(row, 0), max(column, 0)
    mask[first_row : first_row + held.shape[0], first : first + held.shape[1]] = held
    return mask


def centroid_sigmas(member: Candidate, flux_e: float, prepared: PreparedFrame) -> tuple[float, float]:
    """Compute the centroid's standard deviations: √(Σ (x - x̄)² variance) / flux along each axis."""
    if not flux_e > 0.0:
        return math.nan, math.nan
    blob = member.blob
    light_e = prepared.excess_e[blob.box.slices][blob.pixels] + prepared.background_e(
        member.u_px, member.v_px
    )
    variance = np.maximum(light_e, 0.0) + prepared.floor_e2
    rows, columns = np.nonzero(blob.pixels)
    return (
        math.sqrt(float(np.sum((blob.box.left + columns - member.u_px) ** 2 * variance))) / flux_e,
        math.sqrt(float(np.sum((blob.box.top + rows - member.v_px) ** 2 * variance))) / flux_e,
    )


def measure_by_aperture(member: Candidate, cluster: Cluster, prepared: PreparedFrame) -> MeasuredFlare:
    """Sum what exceeds a ring around the blob, at its centroid.

    Whether it is all of a source's light, and no other's, nothing tells: no σ of range is claimed, and none
    of the place of what is large.
    """
    blob, window = member.blob, cluster.window
    frame, calibration = prepared.frame, prepared.calibration
    reach_px = 0.5 * math.hypot(blob.box.height, blob.box.width) + 2.0
    own = mask_in(window.box.top, window.box.left, window.usable.shape, blob)
    lit = prepared.lit_in(window.box) & ~own
    aperture = aperture_flux(
        window.image_e,
        member.u_px - window.box.left,
        member.v_px - window.box.top,
        reach_px,
        reach_px,
        reach_px + 4.0,
        window.usable & ~dilated(lit, 2),
    )
    gain = gain_dn_per_e(frame, calibration)
    ranged = range_from_flux(
        aperture.flux * gain,
        aperture.flux_sigma * gain,
        member.u_px,
        member.v_px,
        frame.exposure_s,
        frame.gain,
        calibration,
        aperture.background * gain,
    )
    has_place = not (member.is_clipped or member.is_too_large)
    u_sigma_px, v_sigma_px = centroid_sigmas(member, aperture.flux, prepared)
    return MeasuredFlare(
        u_px=member.u_px,
        v_px=member.v_px,
        u_sigma_px=u_sigma_px if has_place else math.nan,
        v_sigma_px=v_sigma_px if has_place else math.nan,
        flux_e=aperture.flux,
        flux_sigma_e=aperture.flux_sigma,
        flux_noise_e=aperture.flux_sigma,
        background_e=aperture.background,
        range_m=ranged.range_m,
        range_sigma_m=math.nan,
        saturated=member.is_clipped,
        misfit=member.is_too_large and not member.is_clipped,
    )
