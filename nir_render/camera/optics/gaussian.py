"""The image of a point under a Gaussian, integrated over pixels exactly."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf


def pixel_shares(edges_px: NDArray[np.float64], sigma_px: float) -> NDArray[np.float64]:
    """Return the shares of a Gaussian in the pixels of a row: Φ(b/σ) − Φ(a/σ) between edges a and b.

    Parameters
    ----------
    edges_px
        Where the pixels' edges lie from its middle, shape (..., pixels + 1).
    """
    return np.asarray(np.diff(0.5 * erf(edges_px / (math.sqrt(2.0) * sigma_px))))
