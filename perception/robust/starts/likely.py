"""Which first guesses are worth following: those likelier than what lies beside them."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.flare import is_before
from perception.model.lens import stretch
from perception.model.likelihood.first_guesses import Views, unlikeliness
from perception.model.ranging import angular_radius_rad
from perception.model.window import Camera, lay_out
from perception.robust.problem import Problem

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_OF_STARTS = 0.5  # so fine are images that are only to tell which first guess is likelier
_LEANING_PX = 0.5  # radius times its angle


def start_costs(problems: Sequence[Sequence[Problem]], camera: Camera) -> list[list[float]]:
    """Return −2 ln L of each window's first guesses, all at rest, but for a constant of the window.

    By coarse images: they tell apart guesses whose fluxes differ several times. The windows are of one frame,
    in which all pixels clip at the same number of electrons.
    """
    if not problems:
        return []
    windows = [of_one[0].window for of_one in problems]
    background_e = np.array([of_one[0].background_e for of_one in problems])
    guesses = [each.starts for of_one in problems for each in of_one]
    window = np.repeat(np.arange(len(problems)), [len(of_one) for of_one in problems])
    flares = [len(starts) for starts in guesses]
    first_source = np.cumsum([0, *flares])
    all_starts = np.array([start for starts in guesses for start in starts])
    source_window = np.repeat(window, flares)
    images, laid_as, imaged = _largest_images(source_window, all_starts, camera)
    u_px, v_px, log_range = np.ascontiguousarray(all_starts[images].T)
    hidden_e = camera.hidden_px_at_1_m(all_starts[images, :2])
    if hidden_e is not None:
        hidden_e *= np.maximum(background_e, 0.0)[source_window[images]]
    laid, _ = lay_out(camera, u_px, v_px, log_range, hidden_e, None, np.full(len(u_px), _OF_STARTS))
    costs = unlikeliness(
        Views.of([each.view for each in windows]), laid, camera.known(windows[0].clip_e), all_starts,
        laid_as, background_e, window, first_source,
    )  # fmt: skip
    costs[~np.logical_and.reduceat(imaged, first_source[:-1])] = math.inf
    ends = np.cumsum([len(of_one) for of_one in problems]).tolist()
    return [costs[first:end].tolist() for first, end in zip([0, *ends], ends, strict=False)]


def _largest_images(
    window: Indices, starts: Array, camera: Camera
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Return the largest guesses at each place, but with an image; whose image each has; which have one."""
    radius_rad = angular_radius_rad(np.exp(starts[:, 2]), camera.radius_m)
    direction = direction_camera(starts[:, :2], camera.calibration)
    imaged = is_before(direction, radius_rad)
    # Images off the axis lean by their radius squared: larger ones are no images of smaller discs.
    leaning_px = stretch(direction, camera.calibration) * np.tan(radius_rad) * radius_rad
    own = np.where(imaged & (leaning_px > _LEANING_PX), np.arange(len(starts)), -1)
    order = np.lexsort((starts[:, 2], ~imaged, own, starts[:, 1], starts[:, 0], window))
    places = np.column_stack([window, starts[:, :2], own])[order]
    is_first = np.concatenate([[True], (places[1:] != places[:-1]).any(axis=1)])
    of = np.empty(len(order), dtype=np.int64)
    of[order] = np.cumsum(is_first) - 1
    return order[is_first], of, imaged


def likely_starts(problems: Sequence[Sequence[Problem]], camera: Camera) -> list[tuple[int, Problem]]:
    """Return by index of the cluster which problems to follow: those likelier than what lies beside them.

    From one that is not the climb would lead to where a likelier one leads.
    """
    costs = iter(start_costs([of_one for of_one in problems if len(of_one) > 1], camera))
    chosen = []
    for index, of_one in enumerate(problems):
        if len(of_one) == 1:
            chosen.append((index, of_one[0]))
            continue
        cost = [math.inf, *next(costs), math.inf]
        chosen += [
            (index, each) for at, each in enumerate(of_one, 1) if cost[at] <= min(cost[at - 1], cost[at + 1])
        ]
    return chosen
