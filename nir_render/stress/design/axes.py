"""The axes of a campaign: what is changed in the scene, and through which values."""

import bisect
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import yaml
from pydantic import Field, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document, KeyProblem
from nir_render.scene.text.units import Reading, read_quantity, short_number
from nir_render.stress.design.draws import Distribution, drawn_units

MOST_VALUES = 1000
_PARTS_SHOWN = 8

DottedPath = Annotated[str, Field(max_length=200)]
Label = Annotated[str, Field(max_length=100)]


@dataclass(frozen=True)
class Refinement:
    """How near neighbours are brought where a bound is crossed.

    `step` is in the axis's unit, or, `by_ratio`, how much larger the one may be than the other, as a share.
    """

    step: float
    by_ratio: bool

    def is_kept(self, low: float, high: float) -> bool:
        """Tell whether two neighbours are near enough; a millionth of the step is for their last digits."""
        distance = high / low - 1.0 if self.by_ratio else high - low
        return distance <= self.step * (1.0 + 1e-6)


@dataclass(frozen=True)
class Axis:
    """One axis of a campaign.

    Attributes
    ----------
    name
        What the table's column is called after.
    title
        What to write beside it.
    paths
        The dotted paths that get its value.
    values
        What is set there, as a scene file would hold it, shape (n,).
    labels
        How each value is called, shape (n,).
    unit
        The unit that the values are written in; "" for plain numbers and for what is no number.
    numbers
        The values in that unit, shape (n,), increasing or decreasing; None where they are no numbers.
    values_si
        The same in SI units, which stand in the table.
    log
        Whether neighbours differ by ratios rather than by steps.
    units
        Of an axis that draws: what each unit sets, by dotted path, shape (n,); else None.
    edges
        Of a range that is drawn from: the ends of the parts that are shown as its values, increasing, in its
        unit, shape (n + 1,); else None.
    edges_si
        The same in SI units.
    added
        Which values were put between those written, to find a limit more exactly, shape (n,); empty where
        none was. They are run with the written values of the other axes alone.
    refinement
        How exactly limits along it are wanted; None where the values stay those written.
    """

    name: str
    title: str
    paths: tuple[str, ...]
    values: tuple[Any, ...]
    labels: tuple[str, ...]
    unit: str = ""
    numbers: tuple[float, ...] | None = None
    values_si: tuple[float, ...] | None = None
    log: bool = False
    units: tuple[Mapping[str, Any], ...] | None = None
    edges: tuple[float, ...] | None = None
    edges_si: tuple[float, ...] | None = None
    added: tuple[bool, ...] = ()
    refinement: Refinement | None = None

    def written(self) -> tuple[int, ...]:
        """Return the indices of the values that were written, not added."""
        return tuple(i for i in range(len(self.labels)) if not self.added or not self.added[i])

    def part_of(self, value_si: float) -> int:
        """Return in which part of a range that is drawn from a value lies, as index into its values."""
        return min(max(bisect.bisect_right(self.edges_si or (), value_si) - 1, 0), len(self.labels) - 1)

    def label_of(self, written: float | str) -> str:
        """Return how a value of the table is called: where a range is drawn from, by its own number."""
        if self.edges is None or isinstance(written, str):
            values = self.labels if self.values_si is None else self.values_si
            return self.labels[values.index(written)]
        unit = read_quantity(f"1 {self.unit}" if self.unit else 1)
        assert unit is not None  # it was read before
        return f"{written / unit.value_si:.6g} {self.unit}".rstrip()

    def settings(self, index: int) -> dict[str, Any]:
        """Return what the value of this index sets, by dotted path."""
        if self.units is not None:
            return dict(self.units[index])
        return dict.fromkeys(self.paths, self.values[index])


