"""How well flares explain what is seen of them."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perception.model.window import Structure
from perception.robust.solve import Solution

MODEL_ERROR = 0.05
"""How far, relative to the flares' own light, point spread and source may be off before a fit is bad."""

MISFIT_PROBABILITY = 1e-6

_FEWEST_PIXELS = 16


@dataclass(frozen=True)
class Goodness:
    """χ² over `pixels` pixels, and the probability of one at least as large if the model holds.

    `share_left` is the root of Σ residual² / Σ flares² over these pixels.
    """

    chi2: float
    pixels: int
    probability: float
    share_left: float

    @property
    def is_good(self) -> bool:
        """Whether chance alone may leave so much."""
        return self.probability >= MISFIT_PROBABILITY


def core_goodness(solution: Solution, model_error: float = MODEL_ERROR) -> Goodness:
    """Goodness of fit over the flares' own pixels, allowing for an imperfect model.

    The sum of (x - λ)² / (λ + σ² + (ε F S)²) over the used pixels where F·S exceeds their noise. Over the
    whole window a bad core drowns in good background; without ε a bright flare shows every per cent by
    which the real PSF, the pixels' gains or the source differ from the model. A clipped pixel that should
    clip says nothing, and does not count.

    Parameters
    ----------
    solution
        The fit to judge.
    model_error
        ε, standard deviation of the model relative to the flares' own light.

    Returns
    -------
    Goodness
        Probability 1 if no pixel stands out.
    """
    from scipy.special import chdtrc

    window, residual = solution.window, solution.residual_e
    says = window.usable & ~(window.clipped & (residual == 0.0))
    core = says & (solution.flares_e > np.sqrt(solution.variance_e2(0.0)))
    chi2 = float(np.sum(residual[core] ** 2 / solution.variance_e2(model_error)[core]))
    pixels = int(core.sum())
    left = float(np.sum(residual[core] ** 2)) / max(float(np.sum(solution.flares_e[core] ** 2)), 1e-300)
    return Goodness(chi2, pixels, float(chdtrc(pixels, chi2)) if pixels else 1.0, math.sqrt(left))


def residual_sigmas(solution: Solution) -> NDArray[np.float64]:
    """Return what a fit leaves over, matched to the image of a point, in units of its noise, for each pixel.

    An error of the model counts as noise.
    """
    weight = np.where(solution.window.usable, 1.0 / solution.variance_e2(MODEL_ERROR), 0.0)
    spread = _gaussian(len(weight), math.hypot(solution.psf_sigma_px, math.sqrt(1.0 / 12.0)))
    matched = spread @ (solution.residual_e * weight) @ spread
    power = spread**2 @ weight @ spread**2
    # Where hardly any pixel counts nothing is known.
    known = power > 1e-3 * float(power.max())
    return np.where(known, matched / np.sqrt(np.where(known, power, 1.0)), 0.0)


@lru_cache(maxsize=64)
def _gaussian(side_px: int, sigma_px: float) -> NDArray[np.float64]:
    """Return the symmetric matrix that smooths a row of pixels by a Gaussian, zero beyond its ends."""
    at = np.arange(side_px)
    kernel = np.exp(-0.5 * ((at[:, None] - at) / sigma_px) ** 2)
    return np.asarray(kernel / (math.sqrt(2.0 * math.pi) * sigma_px))


def structure_left_e(solution: Solution) -> float:
    """Return the standard deviation of what lies around the flares beside noise; 0 where that is noise alone.

    By χ² of the pixels that the flares do not reach: noise passes once in a million.
    """
    from scipy.ndimage import binary_dilation
    from scipy.special import chdtrc

    variance = solution.variance_e2(0.0)
    reached = binary_dilation(solution.flares_e > 0.1 * np.sqrt(variance), iterations=2)
    around = solution.window.usable & ~solution.window.clipped & ~reached
    residual2 = solution.residual_e[around] ** 2
    if len(residual2) < _FEWEST_PIXELS:
        return 0.0
    if chdtrc(len(residual2), float(np.sum(residual2 / variance[around]))) >= MISFIT_PROBABILITY:
        return 0.0
    return math.sqrt(max(float(np.mean(residual2 - variance[around])), 0.0))


def excess_e(solution: Solution) -> float:
    """Return the root of the mean square of what a fit leaves over in its window, noise taken off."""
    usable = solution.window.usable
    excess_e2 = solution.residual_e[usable] ** 2 - solution.variance_e2(0.0)[usable]
    return math.sqrt(max(float(np.mean(excess_e2)), 0.0)) if usable.any() else 0.0


def halo_sigmas(solution: Solution, halo: Structure) -> float:
    """Return by how many standard deviations, at least, a halo shows in what a lone flare's fit leaves."""
    window = solution.window
    weight = np.where(window.usable & ~window.clipped, 1.0 / solution.variance_e2(0.0), 0.0)
    columns = halo.columns[0]
    score = (columns * solution.residual_e * weight).sum(axis=(1, 2))
    return float(np.max(score / np.sqrt((columns**2 * weight).sum(axis=(1, 2)) + 1e-300)))
