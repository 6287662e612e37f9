"""Two resolved spheres, one partly behind the other: the nearer is whole, of the farther what stands out.

Deblending adds discs up, which shine through each other; where two overlap neither is then where and as large
as it seems. Here each quadrature node of the farther counts by how much of it stands out from behind the
nearer, so that the expected image and its derivatives, by places and sizes of both, are of what is seen.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera, pixel_turn
from perception.model.flare import image_radius_px
from perception.model.layout import UNUSABLE
from perception.model.window import Camera, lay_out
from perception.robust.clusters import LEAST_RANGE_M, Cluster
from perception.robust.fit import Fit, log_range_by_size
from perception.robust.goodness import MODEL_ERROR
from perception.robust.overlap.climb import Climb, good_ones
from perception.robust.overlap.deblend import LEAST_GAIN, asks_for_more
from perception.robust.overlap.hidden import expectation_of_two
from perception.robust.overlap.oval import fit_oval
from perception.robust.overlap.pairs import (
    OTHER_SIGMAS,
    are_apart,
    is_near,
    is_of_a_layout,
    knows_layouts,
    least_radius_px,
    longer_chi2,
    nearest_two,
    pair_of,
)
from perception.robust.problem import Problem, Start
from perception.robust.solve import Solution, solutions_of

Array = NDArray[np.float64]

_LEAST_OF_A_LAYOUT = -6.0  # of 2 Δ ln L: an oval is believed where it is twenty times as likely as they are
_DRAWN_OUT_CHI2 = 14.0  # of two degrees of freedom: by chance once in a thousand
_FINER = 2.0  # are the nodes of what is hidden in part
_SIZES = (0.45, 0.7, 0.95)  # of the one behind, relative to the other: first guesses
_TRIED = 2
_DIMMEST, _BRIGHTEST = (
    0.5,
    1.5,
)  # of what is lit, over the brightness of sources: where clipped it seems dimmer

_RIVAL = 16.0
"""Another explanation whose −2 ln of the evidence is at most so much more is not excluded."""


def eclipses(
    found: Sequence[Cluster],
    plain: Sequence[Solution | None],
    parted: Mapping[int, Solution],
    may_be: Sequence[bool],
    camera: Camera,
) -> tuple[dict[int, Solution], dict[int, Solution]]:
    """Explain windows by two resolved spheres, one partly behind the other.

    Where robots are known to carry several sources, smaller ones too, others may be beside them, and two that
    stand as far apart as a robot's are believed where one that is not quite round would explain as much.

    Parameters
    ----------
    found
        The clusters.
    plain, parted
        What explains each so far: a flare for each blob, None where nothing does; and, by index, more.
    may_be
        Which may be of another shape (`limb.may_be_other_shape`): of the others only pairs are tried.
    camera
        The camera.

    Returns
    -------
    By index what explains a window well, nothing where nothing does; and likewise what does, but for which a
    globe that is not round would as well, or which is too small to be told.
    """
    pairs, rivals = dict[int, Solution](), dict[int, Solution]()
    least_px, of_layouts = least_radius_px(camera), knows_layouts(camera)
    for index, (cluster, one) in enumerate(zip(found, plain, strict=True)):
        if cluster.is_in_crowd:
            continue
        guesses: list[list[Start]] = []
        if of_layouts and one is not None and one.count > 1 and asks_for_more(one):
            guesses = _guesses_beside(cluster, one, camera)
        is_long = of_layouts and one is not None and one.count == 1 and longer_chi2(one) > _DRAWN_OUT_CHI2
        if one is None or is_long or (one.count == 1 and may_be[index]):
            guesses = _guesses(cluster, camera)
        of_two = [
            each.starts
            for each in (one, parted.get(index))
            if each is not None and (of_layouts or each.count == 2) and is_near(each, least_px)
        ]
        fits = [_Eclipse(Problem(cluster.window, two, cluster.background_e), camera) for two in guesses]
        fits.sort(key=lambda fit: fit.objective)
        fits = [_Eclipse(Problem(cluster.window, two, cluster.background_e), camera) for two in of_two] + fits
        good = good_ones(
            (fit.solution() for fit in fits),
            lambda pair: pair.left_over.is_good and are_apart(pair, camera),
            _TRIED,
        )
        if not good:
            continue
        rivals[index] = likeliest = min(good, key=lambda pair: pair.cost)
        if not is_near(likeliest, least_px):
            continue
        # Where robots are known to carry sources so far apart, globes that are not round are the odder guess.
        of_one_robot = is_of_a_layout(likeliest, camera)
        least_gain = _LEAST_OF_A_LAYOUT if of_one_robot else LEAST_GAIN
        # An oval explains no more than one of several flares.
        is_believed = (
            of_one_robot if likeliest.count > 2 else fit_oval(likeliest, camera).chi2_more >= least_gain
        )
        if is_believed:
            pairs[index] = replace(rivals.pop(index), is_eclipse=not _may_be_other(likeliest, camera))
    return pairs, rivals


def _may_be_other(pair: Solution, camera: Camera) -> bool:
    """Tell whether the farther may as well be nearer than it seems, and more of it hidden.

    Tried with its outer edge held where it is seen, at the range of the nearer, and half way there.
    """
    near, far = sorted(pair_of(pair), key=lambda k: -float(pair.image_radius_px[k]))
    starts = pair.starts
    (near_u, near_v, near_log), (far_u, far_v, far_log) = starts[near], starts[far]
    apart_px = max(math.hypot(far_u - near_u, far_v - near_v), 1e-9)
    for share in (0.5, 1.0):
        log_range = far_log + share * (near_log - far_log)
        inwards = float(pair.image_radius_px[far]) * (math.exp(far_log - log_range) - 1.0) / apart_px
        place = far_u + inwards * (near_u - far_u), far_v + inwards * (near_v - far_v)
        starts[far] = (*place, log_range)
        climb = _Eclipse(Problem(pair.window, starts, pair.background_e), camera)
        other = climb.solution()
        # One that goes on without an end is not excluded where it has come as far as the pair.
        above = climb.so_far - pair.deviance if other is None else other.cost - pair.cost
        if above > _RIVAL:
            continue
        log_ranges = climb.log_ranges if other is None else other.log_range
        farthest = abs(log_ranges[[near, far]].max() - pair.log_range[far])
        if farthest > OTHER_SIGMAS * float(pair.log_range_sigma[far]):
            return True
    return False


def _guesses(cluster: Cluster, camera: Camera) -> list[list[Start]]:
    """Return first guesses of two discs: at both ends of what is lit, the wider one at either."""
    lit = lit_pixels(cluster)
    if lit is None:
        return []
    window, (level_e, places) = cluster.window, lit
    middle = places.mean(axis=0)
    _, axes = np.linalg.eigh((places - middle).T @ (places - middle))
    along, across = (places - middle) @ axes[:, 1], (places - middle) @ axes[:, 0]
    near_px = 0.5 * (float(np.ptp(across)) + 1.0)
    if near_px < least_radius_px(camera):
        return []
    corner = np.array([window.box.left, window.box.top], dtype=np.float64)
    u_px, v_px = (corner + middle).tolist()
    at_1_m_px = float(image_radius_px(u_px, v_px, math.asin(min(camera.radius_m, 1.0)), camera.calibration))
    most_e = math.inf if cluster.is_clipped else level_e
    if not at_1_m_px > 0.0 or at_1_m_px / near_px < LEAST_RANGE_M:
        return []
    if not is_as_bright(level_e, most_e, (u_px, v_px), at_1_m_px, camera):
        return []
    guesses = []
    for sign in (1.0, -1.0):
        end_px, start_px = sign * float((sign * along).max()), sign * float((sign * along).min())
        for size in _SIZES:
            starts = []
            for at_px, radius_px in (
                (end_px - sign * (near_px - 0.5), near_px),
                (start_px + sign * (size * near_px - 0.5), size * near_px),
            ):
                u, v = (corner + middle + at_px * axes[:, 1]).tolist()
                starts.append((u, v, math.log(at_1_m_px / radius_px)))
            guesses.append(starts)
    return guesses


def _guesses_beside(cluster: Cluster, several: Solution, camera: Camera) -> list[list[Start]]:
    """Return first guesses of two discs in the place of that flare which explains what is around it worst."""
    window, rest = cluster.window, list(several.starts)
    rows, columns = np.indices(window.image_e.shape)
    away_px = [
        np.hypot(columns + window.box.left - u, rows + window.box.top - v)
        for u, v in zip(several.u_px, several.v_px, strict=True)
    ]
    nearest = np.argmin(away_px, axis=0)
    left2 = several.residual_e**2 / several.variance_e2(MODEL_ERROR)
    worst = int(np.argmax([left2[nearest == k].sum() for k in range(several.count)]))
    del rest[worst]
    around = np.where(nearest == worst, window.state, UNUSABLE).astype(np.uint8)
    alone = replace(cluster, window=replace(window, state=around))
    return [[*two, *rest] for two in _guesses(alone, camera)]


def lit_pixels(cluster: Cluster) -> tuple[float, Array] | None:
    """Return how bright the brighter half of a cluster's light is, and which pixels have half of that.

    The pixels by column and row in the window, shape (pixels, 2); None where nothing is lit.
    """
    window = cluster.window
    excess_e = np.where(window.usable, window.image_e - cluster.background_e, 0.0)
    if not excess_e.max() > 0.0:
        return None
    level_e = float(np.median(excess_e[excess_e >= 0.5 * excess_e.max()]))
    rows, columns = np.nonzero(excess_e > 0.5 * level_e)
    return level_e, np.column_stack([columns, rows]).astype(np.float64)


def is_as_bright(
    least_e: float, most_e: float, place: tuple[float, float], at_1_m_px: float, camera: Camera
) -> bool:
    """Tell whether pixels of so much light may be of sources, which are as bright at any range."""
    laid, _ = lay_out(camera, np.array([place[0]]), np.array([place[1]]), np.zeros(1), in_points=True)
    source_e = math.exp(float(laid.log_flux_at_1_m[0])) / (math.pi * at_1_m_px**2)
    spread = 1.0 + 4.0 * camera.flux_spread
    return _DIMMEST / spread * source_e < most_e and least_e < _BRIGHTEST * spread * source_e


class _Eclipse(Climb):
    """The fit of two spheres to a window, on its way from first guesses."""

    def __init__(self, problem: Problem, camera: Camera) -> None:
        fit, self._finer = Fit(problem, camera), finer(camera)
        self._pair = nearest_two(np.array(problem.starts)[:, :2])
        super().__init__(fit, camera, fit.values.copy(), fit.layout.most_step, fit.prior)

    def solution(self) -> Solution | None:
        """Return what is likeliest; None where no maximum is reached."""
        if not self._reach():
            return None
        return solutions_of([self._fit], self._camera)[0]

    def _expectation(self, values: Array) -> tuple[Array, Array]:
        """Return λ and its derivatives, shape (pixels,) and (unknowns, pixels)."""
        fit, camera, layout = self._fit, self._camera, self._fit.layout
        own = layout.of_sources(values)
        by_size = log_range_by_size(own, fit)
        near, far = sorted(self._pair, key=lambda k: float(by_size[k]))
        hidden_px = camera.hidden_px_at_1_m(own[:, :2])
        hidden_e = None if hidden_px is None else hidden_px * max(float(values[layout.background]), 0.0)
        fineness = np.where(np.arange(layout.sources) == far, self._finer, 1.0)
        laid, imaged = lay_out(
            camera, own[:, 0], own[:, 1], by_size, hidden_e, finer=fineness, in_points=True
        )
        fit.log_flux_at_1_m, fit.image_radius_px = laid.log_flux_at_1_m, laid.reach_px
        flux = np.exp(laid.log_flux_at_1_m - 2.0 * own[:, 2])
        flux[~imaged] = math.nan  # nowhere to go on to
        middle_px, first, end = own[near : near + 1, :2], *laid.first_node[far : far + 2]
        offset = np.column_stack([laid.node_u_px[first:end], laid.node_v_px[first:end]])
        away = direction_camera(own[far, :2] + offset, camera.calibration)
        away -= direction_camera(middle_px, camera.calibration)
        turn = pixel_turn(middle_px, camera.calibration)[0]
        radius_rad = math.asin(min(camera.radius_m * math.exp(-float(by_size[near])), 1.0))
        expected = np.empty(self._view.image_e.size)
        jacobian = np.zeros((layout.size, len(expected)))
        expectation_of_two(
            values, near, far, flux, away, turn, radius_rad, self._view, laid, fit.structure, fit.known,
            expected, jacobian,
        )  # fmt: skip
        return expected, jacobian


def finer(camera: Camera) -> float:
    """Return by how much finer sources are laid out: an edge is sharper than a limb.

    No finer than what a pixel alone smooths asks for.
    """
    return min(_FINER, math.sqrt(12.0 * camera.calibration.psf_sigma_px**2 + 1.0))


def hidden_log_range(solution: Solution, index: int) -> float:
    """Return how far a flare's ln range may be off because sources hide parts of each other.

    What is fitted are whole discs, which shine through each other. Where they overlap so much of a source's
    light may lack, or be another's. And one that seems farther than another, within two radii of which it
    lies, may be as near as that, most of it hidden behind it. Eclipses are fitted as they are.
    """
    if solution.is_eclipse or solution.count == 1:
        return 0.0
    apart_px = np.hypot(solution.u_px - solution.u_px[index], solution.v_px - solution.v_px[index])
    others_px = solution.radius_at_rest_px
    own_px = float(others_px[index])
    farther = solution.log_range[index] - solution.log_range[apart_px < 2.0 * others_px]
    # Of two discs of unlike size the chord of the smaller one: what a half plane at the mean edge cuts off.
    into = (others_px + own_px - apart_px) / (2.0 * max(own_px, 1e-9))
    into[index] = 0.0
    depth = np.clip(into, 0.0, 1.0)
    cut = (np.arccos(1.0 - 2.0 * depth) - (1.0 - 2.0 * depth) * 2.0 * np.sqrt(depth - depth**2)) / np.pi
    return max(float(farther.max(initial=0.0)), 0.5 * float(cut.sum()))
