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

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, Sources
from perception.model.likelihood.maximum import JUDGED_AFTER, MORE_TO_GAIN, TIMES_TO_GAIN
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.image import LEAST_STRIP
from perception.model.spread.shares import shares, strip_shares
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
_MOST_LOG_AXES, _MOST_LEAN = 1.1, 2.0  # nine times as long as wide
_LEAST_SPREAD_PX2 = 0.05
_FINER = 2.5


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


def fit_oval(flares: Solution, camera: Camera, enough: float = math.inf) -> Oval:
    """Explain a window by one oval in place of flares; what lies around it is taken as these leave it.

    Parameters
    ----------
    flares
        The flares, one or several.
    camera
        The camera.
    enough
        Of an oval that is sure to be worse than them by more, `chi2_more` is just more than that.
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

    of_flares = float(np.sum(flares.residual_e**2 / variance))
    found = [_climbed(guess, fitted, of_flares + enough) for guess in guesses]
    values, (chi2, left, weight, expected, _) = min(found, key=lambda each: each[1][0])
    _, _, log_flux, log_size, d, b, _ = values.tolist()
    # Of a matrix of determinant 1 the greatest eigenvalue of its square.
    half_trace = 0.5 * (2.0 * math.cosh(2.0 * d) + b * b)
    shines = (weight > 0.0) & (expected**2 > variance.ravel())
    log_source = float(laid.log_flux_at_1_m[0]) - 2.0 * float(laid.log_range_at[0])
    return Oval(
        is_good=is_likely(int(shines.sum()), float(np.sum(weight[shines] * left[shines] ** 2))),
        chi2_more=chi2 - of_flares,
        brightness=math.exp(log_flux - 2.0 * log_size - log_source),
        aspect=half_trace + math.sqrt(half_trace**2 - 1.0),
    )


def is_oval(one: Solution, several: Solution, camera: Camera) -> bool:
    """Tell whether a lone resolved source whose axes differ explains as well what takes several flares."""
    if (
        one.count > 1
        or one.motion_px is not None
        or not float(several.image_radius_px.max()) > LEAST_RADIUS_PX
    ):
        return False
    return fit_oval(several, camera, LEAST_GAIN).chi2_more < LEAST_GAIN


def _climbed(values: Array, fitted: Callable[[Array], Fitted], hopeless: float) -> tuple[Array, Fitted]:
    """Return the values to which steps of least squares lead, damped, and what they come to.

    Where what is ahead, to first order, leaves χ² far above `hopeless` they are given up.
    """
    chi2, left, weight, expected, slopes = fitted(values)
    damping, taken = 1e-3, 0
    for _ in range(_MOST_STEPS):
        information, pull = (slopes * weight) @ slopes.T, (slopes * weight) @ left
        if taken >= JUDGED_AFTER and chi2 > hopeless:
            to_gain = float(pull @ np.linalg.lstsq(information, pull, rcond=None)[0])
            if chi2 - MORE_TO_GAIN - TIMES_TO_GAIN * to_gain > hopeless:
                break
        information[np.diag_indices(len(values))] *= 1.0 + damping
        step = np.linalg.lstsq(information, pull, rcond=None)[0]
        step[:2] = np.clip(step[:2], -1.0, 1.0)
        step[2:6] = np.clip(step[2:6], -_MOST_LOG_STEP, _MOST_LOG_STEP)
        trial = values + step
        trial[4:6] = np.clip(trial[4:6], (-_MOST_LOG_AXES, -_MOST_LEAN), (_MOST_LOG_AXES, _MOST_LEAN))
        there = fitted(trial)
        if not there[0] < chi2:
            damping *= 10.0
            continue
        is_settled = chi2 - there[0] < _SETTLED
        values, damping, taken = trial, 0.1 * damping, taken + 1
        chi2, left, weight, expected, slopes = there
        if is_settled:
            break
    return values, (chi2, left, weight, expected, slopes)


def _largest(flares: Solution, camera: Camera) -> Sources:
    """Return the image of the flare that looks largest, in rows so near together that it may be stretched."""
    one = slice(largest := int(np.argmax(flares.radius_at_rest_px)), largest + 1)
    finer = np.full(1, _FINER)
    return lay_out(camera, flares.u_px[one], flares.v_px[one], flares.log_range[one], finer=finer)[0]


def _first_guess(flares: Solution, light: Array) -> Array:
    """Return u, v, ln flux, ln size, both parts of the axes, background of what has an image's moments.

    The size is relative to the larger flare's; the image of a disc has a quarter of its radius squared as the
    variance of its light along each axis. The matrix that makes it of a round one (`_image`) is, by
    Cholesky's method from below, the root of that.
    """
    box = flares.window.box
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
    flux = float(light.sum())
    u, v = float((light * columns).sum()) / flux, float((light * rows).sum()) / flux
    blurred_px2 = flares.psf_sigma_px**2 + 1.0 / 12.0
    along_u = max(float((light * (columns - u) ** 2).sum()) / flux - blurred_px2, _LEAST_SPREAD_PX2)
    along_v = max(float((light * (rows - v) ** 2).sum()) / flux - blurred_px2, _LEAST_SPREAD_PX2)
    across = float((light * (columns - u) * (rows - v)).sum()) / flux
    left = max(along_u - across**2 / along_v, _LEAST_SPREAD_PX2)
    size2 = math.sqrt(left * along_v)
    log_size = 0.5 * math.log(4.0 * size2 / float(flares.radius_at_rest_px.max()) ** 2)
    log_axes, lean = 0.25 * math.log(left / along_v), across / math.sqrt(along_v * size2)
    log_flux = math.log(max(float(flares.flares_e.sum()), 1e-300))
    return np.array(
        [
            box.left + u,
            box.top + v,
            log_flux,
            log_size,
            np.clip(log_axes, -0.3, 0.3),
            np.clip(lean, -0.6, 0.6),
            0.0,
        ]
    )


def _image(values: Array, laid: Sources, flares: Solution) -> tuple[Array, Array]:
    """Return the oval's light in each pixel, shape (pixels,), and its derivatives, (unknowns, pixels).

    Each place o of a round disc is moved to s [[eᵈ, b], [0, e⁻ᵈ]] o: any oval is made so, and of a row a row.
    """
    box = flares.window.box
    u_px, v_px, log_flux, log_size, d, b, _ = values.tolist()
    size = float(np.exp(log_size))
    image = np.zeros((6, *flares.window.image_e.shape))
    place = (u_px - box.left, v_px - box.top)
    _spread(laid, place, (size * math.exp(d), size * b, size * math.exp(-d)), flares.psf_sigma_px, image)
    image *= float(np.exp(log_flux))
    light, by_u, by_v, by_wider, by_lean, by_taller = image.reshape(6, -1)
    by_lean *= size
    slopes = np.stack(
        [
            by_u,
            by_v,
            light,
            by_wider + b * by_lean + by_taller,
            by_wider - by_taller,
            by_lean,
            np.ones_like(light),
        ]
    )
    return light + values[-1], slopes


@compiled
def _spread(
    laid: Sources,
    place: tuple[float, float],
    matrix: tuple[float, float, float],
    sigma_px: float,
    image: Array,
) -> None:
    """Spread an image over pixels, moved by a matrix [[wider, lean], [0, taller]], about its place.

    Into zeros of shape (6, rows, columns): its light, and the derivatives by u, v, ln wider, lean, ln taller.
    """
    _, rows, columns = image.shape
    across, down = np.empty((4, whole_lanes(columns))), np.empty((3, whole_lanes(rows)))
    blur = blur_of(sigma_px, max(rows, columns))
    wider, lean, taller = matrix
    for node in range(len(laid.weight)):
        out_v, off_px = laid.node_v_px[node], wider * laid.node_u_px[node]
        if not (math.isfinite(out_v) and math.isfinite(off_px)):
            continue
        at_px, half_px = place[0] + off_px + lean * out_v, wider * laid.half_px[node]
        if half_px > LEAST_STRIP * sigma_px:
            shading = (laid.tilt[node], laid.bend[node])
            left, right = strip_shares(at_px, half_px, shading, off_px, columns, blur, across)
        else:
            left, right = shares(at_px, columns, blur, across)
            for column in range(left, right):
                across[3, column] = off_px * across[1, column]
        top, bottom = shares(place[1] + taller * out_v, rows, blur, down)
        for row in range(top, bottom):
            in_v, by_v = laid.weight[node] * down[0, row], laid.weight[node] * down[1, row]
            for column in range(left, right):
                by_u_here, by_v_here = in_v * across[1, column], by_v * across[0, column]
                image[0, row, column] += in_v * across[0, column]
                image[1, row, column] += by_u_here
                image[2, row, column] += by_v_here
                image[3, row, column] += in_v * across[3, column]
                image[4, row, column] += out_v * by_u_here
                image[5, row, column] += taller * out_v * by_v_here
