"""A resolved source partly behind a body with a straight edge, such as another robot's column.

A whole disc does not explain what is seen of it: nothing does, or pieces that seem far away. Here it is seen
as far as a straight line of free place and direction; how bright the source is and how its limb bends still
tell how far it is.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import image_radius_px
from perception.model.window import Camera
from perception.robust.clusters import LEAST_RANGE_M, Cluster
from perception.robust.fit import Fit
from perception.robust.hiding.climb import Climb, good_ones
from perception.robust.hiding.eclipse import is_as_bright, lit_pixels
from perception.robust.hiding.spheres import expectation_of_spheres
from perception.robust.motion import AT_REST, asked_motions, moves
from perception.robust.overlap.deblend import LEAST_GAIN, gain
from perception.robust.overlap.pairs import LEAST_RADIUS_PX
from perception.robust.overlap.rivals import NO_RIVAL, likelier
from perception.robust.problem import Motion, Problem, Window
from perception.robust.solve import Solution, solutions_of

Array = NDArray[np.float64]

Guess = tuple[float, float, float, float, float]
"""u, v, ln range, the line's direction, and how far it lies that way from (u, v)."""

_DIRECTIONS = 16  # of the line, first guesses
_TRIED, _GOOD = 7, 2
_MOSTLY_SEEN = 0.8  # of the radius, up to the line: first guess where a whole disc explains most
_BESIDE_PX = 1.0
_MOST_TURN_RAD, _MOST_SHIFT_PX = 0.3, 1.0
_LOOSE = 1e-6  # precision of the line's prior
_LEAST_HIDDEN, _LEAST_SEEN = 0.01, 0.15  # of the disc's area


def cut_discs(
    found: Sequence[Cluster],
    plain: Sequence[Solution | None],
    parted: Mapping[int, Solution],
    may_be: Sequence[bool],
    camera: Camera,
) -> dict[int, Solution]:
    """Explain windows by one resolved sphere, a part of which a straight edge hides.

    Parameters
    ----------
    found
        The clusters.
    plain, parted
        What explains each so far: a flare for each blob, None where nothing does; and, by index, more.
    may_be
        Which may be of another shape (`limb.may_be_other_shape`): the others are not tried.
    camera
        The camera.

    Returns
    -------
    By index what explains a window well, said to be doubtful: who knows what hides it.
    """
    cuts = {}
    for index, (cluster, one) in enumerate(zip(found, plain, strict=True)):
        if cluster.is_in_crowd or not may_be[index]:
            continue
        window, background_e = cluster.window, cluster.background_e
        guesses = _guesses(cluster, camera)
        if guesses and one is not None and one.count == 1:
            guesses.insert(0, _where_light_lacks(one))
        most_cost = parted[index].cost + NO_RIVAL if index in parted else math.inf
        fits = (_Cut(window, background_e, guess, camera) for guess in guesses[:_TRIED])
        good = good_ones((fit.solution(most_cost) for fit in fits), partial(_explains_more, one), _GOOD)
        if good:
            cuts[index] = min(good, key=lambda cut: cut.cost)
    return cuts


def _explains_more(one: Solution | None, cut: Solution) -> bool:
    return cut.left_over.is_good and (one is None or gain(one, cut) >= LEAST_GAIN)


def _where_light_lacks(one: Solution) -> Guess:
    """Return a first guess from a whole disc: a line beyond which it is brighter than what is seen."""
    (u_px, v_px, log_range), radius_px = one.starts[0], float(one.image_radius_px[0])
    lacks = np.maximum(-one.residual_e, 0.0)
    rows, columns = np.indices(lacks.shape)
    off_u, off_v = columns + one.window.box.left - u_px, rows + one.window.box.top - v_px
    lacks[np.hypot(off_u, off_v) > radius_px + _BESIDE_PX] = 0.0
    turn = math.atan2(float((lacks * off_v).sum()), float((lacks * off_u).sum()))
    return u_px, v_px, log_range, turn, _MOSTLY_SEEN * radius_px


