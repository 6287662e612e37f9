"""What lies on the background beside flares, one by one, fitted with them in turns.

Each is of some shape (`edge`, `highlight`): how high it is is linear, where it lies and how wide it is are
not. So it is moved to where it explains best what flares leave, then the flares are fitted beside it, in
which it may still be off to first order, and so on.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import SEEN, Structure, any_of
from perception.model.ranging import covered_px_at_1_m
from perception.model.window import Camera
from perception.robust.goodness import MODEL_ERROR, noise_e2
from perception.robust.overlap.deblend import gain
from perception.robust.problem import Window
from perception.robust.solve import Solution, solve

Array = NDArray[np.float64]

_ROUNDS, _CLIMBS = 3, 16
_LEAST_HEIGHT_E = 0.1
_SETTLED, _SETTLED_IN_TURNS = 0.01, 0.1  # of χ²
_SETTLED_SHARE = 0.002  # of what χ² is beyond noise: where much is left that no feature explains


@dataclass(frozen=True)
class Feature(ABC):
    """Something of the background in a window; x and y are pixels from the window's middle.

    Attributes
    ----------
    height_e
        How bright it is.
    first, second
        Where it lies.
    width_px
        How wide it is.
    usual_px
        How wide it is a priori.
    """

    height_e: float
    first: float
    second: float
    width_px: float
    usual_px: float

    IS_GROUND: ClassVar[bool]
    """Whether flares stand on it: it counts from its level there, which is that of their even background, and
    of it sources hide what they hide of that; else they hide all that is behind them."""

    PRIOR: ClassVar[tuple[float, float, float, float]]
    """σ of height over itself, of where it lies, twice, and of ln width, a priori."""

    MOST_STEPS: ClassVar[tuple[float, float, float]]
    """Of where it lies, twice, and of ln width."""

    LOG_WIDTHS: ClassVar[tuple[float, float]]
    """Of the usual one, least and most."""

    @staticmethod
    @abstractmethod
    def farthest(shape: tuple[int, int]) -> tuple[float, float]:
        """Return the greatest of where it lies, in a window of that shape."""

    @abstractmethod
    def slopes(self, x_px: Array, y_px: Array) -> Array:
        """Return its profile of height 1, and derivatives by `first`, `second` and ln width, (4, places)."""

    @property
    def unknowns(self) -> tuple[float, float, float]:
        """Where it lies, and its ln width over the usual one."""
        return self.first, self.second, math.log(self.width_px / self.usual_px)

    def moved_to(self, first: float, second: float, log_width: float) -> Self:
        """Return it elsewhere."""
        width_px = self.usual_px * math.exp(log_width)
        return replace(self, first=first, second=second, width_px=width_px)


def places_px(one: Solution) -> tuple[Array, Array]:
    """Return x and y of flares."""
    box = one.window.box
    return one.u_px - box.left - 0.5 * (box.width - 1), one.v_px - box.top - 0.5 * (box.height - 1)


def offsets_px(shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return x and y of a window's pixels."""
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns] - np.reshape([0.5 * (rows - 1), 0.5 * (columns - 1)], (2, 1, 1))
    return x, y


Kind = TypeVar("Kind", bound=Feature)


def fit_in_turns(
    tried: Mapping[int, list[Kind]],
    solutions: Mapping[int, Solution],
    plain: Mapping[int, Solution],
    camera: Camera,
    least_share: float = 0.0,
) -> dict[int, tuple[Solution, list[Kind]]]:
    """Fit flares and features in turns: each together with how the other may be off, to first order.

    Parameters
    ----------
    tried
        By index first guesses of the features.
    solutions, plain
        The flares, beside some of these features or none, and without any.
    camera
        The frame's camera.
    least_share
        So much of the χ² that `solutions` leave beside noise the first turn must explain: no more turns are
        taken where it is less.

    Returns
    -------
    By index the likeliest of what both have come to; nothing where flares did not converge, or the first turn
    explained too little.
    """
    known = dict(tried)
    best: dict[int, tuple[Solution, list[Kind]]] = {}
    current = dict(solutions)
    for turn in range(_ROUNDS):
        for index in known:
            known[index] = _climbed(current[index], plain[index].window, known[index], camera)
        windows = {
            index: replace(plain[index].window, features=_structure(features, current[index], camera))
            for index, features in known.items()
        }
        if turn == 0:  # features have not moved to where they belong: nothing is told of what lies ahead
            windows = {index: replace(window, to_beat=math.inf) for index, window in windows.items()}
        problems = [current[index].again(windows[index]) for index in known]
        for index, again in zip(list(known), solve(problems, camera), strict=True):
            if again is None:
                del known[index]
                continue
            before, current[index] = current[index], again
            if index not in best and share_explained(before, again) < least_share:
                del known[index]
                continue
            gained = best[index][0].deviance - again.deviance if index in best else math.inf
            if gained > 0.0:
                best[index] = again, known[index]
            if gained < _SETTLED_IN_TURNS + _SETTLED_SHARE * max(_beyond_noise(again), 0.0):
                del known[index]
    return best


