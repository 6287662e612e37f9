"""Flares are fitted to windows: the maximum-likelihood fit of any number of them in each.

What is maximised is that of `model.likelihood`, with the λ and the priors of `model.window`. Images are laid
out for all windows at once, and anew where that is seen: sizes or places have moved far from where they were.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import pixel_turn
from perception.model.discs.nodes import smoothing_px
from perception.model.layout import Sources, part_of
from perception.model.ranging import covered_px_at_1_m
from perception.model.sensor import pixel_variance_e2
from perception.model.window import Camera, lay_out
from perception.model.window import motion_cost as cost_of_motion
from perception.robust.fit import Fit, log_range_by_size
from perception.robust.goodness import LeftOver, drawn_out, left_over, residual_e
from perception.robust.problem import Motion, Problem, Start, Window
from perception.types import Calibration

Array = NDArray[np.float64]

_MOST_LAYOUTS = 7
# Images are laid out anew where they grow by so much in ln size: strips are then too few (by up to .004 σ),
_GROWTH_KEPT, _LEAST_DISC_PX = 0.15, 0.05
# and where they change by so many σ, but for what so many widths of the point spread blur.
_KEPT_SIGMAS, _BLURRED = 0.05, 4.0
_HIDDEN_KEPT = 4e-4  # share of a source's flux, by the background that it hides: 2e-4 of its range
_LINE_KEPT_PX = 0.5  # by how much a flare may move farther than its image is laid out for
_BLOB_PX2, _PLACES = 50.0, 200.0  # of a flare in a blob: so many px², by four e-foldings of its range
NEIGHBOURS_PER_PX2 = 20.0 / (1280.0 * 960.0)  # of twenty flares in a frame


@dataclass(frozen=True, eq=False)
class Solution:
    """Flares of one window, fitted together.

    Attributes
    ----------
    window
        What they explain.
    u_px, v_px, flux_e, log_photometric_range
        Shape (flares,) each; the last is the range that the flux alone says.
    u_sigma_px, v_sigma_px, flux_sigma_e, flux_noise_e
        Standard deviations, same shape; the last were it certain what explains the window (`rivals.weighed`).
    log_range, log_range_sigma, log_range_common
        Range by flux and size together, its standard deviation, and the part of that which every measurement
        of the source shares (`Camera.log_range`), same shape.
    log_range_of_model, log_flux_of_model
        How far ranges and fluxes may be off because the calibration is (`overlap.free_fits`), same shape.
    log_range_hidden
        Part of these that comes of the background hidden behind each, same shape.
    ranged, image_radius_px
        Whether a range can be had there, and the radius of each image before the point spread, half of its
        motion included, same shape.
    background_e
        Of a pixel, beneath all of them.
    expected_e, flares_e
        λ in each pixel of the window, and the flares' part of it, shape (height, width).
    deviance
        −2 ln L but for a constant of the window.
    psf_sigma_px, log_information
        Width of the point spread as calibrated; logarithm of the determinant of the information, priors
        included, over that of the structure's prior.
    sources
        As laid out last; None where spheres hide parts of each other.
    motion_px, motion_cost
        How far each moves along u and v during the exposure, shape (flares, 2), None where none may; and what
        that costs a priori (`model.window`).
    log_range_of_two
        How far the range of a lone flare may be off because it may be two (`unparted`), beside its σ.
    is_doubtful
        Whether another number of flares explains the window nearly as well (`rivals.weighed`).
    may_be_more
        Whether more flares were not looked for, as there are too many already (`deblend`).
    is_eclipse
        Whether what one hides of another is left out of λ, where fluxes are of whole sources, and nothing
        else explains the window as well (`eclipse`).
    by_outline
        How many flares the outline of what is lit shows (`hiding.outlines`).
    """

    window: Window
    u_px: Array
    v_px: Array
    flux_e: Array
    log_photometric_range: Array
    u_sigma_px: Array
    v_sigma_px: Array
    flux_sigma_e: Array
    flux_noise_e: Array
    log_range: Array
    log_range_sigma: Array
    log_range_common: Array
    log_range_of_model: Array
    log_flux_of_model: Array
    log_range_hidden: Array
    ranged: NDArray[np.bool_]
    image_radius_px: Array
    background_e: float
    expected_e: Array
    flares_e: Array
    deviance: float
    psf_sigma_px: float
    log_information: float
    sources: Sources | None
    motion_px: Array | None = None
    motion_cost: float = 0.0
    log_range_of_two: float = 0.0
    is_doubtful: bool = False
    may_be_more: bool = False
    is_eclipse: bool = False
    by_outline: int = 0

    @property
    def cost(self) -> float:
        """−2 ln of the evidence, but for a constant of the window: flares and structure at a price.

        Laplace's approximation (MacKay, Neural Comput. 4, 415, 1992): an unknown costs the logarithm of how
        much narrower the data leave it than its prior, which for a flare is any of `_PLACES` places and
        brightnesses. That others lie in the same blob is as rare as `NEIGHBOURS_PER_PX2` says, each.
        """
        by_flares = self.count * (2.0 * math.log(_PLACES) - 3.0 * math.log(2.0 * math.pi))
        by_chance = -2.0 * (self.count - 1) * math.log(NEIGHBOURS_PER_PX2 * _BLOB_PX2)
        return self.deviance + self.log_information + by_flares + by_chance + self.motion_cost

    @cached_property
    def count(self) -> int:
        """Number of flares."""
        return len(self.flux_e)

    def is_fit_of(self, other: "Solution") -> bool:
        """Tell whether it is the same fit as another, only σ or doubts being others."""
        return self.expected_e is other.expected_e

    @property
    def starts(self) -> list[Start]:
        """The flares as first guesses of another fit."""
        own = (self.u_px.tolist(), self.v_px.tolist(), self.log_photometric_range.tolist())
        return list(zip(*own, strict=True))

    def again(self, window: Window | None = None) -> Problem:
        """Return the problem of fitting these flares again, or to another view of their window."""
        return Problem(window or self.window, self.starts, self.background_e, self.motions)

    @property
    def most_motion_px(self) -> float:
        """How far that moves which moves farthest; 0 where nothing may."""
        return 0.0 if self.motion_px is None else float(np.hypot(*self.motion_px.T).max())

    @property
    def radius_at_rest_px(self) -> Array:
        """Radii of the flares' images, but for how far they move."""
        if self.motion_px is None:
            return self.image_radius_px
        return np.asarray(self.image_radius_px - 0.5 * np.hypot(*self.motion_px.T))

    @property
    def motions(self) -> list[Motion] | None:
        """How they move as first guesses of another fit."""
        return None if self.motion_px is None else [(float(u), float(v)) for u, v in self.motion_px]

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

    @cached_property
    def drawn_out(self) -> tuple[float, float, float, float]:
        """By how much longer than wide what is seen in its window is than the fit (`goodness.drawn_out`)."""
        window = self.window
        return drawn_out(
            window.image_e, window.state, self.expected_e, self.flares_e, window.floor_e2, window.prnu
        )

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
    if not problems:
        return []
    moving = camera.moving
    fits = [Fit(problem, camera if problem.motions is None else moving) for problem in problems]
    solved: dict[int, Solution] = {}
    for of_camera, moves in ((camera, False), (moving, True)):
        alike = [(index, fit) for index, fit in enumerate(fits) if fit.layout.moves == moves]
        going = [fit for _, fit in alike]
        for _ in range(_MOST_LAYOUTS):
            if not going:
                break
            going = _climbed(going, of_camera)
        done = [(index, fit) for index, fit in alike if fit.converged]
        found = solutions_of([fit for _, fit in done], of_camera)
        solved.update((index, one) for (index, _), one in zip(done, found, strict=True))
    return [solved.get(index) for index in range(len(fits))]


