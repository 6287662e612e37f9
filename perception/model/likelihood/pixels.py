"""What the pixels of a window expect of its sources, and how likely is what they show.

Each pixel counts as x + σ² ~ Poisson(λ + σ²), σ² the variance of a dark pixel (Snyder et al., J. Opt. Soc.
Am. A 12, 272, 1995), widened by the spread of the pixels' responses; its score is (x - λ) / variance. A
clipped pixel says only that x is c or more: its score is φ(z) / (σ Q(z)), z = (c - λ) / σ. Variances come
from the model, not from the data: weights from the data would favour pixels that came out low. All that is
here is compiled, one window at a time; `model.window` says what the unknowns are.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, UNUSABLE, Known, Sources, Structure, View
from perception.model.likelihood.cosines import add_wave_information, add_waves, cosine_sums
from perception.model.likelihood.products import add_information, dot
from perception.model.normal import SURE_SIGMAS, kept_of_clipping, log_upper_tail, of_clipped
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.image import spread_nodes

Array = NDArray[np.float64]

LOG_RANGE_BOUND, MOTION_BOUND_PX = 12.0, 30.0


@compiled
def expectation(
    values: Array, view: View, sources: Sources, structure: Structure, known: Known, expected: Array,
    jacobian: Array, variance: Array,
) -> None:  # fmt: skip
    """Compute λ, its derivatives, and the variance of pixels.

    Parameters
    ----------
    values
        Unknowns, in the order of `layout.Layout`.
    view, sources, structure, known
        The window, of which all but what it shows counts, and what is in it.
    expected, jacobian, variance
        Shape (pixels,), (unknowns, pixels) and (pixels,): written; the last as `sensor.pixel_variance_e2`.
        Of the structure's waves, the first amplitudes after the background, `jacobian` has no rows.
    """
    count, has_slack, moves = len(sources.log_range_at), known.tie_spread > 0.0, known.motion_px > 0.0
    step = 3 + has_slack + 2 * moves
    width = count * step
    background = width + (1 if known.width_spread > 0.0 else 0)
    sigma_px = known.psf_sigma_px
    if known.width_spread > 0.0:
        sigma_px *= math.exp(known.width_spread * values[width])
        jacobian[width] = 0.0
    expected[:], jacobian[background] = values[background], 1.0
    expected += view.known_e.ravel()
    waves = len(structure.order)
    if waves:
        amplitudes = values[background + 1 : background + 1 + waves]
        add_waves(structure.cosines, structure.order, amplitudes, expected.reshape(view.image_e.shape))
    for other in range(len(structure.columns)):
        expected += values[background + 1 + waves + other] * structure.columns[other]
        jacobian[background + 1 + other] = structure.columns[other]
    rows, columns = view.image_e.shape
    planes = 7 if moves else 4 + (known.width_spread > 0.0)
    image, blur = np.empty((planes, rows, whole_lanes(columns))), blur_of(sigma_px, max(rows, columns))
    for source in range(count):
        at = source * step
        by_size = values[at + 2]
        if has_slack:
            by_size -= known.tie_spread * values[at + 3]
        motion = (sources.swept_u_px[source], sources.swept_v_px[source])
        if moves:
            motion = (motion[0] + values[at + step - 2], motion[1] + values[at + step - 1])
        image[:] = 0.0
        place = (values[at] - view.left, values[at + 1] - view.top)
        growth = math.exp(sources.log_range_at[source] - by_size)
        spread_nodes(sources, source, place, growth, motion, blur, columns, image)
        flux = math.exp(sources.log_flux_at_1_m[source] - 2.0 * values[at + 2])
        add_plane(flux, image[0], columns, expected)
        _set_by_place_and_range(flux, image, columns, jacobian[at : at + 3])
        if has_slack:
            jacobian[at + 3] = 0.0
            add_plane(known.tie_spread * flux, image[3], columns, jacobian[at + 3])
        if moves:
            for plane in (5, 6):
                jacobian[at + step + plane - 7] = 0.0
                add_plane(flux, image[plane], columns, jacobian[at + step + plane - 7])
        if known.width_spread > 0.0:
            add_plane(known.width_spread * flux, image[4], columns, jacobian[width])
    _set_variance(view, known, expected, variance)


@compiled
def _set_variance(view: View, known: Known, expected: Array, variance: Array) -> None:
    for pixel in range(len(expected)):
        lit_e = max(expected[pixel], 0.0)
        variance[pixel] = lit_e + (known.prnu * lit_e) ** 2 + view.floor_e2


@compiled
def take_last_step(
    view: View, structure: Structure, known: Known, first_wave: int, shift: Array, values: Array,
    jacobian: Array, expected: Array, variance: Array,
) -> None:  # fmt: skip
    """Take a step that is so short that what is expected follows from the derivatives."""
    waves = len(structure.order)
    values += shift
    for row in range(len(jacobian)):
        factor = shift[row if row < first_wave else row + waves]
        for pixel in range(len(expected)):
            expected[pixel] += factor * jacobian[row, pixel]
    if waves:
        amplitudes = shift[first_wave : first_wave + waves]
        add_waves(structure.cosines, structure.order, amplitudes, expected.reshape(view.image_e.shape))
    _set_variance(view, known, expected, variance)


@compiled
def add_plane(factor: float, plane: Array, columns: int, into: Array) -> None:
    """Add so many times what is in a plane's columns, of which it has more, to pixels row after row."""
    rows, width = plane.shape
    flat = plane.reshape(-1)
    for row in range(rows):
        at, pixel = np.uint64(row * width), np.uint64(row * columns)
        for column in range(np.uint64(columns)):
            into[pixel + column] += factor * flat[at + column]


