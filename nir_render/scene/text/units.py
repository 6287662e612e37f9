"""The one place where text with units becomes SI floats, and back.

A scene file writes "940 nm", "0.2 W" or "[1, 2, 0.3] m"; everything behind this file is in SI units
(metre, second, watt, radian, hertz, kelvin), plus electrons (e), digital numbers (DN), pixels and bits.
The models of a scene file use the annotated types of `base`, which stand on this; `unit_names` tells what
the text of a unit means.
"""

import math
import re
from dataclasses import dataclass
from functools import lru_cache

from nir_render.errors import shown
from nir_render.scene.text.unit_names import UnknownUnitError, dimension_of, factor


@dataclass(frozen=True)
class Quantity:
    """A kind of physical quantity: its name, the unit that the program computes in, and an example.

    `most` is how large a value of it may be in that unit, either way: far more than any scene holds, so that
    what lies beyond is a slip, and no sum or square of it overflows.
    """

    name: str
    unit: str
    example: str
    most: float = 1e12


LENGTH = Quantity("length", "m", "0.3 m", 1e6)
TIME = Quantity("time", "s", "1.5 ms", 1e9)
FREQUENCY = Quantity("frequency", "Hz", "30 Hz")
ANGLE = Quantity("angle", "rad", "90 deg", 1e6)
POWER = Quantity("power", "W", "0.2 W", 1e9)
TEMPERATURE = Quantity("temperature", "K", "2856 K", 1e6)
LUMINOUS_FLUX = Quantity("luminous flux", "lm", "4000 lm")
ILLUMINANCE = Quantity("illuminance", "lx", "500 lx")
ELECTRONS = Quantity("number of electrons", "e", "5500 e")
COUNTS = Quantity("count", "DN", "64 DN")
SYSTEM_GAIN = Quantity("system gain", "DN/e", "0.74 DN/e")
DARK_CURRENT = Quantity("dark current", "e/s", "20 e/s")
FOCUS_SHIFT = Quantity("focus shift", "m/K", "5 um/K", 1.0)
WAVELENGTH_SHIFT = Quantity("wavelength shift", "m/K", "0.3 nm/K", 1e-6)
TEMPERATURE_COEFFICIENT = Quantity("temperature coefficient", "1/K", "-0.3 %/K", 1.0)
CURRENT = Quantity("current", "A", "100 mA", 1e6)
VOLTAGE = Quantity("voltage", "V", "1.5 V", 1e6)
THERMAL_RESISTANCE = Quantity("thermal resistance", "K/W", "450 K/W", 1e6)
PIXELS = Quantity("length in the image", "px", "0.7 px", 1e6)
BITS = Quantity("number of bits", "bit", "12 bit", 1e3)
FRACTION = Quantity("fraction", "", "0.8", 1e12)
EXTINCTION = Quantity("extinction coefficient", "1/m", "0.05 /m", 1e9)
SPECTRAL_IRRADIANCE = Quantity("spectral irradiance", "W/m**3", "0.287 W/m^2/nm", 1e18)
VISIBILITY = Quantity("length", "m", "50 m", 1e9)
SPEED = Quantity("speed", "m/s", "0.1 m/s", 1e6)
_OTHERS = (
    Quantity("mass", "kg", ""),
    Quantity("radiant intensity", "W/sr", ""),
    Quantity("irradiance", "W/m**2", ""),
    Quantity("energy", "J", ""),
)
_KNOWN = (
    LENGTH, TIME, FREQUENCY, ANGLE, POWER, TEMPERATURE, LUMINOUS_FLUX, ILLUMINANCE, ELECTRONS, COUNTS,
    SYSTEM_GAIN, DARK_CURRENT, FOCUS_SHIFT, TEMPERATURE_COEFFICIENT, CURRENT, VOLTAGE, THERMAL_RESISTANCE,
    PIXELS, BITS, FRACTION, EXTINCTION, SPECTRAL_IRRADIANCE, SPEED, *_OTHERS,
)  # fmt: skip

_NUMBER = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf|infinity))\s*(.*?)\s*", re.I
)
_VECTOR = re.compile(r"\s*\[([^\]]*)\]\s*(.*?)\s*")


@lru_cache(maxsize=4096)
def _factor(unit: str, quantity: Quantity) -> float:
    """Return what one `unit` is in the quantity's own unit; raise ValueError where it is no such unit."""
    try:
        dimension = dimension_of(unit)
        if dimension == dimension_of(quantity.unit):
            return factor(unit, quantity.unit)
    except UnknownUnitError:
        raise ValueError(f"has the unknown unit {shown(unit)}; wanted {wanted(quantity)}") from None
    raise ValueError(f"is {_kind_of(unit)}; wanted {wanted(quantity)}")


@lru_cache(maxsize=4096)
def _quantity_of(unit: str) -> Quantity | None:
    """Return the first known kind of quantity that a unit measures; None where it is no unit of any."""
    try:
        dimension = dimension_of(unit)
    except UnknownUnitError:
        return None
    return next((known for known in _KNOWN if dimension_of(known.unit) == dimension), None)


def _kind_of(unit: str) -> str:
    known = _quantity_of(unit)
    return f"in {shown(unit)}" if known is None else _with_article(known)


