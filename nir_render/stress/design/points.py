"""The points of a campaign: all combinations of its axes' values, or samples of the space that they span."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.stats import qmc

from nir_render.randomness import generator
from nir_render.scene.documents.base import Document
from nir_render.scene.text.units import read_quantity
from nir_render.stress.design.axes import Axis, between, written_value

_MOST_POINTS = 100_000


class SampleDocument(Document):
    """Samples of the space of all axes, instead of all combinations: `count` points, keyed by `seed`.

    Sobol points (scrambled) cover it most evenly, and come in powers of two; a Latin hypercube has one point
    in each of `count` parts of each axis; `random` ones are independent.
    """

    example: ClassVar[str] = "{design: sobol, count: 128}"

    design: Literal["sobol", "latin_hypercube", "random"] = "sobol"
    count: Annotated[int, Field(ge=2, le=_MOST_POINTS)]
    seed: Annotated[int, Field(ge=0)] = 1

    @model_validator(mode="after")
    def _sobol_in_powers_of_two(self) -> Self:
        if self.design == "sobol" and self.count & (self.count - 1):
            below = 2 ** int(math.log2(self.count))
            raise ValueError(
                f"'count' is {self.count}; Sobol points cover a space evenly in powers of two: take {below} "
                f"or {2 * below}, or 'design: latin_hypercube', which takes any count"
            )
        return self

    def shares(self, axes: int) -> NDArray[np.float64]:
        """Return the points in the unit cube, shape (count, axes), each number from 0 up to but not 1."""
        rng = generator(self.seed, f"stress/sample/{self.design}", "", axes)
        if self.design == "random":
            return rng.random((self.count, axes))
        seed = int(rng.integers(2**63))  # scipy spawns generators of its own, from a seed alone
        if self.design == "sobol":
            points = qmc.Sobol(axes, scramble=True, rng=seed).random_base2(int(math.log2(self.count)))
        else:
            points = qmc.LatinHypercube(axes, rng=seed).random(self.count)
        return np.asarray(points, dtype=np.float64)


@dataclass(frozen=True)
class Point:
    """One point of a campaign: what is set in the scene there.

    Attributes
    ----------
    values
        Index into each axis's values, or into the parts of a range that is drawn from, shape (axes,).
    settings
        What is set, by dotted path.
    written
        What the table holds for each axis: a number in SI units, or a label, shape (axes,).
    labels
        How each value is called, shape (axes,).
    """

    values: tuple[int, ...]
    settings: dict[str, Any]
    written: tuple[float | str, ...]
    labels: tuple[str, ...]


def points_of(axes: Sequence[Axis], sample: SampleDocument | None) -> Iterator[Point]:
    """Yield the points of a campaign, in the order of its axes or of its samples.

    Values that were added to one axis are combined with the values written of all others.
    """
    if sample is not None:
        for shares in sample.shares(len(axes)):
            yield _joined([_at_share(axis, float(share)) for axis, share in zip(axes, shares, strict=True)])
        return
    yield from points_at(axes, combinations_of(axes))


def points_at(axes: Sequence[Axis], combinations: Iterable[Sequence[int]]) -> Iterator[Point]:
    """Yield the points at combinations of values, each an index into every axis's values."""
    for values in combinations:
        yield _joined([_at_index(axis, index) for axis, index in zip(axes, values, strict=True)])


def number_of_points(axes: Sequence[Axis], sample: SampleDocument | None) -> int:
    """Return how many points `points_of` yields."""
    if sample is not None:
        return sample.count
    written = [len(axis.written()) for axis in axes]
    whole = math.prod(written)
    added = (len(axis.labels) - own for axis, own in zip(axes, written, strict=True))
    return whole + sum(more * whole // own for more, own in zip(added, written, strict=True))


def combinations_of(axes: Sequence[Axis]) -> list[tuple[int, ...]]:
    """Return the combinations of values that are run, as indices into each axis's values, in order."""
    written = [axis.written() for axis in axes]
    chosen = set(itertools.product(*written))
    for index, axis in enumerate(axes):
        added = tuple(sorted(set(range(len(axis.labels))) - set(written[index])))
        chosen.update(itertools.product(*written[:index], added, *written[index + 1 :]))
    return sorted(chosen)


def _joined(settings: Sequence[Point]) -> Point:
    """Return a point of all axes from one of each."""
    return Point(
        tuple(index for one in settings for index in one.values),
        {path: value for one in settings for path, value in one.settings.items()},
        tuple(value for one in settings for value in one.written),
        tuple(label for one in settings for label in one.labels),
    )


def _at_index(axis: Axis, index: int) -> Point:
    written = axis.labels[index] if axis.values_si is None else axis.values_si[index]
    return Point((index,), axis.settings(index), (written,), (axis.labels[index],))


def _at_share(axis: Axis, share: float) -> Point:
    if axis.edges is None:
        return _at_index(axis, min(int(share * len(axis.labels)), len(axis.labels) - 1))
    number = between(axis.edges[0], axis.edges[-1], share, axis.log)
    value = written_value(number, axis.unit)
    reading = read_quantity(value)
    assert reading is not None  # a number, and a unit that was read before
    label = f"{number:.6g} {axis.unit}".rstrip()
    part = axis.part_of(reading.value_si)
    return Point((part,), dict.fromkeys(axis.paths, value), (reading.value_si,), (label,))
