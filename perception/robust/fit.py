"""The fit of one window, on its way from first guesses to the greatest likelihood."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import Sources
from perception.model.likelihood.maximum import maximise
from perception.model.window import Camera
from perception.robust.problem import Problem

Array = NDArray[np.float64]


class Fit:
    """The fit of one window, on its way from first guesses."""

    def __init__(self, problem: Problem, camera: Camera) -> None:
        window = problem.window
        self.window, self.known = window, camera.known(window.clip_e)
        self.structure = window.beside
        self.layout = self.known.layout(len(problem.starts), self.structure.amplitudes)
        self.values = np.zeros(self.layout.size)
        self.own = self.layout.of_sources(self.values)
        """The sources' unknowns, a view of shape (sources, unknowns of each)."""
        self.own[:, :3] = problem.starts
        if problem.motions is not None:
            self.own[:, self.layout.motion :] = problem.motions
        self.values[self.layout.background] = problem.background_e
        self.covariance = np.full((self.layout.size, self.layout.size), np.nan)
        self.expected_e = np.empty(window.image_e.shape)
        self.deviance = self.log_information = math.inf
        self.converged = False
        self.sources: Sources | None = None
        self.log_flux_at_1_m, self.image_radius_px = (np.empty(self.layout.sources) for _ in range(2))

    @property
    def background_e(self) -> float:
        """Of a pixel."""
        return float(self.values[self.layout.background])

    @property
    def of_sources(self) -> Array:
        """Their covariances, shape (sources, unknowns of each, unknowns of each)."""
        step = self.layout.per_source
        if self.layout.sources == 1:
            return self.covariance[None, :step, :step]
        return np.array(
            [self.covariance[at : at + step, at : at + step] for at in range(0, self.layout.width, step)]
        )

    @property
    def place_variances_px2(self) -> list[float]:
        """Variance of each source's place, the lesser of both."""
        of_all = np.diagonal(self.covariance).tolist()
        return [min(of_all[at : at + 2]) for at in range(0, self.layout.width, self.layout.per_source)]

    @property
    def prior(self) -> Array:
        """Precision of the unknowns a priori."""
        return self.layout.prior(self.structure, self.known.motion_px)

    def climb(self, sources: Sources) -> None:
        """Go on to the greatest likelihood, with images as laid out."""
        self.sources, self.log_flux_at_1_m = sources, sources.log_flux_at_1_m
        self.deviance, self.log_information = maximise(
            self.window.view, sources, self.structure, self.known, self.prior, self.layout.most_step,
            self.window.to_beat, self.values, self.covariance, self.expected_e.ravel(),
        )  # fmt: skip

    def end_at(self, image_radius_px: Array) -> None:
        """Tell whether it converged, to images of such radii: it does to no wider ones than the window.

        Of larger ones no limb is seen: they are even ground, and may be as near as they like.
        """
        self.image_radius_px = image_radius_px
        shows_limb = float(image_radius_px.max()) < self.window.diagonal_px
        self.converged = math.isfinite(self.deviance) and shows_limb


def log_range_by_size(own: Array, fit: Fit) -> Array:
    """Return the logarithm of the range that each source's size stands for."""
    return np.asarray(own[:, 2] - fit.known.tie_spread * own[:, 3]) if fit.layout.has_slack else own[:, 2]
