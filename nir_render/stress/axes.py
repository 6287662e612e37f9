"""The axes of a campaign: what is changed in the scene, and through which values."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import yaml
from pydantic import Field, model_validator

from nir_render.errors import shown
from nir_render.randomness import generator
from nir_render.scene.documents.base import Document, KeyProblem
from nir_render.scene.text.units import Reading, read_quantity

MOST_VALUES = 1000
_MOST_DRAWS = 1000

DottedPath = Annotated[str, Field(max_length=200)]
Label = Annotated[str, Field(max_length=100)]


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

    def settings(self, index: int) -> dict[str, Any]:
        """Return what the value of this index sets, by dotted path."""
        if self.units is not None:
            return dict(self.units[index])
        return dict.fromkeys(self.paths, self.values[index])


class Distribution(Document):
    """How a value spreads over units: normal about `mean` with `sigma`, or uniform from `least` to `most`.

    A normal one with `least` or `most` is cut off there: units beyond are sorted out, as bins do.
    """

    example: ClassVar[str] = "{mean: 940 nm, sigma: 4 nm, least: 920 nm, most: 960 nm}"

    mean: Any = None
    sigma: Any = None
    least: Any = None
    most: Any = None

    @model_validator(mode="after")
    def _normal_or_uniform(self) -> Self:
        if (self.mean is None) != (self.sigma is None) or (
            self.mean is None and (self.least is None or self.most is None)
        ):
            raise ValueError(
                "wanted 'mean' and 'sigma', or 'least' and 'most' alone (all values between alike), such as "
                f"{self.example}"
            )
        return self

    def value(self, rng: np.random.Generator) -> str | float:
        """Return a drawn value, as a scene file holds it.

        Raises
        ------
        ValueError
            A figure is no number, they are not of one kind, or hardly a unit lies within the bounds.
        """
        like, (mean, sigma, least, most) = self._numbers()
        if mean is None or sigma is None:
            assert least is not None
            assert most is not None
            if not least < most:
                raise ValueError(f"'least', {self.least}, is not below 'most', {self.most}")
            number = rng.uniform(least, most)
        else:
            if not sigma > 0.0:
                raise ValueError(f"'sigma' is {shown(self.sigma)}; wanted one above 0")
            low, high = -np.inf if least is None else least, np.inf if most is None else most
            drawn = rng.normal(mean, sigma, _MOST_DRAWS)
            within = drawn[(drawn >= low) & (drawn <= high)]
            if not within.size:
                raise ValueError(
                    f"not one unit in {_MOST_DRAWS} lies from {shown(self.least)} to {shown(self.most)}; "
                    "check them"
                )
            number = within[0]
        rounded = float(f"{number:.12g}")
        return f"{rounded!r} {like.unit}" if like.unit else rounded

    def _numbers(self) -> tuple[Reading, list[float | None]]:
        """Return a figure whose unit is taken, and all in that unit."""
        written = [self.mean, self.sigma, self.least, self.most]
        readings = [None if one is None else read_quantity(one) for one in written]
        for one, reading in zip(written, readings, strict=True):
            if one is not None and reading is None:
                raise ValueError(f"{shown(one)} is no number with a unit; write such as {self.example}")
        known = [reading for reading in readings if reading is not None]
        like = known[0]
        if any(reading.quantity is not like.quantity for reading in known):
            raise ValueError(
                f"wanted figures of one kind, not {' and '.join(r.quantity.name for r in known)}"
            )
        unit = read_quantity(f"1 {like.unit}".rstrip())
        assert unit is not None  # it was read before
        return like, [None if reading is None else reading.value_si / unit.value_si for reading in readings]


class AxisDocument(Document):
    """An axis as written: a list of values, a range `from` … `to` of `count` values, or units that are drawn.

    `path` is the dotted path, or several that get the same value; without it the axis's name is the path.
    `labels` name the values, one for each. `draw` holds distributions by dotted path; each of `count` units
    draws all of them, keyed by `seed`.
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
        if self.values is None and any(part is None for part in of_range):
            raise ValueError(f"a range needs 'from', 'to' and 'count', such as {self.example}")
        if self.labels is not None and (self.values is None or len(self.labels) != len(self.values)):
            raise ValueError("'labels' names each of the 'values': wanted as many of them")
        if self.labels is not None and len(set(self.labels)) != len(self.labels):
            raise ValueError("two of the 'labels' are the same")
        return self

    def _drawn(self) -> Self:
        others = {"path": self.path, "values": self.values, "from": self.start, "to": self.to}
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
            units = _drawn_units(self.draw, name, self.seed, self.count or 1)
            labels = tuple(f"{name} {number}" for number in range(1, len(units) + 1))
            return Axis(name, self.title or name, tuple(self.draw), units, labels, units=units)
        paths = self.path if isinstance(self.path, tuple) else (self.path or name,)
        values = self._range() if self.values is None else self.values
        read = [read_quantity(value) for value in values]
        title = self.title or (name if self.path is not None else name.rpartition(".")[2].replace("_", " "))
        readings = [reading for reading in read if reading is not None]
        if self.labels is not None or None in read or len({reading.quantity for reading in readings}) > 1:
            labels = self.labels or tuple(_label(value) for value in values)
            _refuse_repeats(labels)
            return Axis(name, title, paths, values, labels)
        unit = readings[0].unit
        si = tuple(reading.value_si for reading in readings)
        numbers = tuple(_in_unit(reading, readings[0]) for reading in readings)
        labels = tuple(f"{number:.4g} {unit}".rstrip() for number in numbers)
        _refuse_repeats(si)
        if len(set(labels)) != len(labels):
            labels = tuple(f"{number!r} {unit}".rstrip() for number in numbers)
        order = sorted(range(len(si)), key=si.__getitem__)
        return Axis(
            name,
            title,
            paths,
            tuple(values[i] for i in order),
            tuple(labels[i] for i in order),
            unit,
            tuple(numbers[i] for i in order),
            tuple(si[i] for i in order),
            self._spaced_by_ratios(sorted(si)),
        )

    def _spaced_by_ratios(self, si: list[float]) -> bool:
        if self.values is None:
            return self.spacing == "log"
        if len(si) < 3 or si[0] <= 0.0:
            return False
        steps = [later - earlier for earlier, later in itertools.pairwise(si)]
        ratios = [math.log(later / earlier) for earlier, later in itertools.pairwise(si)]
        return max(ratios) / min(ratios) < max(steps) / min(steps)

    def _range(self) -> tuple[Any, ...]:
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
        count = self.count or 2
        if self.spacing == "log" and min(begin, end) <= 0.0:
            raise ValueError("a log range needs 'from' and 'to' above 0")
        shares = [step / (count - 1) for step in range(count)]
        if self.spacing == "log":
            numbers = [begin * (end / begin) ** share for share in shares]
        else:
            numbers = [begin + (end - begin) * share for share in shares]
        # Twelve digits: 0.1 + 2 · 0.1 is to be 0.3.
        rounded = [float(f"{number:.12g}") for number in numbers]
        whole = all(isinstance(end, int) for end in (self.start, self.to)) and all(
            number.is_integer() for number in rounded
        )
        if not first.unit:
            return tuple(int(number) for number in rounded) if whole else tuple(rounded)
        return tuple(f"{number:.12g} {first.unit}" for number in rounded)


def _drawn_units(
    draws: Mapping[str, Distribution], name: str, seed: int, count: int
) -> tuple[dict[str, Any], ...]:
    """Return what each of so many units sets, by dotted path.

    Unit k of an axis `name` is the same whatever the count and the other paths: its numbers are keyed by the
    seed, the axis, the path, and k. Raises ValueError as `Distribution.value`.
    """
    units: list[dict[str, Any]] = []
    for unit in range(count):
        values = {}
        for path, distribution in draws.items():
            try:
                values[path] = distribution.value(generator(seed, f"draw/{name}", path, unit))
            except ValueError as error:
                raise ValueError(f"draw.{path}: {error}") from None
        units.append(values)
    return tuple(units)


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
