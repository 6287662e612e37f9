"""What units mean, against Pint: the same texts are units, and their factors are the same bits."""

import itertools
import random
from functools import cache
from typing import Any

import pint
import pytest

from nir_render.scene.text.unit_names import UnknownUnitError, dimension_of, factor

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
_NAMES = [
    "metre",
    "m",
    "meter",
    "second",
    "s",
    "sec",
    "gram",
    "g",
    "kelvin",
    "K",
    "candela",
    "cd",
    "radian",
    "rad",
    "electron",
    "e",
    "digital_number",
    "DN",
    "pixel",
    "px",
    "bit",
    "bits",
    "degree",
    "deg",
    "°",
    "steradian",
    "sr",
    "minute",
    "min",
    "hour",
    "h",
    "hertz",
    "Hz",
    "newton",
    "N",
    "joule",
    "J",
    "watt",
    "W",
    "lumen",
    "lm",
    "lux",
    "lx",
    "percent",
    "%",
    "kilogram",
]
_PREFIXES = [
    "y",
    "p",
    "n",
    "µ",
    "u",
    "μ",
    "m",
    "c",
    "k",
    "M",
    "yocto",
    "pico",
    "nano",
    "micro",
    "milli",
    "centi",
    "kilo",
    "mega",
]
# What each kind of quantity is written in, and some that are none.
_WANTED = (
    ["m", "s", "Hz", "rad", "W", "K", "lm", "e", "DN", "DN/e", "e/s", "m/K", "px", "bit", "1/m", "W/m**3", "kg", "lx", "W/sr", "W/m**2", "J", "m/s", ""]
)  # fmt: skip
_JOINTS = (
    "/",
    "*",
    " ",
    "^2/",
    "**2 ",
    "² ",
    "^-1 ",
    " per ",
    " squared / ",
    " / ",
    "·",
    "/(",
    ")*",
    "^0.5*",
)


@cache
def _registry() -> pint.UnitRegistry[Any]:
    return pint.UnitRegistry(_DEFINITIONS.splitlines())


def _by_pint(unit: str, of: str) -> float | None:
    """Return the factor, 0 where the dimensions differ, None where the text is no unit."""
    registry = _registry()
    try:
        given = registry.Quantity(1.0, registry.parse_units(f"1{unit}" if unit.startswith("/") else unit))
        return float(given.to(registry.parse_units(of)).magnitude)
    except pint.DimensionalityError:
        return 0.0
    except Exception:
        return None


def _by_us(unit: str, of: str) -> float | None:
    try:
        return factor(unit, of) if dimension_of(unit) == dimension_of(of) else 0.0
    except UnknownUnitError:
        return None


def _unlike(units: list[str]) -> list[Any]:
    cases = itertools.product(units, _WANTED)
    return [
        (unit, of, ours, theirs)
        for unit, of in cases
        if (ours := _by_us(unit, of)) != (theirs := _by_pint(unit, of))
    ]


def test_every_name_with_every_prefix_is_what_pint_takes_it_for() -> None:
    words = [prefix + name for prefix in ("", *_PREFIXES) for name in _NAMES if name not in ("%", "kilogram")]
    assert (
        _unlike(
            [*words, *(f"{word}s" for word in _NAMES), "kg", "%", "parsnip", "mm m", "ss", "dimensionless"]
        )
        == []
    )


@pytest.mark.parametrize(
    "shape",
    [
        "{}/m",
        "/{}",
        "{}^2",
        "1/{}",
        "W/{}^2/nm",
        "DN/{}",
        "{}/K",
        "{}/ks",
        "W {} / m**4",
        "({})",
        "{} per s",
        "{}²·m⁻²",
    ],
)
def test_products_of_names_are_what_pint_takes_them_for(shape: str) -> None:
    names = [*(name for name in _NAMES if name not in ("%", "°")), "mm", "nm", "kilometres", "ms", "kHz"]
    assert _unlike([shape.format(name) for name in names]) == []


def test_random_products_are_what_pint_takes_them_for() -> None:
    draw = random.Random(7)
    names = [
        *(name for name in _NAMES if name not in ("%", "°")),
        "mm",
        "nm",
        "um",
        "ms",
        "us",
        "kHz",
        "mW",
        "1",
        "2",
    ]
    units = [
        "".join(draw.choice(names) + draw.choice(_JOINTS) for _ in range(draw.randint(1, 4)))
        + draw.choice(names)
        for _ in range(600)
    ]
    assert _unlike(units) == []
    # The same at random within one dimension: what is multiplied and divided by the same stays a length.
    lengths = []
    for _ in range(300):
        others = draw.sample(["um", "ms", "kHz", "deg", "W", "lx", "min", "percent", "mDN", "kN"], 3)
        lengths.append(" ".join(["mm", *others]) + "".join(f"/{one}" for one in draw.sample(others, 3)))
    assert _unlike(lengths) == []
    assert all(_by_us(unit, "m") for unit in lengths)


@pytest.mark.parametrize(
    "text", ["2 m", "m+m", "(m", "m)", "m**s", "m" * 5000, "(" * 5000, "km^9999", "$", "-m"]
)
def test_what_is_no_unit_is_said_to_be_none(text: str) -> None:
    with pytest.raises(UnknownUnitError):
        factor(text, "m")