def share_explained(before: Solution, one: Solution) -> float:
    """Return how much another explains of the χ² beyond noise that a fit leaves, with an imperfect model."""
    return gain(before, one) / max(_beyond_noise(before), 1.0)


def _beyond_noise(one: Solution) -> float:
    """Return by how much χ² in a window, with an imperfect model, exceeds what noise leaves on average."""
    seen = one.window.state == SEEN
    return float((one.residual_e**2 / one.variance_e2(MODEL_ERROR))[seen].sum() - seen.sum())


def _columns(
    feature: Feature, x_px: Array, y_px: Array, covered: Array, one: Solution, camera: Camera
) -> Array:
    """Return a feature's profile of height 1 and its derivatives, as seen beside flares, (4, pixels).

    `covered` is what part of each pixel their discs cover.
    """
    columns, hidden = feature.slopes(x_px, y_px), 1.0
    if feature.IS_GROUND:
        columns[0] -= feature.slopes(*places_px(one))[0].mean()
        hidden = camera.calibration.hidden_background
    return np.asarray(columns * (1.0 - hidden * covered))


def _covered(one: Solution, camera: Camera) -> Array:
    """Return what part of each pixel the flares' discs cover.

    A disc is as bright all over, so that its image tells how much of a pixel it covers. Of several the one
    that seems brightest counts for all.
    """
    at_1_m_px = covered_px_at_1_m(np.column_stack([one.u_px, one.v_px]), camera.calibration)
    of_disc_e = one.flux_e / np.maximum(at_1_m_px * np.exp(-2.0 * one.log_range), 1e-9)
    return np.clip(one.flares_e / float(of_disc_e.max()), 0.0, 1.0)


def _climbed(one: Solution, window: Window, features: list[Kind], camera: Camera) -> list[Kind]:
    """Return features moved to where they explain best what flares leave, as these have come out.

    Levenberg's steps; heights, and the even background, are linear and follow.
    """
    usable = window.state == SEEN
    shape = window.image_e.shape
    weight = 1.0 / np.sqrt(one.variance_e2(0.0)[usable])
    of_model = 1.0 / (weight**2 * one.variance_e2(MODEL_ERROR)[usable])
    known_e = 0.0 if window.known_e is None else window.known_e
    left, covered = (window.image_e - one.flares_e - known_e)[usable] * weight, _covered(one, camera)[usable]
    x_px, y_px = (each[usable] for each in offsets_px(shape))
    now = np.array([feature.unknowns for feature in features])
    prior = np.array([feature.PRIOR[3] for feature in features])
    most_steps = np.array([feature.MOST_STEPS for feature in features])
    least, most = (
        np.array([(*(sign * far for far in f.farthest(shape)), f.LOG_WIDTHS[end]) for f in features])
        for sign, end in ((-1.0, 0), (1.0, 1))
    )

    def fitted(values: Array) -> tuple[list[Kind], float, Array]:
        """Return features, how badly they fit, and the slopes of what is left by their unknowns."""
        there = [f.moved_to(*row) for f, row in zip(features, values.tolist(), strict=True)]
        profiles = [_columns(feature, x_px, y_px, covered, one, camera) * weight for feature in there]
        linear = np.stack([weight, *(profile[0] for profile in profiles)])
        heights = np.linalg.lstsq(linear @ linear.T, linear @ left, rcond=None)[0]
        after = left - heights @ linear
        slopes = [heights[1 + k] * profile[1:] for k, profile in enumerate(profiles)]
        whole = np.concatenate([linear, *slopes])
        high = [replace(f, height_e=float(height)) for f, height in zip(there, heights[1:], strict=True)]
        return high, float(after @ after + ((values[:, 2] / prior) ** 2).sum()), np.vstack([whole, after])

    best, cost, design = fitted(now)
    damping, count = 1e-3, len(features)
    of_width = np.arange(count) * 3 + 2 + 1 + count
    for _ in range(_CLIMBS):
        normal = design[:-1] @ design[:-1].T
        force = design[:-1] @ design[-1]
        normal[of_width, of_width] += prior**-2
        force[of_width] -= now[:, 2] / prior**2
        diagonal = normal.diagonal().copy()
        diagonal[: 1 + count] = 0.0
        step = np.linalg.lstsq(normal + np.diag(damping * diagonal), force, rcond=None)[0][1 + count :]
        moved = now + np.clip(step.reshape(-1, 3), -most_steps, most_steps)
        moved = np.clip(moved, least, most)
        there, cost_there, design_there = fitted(moved)
        if cost_there < cost:
            beyond_noise = max(float(of_model @ design_there[-1] ** 2) - len(left), 0.0)
            settled = cost - cost_there < _SETTLED + _SETTLED_SHARE * beyond_noise
            now, best, cost, design, damping = moved, there, cost_there, design_there, 0.2 * damping
            if settled:
                break
        else:
            damping *= 10.0
    return best


