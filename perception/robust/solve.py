"""Windows with any number of flares each, fitted in as few batches as their sizes and numbers allow."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.likelihood import Windows
from perception.model.sensor import pixel_variance_e2
from perception.model.window import Camera, Structure
from perception.robust.fit import Fits, Starts, fit_flares

Array = NDArray[np.float64]

_MOST_NUMBERS = 4_000_000  # in the largest array of a batch
_PLACES = 200.0  # of a flare in a blob: 50 px² by four e-foldings of its range

Start = tuple[float, float, float]
"""First guess of (u_px, v_px, ln range) of a flare, its range as the flux alone says."""


@dataclass(frozen=True, eq=False)
class Window:
    """A square part of a frame to be explained by flares, in electrons.

    Attributes
    ----------
    box
        Where it is; it may reach beyond the frame.
    image_e, usable, clipped
        Shape (height, width); `usable` says which pixels count, clipped ones too.
    floor_e2, clip_e, prnu
        Variance of a dark pixel, electrons at which one clips, relative spread of the pixels' responses.
    structure, structure_e
        What may lie on the background beside flares, and its standard deviation; None and 0 where it is even.
    on_edges
        Whether that structure is not the frame's texture but something sharper, found in the window itself.
    """

    box: PixelBox
    image_e: Array
    usable: NDArray[np.bool_]
    clipped: NDArray[np.bool_]
    floor_e2: float
    clip_e: float
    prnu: float
    structure: Structure | None = None
    structure_e: float = 0.0
    on_edges: bool = False


@dataclass(frozen=True, eq=False)
class Problem:
    """A window, first guesses of its flares and of its background."""

    window: Window
    starts: Sequence[Start]
    background_e: float


@dataclass(frozen=True, eq=False)
class Solution:
    """Flares of one window, fitted together.

    Attributes
    ----------
    window
        What they explain.
    u_px, v_px, flux_e, log_photometric_range
        Shape (flares,) each; the last is the range that the flux alone says.
    u_sigma_px, v_sigma_px, flux_sigma_e
        Standard deviations, same shape.
    log_range, log_range_sigma
        Range by flux and size together, and its standard deviation, same shape.
    ranged
        Whether a range can be had there, same shape.
    image_radius_px
        Radius of each image before the point spread, same shape.
    background_e
        Of a pixel, beneath all of them.
    expected_e, flares_e
        λ in each pixel of the window, and the flares' part of it, shape (height, width).
    deviance
        −2 ln L but for a constant of the window.
    psf_sigma_px
        Width of the point spread as calibrated.
    log_information
        Logarithm of the determinant of the information, priors included, over that of the structure's prior.
    """

    window: Window
    u_px: Array
    v_px: Array
    flux_e: Array
    log_photometric_range: Array
    u_sigma_px: Array
    v_sigma_px: Array
    flux_sigma_e: Array
    log_range: Array
    log_range_sigma: Array
    ranged: NDArray[np.bool_]
    image_radius_px: Array
    background_e: float
    expected_e: Array
    flares_e: Array
    deviance: float
    psf_sigma_px: float
    log_information: float

    @property
    def cost(self) -> float:
        """−2 ln of the evidence, but for a constant of the window: flares and structure at a price.

        Laplace's approximation (MacKay, Neural Comput. 4, 415, 1992): an unknown costs the logarithm of how
        much narrower the data leave it than its prior, which for a flare is any of `_PLACES` places and
        brightnesses.
        """
        by_flares = self.count * (2.0 * math.log(_PLACES) - 3.0 * math.log(2.0 * math.pi))
        return self.deviance + self.log_information + by_flares

    @property
    def count(self) -> int:
        """Number of flares."""
        return len(self.flux_e)

    @property
    def starts(self) -> list[Start]:
        """The flares as first guesses of another fit."""
        rows = zip(self.u_px, self.v_px, self.log_photometric_range, strict=True)
        return [(float(u), float(v), float(log_range)) for u, v, log_range in rows]

    def again(self, window: Window | None = None) -> Problem:
        """Return the problem of fitting these flares again, or to another view of their window."""
        return Problem(self.window if window is None else window, self.starts, self.background_e)

    @cached_property
    def residual_e(self) -> Array:
        """What the fit leaves over: 0 where unusable, or clipped as is expected."""
        left = self.window.image_e - self.expected_e
        left = np.where(self.window.clipped, np.maximum(left, 0.0), left)
        return np.where(self.window.usable, left, 0.0)

    def variance_e2(self, model_error: float) -> Array:
        """Variance of pixels, an error of the model relative to the flares' own light counted in."""
        window = self.window
        of_noise = pixel_variance_e2(self.expected_e, window.floor_e2, window.prnu)
        return of_noise + (model_error * self.flares_e) ** 2


