"""What explains a cluster best: flares at rest or drawn out, one or several, a halo, uneven ground, spill."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from perception.model.window import MOST_MOTION_PX, Camera
from perception.robust.around.before_edges import (
    brightest_alone,
    likelier_before_edges,
    with_flares_and_edges,
)
from perception.robust.around.edge import (
    is_beyond_doubt,
    leaves_something,
    surely_leaves_something,
    with_edges,
)
from perception.robust.around.halo import with_halo
from perception.robust.around.highlight import likelier_beside_highlights, seems_highlit, with_highlights
from perception.robust.around.uneven import (
    MOST_LEFT,
    by_flanks,
    retry_on_uneven_ground,
    retry_without_spill,
    without_spill,
)
from perception.robust.clusters import Cluster
from perception.robust.forward_light import fit_beside_forward_light
from perception.robust.hiding.cut import cut_discs
from perception.robust.hiding.eclipse import eclipses, pile_of
from perception.robust.motion import moving
from perception.robust.overlap.deblend import (
    RESIDUAL_SIGMAS,
    asks_for_more,
    deblend,
)
from perception.robust.overlap.free_fits import of_free_width
from perception.robust.overlap.limb import may_be_other_shape
from perception.robust.overlap.oval import is_oval
from perception.robust.overlap.pairs import LEAST_RADIUS_PX
from perception.robust.overlap.rivals import against, beside_rival, better, to_beat, weighed
from perception.robust.overlap.unparted import doubted
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution
from perception.robust.verdict import is_hardly_seen

_GOOD_SIGMAS = 10.0  # of χ²: what leaves so much more is not as good, whatever error the model may have


def best(
    found: Sequence[Cluster], plain: Sequence[Solution | None], prepared: PreparedFrame, camera: Camera
) -> list[Solution | None]:
    """Explain clusters by a flare for each blob, drawn out or not, by several, with what lies around them.

    Parameters
    ----------
    found, plain
        The clusters, and what `by_blobs` makes of them.
    prepared, camera
        The frame they are of, and its camera.

    Returns
    -------
    What explains each best; None where nothing does.
    """
    chosen = list(plain)
    for index, fit in by_flanks(found, chosen, prepared, camera).items():
        chosen[index] = fit
    fit_beside_forward_light(chosen, camera)
    piles = _piles(found, chosen, prepared, camera)
    sure = {index: pile for index, pile in piles.items() if not pile.is_doubtful}
    others = [index for index in range(len(found)) if index not in sure]
    rivals = {at: piles[index] for at, index in enumerate(others) if index in piles}
    explained = _explained([found[k] for k in others], [chosen[k] for k in others], rivals, prepared, camera)
    for index, one in zip(others, explained, strict=True):
        chosen[index] = one
    return [sure.get(index, one) for index, one in enumerate(chosen)]


def _piles(
    found: Sequence[Cluster], plain: Sequence[Solution | None], prepared: PreparedFrame, camera: Camera
) -> dict[int, Solution]:
    """Explain windows by spheres that hide parts of each other, where a flare for each blob does not.

    Not where one that moves explains what is seen as well: nothing else does, but for one behind an edge,
    which it takes more than the outline shows.
    """
    piles = dict[int, Solution]()
    if prepared.frame.line_time_s > 0.0:
        return piles
    for index, (cluster, one) in enumerate(zip(found, plain, strict=True)):
        if one is None or may_be_other_shape(one, camera):
            is_lone = one is not None and one.count == 1 and one.window is cluster.window
            pile = pile_of(cluster, camera, one if is_lone else None)
            if pile is not None and pile.left_over.is_nothing:
                piles[index] = pile
    lone: list[Solution | None] = [None] * len(plain)
    for index, pile in piles.items():
        one, most = plain[index], pile.deviance + _GOOD_SIGMAS * math.sqrt(2.0 * pile.expected_e.size)
        lone[index] = None if one is None else to_beat(one, most)
    for index, line in moving(lone, camera).items():
        if line.motion_px is not None and line.left_over.is_good:
            del piles[index]
    return piles


def _explained(
    found: Sequence[Cluster],
    solved: Sequence[Solution | None],
    piles: Mapping[int, Solution],
    prepared: PreparedFrame,
    camera: Camera,
) -> list[Solution | None]:
    """Explain windows by more than a flare for each blob, as by `piles`, where that explains them better."""
    # Where spheres explain all that is seen, all else is worth a look only as far as it may matter then.
    piles = {index: pile for index, pile in piles.items() if _explains_all(pile, prepared.shape)}
    chosen = against(solved, piles)
    lone = {k: one for k, one in enumerate(chosen) if one is not None and not found[k].is_in_crowd}
    on_structure = {k for k in lone if prepared.is_structured(found[k].members[0].blob.box)}
    # What light fog throws forward goes by a flux that an edge no longer leads astray.
    edged = _beside_forward_light(with_edges(lone, on_structure, camera), camera)
    at_rest = list(chosen)
    certain = {index: one for index, one in edged.items() if is_beyond_doubt(one, lone[index])}
    for index in certain:
        chosen[index] = None
    # Behind a rolling shutter a drive that switches while rows are read leaves a part of one flare, which two
    # flares would explain better.
    parted: dict[int, Solution] = {}
    rivals: dict[int, Solution] = {}
    cut_short: set[int] = set()
    halos: dict[int, Solution] = {}
    plain: list[Solution | None] = [None] * len(found)
    known = plain
    if prepared.frame.line_time_s == 0.0:
        plain = [None if c.is_in_crowd else s for c, s in zip(found, chosen, strict=True)]
        may_be = [one is None or may_be_other_shape(one, camera) for one in plain]
        divisible = [
            one if other or _may_be_several(one) else None for one, other in zip(plain, may_be, strict=True)
        ]
        halos = with_halo(dict(enumerate(plain)), camera)
        parted = _parted(divisible, halos, prepared.shape, camera, cut_short)
        pairs, rivals = eclipses(found, plain, parted, piles, may_be, camera)
        for several in (piles, pairs):
            _take_up(several, parted, prepared.shape)
        _take_up(cut_discs(found, plain, parted, may_be, camera), parted, prepared.shape)
        spilled = without_spill(plain, prepared, camera)
        # Of what takes several more flares at rest one that moves is where others that move begin.
        few = {
            k: more for k, more in parted.items() if (one := plain[k]) is None or more.count <= one.count + 1
        }
        known = _take_lines(chosen, plain, halos, spilled, few, camera)
        _drop_beside_lines(chosen, parted, halos, prepared.shape, camera, cut_short)
    retry_without_spill(chosen, parted, prepared, camera)
    uneven_e = [0.0 if one is None else one.left_over.structure_e for one in chosen]
    # Many flares where one blob was seen may be something wide: its whole residual counts.
    spread_e = {
        index: one.excess_e
        for index, more in parted.items()
        if (one := chosen[index]) is not None and more.count > one.count + 1
    }
    others = {index: one for index, one in enumerate(chosen) if one is not known[index]}
    kept = {index: one for index, one in halos.items() if index not in others}
    for index, one in (kept | with_halo(others, camera)).items():
        chosen[index] = one
        uneven_e[index] = one.left_over.structure_e
    uneven_e = [left_e or spread_e.get(index, 0.0) for index, left_e in enumerate(uneven_e)]
    if prepared.frame.line_time_s == 0.0:
        edged |= _several_before_edges(found, at_rest, chosen, edged, parted, prepared.shape, camera)
    _adopt(likelier_before_edges(edged, chosen, parted), chosen, parted, uneven_e)
    if prepared.frame.line_time_s == 0.0:
        highlit = _beside_highlights(found, at_rest, chosen, parted, prepared.shape, camera)
        _adopt(likelier_beside_highlights(highlit, chosen, parted), chosen, parted, uneven_e)
    chosen = against(chosen, parted)
    retry_on_uneven_ground(chosen, uneven_e, camera)
    for index, more in parted.items():
        chosen[index] = better(more, chosen[index])
    for index, pair in rivals.items():
        chosen[index] = beside_rival(chosen[index], pair)
    if prepared.frame.line_time_s == 0.0:
        for index, one_or_two in doubted(chosen, plain, camera).items():
            chosen[index] = one_or_two
    for index in cut_short:
        one = chosen[index]
        if one is not None and asks_for_more(one):
            chosen[index] = replace(one, may_be_more=True)
    return chosen


def _take_up(others: Mapping[int, Solution], parted: dict[int, Solution], shape: tuple[int, int]) -> None:
    """Hold other explanations of windows against those so far, where they explain all that is seen."""
    for index, other in others.items():
        if _explains_all(other, shape):
            parted[index] = better(other, parted.get(index))


def _take_lines(
    chosen: list[Solution | None],
    plain: Sequence[Solution | None],
    halos: dict[int, Solution],
    without_spill: Mapping[int, Solution],
    few: Mapping[int, Solution],
    camera: Camera,
) -> list[Solution | None]:
    """Choose flares that move where they explain more than flares at rest; both with their halos, if any.

    Charge that spills along columns makes a flare long, too: a motion must then explain all of it. `halos`
    are those of what is returned: of lines where these were chosen, else of `plain`.
    """
    known = list(plain)
    lines = moving(against(plain, few), camera)
    tried = {index: one for index, one in lines.items() if one.motion_px is not None and index in halos}
    of_lines = with_halo(tried, camera)
    for index, line in lines.items():
        spills = index in without_spill and without_spill[index].left_over.share < MOST_LEFT
        if index in tried:
            rival = of_lines.get(index, line)
            if halos[index].cost < rival.cost:
                halos[index] = weighed(halos[index], rival)
                continue
        if line.motion_px is None or line.left_over.is_good or not spills:
            chosen[index] = line
            if index in tried:
                known[index] = line
                if index in of_lines:
                    halos[index] = of_lines[index]
                else:
                    del halos[index]
    return known


def _drop_beside_lines(
    chosen: list[Solution | None],
    parted: dict[int, Solution],
    halos: Mapping[int, Solution],
    shape: tuple[int, int],
    camera: Camera,
    cut_short: set[int],
) -> None:
    """Hold several flares at rest against what moves: drop them, or take several that move.

    Where those that move explain all but little, more of them at rest must explain it better than the point
    spread's own width does. Where they do not, and it takes three and more at rest, if these are enough, more
    that move are tried.
    """
    lines = {index: one for index, one in enumerate(chosen) if one is not None and one.motion_px is not None}
    rivals = [index for index, one in lines.items() if index in parted and one.left_over.is_good]
    free = of_free_width([lines[index] for index in rivals], camera)
    for index, line in zip(rivals, free, strict=True):
        more = parted[index]
        if min(lines[index].cost, math.inf if line is None else line.cost) < more.cost:
            chosen[index] = weighed(lines[index], parted.pop(index))
        else:
            parted[index] = weighed(more, lines[index])
    poor: list[Solution | None] = [None] * len(chosen)
    for index, one in lines.items():
        if index not in parted or parted[index].count > one.count + 1:
            poor[index] = one
    for index, several in _parted(poor, halos, shape, camera, cut_short).items():
        if index not in parted or several.cost < parted[index].cost:
            parted[index] = several


def _several_before_edges(
    found: Sequence[Cluster],
    plain: Sequence[Solution | None],
    chosen: Sequence[Solution | None],
    edged: Mapping[int, Solution],
    parted: Mapping[int, Solution],
    shape: tuple[int, int],
    camera: Camera,
) -> dict[int, Solution]:
    """Explain by several flares before edges what nothing else explains, or only far more flares do."""
    tried: dict[int, Solution | None] = {}
    for index, (cluster, one) in enumerate(zip(found, plain, strict=True)):
        more = parted.get(index)
        by_few = None if more is None or (one is not None and more.count > one.count + 2) else more
        so_far = (edged.get(index), chosen[index], by_few)
        if cluster.is_in_crowd or not (one is None or surely_leaves_something(one)):
            continue
        if all(each is None or leaves_something(each) for each in so_far):
            tried[index] = one
    several = with_flares_and_edges(brightest_alone(tried, found, camera), camera)
    return {
        index: one
        for index, one in _beside_forward_light(several, camera).items()
        if _explains_all(one, shape) and (index not in edged or one.cost < edged[index].cost)
    }


def _beside_highlights(
    found: Sequence[Cluster],
    plain: Sequence[Solution | None],
    chosen: Sequence[Solution | None],
    parted: Mapping[int, Solution],
    shape: tuple[int, int],
    camera: Camera,
) -> dict[int, Solution]:
    """Explain by lone flares beside highlights what nothing else explains, or only several flares do.

    Not what the lone flare itself explains best, whatever rivals have widened its sigmas.
    """
    tried = {
        index: one
        for index, (cluster, one) in enumerate(zip(found, plain, strict=True))
        if one is not None and not cluster.is_in_crowd
        if (held := parted.get(index, chosen[index])) is None
        or not held.is_fit_of(one)
        or surely_leaves_something(one)
        or one.count > 1
        if seems_highlit(one, held)
    }
    highlit = with_highlights(brightest_alone(tried, found, camera), camera)
    fits = _beside_forward_light(highlit, camera)
    return {index: one for index, one in fits.items() if _explains_all(one, shape)}


def _beside_forward_light(fits: Mapping[int, Solution], camera: Camera) -> dict[int, Solution]:
    """Fit windows again beside what light fog throws forward of these flares; the others as they are."""
    some: list[Solution | None] = list(fits.values())
    fit_beside_forward_light(some, camera)
    return {index: one for index, one in zip(fits, some, strict=True) if one is not None}


def _adopt(
    likelier: Mapping[int, Solution],
    chosen: list[Solution | None],
    parted: dict[int, Solution],
    uneven_e: list[float],
) -> None:
    """Take what explains windows better, in place of one flare and of several."""
    for index, one in likelier.items():
        chosen[index], uneven_e[index] = one, one.left_over.structure_e
        parted.pop(index, None)


def _may_be_several(one: Solution | None) -> bool:
    """Tell whether what is a whole disc by its limb may be several flares: beside it, or too small to say.

    Of points half a pixel apart the limb shows two thirds of what they gain.
    """
    if one is None:
        return False
    small = float(one.image_radius_px.min()) < LEAST_RADIUS_PX
    return small or one.left_over.peak_sigmas > RESIDUAL_SIGMAS


def _parted(
    plain: Sequence[Solution | None],
    halos: Mapping[int, Solution],
    shape: tuple[int, int],
    camera: Camera,
    cut_short: set[int],
) -> dict[int, Solution]:
    """Deblend, and return by index what explains all that is seen: enough flares explain anything by half.

    Flares that would shine where a window does not look explain nothing, nor do those in the place of a lone
    source that one that is not quite round explains as well. Adds to `cut_short` where there may
    be more than were looked for.
    """
    tried = [(index, one) for index, one in enumerate(plain) if one is not None]
    beside = {at: halos[index] for at, (index, _) in enumerate(tried) if index in halos}
    more = deblend([one for _, one in tried], camera, beside)
    cut_short.update(index for (index, _), several in zip(tried, more, strict=True) if several.may_be_more)
    divided: list[Solution | None] = [
        several if several.count > one.count and not is_oval(one, several, camera) else None
        for (_, one), several in zip(tried, more, strict=True)
    ]
    # What was divided had the halo of the flares that were there before.
    fit_beside_forward_light(divided, camera)
    return {
        index: several
        for (index, _), several in zip(tried, divided, strict=True)
        if several is not None and several.most_motion_px <= MOST_MOTION_PX and _explains_all(several, shape)
    }


def _explains_all(several: Solution, shape: tuple[int, int]) -> bool:
    """Tell whether several flares explain all that is seen, each of them seen itself."""
    hardly_seen = (is_hardly_seen(several, k, shape) for k in range(several.count))
    return several.left_over.is_nothing and not any(hardly_seen)
