"""Several flares before straight edges: how many of both there are is found out together.

An edge that is left out looks like flares along it, and two flares that are taken for one look like an edge.
So neither are flares divided first nor edges fitted first.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from perception.model.window import Camera
from perception.robust.around.edge import (
    MOST_EDGES,
    Edge,
    leaves_something,
    likeliest_edge_of,
)
from perception.robust.around.turns import fit_in_turns
from perception.robust.clusters import Cluster
from perception.robust.overlap.deblend import (
    LEAST_GAIN,
    MOST_WINDOWS,
    asks_for_more,
    gain,
    gaining,
    with_one_more,
)
from perception.robust.overlap.rivals import weighed
from perception.robust.problem import Problem
from perception.robust.solve import Solution, solve

MOST_FLARES = 4
"""So many flares are looked for before the edges of one window at most."""


def brightest_alone(
    fits: Mapping[int, Solution | None], found: Sequence[Cluster], camera: Camera
) -> dict[int, Solution]:
    """Fit the brightest flare of each cluster alone: what else there is may be more flares, or edges.

    A fit of one flare stays as it is. Of more clusters than `MOST_WINDOWS` only the brightest are looked at.

    Returns
    -------
    By index, but for those where nothing converges.
    """
    if len(fits) > MOST_WINDOWS:
        by_flux = sorted(fits, key=lambda index: -max(member.flux_e for member in found[index].members))
        fits = {index: fits[index] for index in sorted(by_flux[:MOST_WINDOWS])}
    alone = {index: one for index, one in fits.items() if one is not None}
    tried, problems = [], []
    for index, one in fits.items():
        members = found[index].members
        if one is None and len(members) > 1:
            brightest = max(members, key=lambda member: member.flux_e)
            start = brightest.u_px, brightest.v_px, brightest.log_range(max(brightest.flux_e, 1.0))
            problems.append(Problem(found[index].window, [start], found[index].background_e))
        elif one is not None and one.count > 1:
            start = one.starts[int(np.argmax(one.flux_e))]
            problems.append(Problem(one.window, [start], one.background_e))
        else:
            continue
        tried.append(index)
    solved = zip(tried, solve(problems, camera), strict=True)
    return alone | {index: one for index, one in solved if one is not None}


def with_flares_and_edges(flares: Mapping[int, Solution], camera: Camera) -> dict[int, Solution]:
    """Explain windows by several flares before edges: what neither more flares nor edges alone explain.

    One after another is added, a flare or an edge, whichever makes what is seen likelier.

    Parameters
    ----------
    flares, camera
        What explains windows so far, without edges, and the frame's camera.

    Returns
    -------
    By index those in which nothing is left to explain, and that have an edge.
    """
    now: dict[int, tuple[Solution, list[Edge]]] = {index: (one, []) for index, one in flares.items()}
    going, done = list(flares), {}
    while going:
        likelier = _with_one_flare_more({index: now[index][0] for index in going}, camera)
        tried: dict[int, list[Edge]] = {}
        for index in going:
            one, edges = now[index]
            if len(edges) < MOST_EDGES and (edge := likeliest_edge_of(one)) is not None:
                tried[index] = [*edges, edge]
        fits = fit_in_turns(tried, {index: now[index][0] for index in tried}, flares, camera)
        moved: dict[int, list[Edge]] = {}
        for index, more in likelier.items():
            if index not in fits or more.deviance < fits[index][0].deviance:
                fits[index] = more, now[index][1]
                if now[index][1]:
                    moved[index] = now[index][1]
        beside_edges = {index: fits[index][0] for index in moved}
        for index, again in fit_in_turns(moved, beside_edges, flares, camera).items():
            if again[0].deviance < fits[index][0].deviance:
                fits[index] = again
        going = []
        for index, (one, edges) in fits.items():
            if gain(now[index][0], one) < LEAST_GAIN:
                continue
            now[index] = one, edges
            if leaves_something(one):
                going.append(index)
            elif edges:
                done[index] = one
    return done


def _with_one_flare_more(found: Mapping[int, Solution], camera: Camera) -> dict[int, Solution]:
    """Return by index what one flare more explains better, than one of another width or size, too."""
    trials = [
        (index, starts)
        for index, one in found.items()
        if one.count < MOST_FLARES and asks_for_more(one)
        for starts in with_one_more(one)
        if len(starts) == one.count + 1
    ]
    return gaining(trials, found, dict(found), camera)


def likelier_before_edges(
    edged: Mapping[int, Solution], chosen: Sequence[Solution | None], parted: Mapping[int, Solution]
) -> dict[int, Solution]:
    """Return by index flares before edges where these explain all, and better than what did so far."""
    likelier = {}
    for index, one in edged.items():
        held = parted.get(index, chosen[index])
        if one.left_over.is_nothing and (held is None or one.cost < held.cost):
            likelier[index] = one if held is None else weighed(one, held)
    return likelier
