"""How wide the point spread is by a lone flare fitted through one of known width: a step from there."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import Known, Sources, Structure, View
from perception.model.likelihood.pixels import expectation, slopes
from perception.model.likelihood.products import dot, inverted

Array = NDArray[np.float64]


@compiled
def width_step(
    view: View, source: Sources, structure: Structure, known: Known, precision: Array, values: Array
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return by how much the width of the point spread is off, by one flare alone in its window.

    One step of Fisher scoring, of all unknowns at once: exact for what is small beside the width.

    Parameters
    ----------
    view, source, structure, known
        The window, and what is in it; the spread of the width, above 0, is the unit of that unknown.
    precision, values
        Prior of the unknowns, 0 of the width; and where to step from, near the fit (`layout.Layout`).

    Returns
    -------
    The change of ln width, its standard deviation, and by how much ln range by flux, and the slack if there
    is one, change with ln width where the width is taken as known. NaN where the window does not tell.
    """
    size, pixels, unit = len(values), view.image_e.size, known.width_spread
    width = 3 + (known.tie_spread > 0.0)
    gradient, information, covariance = np.empty(size), np.empty((size, size)), np.empty((size, size))
    expected, variance = np.empty(pixels), np.empty(pixels)
    jacobian = np.empty((size - len(structure.order), pixels))
    expectation(values, view, source, structure, known, expected, jacobian, variance)
    slopes(
        view, structure, width + 2, values, expected, jacobian, variance, precision, known.clip_e, False,
        gradient, information,
    )  # fmt: skip
    if math.isnan(inverted(information, covariance)):
        return math.nan, math.nan, math.nan, math.nan
    step, own = dot(covariance[width], gradient), covariance[width, width]
    of_slack = covariance[3, width] / (unit * own) if known.tie_spread > 0.0 else 0.0
    return unit * step, unit * math.sqrt(own), covariance[2, width] / (unit * own), of_slack
