"""Resolved spheres, some of them partly behind others: of the farther ones what stands out.

Deblending adds discs up, which shine through each other; where two overlap neither is then where and as large
as it seems. Here farther ones are seen as far as they stand out from behind nearer ones, so that the expected
image and its derivatives, by places and sizes of all, are of what is seen.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import image_radius_px
from perception.model.layout import UNUSABLE
from perception.model.ranging import brightness_e
from perception.model.window import Camera
from perception.robust.clusters import LEAST_RANGE_M, Cluster
from perception.robust.goodness import MODEL_ERROR
from perception.robust.hiding.climb import good_ones
from perception.robust.hiding.covered import shows_its_size
from perception.robust.hiding.outlines import discs_by_outline
from perception.robust.hiding.spheres import Spheres
from perception.robust.motion import AT_REST, asked_motions, moves, moving, share_asked
from perception.robust.overlap.deblend import LEAST_GAIN, RESIDUAL_SIGMAS, asks_for_more, with_one_more
from perception.robust.overlap.oval import fit_oval
from perception.robust.overlap.pairs import (
    OTHER_SIGMAS,
    alone,
    are_apart,
    groups_of,
    is_near,
    is_of_a_layout,
    knows_layouts,
    least_radius_px,
    longer_chi2,
    meeting,
)
from perception.robust.overlap.rivals import NO_RIVAL, likelier
from perception.robust.problem import Problem, Start
from perception.robust.solve import Solution

Array = NDArray[np.float64]

_LEAST_OF_A_LAYOUT = -6.0  # of 2 Δ ln L: an oval is believed where it is twenty times as likely as they are
_DRAWN_OUT_CHI2 = 14.0  # of two degrees of freedom: by chance once in a thousand
_SIZES = (0.45, 0.7, 0.95)  # of the one behind, relative to the other: first guesses
_TRIED = 2
_BESIDE_PX = 2.0
_NEARLY = 1.0  # of 2 Δ ln L: what has more to gain goes on without an end
# Of the χ² that those at rest leave, by motions: of what moves mostly more, of what lacks one sphere mostly
# less; these are tried last.
_LEAST_ASKED = 0.6
_MOST_MORE = 2  # flares than outline and blobs show
# Of what is lit, over the brightness of sources: where clipped it seems dimmer.
_DIMMEST, _BRIGHTEST = 0.5, 1.5

_RIVAL = 16.0
"""Another explanation whose −2 ln of the evidence is at most so much more is not excluded."""


def eclipses(
    found: Sequence[Cluster],
    plain: Sequence[Solution | None],
    parted: Mapping[int, Solution],
    piles: Mapping[int, Solution],
    may_be: Sequence[bool],
    camera: Camera,
) -> tuple[dict[int, Solution], dict[int, Solution]]:
    """Explain windows by two resolved spheres, one partly behind the other, where no outline shows them.

    Where robots are known to carry several sources, smaller ones too, others may be beside them, and two that
    stand as far apart as a robot's are believed where one that is not quite round would explain as much.

    Parameters
    ----------
    found
        The clusters.
    plain, parted
        What explains each so far: a flare for each blob, None where nothing does; and, by index, more.
    piles
        By index spheres that explain a window, but maybe others do, too.
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
    for index, (cluster, one) in enumerate(zip(found, plain, strict=True)):
        if cluster.is_in_crowd:
            continue
        several = [each[index] for each in (parted, piles) if index in each]
        good = _by_both_ends(cluster, one, several, camera, may_be=may_be[index])
        if not good:
            continue
        likeliest = min(good, key=lambda pair: pair.cost)
        likeliest = likelier(likeliest, _moved(likeliest, camera)) or likeliest
        believed = _believed(likeliest, camera)
        if believed is None:
            rivals[index] = likeliest
        else:
            pairs[index] = believed
    return pairs, rivals


