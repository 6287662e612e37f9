"""The one place where text with units becomes SI floats, and back.

A scene file writes "940 nm", "0.2 W" or "[1, 2, 0.3] m"; everything behind this file is in SI units
(metre, second, watt, radian, hertz, kelvin), plus electrons (e), digital numbers (DN), pixels and bits.
Only the annotated types at the end are used by the models of a scene file.
"""

import contextlib
import math
import re
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

import pint
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

# Angles, electrons, counts, pixels and bits are dimensions of their own here, so that a pixel can never
# stand where an angle belongs.
_DEFINITIONS = """
yocto- = 1e-24 = y-
pico- = 1e-12 = p-
nano- = 1e-9 = n-
micro- = 1e-6 = µ- = u- = μ-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
mega- = 1e6 = M-
metre = [length] = m = meter
second = [time] = s = sec
gram = [mass] = g
kelvin = [temperature] = K
candela = [luminosity] = cd
radian = [angle] = rad
electron = [electrons] = e
digital_number = [counts] = DN
pixel = [image] = px
bit = [information] = bits
degree = 0.017453292519943295 radian = deg = °
steradian = [solid_angle] = sr
minute = 60 second = min
hour = 60 minute = h
hertz = 1 / second = Hz
newton = kilogram * metre / second ** 2 = N
joule = newton * metre = J
watt = joule / second = W
lumen = candela * steradian = lm
lux = lumen / metre ** 2 = lx
percent = 0.01 = %
"""


@dataclass(frozen=True)
class Quantity:
    """A kind of physical quantity: its name, the unit that the program computes in, and an example."""

    name: str
    unit: str
    example: str


LENGTH = Quantity("length", "m", "0.3 m")
TIME = Quantity("time", "s", "1.5 ms")
FREQUENCY = Quantity("frequency", "Hz", "30 Hz")
ANGLE = Quantity("angle", "rad", "90 deg")
POWER = Quantity("power", "W", "0.2 W")
TEMPERATURE = Quantity("temperature", "K", "2856 K")
LUMINOUS_FLUX = Quantity("luminous flux", "lm", "4000 lm")
ELECTRONS = Quantity("number of electrons", "e", "5500 e")
COUNTS = Quantity("count", "DN", "64 DN")
SYSTEM_GAIN = Quantity("system gain", "DN/e", "0.74 DN/e")
DARK_CURRENT = Quantity("dark current", "e/s", "20 e/s")
FOCUS_SHIFT = Quantity("focus shift", "m/K", "5 um/K")
PIXELS = Quantity("length in the image", "px", "0.7 px")
BITS = Quantity("number of bits", "bit", "12 bit")
FRACTION = Quantity("fraction", "", "0.8")
EXTINCTION = Quantity("extinction coefficient", "1/m", "0.05 /m")
SPECTRAL_IRRADIANCE = Quantity("spectral irradiance", "W/m**3", "0.305 W/m^2/nm")
VISIBILITY = Quantity("length", "m", "50 m")
_OTHERS = (
    Quantity("mass", "kg", ""),
    Quantity("illuminance", "lx", ""),
    Quantity("radiant intensity", "W/sr", ""),
    Quantity("irradiance", "W/m**2", ""),
    Quantity("energy", "J", ""),
    Quantity("speed", "m/s", ""),
)
_KNOWN = (
    LENGTH, TIME, FREQUENCY, ANGLE, POWER, TEMPERATURE, LUMINOUS_FLUX, ELECTRONS, COUNTS, SYSTEM_GAIN,
    DARK_CURRENT, FOCUS_SHIFT, PIXELS, BITS, FRACTION, EXTINCTION, SPECTRAL_IRRADIANCE, *_OTHERS,
)  # fmt: skip

_NUMBER = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf|infinity))\s*(.*?)\s*", re.I
)
_VECTOR = re.compile(r"\s*\[([^\]]*)\]\s*(.*?)\s*")


@cache
def _registry() -> pint.UnitRegistry[Any]:
    return pint.UnitRegistry(_DEFINITIONS.splitlines())