def wanted(quantity: Quantity) -> str:
    """Return what is wanted of a kind, in words: "a length such as '0.3 m'"."""
    return f"{_with_article(quantity)} such as {quantity.example!r}"


def _with_article(quantity: Quantity) -> str:
    return f"{'an' if quantity.name[0] in 'aeiou' else 'a'} {quantity.name}"


def _number(text: str, written: object) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(
            f"{shown(written)} holds {shown(text)}, which is no number; write it in digits, such as 0.5"
        ) from None
    if not math.isfinite(value):
        raise ValueError(f"{shown(written)} is not a finite number; write one in digits, such as 0.5")
    return value


def _within_bounds(value_si: float, quantity: Quantity) -> float:
    """Return a value; raise ValueError where nothing in a scene is as large."""
    if abs(value_si) > quantity.most:
        bound = f"{quantity.most:g} {quantity.unit}".rstrip()
        raise ValueError(
            f"is beyond {bound}, the largest {quantity.name} that is taken; check number and unit"
        )
    return value_si


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
        A bare number, another dimension, an unknown unit, NaN, infinity, a value beyond the quantity's bound.
    """
    if isinstance(text, bool) or not isinstance(text, str | int | float):
        raise ValueError(f"{shown(text)} is not {wanted(quantity)}")
    if not isinstance(text, str):
        if quantity is FRACTION:
            return _number(str(text), text)
        raise ValueError(
            f"{shown(text)} is a bare number; write it with its unit, such as {quantity.example!r}"
        )
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise ValueError(f"{shown(text)} is not {wanted(quantity)}")
    value, unit = _number(match[1], text), match[2]
    if not unit and quantity is not FRACTION:
        raise ValueError(
            f"{shown(text)} is a bare number; write it with its unit, such as {quantity.example!r}"
        )
    try:
        return _within_bounds(value * _factor(unit, quantity), quantity)
    except ValueError as error:
        raise ValueError(f"{shown(text)} {error}") from None


def parse_vector(text: object, quantity: Quantity, size: int | None) -> tuple[float, ...]:
    """Read "[1, 2, 0.3] m" as `size` numbers (None: as many as there are) in the quantity's unit.

    Errors as `parse_quantity`.
    """
    example = f"'[{', '.join('123'[:size])}] {quantity.unit}'".replace(" '", "'")
    if isinstance(text, list | tuple):
        raise ValueError(f"{shown(text)} is a vector without a unit; write it as text, such as {example}")
    match = _VECTOR.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"{shown(text)} is not a vector with a unit, such as {example}")
    parts = match[1].split(",")
    if size is not None and len(parts) != size:
        raise ValueError(f"{shown(text)} has {len(parts)} components; wanted {size}, such as {example}")
    if not match[2] and quantity is not FRACTION:
        raise ValueError(f"{shown(text)} is a vector without a unit; write it with one, such as {example}")
    numbers = [_number(part.strip(), text) for part in parts]
    try:
        scale = _factor(match[2], quantity)
        return tuple(_within_bounds(number * scale, quantity) for number in numbers)
    except ValueError as error:
        raise ValueError(f"{shown(text)} {error}") from None


def format_quantity(value: float, quantity: Quantity) -> str:
    """Write a value so that `parse_quantity` reads the same bits."""
    return f"{value!r} {quantity.unit}".rstrip()


def short_number(number: float, digits: int = 4) -> str:
    """Write a number with so many digits; up to a million no power of ten, and whole ones in full."""
    text = f"{number:.{digits}g}"
    if "e+" not in text or abs(number) >= 1e6:
        return text
    return f"{number if number == round(number) else float(text):.0f}"


def format_in_unit_of(text: object, value: float) -> str:
    """Write a value, in the unit that the program computes in, in the unit of a text such as "100 deg".

    Without a unit where the text has none.
    """
    match = _NUMBER.fullmatch(str(text))
    unit = "" if match is None else match[2]
    known = _quantity_of(unit)
    return f"{value:g}" if known is None else f"{value / _factor(unit, known):.6g} {unit}".rstrip()


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
    known = _quantity_of(unit)
    return None if known is None else Reading(number, number * _factor(unit, known), unit, known)


def with_component(vector: str, index: int, value: object) -> str:
    """Return the vector "[1, 2, 0.3] m" with one of its numbers replaced by a value such as "3 m".

    Raises
    ------
    ValueError
        The text is no vector with a unit, has no such component, or the value is no such quantity.
    """
    match = _VECTOR.fullmatch(vector)
    if match is None:
        raise ValueError(f"{shown(vector)} is no vector")
    parts = [part.strip() for part in match[1].split(",")]
    if index >= len(parts):
        raise ValueError(f"{shown(vector)} has {len(parts)} components")
    known = _quantity_of(match[2])
    if known is None:
        raise ValueError(f"{shown(vector)} has no unit that is known")
    # The same digits where the units are the same, as 4.3 m is not 4300 mm to the last bit.
    given = read_quantity(value)
    number = parse_quantity(value, known) / _factor(match[2], known)
    parts[index] = repr(given.number if given is not None and given.unit == match[2] else number)
    return f"[{', '.join(parts)}] {match[2]}"


def format_vector(values: tuple[float, ...], quantity: Quantity) -> str:
    """Write a vector so that `parse_vector` reads the same bits."""
    return f"[{', '.join(repr(value) for value in values)}] {quantity.unit}".rstrip()