def pile_of(
    cluster: Cluster, camera: Camera, lone: Solution | None = None, most_more: int = _MOST_MORE
) -> Solution | None:
    """Explain a window by the spheres that its outline shows, some partly behind others; None if they do not.

    Blobs that lie beside these are flares of their own. Where something is left, it may be up to `most_more`
    flares of which too little is seen for an outline: then who knows what it is. `lone` is what a single
    flare makes of the window, if that is known.
    """
    if cluster.is_in_crowd:
        return None
    starts = discs_by_outline(cluster, camera)
    reach_px = [
        float(image_radius_px(u, v, math.asin(camera.radius_m * math.exp(-log_range)), camera.calibration))
        for u, v, log_range in starts
    ]
    starts += [
        (member.u_px, member.v_px, member.log_range(member.flux_e))
        for member in cluster.members
        if member.flux_e > 0.0
        if all(
            math.hypot(member.u_px - u, member.v_px - v) > radius_px + _BESIDE_PX
            for (u, v, _), radius_px in zip(starts, reach_px, strict=False)
        )
    ]
    if not reach_px or len(starts) + most_more < 2:
        return None
    shown, likeliest, late = len(starts), None, []
    moves_alone: bool | None = None
    for more in range(1 + most_more):
        pile = lone
        if len(starts) > 1 or lone is None:
            climb = Spheres(Problem(cluster.window, starts, cluster.background_e), camera)
            pile = climb.solution(may_be_bad=more < max(most_more, 1))
        if pile is None:
            break
        if pile.count > 1:
            is_good = _is_good(pile, camera)
            likeliest = likelier(likeliest, pile if is_good and climb.to_gain < _NEARLY else None)
            # Of what clips, more that move than its outline shows fill any patch.
            if more == 0 or not cluster.is_clipped:
                if not is_good and moves_alone is None:
                    moves_alone = _moves_alone(lone, camera)
                if is_good or (share_asked(pile) >= _LEAST_ASKED and not moves_alone):
                    likeliest = likelier(likeliest, _moved(pile, camera))
                else:
                    late.append(pile)
        # Ones that move may explain what another flare does far better.
        explained = pile if likeliest is None or likeliest.motion_px is not None else likeliest
        asking = (pile.left_over.peak_sigmas, explained.left_over.peak_sigmas)
        if more == most_more or not min(asking) > RESIDUAL_SIGMAS:
            break
        starts = with_one_more(pile)[0]
    for pile in late if not moves_alone else []:
        if likeliest is None or (likeliest.motion_px is None and likeliest.count > pile.count):
            likeliest = likelier(likeliest, _moved(pile, camera, likeliest))
    return None if likeliest is None else _believed(replace(likeliest, by_outline=shown), camera)


def _moves_alone(lone: Solution | None, camera: Camera) -> bool:
    """Tell whether one flare that moves explains a window: then it takes no several that do."""
    line = moving([lone], camera).get(0)
    return line is not None and line.motion_px is not None and line.left_over.is_good


def _moved(pile: Solution, camera: Camera, rival: Solution | None = None) -> Solution | None:
    """Return spheres that move while they are exposed, if the residual of those at rest asks for that.

    Nothing where that is sure not to matter beside a rival, or those at rest if they are good.
    """
    is_good = _is_good(pile, camera)
    motions = asked_motions(pile, camera)
    if all(motion == AT_REST for motion in motions):
        return None
    problem = Problem(pile.window, pile.starts, pile.background_e, motions)
    moving = camera.moving
    rival = pile if is_good and rival is None else rival
    most_cost = math.inf if rival is None else rival.cost + NO_RIVAL
    moved = Spheres(problem, moving).solution(most_cost, begins_near=is_good)
    return moved if moved is not None and _is_good(moved, moving) and moves(moved) else None


def _believed(pile: Solution, camera: Camera) -> Solution | None:
    """Return spheres that explain a window, unless globes that are not round would as well."""
    # Where robots are known to carry sources so far apart, these are the odder guess.
    least_gain = _LEAST_OF_A_LAYOUT if is_of_a_layout(pile, camera) else LEAST_GAIN
    meet = [group for group in groups_of(pile) if len(group) > 1]
    if not is_near(pile, least_radius_px(camera)) or any(
        fit_oval(alone(pile, group), camera, least_gain).chi2_more < least_gain for group in meet
    ):
        return None
    if pile.count > pile.by_outline > 0:
        return replace(pile, is_doubtful=True)
    unsure = (two for two in meeting(pile) if not shows_its_size(pile, *two))
    may_be_others = any(_may_be_other(pile, *two, camera) for two in unsure)
    return replace(pile, is_eclipse=not may_be_others)


def _by_both_ends(
    cluster: Cluster, one: Solution | None, several: Sequence[Solution], camera: Camera, *, may_be: bool
) -> list[Solution]:
    """Explain a window by two discs at both ends of what is lit, or where two flares were before.

    As far as that may matter beside what explains the window already.
    """
    most_cost = math.inf if one is None else one.window.to_beat
    of_layouts = knows_layouts(camera)
    guesses: list[list[Start]] = []
    if of_layouts and one is not None and one.count > 1 and asks_for_more(one):
        guesses = _guesses_beside(cluster, one, camera)
    is_long = of_layouts and one is not None and one.count == 1 and longer_chi2(one) > _DRAWN_OUT_CHI2
    if one is None or is_long or (one.count == 1 and may_be):
        guesses = _guesses(cluster, camera)
    of_two = [
        each.starts
        for each in (one, *several)
        if each is not None and (of_layouts or each.count == 2) and is_near(each, least_radius_px(camera))
    ]
    tried = of_two + (guesses[:_TRIED] if of_two and math.isfinite(most_cost) else guesses)
    problems = (Problem(cluster.window, starts, cluster.background_e) for starts in tried)
    fits = (Spheres(problem, camera) for problem in problems)
    return good_ones((fit.solution(most_cost) for fit in fits), partial(_is_good, camera=camera), _TRIED)


