"""How much light a flare gives: by an aperture, and by the maximum-likelihood fit."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.fisher import covariance, fisher_information, flare_jacobian
from perception.model.flare import PixelBox, flare_image, has_image
from perception.model.sensor import noise_floor_e2, pixel_variance_e2
from perception.types import Calibration

_MAX_STEPS = 20


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


@dataclass(frozen=True, eq=False)
class FlareFit:
    """Maximum-likelihood estimate of one flare, in electrons.

    Attributes
    ----------
    u_px, v_px, flux_e, background_e
        The estimate; the background is per pixel.
    covariance
        Of (u, v, flux, background), shape (4, 4): the inverse Fisher information. NaN if not converged.
    reduced_chi2
        Σ (x - λ)² / variance over the used pixels, per degree of freedom: 1 ± √(2/n) if the model holds.
    expected_e
        λ in each pixel of the window, shape (height, width).
    used
        The pixels that took part, same shape.
    converged
        Whether the last step was below a hundredth of a standard deviation.
    """

    u_px: float
    v_px: float
    flux_e: float
    background_e: float
    covariance: NDArray[np.float64]
    reduced_chi2: float
    expected_e: NDArray[np.float64]
    used: NDArray[np.bool_]
    converged: bool

    @property
    def flux_sigma_e(self) -> float:
        """Standard deviation of the flux."""
        return math.sqrt(self.covariance[2, 2])


def fit_flare(
    image_e: NDArray[np.floating],
    usable: NDArray[np.bool_],
    window: PixelBox,
    calibration: Calibration,
    *,
    start: tuple[float, float, float, float],
    angular_radius_rad: float,
    gain: float = 1.0,
) -> FlareFit:
    """Fit place, flux and background of a flare of known size, by Fisher scoring.

    Maximises the shifted Poisson likelihood, x + σ² ~ Poisson(λ + σ²) with λ = F·S(u, v) + B and σ² the
    variance of a dark pixel (Snyder et al., J. Opt. Soc. Am. A 12, 272, 1995), whose score is
    Σ ∂λ (x - λ)/(λ + σ²). The spread of the pixels' responses adds (PRNU λ)² to each pixel's variance. That
    comes from the model, not from the data: weights from the data
    would favour pixels that came out low and bias the flux.

    Parameters
    ----------
    image_e
        Electrons above black level in the window, shape (height, width).
    usable
        Pixels that count, same shape. Clipped pixels must not: leave out their neighbours too, because a
        choice made by the noise of a pixel biases what remains.
    window
        Where the pixels lie.
    calibration
        Camera and PSF.
    start
        First guess of (u_px, v_px, flux_e, background_e).
    angular_radius_rad
        Angular radius of the source, held fixed.
    gain
        Gain of the frame relative to the calibrated one (for the rounding noise).

    Returns
    -------
    FlareFit
        With `converged` False where the pixels do not determine all four, or the steps do not settle.

    Raises
    ------
    ValueError
        If shapes do not match, or the start is not finite or its flux not positive.
    """
    shape = (window.height, window.width)
    if image_e.shape != shape or usable.shape != shape:
        raise ValueError(
            f"the window has shape {shape}, image_e {image_e.shape}, usable {usable.shape}; they must match"
        )
    if not (all(map(math.isfinite, start)) and start[2] > 0.0):
        raise ValueError(f"start must be finite with a positive flux, not {start}")
    floor_e2 = noise_floor_e2(calibration, gain)
    data = image_e[usable].astype(np.float64)
    u, v, flux, background = start
    converged = False
    inverse: NDArray[np.float64] | None = None
    expected = np.full(shape, background)
    variance = pixel_variance_e2(expected, floor_e2, calibration.prnu)
    for _ in range(_MAX_STEPS):
        if not has_image(u, v, angular_radius_rad, calibration):
            break
        image = flare_image(u, v, angular_radius_rad, window, calibration)
        expected = flux * image.fraction + background
        variance = pixel_variance_e2(expected, floor_e2, calibration.prnu)
        jacobian = flare_jacobian(image, flux)[:, usable]
        inverse = covariance(fisher_information(jacobian, variance[usable]))
        if inverse is None:
            break
        step = inverse @ (jacobian @ ((data - expected[usable]) / variance[usable]))
        if np.all(np.abs(step) < 0.01 * np.sqrt(np.diagonal(inverse))):
            converged = True
            break
        # A far start makes the linear step overshoot: at most a pixel, and a factor of three, at a time.
        u += float(np.clip(step[0], -1.0, 1.0))
        v += float(np.clip(step[1], -1.0, 1.0))
        flux = float(np.clip(flux + step[2], flux / 3.0, flux * 3.0))
        background += float(step[3])
        if not (
            abs(u - start[0]) < 0.5 * window.width + 1.0 and abs(v - start[1]) < 0.5 * window.height + 1.0
        ):
            break
    degrees = max(data.size - 4, 1)
    return FlareFit(
        u_px=u,
        v_px=v,
        flux_e=flux,
        background_e=background,
        covariance=inverse if converged and inverse is not None else np.full((4, 4), math.nan),
        reduced_chi2=float(np.sum((data - expected[usable]) ** 2 / variance[usable])) / degrees,
        expected_e=expected,
        used=usable,
        converged=converged,
    )


@dataclass(frozen=True)
class Goodness:
    """χ² over `pixels` pixels, and the probability of one at least as large if the model holds."""

    chi2: float
    pixels: int
    probability: float


def core_goodness(
    image_e: NDArray[np.floating],
    expected_e: NDArray[np.float64],
    background_e: float,
    used: NDArray[np.bool_],
    floor_e2: float,
    model_error: float,
) -> Goodness:
    """Goodness of fit over the flare's own pixels, allowing for an imperfect model.

    The sum of (x - λ)² / (λ + σ² + (ε F S)²) over the used pixels where F·S exceeds their noise. Over the
    whole window a bad core drowns in good background; without ε a bright flare shows every per cent by
    which the real PSF, the pixels' gains or the source differ from the model.

    Parameters
    ----------
    image_e
        Electrons in the window.
    expected_e, background_e, used
        The fit to judge: λ in each pixel, the background of a pixel, and which pixels took part.
    floor_e2
        Variance of a dark pixel.
    model_error
        ε, standard deviation of the model relative to the flare's own light.

    Returns
    -------
    Goodness
        Probability 1 if no pixel stands out.
    """
    from scipy.special import chdtrc

    flare_e = expected_e - background_e
    variance = np.maximum(expected_e, 0.0) + floor_e2
    core = used & (flare_e > np.sqrt(variance))
    residual = image_e[core] - expected_e[core]
    chi2 = float(np.sum(residual**2 / (variance[core] + (model_error * flare_e[core]) ** 2)))
    pixels = int(core.sum())
    return Goodness(chi2, pixels, float(chdtrc(pixels, chi2)) if pixels else 1.0)
