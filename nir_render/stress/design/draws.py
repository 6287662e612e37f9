"""Units that are drawn: how values spread, and what each unit gets of them."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import model_validator

from nir_render.errors import shown
from nir_render.randomness import generator
from nir_render.scene.documents.base import Document
from nir_render.scene.text.units import Reading, read_quantity

_MOST_DRAWS = 1000


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


def drawn_units(
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
