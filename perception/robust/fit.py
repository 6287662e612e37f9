"""The maximum-likelihood fit of flares, all windows of one size at once.

What is maximised is `model.likelihood` with the λ and the priors of `model.window`, by damped Fisher scoring.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.likelihood import Likelihood, Windows
from perception.model.window import Camera, Structure, WindowModel, window_model

Array = NDArray[np.float64]

_MOST_STEPS = 50
_MOST_LAYOUTS = 6
_SETTLED_SIGMAS = 0.01
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e7
_MOST_PX_A_STEP, _MOST_LOG_A_STEP, _MOST_SLACK_A_STEP = 1.0, 0.5, 3.0
# How far the range by size may move before images are laid out anew: their shape changes with its square.
_LAYOUT_KEPT = 0.02
_LAYOUT_KEPT_PX = 0.05


@dataclass(frozen=True, eq=False)
class Starts:
    """First guesses: places and ln ranges, shape (windows, sources), and backgrounds, shape (windows,)."""

    u_px: Array
    v_px: Array
    log_range: Array
    background_e: Array


@dataclass(frozen=True, eq=False)
class Fits:
    """Maximum-likelihood estimates of some windows.

    Attributes
    ----------
    model
        The model, laid out about the estimates.
    values
        Estimates, shape (windows, unknowns), in the order of the model's layout.
    covariance
        Inverse of information and priors, shape (windows, unknowns, unknowns).
    expected_e
        λ, shape (windows, rows, columns).
    deviance
        −2 ln L, priors included, but for a constant of the data; shape (windows,).
    converged
        Whether the last step was below a hundredth of a standard deviation.
    """

    model: WindowModel
    values: Array
    covariance: Array
    expected_e: Array
    deviance: Array
    converged: NDArray[np.bool_]

    @property
    def _own(self) -> Array:
        return self.model.layout.of_sources(self.values)

    @property
    def places_px(self) -> Array:
        """U and v of each source, shape (windows, sources, 2)."""
        return self._own[..., :2]

    @property
    def log_photometric_range(self) -> Array:
        """L of each source, shape (windows, sources)."""
        return self._own[..., 2]

    @property
    def flux_e(self) -> Array:
        """Flux of each source, shape (windows, sources)."""
        return np.asarray(np.exp(self.model.log_flux_at_1_m - 2.0 * self._own[..., 2]))

    @property
    def background_e(self) -> Array:
        """Background of a pixel, its structure left out, shape (windows,)."""
        return self.values[:, self.model.layout.background]

    def of_source(self, index: int) -> Array:
        """Return the covariance of one source's (u, v, l[, a]), shape (windows, 3 or 4, 3 or 4)."""
        step = self.model.layout.per_source
        own = slice(index * step, (index + 1) * step)
        return self.covariance[:, own, own]

    def log_range(self, index: int) -> tuple[Array, Array]:
        """Return ln range and its σ of one source, shape (windows,) each."""
        own = self._own[:, index]
        slack = own[:, 3] if self.model.layout.has_slack else None
        return self.model.camera.log_range(own[:, 2], slack, self.of_source(index)[:, 2:, 2:])

    def image_radius_px(self) -> Array:
        """Return the radius of each source's image before the point spread, shape (windows, sources)."""
        model, shape = self.model, self._own.shape[:2]
        reach_px = np.where(np.isfinite(model.nodes.u_px), np.hypot(model.nodes.u_px, model.nodes.v_px), 0.0)
        growth = np.exp(model.log_range_at.reshape(shape) - model.log_range_by_size(self.values))
        return np.asarray(reach_px.max(axis=1).reshape(shape) * growth)

    def flares_e(self) -> Array:
        """Return what the sources alone are expected to give, shape of `expected_e`."""
        flares_e = self.expected_e - self.background_e[:, None, None]
        if (structure := self.model.structure) is not None:
            amplitudes = self.values[:, -self.model.layout.structure :]
            flares_e -= np.einsum("gm,gmrc->grc", amplitudes, structure.columns)
        return np.asarray(flares_e)


def fit_flares(windows: Windows, camera: Camera, starts: Starts, structure: Structure | None = None) -> Fits:
    """Fit the same number of flares to each of some windows.

    Parameters
    ----------
    windows
        What is seen.
    camera
        The camera, its exposure and priors.
    starts
        First guesses.
    structure
        What may lie on the backgrounds.

    Returns
    -------
    Fits
        With `converged` False where the pixels do not determine all unknowns, where a flare leaves its
        window, or where the steps do not settle.
    """
    model, imaged = _laid_out(windows, camera, starts.u_px, starts.v_px, starts.log_range, structure)
    layout = model.layout
    values = np.zeros((len(starts.u_px), layout.size))
    own = layout.of_sources(values)
    own[..., 0], own[..., 1], own[..., 2] = starts.u_px, starts.v_px, starts.log_range
    values[:, layout.background] = starts.background_e
    fits = _climb(windows, model, values, imaged)
    for _ in range(_MOST_LAYOUTS):
        stale = np.flatnonzero(fits.converged & _moved(fits))
        if not len(stale):
            break
        # Images are laid out for all windows alike; those that stayed find themselves where they were.
        own, by_size = layout.of_sources(fits.values), model.log_range_by_size(fits.values)
        model, imaged = _laid_out(windows, camera, own[..., 0], own[..., 1], by_size, structure)
        fits = _climb(windows, model, fits.values, imaged & fits.converged)
    return fits