@compiled
def _set_by_place_and_range(flux: float, image: Array, columns: int, into: Array) -> None:
    """Set the derivatives of a source's light by u, v and ln range, shape (3, pixels), from its planes."""
    _, rows, width = image.shape
    light, of_u, of_v, larger = image[0].ravel(), image[1].ravel(), image[2].ravel(), image[3].ravel()
    by_u, by_v, by_range = into[0], into[1], into[2]
    for row in range(rows):
        at, pixel = np.uint64(row * width), np.uint64(row * columns)
        for column in range(np.uint64(columns)):
            by_u[pixel + column] = flux * of_u[at + column]
        for column in range(np.uint64(columns)):
            by_v[pixel + column] = flux * of_v[at + column]
        for column in range(np.uint64(columns)):
            by_range[pixel + column] = -flux * (2.0 * light[at + column] + larger[at + column])


@compiled
def slopes(
    view: View, structure: Structure, first_wave: int, values: Array, expected: Array, jacobian: Array,
    variance: Array, precision: Array, clip_e: float, of_average: bool, gradient: Array, information: Array,
) -> None:  # fmt: skip
    """Write the gradient of ln L and the information, priors included.

    The information is what these very pixels give, or, `of_average`, what such pixels give on average; the
    gradient counts what clips in the first case alone.
    `first_wave` is the index of the first amplitude of a wave of the structure, which `jacobian` leaves out.
    """
    image, state, waves = view.image_e.ravel(), view.state.ravel(), len(structure.order)
    pull, weight = np.empty(len(expected)), np.empty(len(expected))
    for pixel in range(len(expected)):
        weight[pixel] = 1.0 / variance[pixel] if state[pixel] != UNUSABLE else 0.0
    for pixel in range(len(expected)):
        pull[pixel] = (image[pixel] - expected[pixel]) * weight[pixel] if state[pixel] == SEEN else 0.0
    if of_average and math.isfinite(clip_e):
        for pixel in range(len(expected)):
            short_e = clip_e - expected[pixel]
            if short_e * short_e <= SURE_SIGMAS**2 * variance[pixel]:
                weight[pixel] *= kept_of_clipping(short_e / math.sqrt(variance[pixel]))
            elif short_e < 0.0:
                weight[pixel] = 0.0
    elif math.isfinite(clip_e):
        for pixel in range(len(expected)):
            if state[pixel] == CLIPPED:
                sigma = math.sqrt(variance[pixel])
                mills, curvature = of_clipped((clip_e - expected[pixel]) / sigma)
                pull[pixel] = mills / sigma
                weight[pixel] *= curvature
    information[:] = precision
    if waves:
        of_rows = np.zeros((len(jacobian), len(jacobian)))
        add_information(jacobian, weight, of_rows)
        for row in range(len(jacobian)):
            one = row if row < first_wave else row + waves
            information[one, :first_wave] += of_rows[row, :first_wave]
            information[one, first_wave + waves :] += of_rows[row, first_wave:]
        add_wave_information(structure.cosines, structure.order, jacobian, weight, first_wave, information)
        by_wave = cosine_sums(pull.reshape(view.image_e.shape), structure.cosines, structure.order.max() + 1)
        for wave in range(waves):
            gradient[first_wave + wave] = by_wave[structure.order[wave, 0], structure.order[wave, 1]]
    else:
        add_information(jacobian, weight, information)
    for row in range(len(jacobian)):
        gradient[row if row < first_wave else row + waves] = dot(jacobian[row], pull)
    for one in range(len(values)):
        for other in range(len(values)):
            gradient[one] -= precision[one, other] * values[other]


@compiled
def objective(
    view: View, values: Array, expected: Array, variance: Array, precision: Array, clip_e: float
) -> float:
    """Return −2 ln L of an expectation with given variances, priors included, without Σ ln variance."""
    image, state = view.image_e.ravel(), view.state.ravel()
    total = 0.0
    for pixel in range(len(expected)):
        if state[pixel] == SEEN:
            total += (image[pixel] - expected[pixel]) ** 2 / variance[pixel]
        elif state[pixel] == CLIPPED:
            short_e = clip_e - expected[pixel]
            if short_e < 0.0 and short_e * short_e > SURE_SIGMAS**2 * variance[pixel]:
                continue  # ln 1
            z = short_e / math.sqrt(variance[pixel])
            total -= 2.0 * log_upper_tail(min(z, 1e4))
    for one in range(len(values)):
        for other in range(len(values)):
            total += values[one] * precision[one, other] * values[other]
    return total


@compiled
def log_variances(view: View, variance: Array) -> float:
    """Return Σ ln variance of the pixels that are seen."""
    state, total, product = view.state.ravel(), 0.0, 1.0
    for pixel in range(len(variance)):
        if state[pixel] == SEEN:
            product *= variance[pixel]
            # As few logarithms as numbers of such a size allow.
            if not 1e-150 < product < 1e150:
                total, product = total + math.log(product), 1.0
    return total + math.log(product)


@compiled
def is_inside(values: Array, view: View, count: int, step: int) -> bool:
    """Tell whether all sources are on the window's pixels, at ranges and motions that can be."""
    rows, columns = view.image_e.shape
    for at in range(0, count * step, step):
        column, row = values[at] - view.left, values[at + 1] - view.top
        on_pixels = -0.5 < column < columns - 0.5 and -0.5 < row < rows - 0.5
        near = step < 5 or math.hypot(values[at + step - 2], values[at + step - 1]) < MOTION_BOUND_PX
        if not (on_pixels and near and abs(values[at + 2]) < LOG_RANGE_BOUND):
            return False
    return bool(np.isfinite(values).all())
