import pytest

from nir_render.report.wording import counted, degrees, metres, share, times


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.345, "2.35 m"), (12.34, "12.3 m"), (123.4, "123 m"), (0.9996, "1.00 m"), (0.9994, "99.9 cm"),
        (0.0345, "3.45 cm"), (0.00999, "9.99 mm"), (0.009996, "1.00 cm"), (0.0, "0.00 mm"), (-2.9, "−2.90 m"),
        (None, "–"), (float("nan"), "–"), (float("inf"), "–"),
    ],
)  # fmt: skip
def test_metres(value: float | None, text: str) -> None:
    assert metres(value) == text


def test_signs_degrees_shares_and_factors() -> None:
    assert metres(0.0531, signed=True) == "+5.31 cm"
    assert (degrees(10.57), degrees(0.00257), degrees(0.0)) == ("10.6°", "0.0026°", "0.0°")
    assert (share(1.0), share(0.9999), share(0.5), share(0.0)) == ("100 %", "99.9 %", "50.0 %", "0 %")
    assert (times(1.234), times(34.6), times(6841.0)) == ("1.23", "35", "6800")
    assert (counted(1, "frame"), counted(0, "frame")) == ("1 frame", "0 frames")