class AxisDocument(Document):
    """An axis as written: a list of values, a range `from` … `to` of `count` values, or units that are drawn.

    `path` is the dotted path, or several that get the same value; without it the axis's name is the path.
    `labels` name the values, one for each. `refine` says how exactly limits along the axis are wanted, as a
    step in its unit or as a share of the value (2 %): values are added where a bound is crossed. `draw` holds
    distributions by dotted path; each of `count` units draws all of them, keyed by `seed`. In a campaign of
    samples a range is drawn from evenly, and `count` is in how many parts its page shows it.
    """

    example: ClassVar[str] = "{path: robots.r2.position.x, from: 1 m, to: 6 m, count: 6}"

    path: DottedPath | Annotated[tuple[DottedPath, ...], Field(min_length=1)] | None = None
    title: Label | None = None
    values: Annotated[tuple[Any, ...], Field(min_length=1, max_length=MOST_VALUES)] | None = None
    labels: tuple[Label, ...] | None = None
    start: Annotated[Any, Field(alias="from")] = None
    to: Any = None
    count: Annotated[int, Field(ge=2, le=MOST_VALUES)] | None = None
    spacing: Literal["linear", "log"] = "linear"
    refine: Any = None
    draw: Annotated[dict[DottedPath, Distribution], Field(min_length=1)] | None = None
    seed: Annotated[int, Field(ge=0)] = 1

    read_keys: ClassVar[tuple[str, ...]] = ("from",)

    @classmethod
    def key_problems(cls, data: Any) -> list[KeyProblem]:
        """Look at the keys alone: values of an axis may be anything that a scene file holds."""
        return super().key_problems(dict.fromkeys(data) if isinstance(data, Mapping) else data)

    @model_validator(mode="before")
    @classmethod
    def _a_list_is_its_values(cls, data: Any) -> Any:
        return {"values": data} if isinstance(data, list) else data

    @model_validator(mode="after")
    def _list_or_range(self) -> Self:
        if self.draw is not None:
            return self._drawn()
        of_range = (self.start, self.to, self.count)
        if (self.values is None) == all(part is None for part in of_range):
            raise ValueError(f"write either 'values' or 'from', 'to' and 'count', such as {self.example}")
        if self.values is None and (self.start is None or self.to is None):
            raise ValueError(f"a range needs 'from', 'to' and 'count', such as {self.example}")
        if self.labels is not None and (self.values is None or len(self.labels) != len(self.values)):
            raise ValueError("'labels' names each of the 'values': wanted as many of them")
        if self.labels is not None and len(set(self.labels)) != len(self.labels):
            raise ValueError("two of the 'labels' are the same: give each value its own")
        return self

    def _drawn(self) -> Self:
        others = {"path": self.path, "values": self.values, "from": self.start, "to": self.to}
        others["refine"] = self.refine
        written = [key for key, value in {**others, "labels": self.labels}.items() if value is not None]
        if written or self.count is None:
            wrong = f"{written[0]!r} has no place there" if written else "'count' is missing"
            raise ValueError(
                f"'draw' stands with 'count' (how many units) and 'seed' alone, {wrong}; write it such as "
                "{draw: {robots.r2.rig.sources.top.flux: {mean: 0.2 W, sigma: 0.02 W}}, count: 12}"
            )
        return self

    def axis(self, name: str) -> Axis:
        """Return the axis.

        Raises
        ------
        ValueError
            A range whose ends are no numbers of one unit, or the same; a value that stands twice.
        """
        if self.draw is not None:
            units = drawn_units(self.draw, name, self.seed, self.count or 1)
            labels = tuple(f"{name} {number}" for number in range(1, len(units) + 1))
            return Axis(name, self.title or name, tuple(self.draw), units, labels, units=units)
        paths = self.path if isinstance(self.path, tuple) else (self.path or name,)
        if self.values is None and self.count is None:
            raise ValueError(f"a range needs 'from', 'to' and 'count', such as {self.example}")
        values = self._range() if self.values is None else self.values
        read = [read_quantity(value) for value in values]
        title = self.title or (name if self.path is not None else name.rpartition(".")[2].replace("_", " "))
        readings = [reading for reading in read if reading is not None]
        if self.labels is not None or None in read or len({reading.quantity for reading in readings}) > 1:
            labels = self.labels or tuple(_label(value) for value in values)
            _refuse_repeats(labels)
            if self.refine is not None:
                raise ValueError("'refine' puts values between numbers: there is nothing between labels")
            return Axis(name, title, paths, values, labels)
        unit = readings[0].unit
        si = tuple(reading.value_si for reading in readings)
        numbers = tuple(_in_unit(reading, readings[0]) for reading in readings)
        _refuse_repeats(si)
        order = sorted(range(len(si)), key=si.__getitem__)
        numbers = tuple(numbers[i] for i in order)
        return Axis(
            name,
            title,
            paths,
            tuple(values[i] for i in order),
            _number_labels(numbers, unit),
            unit,
            numbers,
            tuple(si[i] for i in order),
            self._spaced_by_ratios(sorted(si)),
            refinement=None if self.refine is None else self._refinement(readings[0], min(si)),
        )

    def _refinement(self, like: Reading, least_si: float) -> Refinement:
        """Return how near neighbours are brought: "%" is a share of the value, but on an axis in %."""
        step = read_quantity(self.refine)
        wanted = f"wanted a step, such as {_like(like, 0.1)}"
        wanted += "" if like.unit == "%" else ", or a share of the value, such as 2 %"
        if step is None or not step.value_si > 0.0:
            raise ValueError(f"'refine' is {shown(self.refine)}; {wanted}")
        by_ratio = step.unit == "%" and like.unit != "%"
        if not by_ratio and not step.unit and like.unit:
            raise ValueError(f"'refine' is {shown(self.refine)}, without a unit; {wanted}")
        if not by_ratio and step.quantity is not like.quantity:
            raise ValueError(f"'refine' is {shown(self.refine)}, a {step.quantity.name}; {wanted}")
        if by_ratio and least_si <= 0.0:
            raise ValueError(f"'refine' is a share, {self.refine}, of values down to 0 or less; write a step")
        return Refinement(step.value_si if by_ratio else _in_unit(step, like), by_ratio)

    def _spaced_by_ratios(self, si: list[float]) -> bool:
        if self.values is None:
            return self.spacing == "log"
        if len(si) < 3 or si[0] <= 0.0:
            return False
        steps = [later - earlier for earlier, later in itertools.pairwise(si)]
        ratios = [math.log(later / earlier) for earlier, later in itertools.pairwise(si)]
        return max(ratios) / min(ratios) < max(steps) / min(steps)

    def sampled(self, name: str) -> Axis:
        """Return the axis for a campaign of samples: of a range the parts that are shown, each a value.

        Raises
        ------
        ValueError
            As `axis`; and `refine`, which asks for values at places of its own.
        """
        if self.refine is not None:
            raise ValueError("'refine' puts values into a grid; a campaign of samples has none: leave it out")
        if self.draw is not None or self.values is not None:
            return self.axis(name)
        parts, by_ratio = self.count or _PARTS_SHOWN, self.spacing == "log"
        first, begin, end = self._ends()
        edges = sorted(between(begin, end, part / parts, by_ratio) for part in range(parts + 1))
        pairs = list(itertools.pairwise(edges))
        middles = tuple(written_value(between(low, high, 0.5, by_ratio), first.unit) for low, high in pairs)
        shown = self.model_copy(update={"values": middles}).axis(name)
        readings = [read_quantity(written_value(edge, first.unit)) for edge in edges]
        return replace(
            shown,
            labels=tuple(f"{short_number(a)} to {short_number(b)} {first.unit}".rstrip() for a, b in pairs),
            log=by_ratio,
            edges=tuple(edges),
            edges_si=tuple(reading.value_si for reading in readings if reading is not None),
        )

    def _ends(self) -> tuple[Reading, float, float]:
        """Return the first end of a range, and both in its unit."""
        first, last = read_quantity(self.start), read_quantity(self.to)
        if first is None or last is None:
            wrong = self.start if first is None else self.to
            raise ValueError(f"{shown(wrong)} is no number with a unit; a range goes such as {self.example}")
        if first.quantity is not last.quantity:
            raise ValueError(
                f"{shown(self.start)} and {shown(self.to)} are a {first.quantity.name} and a "
                f"{last.quantity.name}; wanted two of one kind"
            )
        begin, end = first.number, _in_unit(last, first)
        if begin == end:
            raise ValueError("'from' and 'to' are the same; write two ends")
        if self.spacing == "log" and min(begin, end) <= 0.0:
            raise ValueError("a log range needs 'from' and 'to' above 0: give such")
        return first, begin, end

    def _range(self) -> tuple[Any, ...]:
        first, begin, end = self._ends()
        count = self.count or 2
        shares = [step / (count - 1) for step in range(count)]
        rounded = [between(begin, end, share, self.spacing == "log") for share in shares]
        whole = isinstance(self.start, int) and isinstance(self.to, int)
        if whole and all(one.is_integer() for one in rounded):
            return tuple(int(one) for one in rounded)
        return tuple(written_value(one, first.unit) for one in rounded)


