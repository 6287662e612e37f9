"""A lone source that is not quite round: what several discs in its place are held against.

Globes are blown and moulded: axes that differ by some per cent make an image that two discs, nearly one
behind the other, or a disc and some specks explain far better than one. So they must explain it better than
one disc of any axes and brightness does.
"""

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import SEEN
from perception.model.spread import spread_nodes
from perception.model.window import Camera, lay_out
from perception.robust.goodness import MODEL_ERROR, residual_e
from perception.robust.solve import Solution

Array = NDArray[np.float64]

_MOST_STEPS = 12
_SETTLED = 0.1  # in χ²
_MOST_LOG_STEP = 0.2  # of size and axes
_LEAST_SPREAD_PX2 = 0.05


def gain_over_oval(several: Solution, camera: Camera) -> float:
    """Return by how much flares explain a window better than one oval, as 2 Δ ln L with an imperfect model.

    The oval has any place, brightness, size and axes; what lies around it is taken as the flares leave it.

    Parameters
    ----------
    several
        The flares.
    camera
        The camera.
    """
    window = several.window
    around_e = several.expected_e - several.flares_e
    variance = several.variance_e2(MODEL_ERROR)
    weight = np.where(window.state == SEEN, 1.0 / variance, 0.0).ravel()
    values = _first_guess(several)
    expected, slopes = _image(values, several, camera)
    left = residual_e(window.image_e, window.state, around_e + expected.reshape(around_e.shape))
    chi2 = float(np.sum(left**2 / variance))
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        information = (slopes * weight) @ slopes.T
        gradient = (slopes * weight) @ left.ravel()
        information[np.diag_indices(len(values))] *= 1.0 + damping
        step = np.linalg.lstsq(information, gradient, rcond=None)[0]
        step[:2] = np.clip(step[:2], -1.0, 1.0)
        step[2:6] = np.clip(step[2:6], -_MOST_LOG_STEP, _MOST_LOG_STEP)
        trial = values + step
        expected, trial_slopes = _image(trial, several, camera)
        trial_left = residual_e(window.image_e, window.state, around_e + expected.reshape(around_e.shape))
        trial_chi2 = float(np.sum(trial_left**2 / variance))
        if not trial_chi2 < chi2:
            damping *= 10.0
            continue
        is_settled = chi2 - trial_chi2 < _SETTLED
        values, slopes, left, chi2, damping = trial, trial_slopes, trial_left, trial_chi2, 0.1 * damping
        if is_settled:
            break
    return chi2 - float(np.sum(several.residual_e**2 / variance))


def _first_guess(several: Solution) -> Array:
    """Return u, v, ln flux, ln size, both parts of the axes, background of what has the flares' moments.

    The size is relative to the larger flare's; the image of a disc has a quarter of its radius squared as the
    variance of its light along each axis.
    """
    box, light = several.window.box, np.maximum(several.flares_e, 0.0)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
    flux = float(light.sum())
    u, v = float((light * columns).sum()) / flux, float((light * rows).sum()) / flux
    along_u = float((light * (columns - u) ** 2).sum()) / flux - several.psf_sigma_px**2 - 1.0 / 12.0
    along_v = float((light * (rows - v) ** 2).sum()) / flux - several.psf_sigma_px**2 - 1.0 / 12.0
    across = float((light * (columns - u) * (rows - v)).sum()) / flux
    mean = max(0.5 * (along_u + along_v), _LEAST_SPREAD_PX2)
    log_size = 0.5 * float(np.log(4.0 * mean / several.image_radius_px.max() ** 2))
    stretched = np.clip([0.25 * (along_u - along_v) / mean, 0.5 * across / mean], -0.3, 0.3)
    return np.array([box.left + u, box.top + v, np.log(flux), log_size, *stretched, 0.0])


def _image(values: Array, several: Solution, camera: Camera) -> tuple[Array, Array]:
    """Return the oval's light in each pixel, shape (pixels,), and its derivatives, (unknowns, pixels).

    Each node of a round disc is moved from o to s (1 + A) o, A = [[a, b], [b, -a]].
    """
    box, shape = several.window.box, several.window.image_e.shape
    largest = int(np.argmax(several.image_radius_px))
    laid, _ = lay_out(
        camera, several.u_px[largest : largest + 1], several.v_px[largest : largest + 1],
        several.log_range[largest : largest + 1], in_points=True)  # fmt: skip
    u_px, v_px, log_flux, log_size, a, b, _ = values.tolist()
    size, out_u, out_v = float(np.exp(log_size)), laid.node_u_px, laid.node_v_px
    moved = laid._replace(
        node_u_px=size * (out_u + a * out_u + b * out_v), node_v_px=size * (out_v + b * out_u - a * out_v)
    )
    place, sigma_px = (u_px - box.left, v_px - box.top), several.psf_sigma_px
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
