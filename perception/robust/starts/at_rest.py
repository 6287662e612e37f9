"""A flare at rest for each blob: what the first guesses of a frame's clusters lead to."""

from collections.abc import Sequence

from perception.model.window import Camera
from perception.robust.clusters import Cluster
from perception.robust.problem import Problem, Start
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution, solve
from perception.robust.starts.guesses import guesses, more_guesses
from perception.robust.starts.likely import likely_starts
from perception.robust.verdict import is_one_pixel


def by_blobs(found: Sequence[Cluster], prepared: PreparedFrame, camera: Camera) -> list[Solution | None]:
    """Solve clusters by a flare at rest for each blob; None where that does not converge."""
    first = guesses(found, prepared)
    chosen = _best_of(found, first, camera)
    # Of one that moves the only guess may be where no way leads on.
    lost = [
        index
        for index, (cluster, one) in enumerate(zip(found, chosen, strict=True))
        if one is None and cluster.is_clipped and len(first[index]) == 1
    ]
    again = [found[index] for index in lost]
    for index, solution in zip(lost, _best_of(again, more_guesses(again, prepared), camera), strict=True):
        chosen[index] = solution
    for index, (cluster, solution) in enumerate(zip(found, chosen, strict=True)):
        if len(cluster.members) == 1 and solution is not None and is_one_pixel(solution):
            chosen[index] = None
    return chosen


def _best_of(
    found: Sequence[Cluster], sets: Sequence[Sequence[Sequence[Start]]], camera: Camera
) -> list[Solution | None]:
    """Return the likeliest that some sets of first guesses of each cluster lead to."""
    # The same window with each of them.
    problems = likely_starts(
        [
            [Problem(cluster.window, starts, cluster.background_e) for starts in of_one]
            for cluster, of_one in zip(found, sets, strict=True)
        ],
        camera,
    )
    chosen: list[Solution | None] = [None] * len(found)
    for (index, _), solution in zip(problems, solve([p for _, p in problems], camera), strict=True):
        held = chosen[index]
        if solution is not None and (held is None or solution.deviance < held.deviance):
            chosen[index] = solution
    return chosen
