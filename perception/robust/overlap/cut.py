"""A resolved source partly behind a body with a straight edge, such as another robot's column.

A whole disc does not explain what is seen of it: nothing does, or pieces that seem far away. Here each
quadrature node counts by how much of it lies on the lit side of a line of free place and direction; how
bright the source is and how its limb bends still tell how far it is.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import image_radius_px
from perception.model.layout import Sources
from perception.model.spread import spread_nodes
from perception.model.window import Camera, lay_out
from perception.robust.clusters import LEAST_RANGE_M, Cluster
from perception.robust.fit import Fit, log_range_by_size
from perception.robust.overlap.climb import Climb, good_ones
from perception.robust.overlap.deblend import LEAST_GAIN, gain
from perception.robust.overlap.eclipse import is_as_bright, lit_pixels
from perception.robust.overlap.pairs import LEAST_RADIUS_PX
from perception.robust.overlap.rivals import NO_RIVAL
from perception.robust.problem import Problem
from perception.robust.solve import Solution, solutions_of

Array = NDArray[np.float64]

Guess = tuple[float, float, float, float, float]
"""u, v, ln range, the line's direction, and how far it lies that way from (u, v)."""

_FINER = 2.0  # are the nodes of what is hidden in part
_RAMP_PX = 0.4  # over so much what is hidden begins: about as far as nodes lie apart
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
        fits = [_Cut(cluster, guess, camera) for guess in _guesses(cluster, camera)]
        fits.sort(key=lambda fit: fit.objective)
        if fits and one is not None and one.count == 1:
            fits.insert(0, _Cut(cluster, _where_light_lacks(one), camera))
        to_beat = parted[index].cost + NO_RIVAL if index in parted else math.inf
        cut = (fit.solution(to_beat) for fit in fits[:_TRIED])
        good = good_ones(cut, partial(_explains_more, one), _GOOD)
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
    """Return first guesses for lines of all directions.

    Of what is lit, the extent across the line is the diameter if more than half of the disc is seen, else a
    chord; that along it the height of the piece.
    """
    lit = lit_pixels(cluster)
    if lit is None:
        return []
    level_e, places = lit
    middle = places.mean(axis=0)
    corner = np.array([cluster.window.box.left, cluster.window.box.top], dtype=np.float64)
    u_px, v_px = (corner + middle).tolist()
    at_1_m_px = float(image_radius_px(u_px, v_px, math.asin(min(camera.radius_m, 1.0)), camera.calibration))
    most_e = math.inf if cluster.is_clipped else level_e
    if not at_1_m_px > 0.0 or not is_as_bright(level_e, most_e, (u_px, v_px), at_1_m_px, camera):
        return []
    guesses = []
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
        guesses.append((*place.tolist(), math.log(at_1_m_px / radius_px), float(turn), edge_px))
    return guesses