@cache
def _factor(unit: str, quantity: Quantity) -> float:
    """Return what one `unit` is in the quantity's own unit; raise ValueError where it is no such unit."""
    registry = _registry()
    try:
        given = registry.Quantity(1.0, registry.parse_units(f"1{unit}" if unit.startswith("/") else unit))
        return float(given.to(registry.parse_units(quantity.unit)).magnitude)
    except pint.DimensionalityError:
        kind = _kind_of(given)
        raise ValueError(f"is {kind}; wanted {_wanted(quantity)}") from None
    except Exception:  # pint raises a dozen types, its tokenizer's among them, for text that is no unit
        raise ValueError(f"has the unknown unit {unit!r}; wanted {_wanted(quantity)}") from None


def _kind_of(given: Any) -> str:
    for known in _KNOWN:
        if given.dimensionality == _registry().parse_units(known.unit).dimensionality:
            return _with_article(known)
    return f"of dimension {given.dimensionality}"


def _wanted(quantity: Quantity) -> str:
    return f"{_with_article(quantity)} such as {quantity.example!r}"


def _with_article(quantity: Quantity) -> str:
    return f"{'an' if quantity.name[0] in 'aeiou' else 'a'} {quantity.name}"


def _number(text: str, shown: object) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{shown!r} holds {text!r}, which is no number") from None
    if not math.isfinite(value):
        raise ValueError(f"{shown!r} is not a finite number")
    return value


def parse_quantity(text: object, quantity: Quantity) -> float:
    """Read "940 nm" as a number in the quantity's unit.

    Parameters
    ----------
    text
        A string of number and unit. Plain numbers are taken only for fractions.
    quantity
        What is wanted.

    Raises
    ------
    ValueError
        A bare number, another dimension, an unknown unit, NaN, infinity.
    """
    if isinstance(text, bool) or not isinstance(text, str | int | float):
        raise ValueError(f"{text!r} is not {_wanted(quantity)}")
    if not isinstance(text, str):
        if quantity is FRACTION:
            return _number(str(text), text)
        raise ValueError(f"{text!r} is a bare number; write it with its unit, such as {quantity.example!r}")
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not {_wanted(quantity)}")
    value, unit = _number(match[1], text), match[2]
    if not unit and quantity is not FRACTION:
        raise ValueError(f"{text!r} is a bare number; write it with its unit, such as {quantity.example!r}")
    try:
        return value * _factor(unit, quantity)
    except ValueError as error:
        raise ValueError(f"{text!r} {error}") from None


def parse_vector(text: object, quantity: Quantity, size: int | None) -> tuple[float, ...]:
    """Read "[1, 2, 0.3] m" as `size` numbers (None: as many as there are) in the quantity's unit.

    Errors as `parse_quantity`.
    """
    example = f"'[{', '.join('123'[:size])}] {quantity.unit}'".replace(" '", "'")
    if isinstance(text, list | tuple):
        raise ValueError(f"{text!r} is a vector without a unit; write it as text, such as {example}")
    match = _VECTOR.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"{text!r} is not a vector with a unit, such as {example}")
    parts = match[1].split(",")
    if size is not None and len(parts) != size:
        raise ValueError(f"{text!r} has {len(parts)} components; wanted {size}, such as {example}")
    if not match[2] and quantity is not FRACTION:
        raise ValueError(f"{text!r} is a vector without a unit; write it with one, such as {example}")
    try:
        factor = _factor(match[2], quantity)
    except ValueError as error:
        raise ValueError(f"{text!r} {error}") from None
    return tuple(_number(part.strip(), text) * factor for part in parts)


def format_quantity(value: float, quantity: Quantity) -> str:
    """Write a value so that `parse_quantity` reads the same bits."""
    return f"{value!r} {quantity.unit}".rstrip()


def format_in_unit_of(text: object, value: float) -> str:
    """Write a value, in the unit that the program computes in, in the unit of a text such as "100 deg".

    Without a unit where the text has none.
    """
    match = _NUMBER.fullmatch(str(text))
    unit = "" if match is None else match[2]
    for known in _KNOWN:
        with contextlib.suppress(ValueError):
            return f"{value / _factor(unit, known):.6g} {unit}".rstrip()
    return f"{value:g}"


@dataclass(frozen=True)
class Reading:
    """A number as it was written: "1.5 ms" is 1.5, in SI units 0.0015, "ms", a time."""

    number: float
    value_si: float
    unit: str
    quantity: Quantity