def _structure(features: Sequence[Feature], one: Solution, camera: Camera) -> Structure:
    """Return what features may add to a window: their heights, and what else is not known of them."""
    x_px, y_px = (each.ravel() for each in offsets_px(one.window.image_e.shape))
    covered = _covered(one, camera).ravel()
    columns = np.concatenate([_columns(each, x_px, y_px, covered, one, camera) for each in features])
    sigma = np.concatenate(
        [np.multiply(feature.PRIOR, max(abs(feature.height_e), _LEAST_HEIGHT_E)) for feature in features]
    )
    return any_of(columns, np.diag(1.0 / sigma**2))


def sharp_px(one: Solution) -> float:
    """Return how wide what is sharp is seen: point spread and pixel."""
    return math.hypot(one.psf_sigma_px, math.sqrt(1.0 / 12.0))


@compiled
def free_of_flares(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array, floor_e2: float, prnu: float
) -> tuple[Array, Array, Array]:
    """Return what is left over in the pixels seen, free of what flares that are off leave.

    Returns
    -------
    Shape (6, n), over the noise of each pixel: what an even background, and errors of the flares' light,
    place (two) and width look like, orthogonal and of length 1, and the residual without them. Then one over
    that noise; and x and y from the window's middle, (2, n).
    """
    rows, columns = image_e.shape
    parts, at = np.empty((6, rows * columns)), np.empty((2, rows * columns))
    weights, count = np.empty(rows * columns), 0
    for row in range(rows):
        for column in range(columns):
            if state[row, column] != SEEN:
                continue
            weight = 1.0 / math.sqrt(noise_e2(expected_e[row, column], floor_e2, prnu))
            here = flares_e[row, column]
            left, right = flares_e[row, max(column - 1, 0)], flares_e[row, min(column + 1, columns - 1)]
            above, below = flares_e[max(row - 1, 0), column], flares_e[min(row + 1, rows - 1), column]
            parts[0, count] = weight
            parts[1, count] = weight * here
            parts[2, count] = weight * (right - left)
            parts[3, count] = weight * (below - above)
            parts[4, count] = weight * (left + right + above + below - 4.0 * here)
            parts[5, count] = weight * (image_e[row, column] - expected_e[row, column])
            at[0, count], at[1, count] = column - 0.5 * (columns - 1), row - 0.5 * (rows - 1)
            weights[count] = weight
            count += 1
    parts = parts[:, :count].copy()
    for one in range(5):
        power = (parts[one] ** 2).sum()
        parts[one] *= 1.0 / math.sqrt(power) if power > 0.0 else 0.0
        for other in range(one + 1, 6):
            parts[other] -= (parts[one] * parts[other]).sum() * parts[one]
    return parts, weights[:count], at[:, :count]