def _guesses(cluster: Cluster, camera: Camera) -> list[Guess]:
    """Return first guesses for lines of all directions, the likeliest first.

    Of what is lit, the extent across the line is the diameter if more than half of the disc is seen, else a
    chord; that along it the height of the piece.
    """
    lit = lit_pixels(cluster)
    if lit is None:
        return []
    level_e, is_lit = lit
    places = np.argwhere(is_lit)[:, ::-1].astype(np.float64)
    middle = places.mean(axis=0)
    corner = np.array([cluster.window.box.left, cluster.window.box.top], dtype=np.float64)
    u_px, v_px = (corner + middle).tolist()
    at_1_m_px = float(image_radius_px(u_px, v_px, math.asin(min(camera.radius_m, 1.0)), camera.calibration))
    most_e = math.inf if cluster.is_clipped else level_e
    if not at_1_m_px > 0.0 or not is_as_bright(level_e, most_e, (u_px, v_px), camera):
        return []
    guesses: list[tuple[int, Guess]] = []
    rows, columns = np.indices(cluster.window.image_e.shape)
    for turn in np.arange(_DIRECTIONS) * (2.0 * math.pi / _DIRECTIONS):
        away, beside = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
        along, across = (places - middle) @ away, (places - middle) @ beside
        height, width = float(np.ptp(along)) + 1.0, float(np.ptp(across)) + 1.0
        radius_px = 0.5 * width if height >= 0.5 * width else width**2 / (8.0 * height) + 0.5 * height
        if radius_px < LEAST_RADIUS_PX or at_1_m_px / radius_px < LEAST_RANGE_M:
            continue
        at = float(along.min()) - 0.5 + radius_px
        place = corner + middle + at * away + 0.5 * (float(across.max()) + float(across.min())) * beside
        edge_px = float(along.max()) + 0.5 - at
        off_u, off_v = columns + corner[0] - place[0], rows + corner[1] - place[1]
        shown = (np.hypot(off_u, off_v) < radius_px) & (off_u * away[0] + off_v * away[1] < edge_px)
        guess = (*place.tolist(), math.log(at_1_m_px / radius_px), float(turn), edge_px)
        guesses.append((int(np.count_nonzero((is_lit != shown) & cluster.window.usable)), guess))
    return [guess for _, guess in sorted(guesses, key=lambda each: each[0])]


class _Cut(Climb):
    """The fit of a sphere behind an edge to a window, on its way from a first guess.

    Its unknowns are those of a lone flare and, after them, the direction away from what is lit at a right
    angle to the line, and how far the line lies that way from where the flare was guessed.
    """

    def __init__(
        self,
        window: Window,
        background_e: float,
        guess: Guess,
        camera: Camera,
        motions: list[Motion] | None = None,
    ) -> None:
        u_px, v_px, log_range, turn, edge_px = guess
        problem = Problem(window, [(u_px, v_px, log_range)], background_e, motions)
        fit, self._from = Fit(problem, camera), (u_px, v_px)
        size = fit.layout.size
        prior = np.diag([*np.zeros(size), _LOOSE, _LOOSE])
        prior[:size, :size] = fit.prior
        most_step = np.array([*fit.layout.most_step, _MOST_TURN_RAD, _MOST_SHIFT_PX])
        super().__init__(fit, camera, np.array([*fit.values, turn, edge_px]), most_step, prior)

    def solution(self, most_cost: float) -> Solution | None:
        """Return what is likeliest, at rest or not; None where nothing is, or hardly any is hidden or seen.

        Nor where its cost would be greater than `most_cost`.
        """
        at_rest = self._likeliest(most_cost)
        motions = [AT_REST] if at_rest is None else asked_motions(at_rest, self._camera)
        if at_rest is None or motions == [AT_REST]:
            return at_rest
        ((u_px, v_px, log_range),) = at_rest.starts
        turn, edge_px = self._values[-2:].tolist()
        edge_px += (self._from[0] - u_px) * math.cos(turn) + (self._from[1] - v_px) * math.sin(turn)
        guess, moving = (u_px, v_px, log_range, turn, edge_px), self._camera.moving
        moved = _Cut(at_rest.window, at_rest.background_e, guess, moving, motions)._likeliest(most_cost)
        if moved is None or not moves(moved):
            return at_rest
        return likelier(at_rest, moved)

    def _likeliest(self, most_cost: float) -> Solution | None:
        if not self._reach(most_cost) or not _LEAST_SEEN < self._seen < 1.0 - _LEAST_HIDDEN:
            return None
        found = solutions_of([self._fit], self._camera)[0]
        # A priori the line has any direction, and cuts the disc anywhere.
        volume = 2.0 * math.pi * 2.0 * float(found.image_radius_px[0])
        price = 2.0 * math.log(volume) - 2.0 * math.log(2.0 * math.pi)
        return replace(found, log_information=found.log_information + price, is_doubtful=True)

    def _expectation(self, values: Array) -> tuple[Array, Array]:
        """Return λ and its derivatives, shape (pixels,) and (unknowns, pixels)."""
        size = self._fit.layout.size
        edge = np.array([*self._from, *values[size:]])
        expected, jacobian, seen = expectation_of_spheres(values, self._fit, self._camera, edge)
        self._seen = math.nan if seen is None else float(seen.shares[0])
        return expected, jacobian