class _Cut(Climb):
    """The fit of a sphere behind an edge to a window, on its way from a first guess.

    Its unknowns are those of a lone flare and, after them, the direction away from what is lit at a right
    angle to the line, and how far the line lies that way from where the flare was guessed.
    """

    def __init__(self, cluster: Cluster, guess: Guess, camera: Camera) -> None:
        u_px, v_px, log_range, turn, edge_px = guess
        problem = Problem(cluster.window, [(u_px, v_px, log_range)], cluster.background_e)
        fit, self._finer, self._from = (
            Fit(problem, camera),
            np.array([_finer(camera)]),
            np.array([u_px, v_px]),
        )
        size = fit.layout.size
        prior = np.diag([*np.zeros(size), _LOOSE, _LOOSE])
        prior[:size, :size] = fit.prior
        most_step = np.array([*fit.layout.most_step, _MOST_TURN_RAD, _MOST_SHIFT_PX])
        super().__init__(fit, camera, np.array([*fit.values, turn, edge_px]), most_step, prior)

    def solution(self, to_beat: float) -> Solution | None:
        """Return what is likeliest; None where no maximum is reached, or hardly any is hidden or seen.

        Nor where its cost would be greater than `to_beat`.
        """
        if not self._reach(to_beat) or not _LEAST_SEEN < self._seen < 1.0 - _LEAST_HIDDEN:
            return None
        found = solutions_of([self._fit], self._camera)[0]
        # A priori the line has any direction, and cuts the disc anywhere.
        volume = 2.0 * math.pi * 2.0 * float(found.image_radius_px[0])
        price = 2.0 * math.log(volume) - 2.0 * math.log(2.0 * math.pi)
        return replace(found, log_information=found.log_information + price, is_doubtful=True)

    def _expectation(self, values: Array) -> tuple[Array, Array]:
        """Return λ and its derivatives, shape (pixels,) and (unknowns, pixels)."""
        fit, known, layout = self._fit, self._fit.known, self._fit.layout
        own = layout.of_sources(values[: layout.size])
        background_e = float(values[layout.background])
        by_size = log_range_by_size(own, fit)
        hidden_px = self._camera.hidden_px_at_1_m(own[:, :2])
        hidden_e = None if hidden_px is None else hidden_px * max(background_e, 0.0)
        sigma_px = known.psf_sigma_px
        if layout.has_width:
            sigma_px *= math.exp(known.width_spread * float(values[layout.width]))
        laid, imaged = lay_out(
            self._camera, own[:, 0], own[:, 1], by_size, hidden_e, finer=self._finer, in_points=True
        )
        fit.log_flux_at_1_m[0], fit.image_radius_px[0] = laid.log_flux_at_1_m[0], laid.reach_px[0]
        flux = math.exp(float(laid.log_flux_at_1_m[0]) - 2.0 * float(own[0, 2]))
        flux = flux if imaged[0] else math.nan  # nowhere to go on to
        seen, changes = self._seen_part(laid, own[0], float(values[-2]), float(values[-1]), sigma_px)
        image = self._spread(seen, own[0], sigma_px)
        jacobian = np.zeros((len(values), fit.window.image_e.size))
        beside = slice(layout.background + 1, layout.size)
        jacobian[layout.background] = 1.0
        jacobian[beside] = fit.structure.columns
        expected = background_e + self._view.known_e.ravel() + values[beside] @ fit.structure.columns
        expected = expected + flux * image[0]
        grown = image[3] + changes[2]
        jacobian[:2] = flux * (image[1:3] + changes[:2])
        jacobian[2] = -flux * (2.0 * image[0] + grown)
        if layout.has_slack:
            jacobian[3] = known.tie_spread * flux * grown
        if layout.has_width:
            jacobian[layout.width] = known.width_spread * flux * image[4]
        jacobian[-2:] = flux * changes[3:]
        return expected, jacobian

    def _seen_part(
        self, laid: Sources, own: Array, turn: float, edge_px: float, sigma_px: float
    ) -> tuple[Sources, Array]:
        """Return what lies on the lit side of the line, and how that changes.

        The changes, shape (5, pixels), are by column, row and ln size of the source, and by the line's
        direction and place.
        """
        away, beside = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
        offset = np.column_stack([laid.node_u_px, laid.node_v_px])
        place = own[:2] - self._from + offset
        stands_out = 0.5 + (edge_px - place @ away) / _RAMP_PX
        self._seen = float(np.sum(laid.weight * np.clip(stands_out, 0.0, 1.0)) / np.sum(laid.weight))
        ramp = (stands_out > 0.0) & (stands_out < 1.0)
        edge, light = _chosen(laid, ramp), laid.weight[ramp] / _RAMP_PX
        by_place, by_size, by_turn = (
            self._spread(edge._replace(weight=light * factor), own, sigma_px)[0]
            for factor in (np.ones(len(light)), (offset @ away)[ramp], (place @ beside)[ramp])
        )
        seen = laid._replace(weight=laid.weight * np.clip(stands_out, 0.0, 1.0))
        return seen, np.stack([-away[0] * by_place, -away[1] * by_place, -by_size, -by_turn, by_place])

    def _spread(self, laid: Sources, own: Array, sigma_px: float) -> Array:
        """Return shares of light in each pixel, and derivatives, as `spread_nodes`; shape (5, pixels)."""
        image = np.zeros((5, *self._fit.window.image_e.shape))
        place = (float(own[0]) - self._view.left, float(own[1]) - self._view.top)
        spread_nodes(laid, 0, place, 1.0, (0.0, 0.0), sigma_px, image)
        return image.reshape(5, -1)


def _chosen(laid: Sources, which: NDArray[np.bool_]) -> Sources:
    """Return some of the nodes of a source."""
    return laid._replace(
        first_node=np.array([0, int(which.sum())]),
        node_u_px=laid.node_u_px[which],
        node_v_px=laid.node_v_px[which],
        half_px=laid.half_px[which],
        tilt=laid.tilt[which],
        bend=laid.bend[which],
        node_along=laid.node_along[which],
        weight=laid.weight[which],
    )


def _finer(camera: Camera) -> float:
    """Return by how much finer sources are laid out: an edge is sharper than a limb.

    No finer than what a pixel alone smooths asks for.
    """
    return min(_FINER, math.sqrt(12.0 * camera.calibration.psf_sigma_px**2 + 1.0))