def solve(problems: Sequence[Problem], camera: Camera) -> list[Solution | None]:
    """Fit the flares of each problem to its window.

    Returns
    -------
    A solution for each, None where the fit did not converge.
    """
    batches: defaultdict[tuple[int, ...], list[int]] = defaultdict(list)
    for index, problem in enumerate(problems):
        structure = problem.window.structure
        columns = 0 if structure is None else structure.columns.shape[1]
        size = _size(problem, camera)
        batches[len(problem.starts), *problem.window.image_e.shape, columns, size].append(index)
    solutions: list[Solution | None] = [None] * len(problems)
    for (count, rows, columns, more, _), members in batches.items():
        at_once = max(1, _MOST_NUMBERS // ((4 * count + 2 + more) * rows * columns))
        for first in range(0, len(members), at_once):
            part = members[first : first + at_once]
            for index, solution in zip(part, _solve_alike([problems[k] for k in part], camera), strict=True):
                solutions[index] = solution
    return solutions


def _size(problem: Problem, camera: Camera) -> int:
    """Return a class of how large images are: the largest sets how many nodes all of a batch have."""
    nearest_m = math.exp(min(log_range for _, _, log_range in problem.starts))
    calibration = camera.calibration
    radius_px = calibration.fx_px * calibration.source_radius_m / max(nearest_m, 1e-3)
    return max(0, math.ceil(math.log2(max(radius_px, 1e-3) / calibration.psf_sigma_px)))


def _solve_alike(problems: Sequence[Problem], camera: Camera) -> list[Solution | None]:
    """Solve problems of one size and one number of flares."""
    windows = [problem.window for problem in problems]
    first = windows[0]
    starts = np.array([problem.starts for problem in problems], dtype=np.float64)
    structures = [window.structure for window in windows if window.structure is not None]
    structure = None
    if structures:
        structure = Structure(
            np.concatenate([each.columns for each in structures]),
            np.concatenate([each.precision for each in structures]),
        )
    fits = fit_flares(
        Windows(
            top=np.array([window.box.top for window in windows]),
            left=np.array([window.box.left for window in windows]),
            image_e=np.stack([window.image_e for window in windows]),
            usable=np.stack([window.usable for window in windows]),
            clipped=np.stack([window.clipped for window in windows]),
            floor_e2=np.array([window.floor_e2 for window in windows]),
            clip_e=first.clip_e,
            prnu=first.prnu,
        ),
        camera,
        Starts(
            u_px=starts[..., 0],
            v_px=starts[..., 1],
            log_range=starts[..., 2],
            background_e=np.array([problem.background_e for problem in problems]),
        ),
        structure,
    )
    return _solutions(fits, windows)


def _solutions(fits: Fits, windows: Sequence[Window]) -> list[Solution | None]:
    count = fits.model.layout.sources
    own = [np.sqrt(np.einsum("gii->gi", fits.of_source(k))) for k in range(count)]
    sigmas = np.stack(own, axis=1)
    ranges = [fits.log_range(k) for k in range(count)]
    log_range = np.stack([value for value, _ in ranges], axis=1)
    log_sigma = np.stack([sigma for _, sigma in ranges], axis=1)
    radius_px = fits.image_radius_px()
    flux_e, flares_e = fits.flux_e, fits.flares_e()
    log_information = np.full(len(windows), np.inf)
    log_information[fits.converged] = -np.linalg.slogdet(fits.covariance[fits.converged])[1]
    if (structure := fits.model.structure) is not None:
        log_information -= np.linalg.slogdet(structure.precision)[1]
    return [
        Solution(
            window=window,
            u_px=fits.places_px[g, :, 0],
            v_px=fits.places_px[g, :, 1],
            flux_e=flux_e[g],
            log_photometric_range=fits.log_photometric_range[g],
            u_sigma_px=sigmas[g, :, 0],
            v_sigma_px=sigmas[g, :, 1],
            flux_sigma_e=2.0 * sigmas[g, :, 2] * flux_e[g],
            log_range=log_range[g],
            log_range_sigma=log_sigma[g],
            ranged=fits.model.log_flux_at_1_m[g] != 0.0,
            image_radius_px=radius_px[g],
            background_e=float(fits.background_e[g]),
            expected_e=fits.expected_e[g],
            flares_e=flares_e[g],
            deviance=float(fits.deviance[g]),
            psf_sigma_px=fits.model.camera.calibration.psf_sigma_px,
            log_information=float(log_information[g]),
        )
        if fits.converged[g]
        else None
        for g, window in enumerate(windows)
    ]