def _climbed(fits: Sequence[Fit], camera: Camera) -> list[Fit]:
    """Lay images out and climb; return those that have moved so far that it is to be done anew."""
    counts = [fit.layout.sources for fit in fits]
    own = np.concatenate([fit.own for fit in fits])
    background_e = np.repeat([fit.background_e for fit in fits], counts)
    motion_px = _motion_px(own, fits[0])
    laid_px = None if motion_px is None else motion_px + _LINE_KEPT_PX
    most_px = np.repeat([fit.window.diagonal_px for fit in fits], counts)
    hidden_px = camera.hidden_px_at_1_m(own[:, :2])
    hidden_e = None if hidden_px is None else hidden_px * np.maximum(background_e, 0.0)
    by_size = log_range_by_size(own, fits[0])
    laid, imaged = lay_out(camera, own[:, 0], own[:, 1], by_size, hidden_e, laid_px, None, most_px)
    reach_px = laid.reach_px
    ends = np.cumsum(counts).tolist()
    parts = list(zip(fits, [0, *ends], ends, strict=False))
    has_image = imaged.tolist()
    climbed = [(fit, first, end) for fit, first, end in parts if all(has_image[first:end])]
    for fit, first, end in climbed:
        fit.climb(part_of(laid, first, end))
    laid_at, own = own[:, :2], np.concatenate([fit.own for fit in fits])
    change = laid.log_range_at - log_range_by_size(own, fits[0])
    radius_px = reach_px * np.exp(change)
    for fit in fits:
        fit.converged = False
    for fit, first, end in climbed:
        fit.end_at(radius_px[first:end])
    moved = (change > _GROWTH_KEPT) & (radius_px > _LEAST_DISC_PX)
    if laid_px is not None and (motion_px := _motion_px(own, fits[0])) is not None:
        moved |= motion_px > laid_px
    if hidden_px is not None:
        more_e = np.repeat([fit.background_e for fit in fits], counts) - background_e
        moved |= abs(hidden_px * more_e) > _HIDDEN_KEPT * np.exp(laid.log_flux_at_1_m)
    kept_px = _KEPT_SIGMAS * np.sqrt([variance for fit in fits for variance in fit.place_variances_px2])
    moved |= _are_off(laid, reach_px, laid_at, own[:, :2], abs(change), kept_px, camera)
    if not moved.any():
        return []
    return [fit for fit, first, end in parts if fit.converged and moved[first:end].any()]