def between(begin: float, end: float, share: float, log: bool) -> float:
    """Return what lies at a share of the way; in twelve digits, as 0.1 + 2 · 0.1 is to be 0.3."""
    number = begin * (end / begin) ** share if log else begin + (end - begin) * share
    return float(f"{number:.12g}")


def written_value(number: float, unit: str) -> str | float:
    """Return a number as a scene file holds it, with its unit."""
    return f"{number:.12g} {unit}" if unit else number


def with_values(axis: Axis, added: Sequence[float]) -> Axis:
    """Return an axis of numbers with more values, in its unit; they are marked as added.

    Raises
    ------
    ValueError
        It is no axis of numbers, or has one of them already.
    """
    if axis.numbers is None or axis.values_si is None:
        raise ValueError(f"the axis {axis.name!r} is not one of numbers")
    whole = all(isinstance(value, int) for value in axis.values)
    values: list[Any] = [*axis.values]
    si = [*axis.values_si]
    for number in added:
        value = round(number) if whole and not axis.unit else written_value(number, axis.unit)
        reading = read_quantity(value)
        assert reading is not None  # a number, and a unit that was read before
        values.append(value)
        si.append(reading.value_si)
    _refuse_repeats(tuple(si))
    flags = [*(axis.added or (False,) * len(axis.values)), *(True for _ in added)]
    order = sorted(range(len(si)), key=si.__getitem__)
    numbers = [*axis.numbers, *(float(value) for value in added)]
    numbers = [numbers[i] for i in order]
    return replace(
        axis,
        values=tuple(values[i] for i in order),
        labels=_number_labels(numbers, axis.unit),
        numbers=tuple(numbers),
        values_si=tuple(si[i] for i in order),
        added=tuple(flags[i] for i in order),
    )


