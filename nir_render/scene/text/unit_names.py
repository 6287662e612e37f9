"""The names of units, "W/m^2/nm", "DN/e", "/m", and the factors from one to another.

A unit is a product of named units to powers, each with or without a prefix. Its factor is the product of the
scales of all that it is made of, those above the line first, each in the order in which it is met, with equal
scales on both sides cancelled: this is how Pint multiplies, whose bits a test compares.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

# Angles, electrons, counts, pixels and bits are dimensions of their own here, so that a pixel can never
# stand where an angle belongs.
_BASE = frozenset(
    [
        "metre",
        "second",
        "gram",
        "kelvin",
        "candela",
        "ampere",
        "radian",
        "electron",
        "digital_number",
        "pixel",
        "bit",
        "steradian",
    ]
)
# Scale, and what it is a multiple of.
_DERIVED: Mapping[str, tuple[float, Mapping[str, float]]] = MappingProxyType(
    {
        "degree": (0.017453292519943295, {"radian": 1}),
        "minute": (60.0, {"second": 1}),
        "hour": (60.0, {"minute": 1}),
        "hertz": (1.0, {"second": -1}),
        "kilogram": (1e3, {"gram": 1}),
        "newton": (1.0, {"kilogram": 1, "metre": 1, "second": -2}),
        "joule": (1.0, {"newton": 1, "metre": 1}),
        "watt": (1.0, {"joule": 1, "second": -1}),
        "volt": (1.0, {"watt": 1, "ampere": -1}),
        "lumen": (1.0, {"candela": 1, "steradian": 1}),
        "lux": (1.0, {"lumen": 1, "metre": -2}),
        "percent": (0.01, {}),
    }
)
_SYMBOLS = MappingProxyType(
    {
        "m": "metre", "meter": "metre", "s": "second", "sec": "second", "g": "gram", "K": "kelvin",
        "cd": "candela", "rad": "radian", "e": "electron", "DN": "digital_number", "px": "pixel",
        "bits": "bit", "deg": "degree", "sr": "steradian", "min": "minute", "h": "hour", "Hz": "hertz",
        "N": "newton", "J": "joule", "W": "watt", "lm": "lumen", "lx": "lux", "A": "ampere", "V": "volt",
    }
    | {name: name for name in (*_BASE, *_DERIVED)}
)  # fmt: skip
_PREFIXES = MappingProxyType(
    {
        "yocto": 1e-24, "y": 1e-24, "pico": 1e-12, "p": 1e-12, "nano": 1e-9, "n": 1e-9, "micro": 1e-6,
        "µ": 1e-6, "u": 1e-6, "μ": 1e-6, "milli": 1e-3, "m": 1e-3, "centi": 1e-2, "c": 1e-2, "kilo": 1e3,
        "k": 1e3, "mega": 1e6, "M": 1e6,
    }
)  # fmt: skip
_TOKEN = re.compile(r"\s*(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|[^\W\d]\w*|\*\*|//|[*/()+-])")
# What may be written otherwise, and how it is read. A space between two names is a product.
_SPELLINGS = tuple(
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        ("‰", " permille "), ("%", " percent "), ("×", "*"), (",", ""), (" per ", "/"), ("°", "degree"),
        (r"([\w.\-+*^])\s+", r"\1 "),
        (r"([_a-zA-Z]\w*) squared", r"\1**2"), (r"([_a-zA-Z]\w*) cubed", r"\1**3"),
        (r"cubic ([_a-zA-Z]\w*)", r"\1**3"), (r"(?:square|sq) ([_a-zA-Z]\w*)", r"\1**2"),
        (r"(⁻?[⁰¹²³⁴⁵⁶⁷⁸⁹]+)", r"**(\1)"),
    )
)  # fmt: skip
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹·⁻", "0123456789*-")


class UnknownUnitError(ValueError):
    """A text is no unit."""


def dimension_of(unit: str) -> dict[str, float]:
    """Return the exponents of the base units in a unit, by their names; raise UnknownUnitError."""
    return _expanded(_parsed(unit))[1]


def factor(unit: str, of: str) -> float:
    """Return how many of another unit of its dimension one `unit` is; raise UnknownUnitError."""
    ratio = _parsed(unit)
    for name, exponent in _parsed(of).items():
        ratio[name] = ratio.get(name, 0) - exponent
    return _expanded({name: exponent for name, exponent in ratio.items() if exponent})[0]


def _expanded(units: Mapping[str, float]) -> tuple[float, dict[str, float]]:
    """Return the factor of a product of units, and the exponents of its base units."""
    above: dict[float, float] = {}  # exponents by scale
    below: dict[float, float] = {}
    base: dict[str, float] = {}

    def walk(parts: Mapping[str, float], power: float) -> None:
        for name, exponent in parts.items():
            if name in _BASE:
                base[name] = base.get(name, 0) + exponent * power
                continue
            scale, made_of = _definition(name)
            side = below if exponent * power < 0 else above
            side[scale] = side.get(scale, 0) + abs(exponent * power)
            walk(made_of, exponent * power)

    walk(units, 1)
    for scale in above.keys() & below.keys():
        common = min(above[scale], below[scale])
        above[scale] -= common
        below[scale] -= common
    product = 1.0
    try:
        for scale, exponent in above.items():
            product *= scale**exponent
        for scale, exponent in below.items():
            product *= scale**-exponent
    except OverflowError:
        raise UnknownUnitError from None
    return product, {name: exponent for name, exponent in base.items() if exponent}


def _definition(name: str) -> tuple[float, Mapping[str, float]]:
    """Return the scale of a derived or prefixed unit, and what it is a multiple of."""
    if name in _DERIVED:
        return _DERIVED[name]
    prefix, _, unit = name.partition("-")
    return _PREFIXES[prefix], {unit: 1}


def _name_of(word: str) -> str:
    """Return the name of a unit for a word such as "nm" or "metres": "n-metre" has a prefix."""
    if word in _SYMBOLS:
        return _SYMBOLS[word]
    for suffix in ("", "s"):
        for prefix in ("", *_PREFIXES):
            symbol = word.removeprefix(prefix).removesuffix(suffix)
            whole = word == f"{prefix}{symbol}{suffix}" and not (suffix and len(symbol) == 1)
            if whole and symbol in _SYMBOLS:
                # One name for all spellings of a prefix, so that nm / nanometre is 1.
                scale = _PREFIXES.get(prefix)
                first = next((key for key, value in _PREFIXES.items() if value == scale), "")
                return f"{first}-{_SYMBOLS[symbol]}" if prefix else _SYMBOLS[symbol]
    raise UnknownUnitError


@dataclass(frozen=True)
class _Product:
    """A number times units, by their words."""

    number: float
    units: Mapping[str, float]

    def times(self, other: "_Product", power: float) -> "_Product":
        units = dict(self.units)
        for word, exponent in other.units.items():
            units[word] = units.get(word, 0) + exponent * power
        number = self.number * other.number**power
        return _Product(number, {word: exponent for word, exponent in units.items() if exponent})


def _parsed(text: str) -> dict[str, float]:
    """Return the exponents of the units in a text, by name, in their order."""
    text = f"1{text}" if text.startswith("/") else text
    for pattern, replacement in _SPELLINGS:
        text = pattern.sub(replacement, text)
    text = text.translate(_SUPERSCRIPTS).replace("^", "**").strip()
    if not text:
        return {}
    try:
        product = _Reader(_tokens(text)).whole()
    except (ArithmeticError, RecursionError):
        raise UnknownUnitError from None
    if product.number != 1:
        raise UnknownUnitError
    named: dict[str, float] = {}
    for word, exponent in product.units.items():
        if word == "dimensionless":
            continue
        name = _name_of(word)
        named[name] = named.get(name, 0) + exponent
    return {name: exponent for name, exponent in named.items() if exponent}


def _tokens(text: str) -> list[str]:
    tokens, place = [], 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise UnknownUnitError
        tokens.append(match[1])
        place = match.end()
    return tokens


class _Reader:
    """Reads tokens from the left: products and quotients of powers."""

    def __init__(self, tokens: list[str]) -> None:
        self._tokens = [*tokens, ""]  # the end
        self._place = 0

    def whole(self) -> _Product:
        product = self._product()
        if self._tokens[self._place]:
            raise UnknownUnitError
        return product

    def _take(self) -> str:
        self._place += 1
        return self._tokens[self._place - 1]

    def _product(self) -> _Product:
        product = self._signed()
        while (token := self._tokens[self._place]) and token not in ("+", "-", ")", "**"):
            if token in ("*", "/", "//"):
                self._take()
            product = product.times(self._signed(), -1 if token in ("/", "//") else 1)
        return product

    def _signed(self) -> _Product:
        if self._tokens[self._place] in ("+", "-"):
            sign = -1.0 if self._take() == "-" else 1.0
            return _Product(sign, {}).times(self._signed(), 1)
        return self._power()

    def _power(self) -> _Product:
        base = self._atom()
        if self._tokens[self._place] != "**":
            return base
        self._take()
        power = self._signed()
        if power.units:
            raise UnknownUnitError
        exponent = int(power.number) if power.number == int(power.number) else power.number
        return _Product(1.0, {}).times(base, exponent)

    def _atom(self) -> _Product:
        word = self._take()
        if word == "(":
            product = self._product()
            if self._take() != ")":
                raise UnknownUnitError
            return product
        if word[:1].isdigit() or word[:1] == ".":
            return _Product(float(word), {})
        if word[:1].isalpha() or word[:1] == "_":
            return _Product(1.0, {word: 1})
        raise UnknownUnitError
