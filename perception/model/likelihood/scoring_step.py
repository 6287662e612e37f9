"""What a window tells of unknowns that its fit took as known: a step from there to where they are free."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import Known, Sources, Structure, View
from perception.model.likelihood.pixels import expectation, slopes
from perception.model.likelihood.products import dot, inverted

Array = NDArray[np.float64]


@compiled
def scoring_step(
    view: View, sources: Sources, structure: Structure, known: Known, precision: Array, values: Array
) -> tuple[Array, Array]:  # fmt: skip
    """Return one step of Fisher scoring, of all unknowns at once, and their covariance.

    Exact for what is small beside the images.

    Parameters
    ----------
    view, sources, structure, known
        The window, and what is in it; the spread of the width, if above 0, is the unit of that unknown.
    precision, values
        Prior of the unknowns, 0 of what is to be free; and where to step from, near the fit
        (`layout.Layout`).

    Returns
    -------
    Shape (unknowns,) and (unknowns, unknowns); NaN where the window does not tell.
    """
    size, pixels, count = len(values), view.image_e.size, len(sources.log_range_at)
    per_source = 3 + (known.tie_spread > 0.0) + 2 * (known.motion_px > 0.0)
    first_wave = count * per_source + (known.width_spread > 0.0) + 1
    gradient, information, covariance = np.empty(size), np.empty((size, size)), np.empty((size, size))
    expected, variance = np.empty(pixels), np.empty(pixels)
    jacobian = np.empty((size - len(structure.order), pixels))
    expectation(values, view, sources, structure, known, expected, jacobian, variance)
    slopes(
        view, structure, first_wave, values, expected, jacobian, variance, precision, known.clip_e, False,
        gradient, information,
    )  # fmt: skip
    step = np.full(size, math.nan)
    if math.isnan(inverted(information, covariance)):
        covariance[:] = math.nan
        return step, covariance
    for one in range(size):
        step[one] = dot(covariance[one], gradient)
    return step, covariance
