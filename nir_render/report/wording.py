"""Numbers as a person reads them."""

import math


def metres(value: float | None, *, signed: bool = False, more: int = 0) -> str:
    """Write a length with three digits, or `more`, in mm, cm or m."""
    if value is None or not math.isfinite(value):
        return "–"
    for least, unit, factor in ((1.0, "m", 1.0), (0.01, "cm", 100.0)):
        # Below the step by less than the rounding: 0.9996 m is 1.00 m, not 100 cm.
        if abs(value) >= least * 0.9995:
            return f"{_three_digits(value * factor, signed, more)} {unit}"
    return f"{_three_digits(value * 1e3, signed, more)} mm"


def degrees(value: float | None) -> str:
    """Write an angle with two digits or more."""
    if value is None or not math.isfinite(value):
        return "–"
    digits = 1 if value == 0.0 else max(1, 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(digits, 6)}f}°"


def share(value: float | None, *, more: int = 0) -> str:
    """Write a share with one decimal, or `more`, in per cent; 100 % and 0 % stand only for all and none."""
    if value is None:
        return "–"
    if value in (0.0, 1.0):
        return f"{value:.0%}".replace("%", " %")
    step = 0.1 ** (1 + more)
    return f"{min(max(100.0 * value, step), 100.0 - step):.{1 + more}f} %"


def times(value: float) -> str:
    """Write a factor with two or three digits: 1.07, 35, 6800."""
    return f"{value:.2f}" if value < 9.995 else f"{float(f'{value:.2g}'):.0f}"


def significant(value: float, digits: int = 3) -> str:
    """Write a number with so many digits, whole numbers with all: 0.0512, 1.50, 155, 6841."""
    if value == 0.0:
        return "0"
    power = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return f"{value:.{max(digits - 1 - power, 0)}f}".replace("-", "−")


def counted(number: int, one: str, many: str = "") -> str:
    """Write a number of things: 1 frame, 2 frames."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def _three_digits(value: float, signed: bool, more: int) -> str:
    size = abs(value)
    digits = more + (2 if size < 9.995 else 1 if size < 99.95 else 0)
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return text.replace("-", "−")
