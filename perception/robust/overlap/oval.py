"""A lone source that is not quite round: what several discs in its place are held against.

Globes are blown and moulded: axes that differ by some per cent make an image that two discs, nearly one
behind the other, or a disc and some specks explain far better than one. So they must explain it better than
one disc of any axes and brightness does.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import CLIPPED, SEEN, Sources
from perception.model.spread import spread_nodes
from perception.model.window import Camera, lay_out
from perception.robust.goodness import MODEL_ERROR, is_likely, residual_e
from perception.robust.overlap.deblend import LEAST_GAIN
from perception.robust.overlap.pairs import LEAST_RADIUS_PX
from perception.robust.solve import Solution

Array = NDArray[np.float64]
Fitted = tuple[float, Array, Array, Array, Array]

_MOST_STEPS = 40
_SETTLED = 0.1  # in χ²
_MOST_LOG_STEP = 0.2  # of size and axes
_MOST_AXES = 0.6  # each part of them: nine times as long as wide
_LEAST_SPREAD_PX2 = 0.05


@dataclass(frozen=True)
class Oval:
    """What explains a window as one disc of any place, brightness, size and axes.

    Attributes
    ----------
    is_good
        Whether chance alone may leave so much where it shines.
    chi2_more
        By how much it is worse than the flares that it is held against, as 2 Δ ln L with an imperfect model.
    brightness
        How many times as bright as a source it is, each part of it.
    aspect
        How many times as long as wide it is, what the lens stretches taken off.
    """

    is_good: bool
    chi2_more: float
    brightness: float
    aspect: float


def fit_oval(flares: Solution, camera: Camera) -> Oval:
    """Explain a window by one oval in place of flares; what lies around it is taken as these leave it.

    Parameters
    ----------
    flares
        The flares, one or several.
    camera
        The camera.
    """
    window = flares.window
    around_e = flares.expected_e - flares.flares_e
    variance = flares.variance_e2(MODEL_ERROR)
    laid = _largest(flares, camera)
    guesses = [_first_guess(flares, np.maximum(flares.flares_e, 0.0))]
    clips = window.state == CLIPPED
    if clips.any():  # a flare that is too round explains what clips as far as it has to
        guesses.append(_first_guess(flares, clips.astype(np.float64)))

    def fitted(values: Array) -> Fitted:
        """Return χ², what is left, the weight of each pixel, the oval's light, and its slopes."""
        expected, slopes = _image(values, laid, flares)
        left = residual_e(window.image_e, window.state, around_e + expected.reshape(around_e.shape))
        # A pixel clips where it is expected to; one that should not pulls.
        counts = (window.state == SEEN) | ((window.state == CLIPPED) & (left != 0.0))
        return (
            float(np.sum(left**2 / variance)),
            left.ravel(),
            np.where(counts, 1.0 / variance, 0.0).ravel(),
            expected,
            slopes,
        )

    found = [_climbed(guess, fitted) for guess in guesses]
    values, (chi2, left, weight, expected, _) = min(found, key=lambda each: each[1][0])
    _, _, log_flux, log_size, a, b, _ = values.tolist()
    axes = math.hypot(a, b)
    shines = (weight > 0.0) & (expected**2 > variance.ravel())
    log_source = float(laid.log_flux_at_1_m[0]) - 2.0 * float(laid.log_range_at[0])
    return Oval(
        is_good=is_likely(int(shines.sum()), float(np.sum(weight[shines] * left[shines] ** 2))),
        chi2_more=chi2 - float(np.sum(flares.residual_e**2 / variance)),
        brightness=math.exp(log_flux - 2.0 * log_size - log_source) / (1.0 - axes**2),
        aspect=(1.0 + axes) / (1.0 - axes),
    )


def is_oval(one: Solution, several: Solution, camera: Camera) -> bool:
    """Tell whether a lone resolved source whose axes differ explains as well what takes several flares."""
    if (
        one.count > 1
        or one.motion_px is not None
        or not float(several.image_radius_px.max()) > LEAST_RADIUS_PX
    ):
        return False
    return fit_oval(several, camera).chi2_more < LEAST_GAIN