def _are_off(
    laid: Sources,
    reach_px: Array,
    laid_px: Array,
    now_px: Array,
    grown: Array,
    kept_px: Array,
    camera: Camera,
) -> NDArray[np.bool_]:
    """Tell which images are seen to be off by more than is kept, as they moved and grew in ln size since.

    Off the axis a disc is longer than wide, and its middle not its brightest: by where it is, and how large.
    """
    blurred = reach_px**2 / (reach_px**2 + (_BLURRED * smoothing_px(camera.calibration)) ** 2)
    radius_rad = camera.radius_m * np.exp(-laid.log_range_at)
    # The middle of its light lies off its place by its radius squared, too; that no point spread blurs.
    by_growth_px = 0.5 * radius_rad * grown * reach_px * blurred + laid.middle_px * grown
    by_place_px = 2.0 * radius_rad * np.hypot(*(now_px - laid_px).T) * blurred
    is_off = by_growth_px + by_place_px > kept_px
    if is_off.any():
        scale = _change_of_scale(laid_px[is_off], now_px[is_off], camera.calibration)
        off_px = by_growth_px[is_off] + scale * (reach_px * blurred)[is_off]
        is_off[is_off] = ~(off_px <= kept_px[is_off])
    return np.asarray(is_off)


def _change_of_scale(places_px: Array, others_px: Array, calibration: Calibration) -> Array:
    """Return by what share small discs are longer, or wider, at other places; NaN where none is seen."""
    before, after = (
        turn @ turn.swapaxes(1, 2)
        for turn in (pixel_turn(places_px, calibration), pixel_turn(others_px, calibration))
    )
    changed = np.full(len(before), np.nan)
    known = np.isfinite(before).all(axis=(1, 2)) & np.isfinite(after).all(axis=(1, 2))
    turned = np.linalg.solve(before[known], after[known] - before[known])
    changed[known] = 0.5 * np.linalg.norm(turned, axis=(1, 2))
    return changed


