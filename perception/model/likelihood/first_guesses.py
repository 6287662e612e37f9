"""How likely first guesses of flares are, by images as laid out: of all windows in one call."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import Known, Sources, View
from perception.model.likelihood.pixels import add_plane, is_inside, log_variances, objective
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.image import spread_nodes

Array = NDArray[np.float64]


class Views(NamedTuple):
    """Windows one after another: their corners and sizes, and where the pixels of each begin.

    `corner_and_size` is top, left, rows and columns, shape (windows, 4); `first_pixel` has one more entry
    than there are windows. The rest is of pixels, as for `View`, or of windows.
    """

    corner_and_size: NDArray[np.int64]
    first_pixel: NDArray[np.int64]
    image_e: Array
    state: NDArray[np.uint8]
    known_e: Array
    floor_e2: Array

    @classmethod
    def of(cls, views: Sequence[View]) -> "Views":
        """Return windows, one after another."""
        return cls(
            np.array([(view.top, view.left, *view.image_e.shape) for view in views]),
            np.cumsum([0, *(view.image_e.size for view in views)]),
            np.concatenate([view.image_e.ravel() for view in views]),
            np.concatenate([view.state.ravel() for view in views]),
            np.concatenate([view.known_e.ravel() for view in views]),
            np.array([view.floor_e2 for view in views]),
        )


@compiled
def unlikeliness(
    views: Views, sources: Sources, known: Known, starts: Array, laid_as: NDArray[np.int64],
    background_e: Array, window: NDArray[np.int64], first_source: NDArray[np.int64],
) -> Array:  # fmt: skip
    """Return −2 ln L of first guesses, as `maximise` of the likeliest; infinite where none can be.

    Parameters
    ----------
    views, background_e
        The windows, and the background in each, shape (windows,).
    sources, known
        Images as laid out, and what is known.
    starts, laid_as
        Place u, v and ln range of the sources of all guesses one after another, shape (sources, 3), and whose
        image each has, grown to its size, shape (sources,).
    window, first_source
        Which window each guess is of, shape (guesses,), and where its sources begin, shape (guesses + 1,).
    """
    totals = np.full(len(window), math.inf)
    for guess in range(len(window)):
        at = window[guess]
        top, left, rows, columns = views.corner_and_size[at]
        here = slice(views.first_pixel[at], views.first_pixel[at + 1])
        view = View(
            top, left, views.image_e[here].reshape(rows, columns), views.state[here].reshape(rows, columns),
            views.floor_e2[at], views.known_e[here].reshape(rows, columns),
        )  # fmt: skip
        own = starts[first_source[guess] : first_source[guess + 1]]
        if not is_inside(own.ravel(), view, len(own), 3):
            continue
        expected, variance = views.known_e[here] + background_e[at], np.empty(view.image_e.size)
        image = np.empty((1, rows, whole_lanes(columns)))
        blur = blur_of(known.psf_sigma_px, max(rows, columns))
        for source in range(first_source[guess], first_source[guess + 1]):
            image[:], of = 0.0, laid_as[source]
            place = (starts[source, 0] - left, starts[source, 1] - top)
            growth = math.exp(sources.log_range_at[of] - starts[source, 2])
            swept = (sources.swept_u_px[of], sources.swept_v_px[of])
            spread_nodes(sources, of, place, growth, swept, blur, columns, image)
            flux = math.exp(sources.log_flux_at_1_m[of] - 2.0 * starts[source, 2])
            add_plane(flux, image[0], columns, expected)
        for pixel in range(len(expected)):
            lit_e = max(expected[pixel], 0.0)
            variance[pixel] = lit_e + (known.prnu * lit_e) ** 2 + view.floor_e2
        nothing, no_prior = np.empty(0), np.empty((0, 0))
        totals[guess] = objective(view, nothing, expected, variance, no_prior, known.clip_e)
        totals[guess] += log_variances(view, variance)
    return totals