def _climbed(values: Array, fitted: Callable[[Array], Fitted]) -> tuple[Array, Fitted]:
    """Return the values to which steps of least squares lead, damped, and what they come to."""
    chi2, left, weight, expected, slopes = fitted(values)
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        information = (slopes * weight) @ slopes.T
        information[np.diag_indices(len(values))] *= 1.0 + damping
        step = np.linalg.lstsq(information, (slopes * weight) @ left, rcond=None)[0]
        step[:2] = np.clip(step[:2], -1.0, 1.0)
        step[2:6] = np.clip(step[2:6], -_MOST_LOG_STEP, _MOST_LOG_STEP)
        trial = values + step
        trial[4:6] = np.clip(trial[4:6], -_MOST_AXES, _MOST_AXES)
        there = fitted(trial)
        if not there[0] < chi2:
            damping *= 10.0
            continue
        is_settled = chi2 - there[0] < _SETTLED
        values, damping = trial, 0.1 * damping
        chi2, left, weight, expected, slopes = there
        if is_settled:
            break
    return values, (chi2, left, weight, expected, slopes)


def _largest(flares: Solution, camera: Camera) -> Sources:
    """Return the image of the flare that looks largest, in points."""
    one = slice(largest := int(np.argmax(flares.radius_at_rest_px)), largest + 1)
    return lay_out(camera, flares.u_px[one], flares.v_px[one], flares.log_range[one], in_points=True)[0]


def _first_guess(flares: Solution, light: Array) -> Array:
    """Return u, v, ln flux, ln size, both parts of the axes, background of what has an image's moments.

    The size is relative to the larger flare's; the image of a disc has a quarter of its radius squared as the
    variance of its light along each axis.
    """
    box = flares.window.box
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
    flux = float(light.sum())
    u, v = float((light * columns).sum()) / flux, float((light * rows).sum()) / flux
    along_u = float((light * (columns - u) ** 2).sum()) / flux - flares.psf_sigma_px**2 - 1.0 / 12.0
    along_v = float((light * (rows - v) ** 2).sum()) / flux - flares.psf_sigma_px**2 - 1.0 / 12.0
    across = float((light * (columns - u) * (rows - v)).sum()) / flux
    mean = max(0.5 * (along_u + along_v), _LEAST_SPREAD_PX2)
    log_size = 0.5 * float(np.log(4.0 * mean / flares.radius_at_rest_px.max() ** 2))
    stretched = np.clip([0.25 * (along_u - along_v) / mean, 0.5 * across / mean], -0.3, 0.3)
    log_flux = math.log(max(float(flares.flares_e.sum()), 1e-300))
    return np.array([box.left + u, box.top + v, log_flux, log_size, *stretched, 0.0])


def _image(values: Array, laid: Sources, flares: Solution) -> tuple[Array, Array]:
    """Return the oval's light in each pixel, shape (pixels,), and its derivatives, (unknowns, pixels).

    Each node of a round disc is moved from o to s (1 + A) o, A = [[a, b], [b, -a]].
    """
    box, shape = flares.window.box, flares.window.image_e.shape
    u_px, v_px, log_flux, log_size, a, b, _ = values.tolist()
    size, out_u, out_v = float(np.exp(log_size)), laid.node_u_px, laid.node_v_px
    moved = laid._replace(
        node_u_px=size * (out_u + a * out_u + b * out_v), node_v_px=size * (out_v + b * out_u - a * out_v)
    )
    place, sigma_px = (u_px - box.left, v_px - box.top), flares.psf_sigma_px
    by_out_u, by_out_v = np.zeros((7, *shape)), np.zeros((7, *shape))
    spread_nodes(moved._replace(node_along=size * out_u), 0, place, 1.0, (0.0, 0.0), sigma_px, by_out_u)
    spread_nodes(moved._replace(node_along=size * out_v), 0, place, 1.0, (0.0, 0.0), sigma_px, by_out_v)
    flux = float(np.exp(log_flux))
    slopes = np.stack(
        [
            flux * by_out_u[1],
            flux * by_out_u[2],
            flux * by_out_u[0],
            flux * by_out_u[3],
            flux * (by_out_u[5] - by_out_v[6]),
            flux * (by_out_v[5] + by_out_u[6]),
            np.ones(shape),
        ]
    )
    expected = flux * by_out_u[0] + values[-1]
    return expected.ravel(), slopes.reshape(len(values), -1)
