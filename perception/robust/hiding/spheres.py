"""The fit of spheres to a window, some of them before others, or partly behind an edge: all at once."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.discs.nodes import line_rule, smoothing_px
from perception.model.discs.visible import NO_EDGE, Seen, seen_of_discs
from perception.model.flare import is_before
from perception.model.window import Camera, log_flux_at_1_m
from perception.robust.fit import Fit, log_range_by_size
from perception.robust.hiding.climb import Climb
from perception.robust.hiding.seen_light import add_seen
from perception.robust.problem import Problem
from perception.robust.solve import Solution, solutions_of
from perception.types import Calibration

Array = NDArray[np.float64]

_MEET = 1.1  # times the sum of their radii two may be apart, and one hide a little of the other


class Spheres(Climb):
    """The fit of spheres to a window, of which nearer ones hide parts of farther ones, from first guesses."""

    def __init__(self, problem: Problem, camera: Camera) -> None:
        fit = Fit(problem, camera)
        super().__init__(fit, camera, fit.values.copy(), fit.layout.most_step, fit.prior)

    def solution(
        self, most_cost: float = math.inf, *, may_be_bad: bool = False, begins_near: bool = False
    ) -> Solution | None:
        """Return what is likeliest; None where there is no maximum, or no good one unless it `may_be_bad`.

        Nor where its cost would be greater than `most_cost`: told at once of what `begins_near` a maximum.
        """
        if not self._reach(most_cost, may_be_bad=may_be_bad, begins_near=begins_near):
            return None
        return solutions_of([self._fit], self._camera)[0]

    def _expectation(self, values: Array) -> tuple[Array, Array]:
        """Return λ and its derivatives, shape (pixels,) and (unknowns, pixels)."""
        expected, jacobian, _ = expectation_of_spheres(values, self._fit, self._camera)
        return expected, jacobian


def expectation_of_spheres(
    values: Array, fit: Fit, camera: Camera, edge: Array = NO_EDGE
) -> tuple[Array, Array, Seen | None]:
    """Return λ, its derivatives, and what is seen of spheres, some before others, or partly behind an edge.

    Lays the fit's images out anew, of spheres that move at several places. NaN and None where not all are
    imaged: there is nowhere to go on to.

    Parameters
    ----------
    values
        Unknowns, those of the fit, and of an edge its direction and place after them.
    fit, camera
        The fit and its camera.
    edge
        As for `seen_of_discs`.

    Returns
    -------
    Shapes (pixels,) and (unknowns, pixels), that without the structure's waves; and what is seen.
    """
    layout, calibration = fit.layout, camera.calibration
    own = layout.of_sources(values[: layout.size])
    radius_rad = np.arcsin(np.minimum(camera.radius_m * np.exp(-log_range_by_size(own, fit)), 1.0))
    axis = direction_camera(own[:, :2], calibration)
    beside = slice(layout.background + 1, layout.size)
    known_e, structure = fit.window.view.known_e.ravel(), fit.structure
    expected = np.asarray(values[layout.background] + known_e + structure.light(values[beside]))
    jacobian = np.zeros((len(values) - len(structure.order), len(expected)))
    first = layout.background + 1
    jacobian[layout.background], jacobian[first : first + len(structure.columns)] = 1.0, structure.columns
    hidden_px = camera.hidden_px_at_1_m(own[:, :2])
    hidden_e = None if hidden_px is None else hidden_px * max(float(values[layout.background]), 0.0)
    fit.log_flux_at_1_m = log_flux_at_1_m(camera, axis, hidden_e)
    flux = np.exp(fit.log_flux_at_1_m - 2.0 * own[:, 2])
    sigma_px = fit.known.psf_sigma_px
    if layout.has_width:
        sigma_px *= math.exp(fit.known.width_spread * float(values[layout.width]))
    motion_px = own[:, layout.motion :] if layout.moves else np.zeros((len(own), 2))
    seen = None
    for along, share in zip(*_line_rule_of(motion_px, calibration), strict=True):
        places = own[:, :2] + along * motion_px
        axis = direction_camera(places, calibration)
        seen = None
        if is_before(axis, radius_rad).all():
            seen = seen_of_discs(places, axis, radius_rad, _hides(axis, radius_rad), calibration, edge)
        if seen is None:
            return np.full(len(expected), np.nan), jacobian, None
        fit.image_radius_px = seen.reach_px
        add_seen(share * flux, places, along, seen, sigma_px, fit.window.view, fit.known, expected, jacobian)
    return expected, jacobian, seen


def _line_rule_of(motion_px: Array, calibration: Calibration) -> tuple[Array, Array]:
    """Return at which parts of their motions spheres are looked at, and the weight of each."""
    if not motion_px.any():
        return np.zeros(1), np.ones(1)
    return line_rule(float(np.hypot(*motion_px.T).max()) / smoothing_px(calibration))


def _hides(axis: Array, radius_rad: Array) -> NDArray[np.int64]:
    """Return which sphere may hide a part of which farther one, shape (pairs, 2): where their images meet."""
    apart_rad = np.arccos(np.clip(axis @ axis.T, -1.0, 1.0))
    meet = apart_rad < _MEET * (radius_rad[:, None] + radius_rad)
    order = np.argsort(-radius_rad, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return np.argwhere(meet & (rank[:, None] < rank)).astype(np.int64)