def _laid_out(
    windows: Windows,
    camera: Camera,
    u_px: Array,
    v_px: Array,
    log_range: Array,
    structure: Structure | None,
) -> tuple[WindowModel, NDArray[np.bool_]]:
    corners = (windows.top, windows.left)
    return window_model(camera, corners, windows.shape, (u_px, v_px, log_range), structure)


def _moved(fits: Fits) -> NDArray[np.bool_]:
    """Tell where a size has changed so much that images should be laid out anew."""
    by_size = fits.model.log_range_by_size(fits.values)
    change = np.abs(by_size - fits.model.log_range_at.reshape(by_size.shape))
    stale = (change > _LAYOUT_KEPT) & (change * fits.image_radius_px() > _LAYOUT_KEPT_PX)
    return np.asarray(stale.any(axis=1))


def _climb(windows: Windows, model: WindowModel, first: Array, alive: NDArray[np.bool_]) -> Fits:
    """Maximise the likelihood from first values, by Fisher scoring with Levenberg's damping."""
    count, size = first.shape
    values = first.copy()
    covariance = np.full((count, size, size), np.nan)
    expected = np.zeros((count, windows.image_e[0].size))
    deviance = np.full(count, np.inf)
    converged = np.zeros(count, dtype=bool)
    damping = np.full(count, 1e-3)
    going = np.flatnonzero(alive)
    part = Likelihood(windows, model, going)
    state = part.state(values[going])
    for _ in range(_MOST_STEPS):
        if not len(going):
            break
        gradient, information = part.slopes(values[going], state)
        inverse, sound = _inverses(information)
        free_step = np.einsum("gij,gj->gi", inverse, gradient)
        sigmas = np.sqrt(np.maximum(np.einsum("gii->gi", inverse), 0.0))
        settled = sound & (np.abs(free_step) <= _SETTLED_SIGMAS * sigmas)[:, : model.layout.width].all(axis=1)
        index = going[settled]
        if part.any_cut and settled.any():
            inverse, determined = _inverses(part.expected_information(state))
            sound &= determined | ~settled
        covariance[index], expected[index] = inverse[settled], state.expected[settled]
        converged[index] = sound[settled]
        deviance[index] = part.deviance(values[going], state)[settled]
        keep = sound & ~settled & (damping[going] < _MOST_DAMPING)
        if not keep.all():
            going, part, state = going[keep], part.at(keep), state.at(keep)
            gradient, information = gradient[keep], information[keep]
            if not len(going):
                break
        # Each window takes its step if it is a good one, and a shorter one the next time if it is not.
        extra = damping[going, None] * np.einsum("gii->gi", information)
        step = np.linalg.solve(information + extra[:, :, None] * np.eye(size), gradient[..., None])[..., 0]
        now = values[going]
        trial = now + _shortened(model, step)
        inside = part.inside(trial)
        trial = np.where(inside[:, None], trial, now)
        trial_state = part.state(trial)
        before = part.objective(now, state, state.expected)
        after = part.objective(trial, state, trial_state.expected)
        better = inside & (after <= before + 1e-9 * np.abs(before) + 1e-9)
        values[going] = np.where(better[:, None], trial, now)
        state = state.replaced(better, trial_state)
        damping[going] = np.where(
            better, np.maximum(0.1 * damping[going], _LEAST_DAMPING), 10.0 * damping[going]
        )
    return Fits(model, values, covariance, expected.reshape(windows.image_e.shape), deviance, converged)


def _shortened(model: WindowModel, step: Array) -> Array:
    """Keep steps within what a linear model may be trusted with."""
    layout = model.layout
    most = np.full(layout.size, np.inf)
    most[: layout.width] = np.tile(
        [_MOST_PX_A_STEP, _MOST_PX_A_STEP, _MOST_LOG_A_STEP, _MOST_SLACK_A_STEP][: layout.per_source],
        layout.sources,
    )
    if layout.has_width:
        most[layout.width] = _MOST_SLACK_A_STEP
    return np.clip(step, -most, most)


def _inverses(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Invert information matrices, scaled to a unit diagonal; also tell which are not singular."""
    diagonal = np.einsum("gii->gi", information)
    sound = np.isfinite(information).all(axis=(1, 2)) & (diagonal > 0.0).all(axis=1)
    size = information.shape[1]
    scale = 1.0 / np.sqrt(np.where(sound[:, None], diagonal, 1.0))
    scaled = np.where(sound[:, None, None], information * scale[:, :, None] * scale[:, None, :], np.eye(size))
    sound &= np.linalg.eigvalsh(scaled)[:, 0] > 1e-10
    scaled[~sound] = np.eye(size)
    return np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :], sound
