"""The Gaussian that looks most like a core, and what of a flare lies about it: what perception is told."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from nir_render.camera.optics.gaussian import pixel_shares
from nir_render.camera.optics.otf import Core
from nir_render.camera.optics.waves import image_of_points

BLUR_SIGMAS = 3.0
LEAST_RADIUS_PX = 3.0
"""A flare is what lies within three σ of its image, and at least within 3 px of its centre."""

# Where in a pixel the images are compared: from its middle to its corner.
_OFFSETS_PX = ((0.0, 0.0), (0.5, 0.0), (0.25, 0.25), (0.0, 0.5), (0.5, 0.5))


@dataclass(frozen=True)
class GaussianFit:
    """The σ of a Gaussian, and the light in a point's flare over what the Gaussian has there."""

    sigma_px: float
    share: float


@lru_cache(maxsize=64)
def gaussian_fit(core: Core) -> GaussianFit:
    """Return the Gaussian whose image on pixels fits that of a point best: least squares in σ and light."""
    sigma_px = core.gaussian_px
    if sigma_px is not None:
        return GaussianFit(sigma_px, 1.0)
    side = 2 * int(core.reach_px) + 3
    middle = side // 2
    places_px = [np.array([[middle + u, middle + v]]) for u, v in _OFFSETS_PX]
    images = [_whole(core, place, side) for place in places_px]
    widest_px = 0.5 * core.reach_px

    def explained(log_sigma: float) -> float:
        models = [_gaussian(place[0], math.exp(log_sigma), side) for place in places_px]
        overlap = sum(float((model * image).sum()) for model, image in zip(models, images, strict=True))
        return overlap**2 / sum(float((model**2).sum()) for model in models)

    # Below 0.05 px all Gaussians are alike on pixels.
    best = minimize_scalar(
        lambda log_sigma: -explained(log_sigma),
        bounds=(math.log(0.05), math.log(widest_px)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    found_px = math.exp(best.x)
    radius_px = max(BLUR_SIGMAS * found_px, LEAST_RADIUS_PX)
    row, column = np.indices((side, side))
    inside = [np.hypot(column - place[0, 0], row - place[0, 1]) <= radius_px for place in places_px]
    models = [_gaussian(place[0], found_px, side) for place in places_px]
    held, expected = (
        sum(float(image[flare].sum()) for image, flare in zip(these, inside, strict=True))
        for these in (images, models)
    )
    return GaussianFit(found_px, held / expected)


def _whole(core: Core, place_px: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    image = np.zeros((side, side))
    values, row, column = image_of_points(core, place_px, np.ones(1), side, side)
    image[row : row + values.shape[0], column : column + values.shape[1]] = values
    return image


def _gaussian(place_px: NDArray[np.float64], sigma_px: float, side: int) -> NDArray[np.float64]:
    edges = np.arange(side + 1) - 0.5
    u, v = (pixel_shares(edges - middle, sigma_px) for middle in place_px)
    return np.asarray(v[:, None] * u)
