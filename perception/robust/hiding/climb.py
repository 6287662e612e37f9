"""The way from a first guess to the greatest likelihood, where a part of a sphere is hidden.

As `model.likelihood.maximum`, but images are laid out anew at each step: what is hidden changes with them.
One that has come so far, and explains too little, is given up.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import SEEN
from perception.model.likelihood.maximum import (
    FIRST_DAMPING,
    JUDGED_AFTER,
    LEAST_DAMPING,
    MORE_TO_GAIN,
    MOST_DAMPING,
    TIMES_TO_GAIN,
)
from perception.model.likelihood.pixels import is_inside, log_variances, objective, slopes
from perception.model.likelihood.products import inverted
from perception.model.sensor import pixel_variance_e2
from perception.model.window import Camera
from perception.robust.fit import Fit
from perception.robust.solve import Solution, solutions_of

Array = NDArray[np.float64]

_MOST_STEPS = 30  # what is of another shape goes on without an end
_SETTLED = 0.002  # in −2 ln L: a twentieth of a standard deviation
_SETTLED_SHARE = 0.001  # of what χ² is beyond noise, where that is too much for it to be good
_NOISE_SIGMAS = 5.0  # of χ²
_MOST_GIVEN_UP = 3  # guesses, from the likeliest on, after which none of the others comes to anything


def good_ones(
    solutions: Iterable[Solution | None], is_good: Callable[[Solution], bool], enough: int
) -> list[Solution]:
    """Return what guesses come to, followed one by one, as far as it is good; until there are enough.

    None of those first ones comes to anything where `_MOST_GIVEN_UP` have come to nothing.
    """
    good: list[Solution] = []
    given_up = 0
    for solution in solutions:
        if solution is None:
            given_up += 1
        elif is_good(solution):
            good.append(solution)
        if len(good) == enough or (given_up == _MOST_GIVEN_UP and not good):
            break
    return good


class Climb(ABC):
    """The fit of a window's sources, a part of which is hidden, on its way.

    Its unknowns are the fit's, and maybe others after them. `to_gain` is about
    how much likelier, as 2 Δ ln L, a maximum is than where it stands.
    """

    def __init__(self, fit: Fit, camera: Camera, values: Array, most_step: Array, prior: Array) -> None:
        self._fit, self._camera, self._view = fit, camera, fit.window.view
        self._values, self._most_step, self._prior = values, most_step, prior
        self._expected, self._jacobian = self._expectation(values)
        self.to_gain = math.inf

    @abstractmethod
    def _expectation(self, values: Array) -> tuple[Array, Array]:
        """Return λ and its derivatives, as `likelihood.pixels.expectation`."""

    @property
    def so_far(self) -> float:
        """−2 ln L where it stands."""
        return self._objective(self._values, self._expected)

    @property
    def log_ranges(self) -> Array:
        """Logarithms of the sources' ranges where it stands, as their fluxes say."""
        return self._fit.layout.of_sources(self._values[: self._fit.layout.size])[:, 2]

    def _reach(
        self, most_cost: float = math.inf, *, may_be_bad: bool = False, begins_near: bool = False
    ) -> bool:
        """Go on to the greatest likelihood, and write it into the fit; tell whether it is reached.

        It is not where what is ahead has a greater cost than `most_cost`, or is no good explanation. One that
        `may_be_bad` need not be, and is taken as far as it has come; not far where it stays bad. One that
        `begins_near` a maximum is judged from the first step on.
        """
        layout, size = self._fit.layout, len(self._values)
        gradient, fisher, inverse = np.empty(size), np.empty((size, size)), np.empty((size, size))
        damped = np.empty((size, size))
        damping, is_new, is_there = FIRST_DAMPING, True, True
        pixels = int(np.count_nonzero(self._view.state == SEEN))
        for done in range(_MOST_STEPS):
            if is_new:
                variance = self._variance(self._expected)
                self._slopes(variance, gradient, fisher, of_average=False)
                self._fit.log_information = inverted(fisher, inverse)
                if math.isnan(self._fit.log_information):
                    return False
                self.to_gain = float(gradient @ inverse @ gradient)
                before = self._objective(self._values, self._expected, variance)
                if self.to_gain < _SETTLED:
                    break
                beyond_noise = before - pixels - _NOISE_SIGMAS * math.sqrt(2.0 * pixels)
                stays = may_be_bad and self.to_gain < _SETTLED_SHARE * beyond_noise
                is_judged = (begins_near or done >= JUDGED_AFTER) and not may_be_bad
                if (stays or is_judged) and not self._is_promising(inverse, most_cost):
                    if may_be_bad:
                        break
                    return False
            np.copyto(damped, fisher)
            np.fill_diagonal(damped, np.diagonal(fisher) * (1.0 + damping))
            if math.isnan(inverted(damped, damped)):
                return False
            trial = self._values + np.clip(damped @ gradient, -self._most_step, self._most_step)
            is_new = False
            if is_inside(trial, self._view, layout.sources, layout.per_source):
                expected, jacobian = self._expectation(trial)
                after = self._objective(trial, expected, variance)
                is_new = after <= before * (1.0 + 1e-9) + 1e-9
            if is_new:
                self._values, self._expected, self._jacobian = trial, expected, jacobian
                damping = max(0.1 * damping, LEAST_DAMPING)
            else:
                damping *= 10.0
                if not damping < MOST_DAMPING:
                    is_there = False
                    break
        else:
            is_there = False
        if not (is_there or may_be_bad):
            return False
        if not is_new:  # a trial that was none has been laid out last
            self._expected, self._jacobian = self._expectation(self._values)
        self._slopes(self._variance(self._expected), gradient, fisher, of_average=True)
        self._fit.log_information = inverted(fisher, inverse)
        self._write(inverse)
        self._fit.deviance = self._objective(self._values, self._expected)
        return math.isfinite(self._fit.log_information)

    def _is_promising(self, covariance: Array, most_cost: float) -> bool:
        """Tell whether what lies ahead, by `to_gain` to first order, may be good, at no greater cost."""
        self._write(covariance)
        self._fit.deviance = self.so_far
        here, ahead = (
            solutions_of([self._fit], self._camera)[0],
            MORE_TO_GAIN + TIMES_TO_GAIN * self.to_gain,
        )
        return here.left_over.may_be_good(ahead) and here.cost - ahead <= most_cost

    def _write(self, covariance: Array) -> None:
        """Write what is reached into the fit, the unknowns that are not its own left free."""
        fit, size = self._fit, self._fit.layout.size
        fit.values[:], fit.covariance[:] = self._values[:size], covariance[:size, :size]
        fit.expected_e = self._expected.reshape(fit.window.image_e.shape)

    def _slopes(self, variance: Array, gradient: Array, fisher: Array, *, of_average: bool) -> None:
        fit = self._fit
        slopes(
            self._view, fit.structure, fit.layout.background + 1, self._values, self._expected,
            self._jacobian, variance, self._prior, fit.known.clip_e, of_average, gradient, fisher,
        )  # fmt: skip

    def _variance(self, expected: Array) -> Array:
        window = self._fit.window
        return np.asarray(pixel_variance_e2(expected, window.floor_e2, window.prnu))

    def _objective(self, values: Array, expected: Array, variance: Array | None = None) -> float:
        """Return −2 ln L but for a constant of the window; with given variances without their logarithms."""
        own = self._variance(expected) if variance is None else variance
        total = objective(self._view, values, expected, own, self._prior, self._fit.known.clip_e)
        return float(total + log_variances(self._view, own)) if variance is None else float(total)
