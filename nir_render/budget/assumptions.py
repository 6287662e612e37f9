"""What a scene does not say and a budget has to assume, stated and open to change: `--assume NAME=VALUE`."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from nir_render.errors import InputError
from nir_render.scene.text.units import ANGLE, FRACTION, LENGTH, TEMPERATURE, Quantity, parse_quantity


@dataclass(frozen=True)
class Assumptions:
    """Standard deviations of what a calibration does not know, and the wall that lamps shine on.

    Attributes
    ----------
    wall_reflectance
        Of the matt wall that is behind the flares: half of the light.
    led_temperature_sigma_k
        Of the LEDs' junctions, from what the scene says: usual between a warm-up and an hour's driving.
    unit_flux_sigma, unit_wavelength_sigma_m
        From one LED to the next, relative and in metres: one brightness group of 2:1 and 920 to 960 nm, as
        data sheets of 940 nm LEDs have it, taken as limits at two to three σ; a lot that fills them evenly
        has 20 % and 12 nm. 0 where each robot is calibrated by itself.
    field_angle_sigma_rad
        Between the field angle that a range is corrected by and that at which light meets lens and filter:
        how well a filter is mounted.
    """

    wall_reflectance: float = 0.5
    led_temperature_sigma_k: float = 10.0
    unit_flux_sigma: float = 0.15
    unit_wavelength_sigma_m: float = 7e-9
    field_angle_sigma_rad: float = math.radians(0.5)

    def record(self) -> dict[str, float]:
        """Return them as a JSON object."""
        return asdict(self)


_QUANTITIES: dict[str, tuple[str, Quantity, float]] = {
    "wall_reflectance": ("wall_reflectance", FRACTION, 1.0),
    "led_temperature": ("led_temperature_sigma_k", TEMPERATURE, 100.0),
    "unit_flux": ("unit_flux_sigma", FRACTION, 0.9),
    "unit_wavelength": ("unit_wavelength_sigma_m", LENGTH, 1e-7),
    "field_angle": ("field_angle_sigma_rad", ANGLE, 0.5),
}
"""By name: the field, its unit, and how large it may be: beyond, first differences say nothing."""

NAMES = tuple(_QUANTITIES)


def assumptions_of(texts: Iterable[str]) -> Assumptions:
    """Return the assumptions with those changed that texts such as "led_temperature=5 K" name.

    Raises
    ------
    InputError
        An unknown name, a value without its unit, or one out of bounds.
    """
    chosen = Assumptions()
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or name not in _QUANTITIES:
            raise InputError(f"--assume {text}: wanted NAME=VALUE with NAME one of {', '.join(NAMES)}")
        field, quantity, most = _QUANTITIES[name]
        try:
            number = parse_quantity(value, quantity)
        except ValueError as error:
            raise InputError(f"--assume {name}: {error}") from None
        if not 0.0 <= number <= most:
            limit = f"{most:g} {quantity.unit}".rstrip()
            raise InputError(f"--assume {name}: {value} lies outside 0 to {limit}")
        chosen = replace(chosen, **{field: number})
    return chosen
