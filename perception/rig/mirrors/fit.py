"""Planes fitted to the images that they explain: compiled loops of the search for mirrors."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.likelihood.products import invert
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import (
    GATE_CHI2,
    NEAREST_MIRROR_M,
    add_form_into,
    match_all,
    pair_covariance,
    residual,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FIT_STEPS, HOPELESS_CHI2, MOST_MATCHES = 8, 25.0, 4
STEP, SETTLED2 = 1e-4, 1e-4
MOST_STEP = (0.2, 0.2, 1.0, 0.3)


@compiled
def fit_plane(
    flares: Flares, parents: Indices, images: Indices, plane: Array, kind: int, prior: Array, precision: Array
) -> tuple[float, float, Array]:
    """Fit a plane to pairs in place, by Gauss–Newton.

    Parameters
    ----------
    parents, images
        Whom each image shows, shape (pairs,).
    plane
        n, c and the parameter, of a `kind` of reflectance, to start from; the fitted ones afterwards.
    prior, precision
        What is known beforehand: a plane, shape (5,), and the precision of its two angles (left and up), of
        c and of the parameter, shape (4, 4); 0 where nothing is.

    Returns
    -------
    χ², prior included; ln of the density of the residuals of all pairs at 0; the covariance of the unknowns,
    shape (4, 4), which is NaN where the fit fails.
    """
    # Unknowns, and behind them the residual as one more column: [H | r], and [H | r]ᵀ C⁻¹ [H | r].
    slope, of_prior, normal = np.empty((3, 5)), np.eye(4, 5), np.empty((5, 5))
    covariance, turned, information = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4))
    log_peak, settled = 0.0, False
    # How a step of each unknown moves the plane: its angles to the left and upwards, c, the parameter.
    trial, moves = np.empty(5), np.eye(4, 5, 1)
    for step in range(FIT_STEPS):
        across_m = math.hypot(plane[0], plane[1])
        moves[0, 0], moves[0, 1] = 0.0, 1.0
        if across_m > 1e-9:
            moves[0, 0], moves[0, 1] = -plane[1] / across_m, plane[0] / across_m
        moves[1, 0], moves[1, 1] = -plane[2] * moves[0, 1], plane[2] * moves[0, 0]
        moves[1, 2] = plane[0] * moves[0, 1] - plane[1] * moves[0, 0]
        for unknown in range(4):
            of_prior[unknown, 4] = 0.0
            for k in range(5):
                of_prior[unknown, 4] += moves[unknown, k] * (plane[k] - prior[k])
        normal[:] = 0.0
        add_form_into(normal, of_prior, precision)
        log_peak = 0.0
        for pair in range(len(parents)):
            i, j = parents[pair], images[pair]
            x, y, z = flares.place_m[i, 0], flares.place_m[i, 1], flares.place_m[i, 2]
            off = pair_covariance(flares, i, j, plane, kind, turned, covariance)
            for unknown in range(4):
                for k in range(5):
                    trial[k] = plane[k] + STEP * moves[unknown, k]
                moved = residual(flares, j, trial, kind, x, y, z)
                for m in range(3):
                    slope[m, unknown] = (moved[m] - off[m]) / STEP
            slope[0, 4], slope[1, 4], slope[2, 4] = off
            log_peak -= 0.5 * (invert(covariance) + 3.0 * math.log(2.0 * math.pi))
            add_form_into(normal, slope, covariance)
        for k in range(4):
            if not normal[k, k] > 0.0:
                return normal[4, 4], log_peak, np.full((4, 4), np.nan)
        information[:] = normal[:4, :4]
        invert(information)
        # What its own pairs contradict after three steps is not worth polishing.
        if settled or step == FIT_STEPS - 1 or (step > 2 and normal[4, 4] > HOPELESS_CHI2 * len(parents)):
            break
        settled = True
        for k in range(4):
            change = 0.0
            for m in range(4):
                change -= information[k, m] * normal[m, 4]
            settled &= change**2 < SETTLED2 * information[k, k]
            for m in range(5):
                plane[m] += min(max(change, -MOST_STEP[k]), MOST_STEP[k]) * moves[k, m]
        plane[:3] /= math.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
    return normal[4, 4], log_peak, information


@compiled
def fit_matched(
    flares: Flares, robots: Indices, images: Indices, plane: Array, kind: int, prior: Array, precision: Array
) -> tuple[Indices, Indices, float, float, Array]:
    """Fit a plane in place to the pairs that it explains, at first by the coarse gate, until they settle.

    Returns
    -------
    Whom each image shows: parents and images, shape (pairs,), none where fewer than two (one of a known
    plane) make a plane, or the pairs do not settle; χ², ln of density and covariance, as of `fit_plane`.
    """
    none, least = np.empty(0, dtype=np.int64), 1 if precision[0, 0] > 0.0 else 2
    trial = plane.reshape((1, 5))
    shown, many, _ = match_all(flares, robots, images, trial, kind, 0.0)
    for _ in range(MOST_MATCHES):
        if many[0] < least:
            break
        who, whom = shown[0, 0, : many[0]], shown[0, 1, : many[0]]
        chi2, log_peak, covariance = fit_plane(flares, who, whom, plane, kind, prior, precision)
        holds = np.diag(covariance).min() > 0.0
        for j in whom:
            o = flares.origin_m[j]
            holds &= plane[3] - plane[0] * o[0] - plane[1] * o[1] - plane[2] * o[2] > NEAREST_MIRROR_M
        if not holds:
            break
        shown, many, _ = match_all(flares, robots, images, trial, kind, GATE_CHI2)
        same = many[0] == len(who)
        for one in range(many[0]):
            same &= ((who == shown[0, 0, one]) & (whom == shown[0, 1, one])).any()
        if same:
            return who, whom, chi2, log_peak, covariance
    return none, none, 0.0, 0.0, np.full((4, 4), np.nan)