def _motion_px(own: Array, fit: Fit) -> Array | None:
    """Return how far each source moves, None if none may."""
    if not fit.layout.moves:
        return None
    return np.asarray(np.hypot(own[:, fit.layout.motion], own[:, fit.layout.motion + 1]))


def solutions_of(fits: Sequence[Fit], camera: Camera) -> list[Solution]:
    """Return what has been found, reckoned for all sources at once."""
    if not fits:
        return []
    own = np.concatenate([fit.own for fit in fits])
    covariance = np.concatenate([fit.of_sources for fit in fits])
    log_flux_at_1_m = np.concatenate([fit.log_flux_at_1_m for fit in fits])
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    slack = own[:, 3] if fits[0].layout.has_slack else None
    log_range, log_range_sigma, log_range_common = camera.log_range(own[:, 2], slack, covariance[:, 2:, 2:])
    hidden = np.zeros(len(own))
    if unsure := camera.calibration.sigma.get("hidden_background", 0.0):
        counts = [fit.layout.sources for fit in fits]
        background_e = np.maximum(np.repeat([fit.background_e for fit in fits], counts), 0.0)
        behind_e = covered_px_at_1_m(own[:, :2], camera.calibration) * background_e
        hidden = 0.5 * unsure * behind_e / np.exp(log_flux_at_1_m)
        log_range_sigma = np.hypot(log_range_sigma, hidden)
        log_range_common = np.hypot(log_range_common, hidden)
    flux_e = np.exp(log_flux_at_1_m - 2.0 * own[:, 2])
    flux_sigma_e, ranged = 2.0 * sigma[:, 2] * flux_e, log_flux_at_1_m != 0.0
    solutions, first = [], 0
    for fit in fits:
        these = slice(first, first + fit.layout.sources)
        first = these.stop
        background_e, radius_px = fit.background_e, fit.image_radius_px
        motion_px = own[these, fit.layout.motion :] if fit.layout.moves else None
        motion_cost = 0.0
        if motion_px is not None:
            part = slice(fit.layout.motion, fit.layout.motion + 2)
            motion_cost = cost_of_motion(motion_px, own[these, 2], covariance[these, part, part], camera)
            radius_px = radius_px + 0.5 * np.hypot(*motion_px.T)
        flares_e, log_information = fit.expected_e - background_e, fit.log_information
        if fit.window.known_e is not None:
            flares_e -= fit.window.known_e
        if amplitudes := fit.layout.structure:
            flares_e -= fit.structure.light(fit.values[-amplitudes:]).reshape(flares_e.shape)
            log_information -= fit.structure.log_determinant
        solutions.append(
            Solution(
                window=fit.window,
                u_px=own[these, 0],
                v_px=own[these, 1],
                flux_e=flux_e[these],
                log_photometric_range=own[these, 2],
                u_sigma_px=sigma[these, 0],
                v_sigma_px=sigma[these, 1],
                flux_sigma_e=flux_sigma_e[these],
                flux_noise_e=flux_sigma_e[these],
                log_range=log_range[these],
                log_range_sigma=log_range_sigma[these],
                log_range_common=log_range_common[these],
                log_range_of_model=np.zeros(fit.layout.sources),
                log_flux_of_model=np.zeros(fit.layout.sources),
                log_range_hidden=hidden[these],
                ranged=ranged[these],
                image_radius_px=radius_px,
                background_e=background_e,
                expected_e=fit.expected_e,
                flares_e=flares_e,
                deviance=fit.deviance,
                psf_sigma_px=fit.known.psf_sigma_px,
                log_information=log_information,
                sources=fit.sources,
                motion_px=motion_px,
                motion_cost=motion_cost,
            )
        )
    return solutions
