"""Who is around an observer, set by set: sources and mirror images, and which of them count.

A source counts while it is countable (`match`) and through gaps of up to a second: it was dark, or hidden.
One that was gone for longer counts as a new one when it comes back, as no track can know better.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.match import countable
from nir_render.evaluate.sets import SAME_PLACE_M, position_body_m
from nir_render.evaluate.track_errors import TrueWays
from nir_render.truth.sources import SourceTruth
from perception.types import Calibration, FrameKey

Values = NDArray[np.float64]

LONGEST_GAP_S = 1.0
"""A source that does not count for longer is a new one afterwards."""

_SLACK_S = 1e-6  # what sums of times may be off

_COASTING_S = 2.0
"""So long after a source was last in an image tracks of it are no false alarms."""

_SAME_IMAGE_M = 0.5
"""From set to set a mirror image goes no further; what is further off is the image in another mirror."""

SourceName = tuple[str, str, str | None]
"""Robot, source, and `robot.source` of whom a mirror image shows."""

TimedSet = tuple[str, float, Sequence[FrameKey]]
"""Of a set of frames the observer, its time (that of its tracks) and its frames."""


@dataclass(frozen=True, eq=False)
class Present:
    """One source, or mirror image, at one instant.

    `life` numbers its appearances: it is None where it does not count; `lit` is its share of the exposure.
    """

    name: SourceName
    position_body_m: Values
    life: int | None
    lit: float


@dataclass
class _Row:
    """A source, or one of its mirror images, in the frames of one set."""

    places_m: list[Values]
    counts: bool
    lit: float

    @property
    def place_m(self) -> Values:
        return np.asarray(np.mean(self.places_m, axis=0))


def present_in(
    sets: Sequence[TimedSet],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    ways: TrueWays,
    taken_s: Mapping[FrameKey, float],
) -> list[tuple[Present, ...]]:
    """Return who is there in each set, with the numbers of their lives; each mirror shows its own image.

    Sources stand where they are at the set's time, as tracks do, not when its frames were taken: by `ways`.
    """
    of_frame = {key: number for number, (_, _, keys) in enumerate(sets) for key in keys}
    seen = list(truth)
    rows: dict[tuple[str, SourceName], dict[int, list[_Row]]] = defaultdict(lambda: defaultdict(list))
    set_of = [sets[of_frame[row.camera, row.index]] for row in seen]
    places_m = np.array([position_body_m(row, calibrations[row.camera]) for row in seen]).reshape(-1, 3)
    for row, place_m in zip(seen, _at_set_m(places_m, seen, set_of, ways, taken_s), strict=True):
        number = of_frame[row.camera, row.index]
        name = (row.robot, row.source, row.ghost_of)
        own = _row_at(rows[sets[number][0], name][number], place_m, one_alone=row.ghost_of is None)
        own.places_m.append(place_m)
        own.counts |= countable(row, calibrations[row.camera])
        own.lit = max(own.lit, row.on_fraction)
    times_s: dict[str, dict[int, float]] = defaultdict(dict)
    for number in sorted(range(len(sets)), key=lambda each: sets[each][1]):
        times_s[sets[number][0]][number] = sets[number][1]
    present: list[list[Present]] = [[] for _ in sets]
    for (robot, name), by_set in rows.items():
        own_images = (
            [{number: of_set[0] for number, of_set in by_set.items()}]
            if name[2] is None
            else _images(by_set, times_s[robot])
        )
        for image in own_images:
            for number, one in _lives(name, image, times_s[robot]):
                present[number].append(one)
    return [tuple(there) for there in present]


def _at_set_m(
    place_m: Values,
    truth: Sequence[SourceTruth],
    set_of: Sequence[TimedSet],
    ways: TrueWays,
    taken_s: Mapping[FrameKey, float],
) -> Values:
    """Return where sources are at the times of their sets, in body axes, shape (n, 3); images as seen."""
    known = [k for k, row in enumerate(truth) if row.ghost_of is None and (row.camera, row.index) in taken_s]
    at_set_m = place_m.copy()
    at_set_m[known] = ways.carried_m(
        place_m[known],
        [truth[k].robot for k in known],
        [set_of[k][0] for k in known],
        np.array([taken_s[truth[k].camera, truth[k].index] for k in known]),
        np.array([set_of[k][1] for k in known]),
    )
    return at_set_m


def _row_at(rows: list[_Row], place_m: Values, *, one_alone: bool) -> _Row:
    """Return the row of a place, a new one where there is none yet; a source itself is at one place."""
    for row in rows:
        if one_alone or float(np.linalg.norm(row.places_m[0] - place_m)) < SAME_PLACE_M:
            return row
    rows.append(_Row([], counts=False, lit=0.0))
    return rows[-1]


def _images(by_set: Mapping[int, Sequence[_Row]], times_s: Mapping[int, float]) -> list[dict[int, _Row]]:
    """Tell the images of one source in several mirrors apart: each goes on from where it was last."""
    images: list[dict[int, _Row]] = []
    last: list[tuple[float, Values]] = []
    for number in (each for each in times_s if each in by_set):
        free = [k for k, (time_s, _) in enumerate(last) if times_s[number] - time_s <= _COASTING_S]
        for row in by_set[number]:
            apart_m = {k: float(np.linalg.norm(row.place_m - last[k][1])) for k in free}
            nearest = min(apart_m, key=apart_m.__getitem__, default=-1)
            if nearest < 0 or apart_m[nearest] > _SAME_IMAGE_M:
                nearest = len(images)
                images.append({})
                last.append((times_s[number], row.place_m))
            else:
                free.remove(nearest)
            images[nearest][number] = row
            last[nearest] = (times_s[number], row.place_m)
    return images


def _lives(
    name: SourceName, rows: Mapping[int, _Row], times_s: Mapping[int, float]
) -> Iterator[tuple[int, Present]]:
    """Yield a source in the sets of its observer, in order of time: in images, and for a while afterwards."""
    order = list(times_s)
    counting = [k for k, number in enumerate(order) if number in rows and rows[number].counts]
    life_of: dict[int, int] = {}
    life = 0
    for before, k in zip([None, *counting], counting, strict=False):
        if before is not None:
            if times_s[order[k]] - times_s[order[before]] > LONGEST_GAP_S + _SLACK_S:
                life += 1
            else:
                life_of |= dict.fromkeys(order[before + 1 : k], life)
        life_of[order[k]] = life
    last: list[tuple[float, Values]] = []
    for number, time_s in times_s.items():
        if number in rows:
            place_m = rows[number].place_m
            last = [*last[-1:], (time_s, place_m)]
            yield number, Present(name, place_m, life_of.get(number), rows[number].lit)
        elif last and time_s - last[-1][0] <= _COASTING_S:
            (first_s, first_m), (then_s, then_m) = last[0], last[-1]
            pace = (then_m - first_m) / (then_s - first_s) if then_s > first_s else np.zeros(3)
            yield number, Present(name, then_m + pace * (time_s - then_s), None, 0.0)