def read_quantity(text: object) -> Reading | None:
    """Read a number with a unit of any quantity, or without one; None where the text is no such thing."""
    match = None if isinstance(text, bool) else _NUMBER.fullmatch(str(text))
    if match is None or not math.isfinite(float(match[1])):
        return None
    number, unit = float(match[1]), match[2]
    for known in (FRACTION, *_KNOWN) if not unit else _KNOWN:
        with contextlib.suppress(ValueError):
            return Reading(number, number * _factor(unit, known), unit, known)
    return None


def with_component(vector: str, index: int, value: object) -> str:
    """Return the vector "[1, 2, 0.3] m" with one of its numbers replaced by a value such as "3 m".

    Raises
    ------
    ValueError
        The text is no vector with a unit, has no such component, or the value is no such quantity.
    """
    match = _VECTOR.fullmatch(vector)
    if match is None:
        raise ValueError(f"{vector!r} is no vector")
    parts = [part.strip() for part in match[1].split(",")]
    if index >= len(parts):
        raise ValueError(f"{vector!r} has {len(parts)} components")
    for known in _KNOWN:
        with contextlib.suppress(ValueError):
            factor = _factor(match[2], known)
            break
    else:
        raise ValueError(f"{vector!r} has no unit that is known")
    # The same digits where the units are the same, as 4.3 m is not 4300 mm to the last bit.
    given = read_quantity(value)
    number = parse_quantity(value, known) / factor
    parts[index] = repr(given.number if given is not None and given.unit == match[2] else number)
    return f"[{', '.join(parts)}] {match[2]}"


def format_vector(values: tuple[float, ...], quantity: Quantity) -> str:
    """Write a vector so that `parse_vector` reads the same bits."""
    return f"[{', '.join(repr(value) for value in values)}] {quantity.unit}".rstrip()


@dataclass(frozen=True)
class Unit:
    """Annotation of a model's field: text with a unit in the document, SI floats in the model."""

    quantity: Quantity
    size: int | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Parse before, and write after, the field's own validation."""
        return core_schema.no_info_before_validator_function(
            self._parse,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(self._write),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the text, not the float that it becomes."""
        if self.size is not None:
            example = f"[{', '.join('123'[: self.size])}] {self.quantity.unit}"
            return {"type": "string", "pattern": r"^\s*\[.*\]\s*\S+\s*$", "examples": [example]}
        kind = "string" if self.quantity is not FRACTION else ["number", "string"]
        return {"type": kind, "description": _wanted(self.quantity), "examples": [self.quantity.example]}

    def _parse(self, text: object) -> float | tuple[float, ...]:
        if self.size is None:
            return parse_quantity(text, self.quantity)
        return parse_vector(text, self.quantity, self.size)

    def _write(self, value: Any) -> str | float:
        if self.size is not None:
            return format_vector(value, self.quantity)
        return format_quantity(value, self.quantity) if self.quantity.unit else float(value)


Length = Annotated[float, Unit(LENGTH)]
Time = Annotated[float, Unit(TIME)]
Frequency = Annotated[float, Unit(FREQUENCY)]
Angle = Annotated[float, Unit(ANGLE)]
Power = Annotated[float, Unit(POWER)]
Temperature = Annotated[float, Unit(TEMPERATURE)]
LuminousFlux = Annotated[float, Unit(LUMINOUS_FLUX)]
Electrons = Annotated[float, Unit(ELECTRONS)]
Counts = Annotated[float, Unit(COUNTS)]
SystemGain = Annotated[float, Unit(SYSTEM_GAIN)]
DarkCurrent = Annotated[float, Unit(DARK_CURRENT)]
FocusShift = Annotated[float, Unit(FOCUS_SHIFT)]
Pixels = Annotated[float, Unit(PIXELS)]
Pixels2 = Annotated[tuple[float, float], Unit(PIXELS, 2)]
Bits = Annotated[float, Unit(BITS)]
Fraction = Annotated[float, Unit(FRACTION)]
Extinction = Annotated[float, Unit(EXTINCTION)]
SpectralIrradiance = Annotated[float, Unit(SPECTRAL_IRRADIANCE)]
Position = Annotated[tuple[float, float, float], Unit(LENGTH, 3)]
Size2 = Annotated[tuple[float, float], Unit(LENGTH, 2)]
Size3 = Annotated[tuple[float, float, float], Unit(LENGTH, 3)]