def without_added(axis: Axis) -> Axis:
    """Return an axis with the values that were written alone."""
    if not any(axis.added):
        return axis
    kept = axis.written()
    assert axis.numbers is not None
    assert axis.values_si is not None
    numbers = tuple(axis.numbers[i] for i in kept)
    return replace(
        axis,
        values=tuple(axis.values[i] for i in kept),
        labels=_number_labels(numbers, axis.unit),
        numbers=numbers,
        values_si=tuple(axis.values_si[i] for i in kept),
        added=(),
    )


def _number_labels(numbers: Sequence[float], unit: str) -> tuple[str, ...]:
    """Return how numbers are called: four digits where these tell them apart, else all."""
    labels = tuple(f"{short_number(number)} {unit}".rstrip() for number in numbers)
    if len(set(labels)) != len(labels):
        labels = tuple(f"{number!r} {unit}".rstrip() for number in numbers)
    return labels


def _like(reading: Reading, number: float) -> str:
    return f"{number:g} {reading.unit}".rstrip()


def _in_unit(reading: Reading, like: Reading) -> float:
    """Return a number in the unit of another; in its own it keeps its digits."""
    if reading.unit == like.unit:
        return reading.number
    unit = read_quantity(f"1 {like.unit}")
    assert unit is not None  # it was read before
    return float(f"{reading.value_si / unit.value_si:.12g}")


def _refuse_repeats(values: tuple[Any, ...]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise ValueError(f"the value {shown(value)} stands twice; take one of them out")


def _label(value: Any) -> str:
    if isinstance(value, str):
        return value
    return str(yaml.safe_dump(value, default_flow_style=True, width=1000)).removesuffix("...\n").strip()
