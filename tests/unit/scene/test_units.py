import math

import pytest

from nir_render.scene.text import units
from nir_render.scene.text.units import (
    format_quantity,
    format_vector,
    parse_quantity,
    parse_vector,
    short_number,
)


@pytest.mark.parametrize(
    ("text", "quantity", "value"),
    [
        ("940 nm", units.LENGTH, 940e-9),
        ("10mm", units.LENGTH, 0.01),
        ("-2.5e1 cm", units.LENGTH, -0.25),
        ("90 deg", units.ANGLE, math.pi / 2),
        ("12 °", units.ANGLE, math.radians(12)),
        ("1.5 ms", units.TIME, 0.0015),
        ("1.5 µs", units.TIME, 1.5e-6),
        ("0.2 W", units.POWER, 0.2),
        ("25 mW", units.POWER, 0.025),
        ("30 Hz", units.FREQUENCY, 30.0),
        ("0.74 DN/e", units.SYSTEM_GAIN, 0.74),
        ("99.2 %", units.FRACTION, 0.992),
        (0.8, units.FRACTION, 0.8),
    ],
)
def test_text_with_unit_becomes_si(text: object, quantity: units.Quantity, value: float) -> None:
    assert parse_quantity(text, quantity) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "quantity", "said"),
    [
        (3, units.LENGTH, "3 is a bare number; write it with its unit, such as '0.3 m'"),
        ("3", units.TIME, "'3' is a bare number"),
        ("5 kg", units.LENGTH, "'5 kg' is a mass; wanted a length such as '0.3 m'"),
        ("5 W/sr", units.POWER, "is a radiant intensity; wanted a power"),
        ("3 px", units.ANGLE, "is a length in the image; wanted an angle"),
        ("5 parsnip", units.LENGTH, "has the unknown unit 'parsnip'"),
        ("nan m", units.LENGTH, "not a finite number"),
        ("1e999 m", units.LENGTH, "not a finite number"),
        (float("nan"), units.FRACTION, "not a finite number"),
        (None, units.LENGTH, "None is not a length"),
        (True, units.FRACTION, "True is not a fraction"),
        ("far away", units.LENGTH, "'far away' is not a length"),
    ],
)
def test_what_is_no_such_quantity_is_refused_with_a_fix(
    text: object, quantity: units.Quantity, said: str
) -> None:
    with pytest.raises(ValueError) as caught:
        parse_quantity(text, quantity)
    assert said in str(caught.value)


def test_vectors_have_one_unit_for_all_components() -> None:
    assert parse_vector("[1, -2, 0.3] cm", units.LENGTH, 3) == pytest.approx((0.01, -0.02, 0.003), rel=1e-14)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ([1, 2, 3], "without a unit"),
        ("[1, 2, 3]", "without a unit"),
        ("[1, 2] m", "2 components; wanted 3"),
        ("[1, 2, 3] s", "is a time; wanted a length"),
        ("[1, 2, x] m", "'x', which is no number"),
        ("[1, 2, inf] m", "not a finite number"),
        ("1 m", "not a vector"),
    ],
)
def test_what_is_no_vector_is_refused(text: object, said: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_vector(text, units.LENGTH, 3)
    assert said in str(caught.value)


@pytest.mark.parametrize("value", [0.1, 1 / 3, 940e-9, -1e-300, 2.0**-1074, 12345.678901234567])
def test_a_written_value_reads_back_to_the_same_bits(value: float) -> None:
    assert parse_quantity(format_quantity(value, units.LENGTH), units.LENGTH) == value
    assert parse_vector(format_vector((value, value), units.LENGTH), units.LENGTH, 2) == (value, value)


@pytest.mark.parametrize(
    ("number", "digits", "text"),
    [
        (12345.0, 4, "12345"),
        (12345.0, 3, "12345"),
        (5055.439, 3, "5060"),
        (-14000.0, 3, "-14000"),
        (999_999.7, 4, "1000000"),
        (2e6, 4, "2e+06"),
        (0.0512, 4, "0.0512"),
        (1e-5, 4, "1e-05"),
        (0.0, 3, "0"),
    ],
)
def test_short_numbers_are_whole_up_to_a_million(number: float, digits: int, text: str) -> None:
    assert short_number(number, digits) == text