def _is_good(pile: Solution, camera: Camera) -> bool:
    return pile.left_over.is_good and are_apart(pile, camera)


def _may_be_other(pile: Solution, near: int, far: int, camera: Camera) -> bool:
    """Tell whether the farther of two may as well be nearer than it seems, and more of it hidden.

    Tried with its outer edge held where it is seen, at the range of the nearer, and half way there.
    """
    (near_u, near_v, near_log), (far_u, far_v, far_log) = pile.starts[near], pile.starts[far]
    apart_px = max(math.hypot(far_u - near_u, far_v - near_v), 1e-9)
    for share in (0.5, 1.0):
        starts, log_range = pile.starts, far_log + share * (near_log - far_log)
        inwards = float(pile.radius_at_rest_px[far]) * (math.exp(far_log - log_range) - 1.0) / apart_px
        place = far_u + inwards * (near_u - far_u), far_v + inwards * (near_v - far_v)
        starts[far] = (*place, log_range)
        moving = camera if pile.motions is None else camera.moving
        climb = Spheres(Problem(pile.window, starts, pile.background_e, pile.motions), moving)
        other = climb.solution(pile.cost + _RIVAL)
        # One that goes on without an end is not excluded where it has come as far as the pair.
        above = climb.so_far - pile.deviance if other is None else other.cost - pile.cost
        if above > _RIVAL:
            continue
        log_ranges = climb.log_ranges if other is None else other.log_range
        farthest = abs(log_ranges[[near, far]].max() - pile.log_range[far])
        if farthest > OTHER_SIGMAS * float(pile.log_range_sigma[far]):
            return True
    return False


def _guesses(cluster: Cluster, camera: Camera) -> list[list[Start]]:
    """Return first guesses of two discs, the likeliest first: at both ends of what is lit."""
    lit = lit_pixels(cluster)
    if lit is None:
        return []
    window, (level_e, is_lit) = cluster.window, lit
    places = np.argwhere(is_lit)[:, ::-1].astype(np.float64)
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
    if not is_as_bright(level_e, most_e, (u_px, v_px), camera):
        return []
    guesses: list[tuple[int, list[Start]]] = []
    away = tuple(reversed(np.indices(window.image_e.shape) - middle[::-1, None, None]))
    for sign in (1.0, -1.0):
        end_px, start_px = sign * float((sign * along).max()), sign * float((sign * along).min())
        for size in _SIZES:
            starts, shown = [], np.zeros(window.image_e.shape, dtype=np.bool_)
            for at_px, radius_px in (
                (end_px - sign * (near_px - 0.5), near_px),
                (start_px + sign * (size * near_px - 0.5), size * near_px),
            ):
                off_u, off_v = (at_px * axes[:, 1]).tolist()
                starts.append((u_px + off_u, v_px + off_v, math.log(at_1_m_px / radius_px)))
                shown |= np.hypot(away[0] - off_u, away[1] - off_v) < radius_px
            guesses.append((int(np.count_nonzero((is_lit != shown) & window.usable)), starts))
    return [starts for _, starts in sorted(guesses, key=lambda guess: guess[0])]


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


def lit_pixels(cluster: Cluster) -> tuple[float, NDArray[np.bool_]] | None:
    """Return how bright the brighter half of a cluster's light is, and which pixels have half of that.

    The pixels as a mask of the window; None where nothing is lit.
    """
    window = cluster.window
    excess_e = np.where(window.usable, window.image_e - cluster.background_e, 0.0)
    if not excess_e.max() > 0.0:
        return None
    level_e = float(np.median(excess_e[excess_e >= 0.5 * excess_e.max()]))
    return level_e, excess_e > 0.5 * level_e


def is_as_bright(least_e: float, most_e: float, place: tuple[float, float], camera: Camera) -> bool:
    """Tell whether pixels of so much light may be of sources, which are as bright at any range."""
    source_e = float(brightness_e(np.array([place]), camera.exposure_s, camera.gain, camera.calibration)[0])
    spread = 1.0 + 4.0 * camera.flux_spread
    return _DIMMEST / spread * source_e < most_e and least_e < _BRIGHTEST * spread * source_e
