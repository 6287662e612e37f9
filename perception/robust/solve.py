"""Flares are fitted to windows: the maximum-likelihood fit of any number of them in each.

What is maximised is the likelihood of `model.pixels`, with the λ and the priors of `model.window`. Images are
laid out for all windows at once, and anew where a size has moved far from the one they were laid out for.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.layout import CLIPPED, UNUSABLE, Layout, Sources, Structure, View, even
from perception.model.pixels import maximise
from perception.model.sensor import pixel_variance_e2
from perception.model.window import Camera, lay_out
from perception.robust.goodness import LeftOver, left_over, residual_e

Array = NDArray[np.float64]

_MOST_LAYOUTS = 7
# How far the range by size may move before images are laid out anew: their shape changes with its square.
_LAYOUT_KEPT = 0.02
_LAYOUT_KEPT_PX = 0.05
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
    image_e, state
        Shape (height, width); the state of a pixel is one of `model.layout`'s.
    floor_e2, clip_e, prnu
        Variance of a dark pixel, electrons at which one clips, relative spread of the pixels' responses.
    structure, structure_e
        What may lie on the background beside flares, and its standard deviation; None and 0 where it is even.
    on_edges
        Whether that structure is not the frame's texture but something sharper, found in the window itself.
    """

    box: PixelBox
    image_e: Array
    state: NDArray[np.uint8]
    floor_e2: float
    clip_e: float
    prnu: float
    structure: Structure | None = None
    structure_e: float = 0.0
    on_edges: bool = False

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which pixels count, clipped ones too."""
        return np.not_equal(self.state, UNUSABLE)

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """Which of them are clipped."""
        return np.equal(self.state, CLIPPED)


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
        return residual_e(self.window.image_e, self.window.state, self.expected_e)

    @cached_property
    def left_over(self) -> LeftOver:
        """What that amounts to."""
        window = self.window
        return left_over(
            window.image_e, window.state, self.expected_e, self.flares_e,
            window.floor_e2, window.prnu, self.psf_sigma_px,
        )  # fmt: skip

    @property
    def excess_e(self) -> float:
        """Root of the mean square of what the fit leaves over in its window, noise taken off."""
        usable = self.window.usable
        excess_e2 = self.residual_e[usable] ** 2 - self.variance_e2(0.0)[usable]
        return math.sqrt(max(float(np.mean(excess_e2)), 0.0)) if usable.any() else 0.0

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
    solutions: list[Solution | None] = [None] * len(problems)
    fits = [_Fit.begun(problem, camera) for problem in problems]
    going = list(range(len(problems)))
    for _ in range(_MOST_LAYOUTS):
        if not going:
            break
        own = np.concatenate([fits[index].places for index in going])
        laid, imaged = lay_out(camera, *np.ascontiguousarray(own.T))
        reach_px, end, moved = laid.reach_px, 0, []
        for index in going:
            fit, first = fits[index], end
            end = first + fit.layout.sources
            solutions[index] = None
            if imaged[first:end].all() and fit.climb(laid.part(first, end)):
                solutions[index] = fit.solution(reach_px[first:end])
                if fit.has_moved(reach_px[first:end]):
                    moved.append(index)
        going = moved
    return solutions


class _Fit:
    """The fit of one window, on its way."""

    def __init__(self, problem: Problem, camera: Camera, layout: Layout, values: Array) -> None:
        window = problem.window
        self.window, self.camera, self.layout, self.values = window, camera, layout, values
        self.known = camera.known(window.clip_e)
        self.structure = even(window.image_e.size) if window.structure is None else window.structure
        self.view = View(window.box.top, window.box.left, window.image_e, window.state, window.floor_e2)
        self.prior = layout.prior(self.structure)
        self.covariance = np.empty((layout.size, layout.size))
        self.expected_e = np.empty(window.image_e.size)
        self.deviance = self.log_information = math.inf
        self.sources: Sources | None = None

    @classmethod
    def begun(cls, problem: Problem, camera: Camera) -> "_Fit":
        """Return the fit at its first guesses."""
        structure = problem.window.structure
        waves = 0 if structure is None else len(structure.columns)
        layout = camera.known(problem.window.clip_e).layout(len(problem.starts), waves)
        values = np.zeros(layout.size)
        own = values[: layout.width].reshape(layout.sources, layout.per_source)
        own[:, :3] = problem.starts
        values[layout.background] = problem.background_e
        return cls(problem, camera, layout, values)

    @property
    def own(self) -> Array:
        """The sources' unknowns, a view of shape (sources, unknowns of each)."""
        return self.values[: self.layout.width].reshape(self.layout.sources, self.layout.per_source)

    @property
    def log_range_by_size(self) -> Array:
        """Logarithm of the range that each source's size stands for."""
        if not self.layout.has_slack:
            return self.own[:, 2]
        return np.asarray(self.own[:, 2] - self.known.tie_spread * self.own[:, 3])

    @property
    def places(self) -> Array:
        """Where images are to be laid out: u, v and ln range by size, shape (sources, 3)."""
        return np.column_stack([self.own[:, :2], self.log_range_by_size])

    def climb(self, sources: Sources) -> bool:
        """Go on to the greatest likelihood with images as laid out, and tell whether it was reached."""
        self.sources = sources
        self.deviance, self.log_information = maximise(
            self.view, sources, self.structure, self.known, self.prior, self.layout.most_step,
            self.values, self.covariance, self.expected_e,
        )  # fmt: skip
        return math.isfinite(self.deviance)

    def has_moved(self, reach_px: Array) -> bool:
        """Tell whether a size has changed so much that images should be laid out anew."""
        assert self.sources is not None
        change = self.sources.log_range_at - self.log_range_by_size
        stale = (abs(change) > _LAYOUT_KEPT) & (abs(change) * reach_px * np.exp(change) > _LAYOUT_KEPT_PX)
        return bool(stale.any())

    def solution(self, reach_px: Array) -> Solution:
        """Return what has been found."""
        assert self.sources is not None
        layout, window, own = self.layout, self.window, self.own
        step, shape = layout.per_source, window.image_e.shape
        sigmas = np.sqrt(np.diagonal(self.covariance)[: layout.width]).reshape(own.shape)
        # Of (l, a), or of l alone.
        at = np.arange(2, layout.width, step)[:, None] + np.arange(step - 2)
        tied = self.covariance[at[:, :, None], at[:, None, :]]
        slack = own[:, 3] if layout.has_slack else None
        log_range, log_range_sigma = self.camera.log_range(own[:, 2], slack, tied)
        flux_e = np.exp(self.sources.log_flux_at_1_m - 2.0 * own[:, 2])
        background_e = float(self.values[layout.background])
        flares_e = self.expected_e - background_e
        log_information = self.log_information
        if layout.structure:
            flares_e -= self.values[-layout.structure :] @ self.structure.columns
            log_information -= self.structure.log_determinant
        return Solution(
            window=window,
            u_px=own[:, 0].copy(),
            v_px=own[:, 1].copy(),
            flux_e=flux_e,
            log_photometric_range=own[:, 2].copy(),
            u_sigma_px=sigmas[:, 0],
            v_sigma_px=sigmas[:, 1],
            flux_sigma_e=2.0 * sigmas[:, 2] * flux_e,
            log_range=np.array(log_range),
            log_range_sigma=log_range_sigma,
            ranged=self.sources.log_flux_at_1_m != 0.0,
            image_radius_px=reach_px * np.exp(self.sources.log_range_at - self.log_range_by_size),
            background_e=background_e,
            expected_e=self.expected_e.reshape(shape).copy(),
            flares_e=flares_e.reshape(shape),
            deviance=self.deviance,
            psf_sigma_px=self.known.psf_sigma_px,
            log_information=log_information,
        )
