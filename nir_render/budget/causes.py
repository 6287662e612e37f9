"""The expected σ of a range by its causes: those of the Cramér–Rao bound, and what no calibration knows.

The first are `perception.model.fisher.range_causes` through the scene's own exact calibration: they add up to
the limit that a run is judged by. The others are errors of the range constant: σ_d = ½ d δ ln K, with δ ln K
the root of the mean square of ln K's changes by one σ up and down, so that a maximum, where the slope is 0,
counts.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

from nir_render.budget.assumptions import Assumptions
from nir_render.camera.optics.response import response
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from perception.model.fisher import range_causes
from perception.model.sensor import at_gain
from perception.types import Calibration

USUAL_SHIFT_M_PER_K, USUAL_POWER_PER_K = 0.28e-9, -0.003
"""Of 940 nm LEDs, for sources whose scene states a spectrum and no LED (nir_render/data/leds)."""

LIMIT_CAUSES = (
    "own_light_m", "background_m", "dark_current_m", "prnu_m", "read_noise_m", "dsnu_m", "rounding_m",
    "range_constant_m", "source_radius_m", "point_spread_m",
)  # fmt: skip
OTHER_CAUSES = ("led_temperature_m", "unit_spread_m", "field_angle_m", "fog_m")


@dataclass(frozen=True)
class RangeError:
    """The expected σ of one range: `limit_m`, the Cramér–Rao bound, `sigma_m` with all else, and causes.

    All in metres; `causes_m` of `LIMIT_CAUSES` add up to the limit in quadrature, with `OTHER_CAUSES` to
    sigma.
    """

    limit_m: float
    sigma_m: float
    causes_m: dict[str, float]


@dataclass(frozen=True)
class Flare:
    """A flare as the bound takes it: place, range, electrons that perception finds, and those about it."""

    u_px: float
    v_px: float
    field_angle_rad: float
    range_m: float
    flux_e: float
    background_e: float
    dark_e: float


def range_error(
    camera: Camera, source: Source, calibration: Calibration, gain: float, flare: Flare, assumed: Assumptions
) -> RangeError | None:
    """Return the expected error of a range and its causes; None where there is nothing to range by."""
    if not (flare.flux_e > 0.0 and calibration.range_constant_dn_m2_per_s > 0.0):
        return None
    known = at_gain(calibration, gain)
    around_e = flare.background_e + flare.dark_e
    found = range_causes(known, flare.u_px, flare.v_px, flare.range_m, flare.flux_e, around_e)
    if found is None:
        return None
    causes_m = asdict(found)
    # Shot noise of light and of dark current are one noise: by their shares of the electrons.
    around_m = causes_m["background_m"]
    dark_share = flare.dark_e / around_e if around_e > 0.0 else 0.0
    causes_m["background_m"] = around_m * math.sqrt(1.0 - dark_share)
    causes_m["dark_current_m"] = around_m * math.sqrt(dark_share)
    causes_m = {name: causes_m[name] for name in LIMIT_CAUSES}
    limit_m = math.hypot(*causes_m.values())
    of_log_k = {
        "led_temperature_m": _by_temperature(camera, source, flare, assumed.led_temperature_sigma_k),
        "unit_spread_m": _by_units(camera, source, flare, assumed),
        "field_angle_m": _by_angle(camera, source, flare, assumed.field_angle_sigma_rad),
        # ln F has −σ_t d in it: what the calibration does not know of fog.
        "fog_m": flare.range_m * calibration.sigma.get("extinction_per_m", 0.0),
    }
    causes_m |= {name: 0.5 * flare.range_m * change for name, change in of_log_k.items()}
    return RangeError(limit_m, math.hypot(*causes_m.values()), causes_m)


def log_signal(camera: Camera, source: Source, field_angle_rad: float) -> float:
    """Return the logarithm of what K is proportional to: C(θ) cos θ Φ."""
    electrons_per_j = float(response(camera, source)(field_angle_rad))
    return math.log(max(electrons_per_j * math.cos(field_angle_rad) * source.sent_flux_w, 1e-300))


def changed(source: Source, flux: float, wavelength_m: float) -> Source:
    """Return a source with its flux by a factor and its spectrum moved."""
    unit = source.unit.model_copy(
        update={
            "flux": source.unit.flux * flux,
            "wavelength_m": source.unit.wavelength_m + wavelength_m,
        }
    )
    return source.model_copy(update={"unit": unit})


def _by_temperature(camera: Camera, source: Source, flare: Flare, sigma_k: float) -> float:
    led = source.spectrum.led
    shift_m_per_k, per_k = USUAL_SHIFT_M_PER_K, USUAL_POWER_PER_K
    if led is not None:
        # What its data sheet's coefficient takes is of the flux at the reference temperature.
        heated = 1.0 + led.power_shift_per_k * (led.temperature_k - led.reference_temperature_k)
        shift_m_per_k, per_k = led.wavelength_shift_m_per_k, led.power_shift_per_k / heated
    return _either_way(
        lambda k: log_signal(
            camera, changed(source, max(1.0 + per_k * k, 1e-3), shift_m_per_k * k), flare.field_angle_rad
        ),
        sigma_k,
    )


def _by_units(camera: Camera, source: Source, flare: Flare, assumed: Assumptions) -> float:
    of_wavelength = _either_way(
        lambda shift_m: log_signal(camera, changed(source, 1.0, shift_m), flare.field_angle_rad),
        assumed.unit_wavelength_sigma_m,
    )
    return math.hypot(of_wavelength, assumed.unit_flux_sigma)


def _by_angle(camera: Camera, source: Source, flare: Flare, sigma_rad: float) -> float:
    return _either_way(
        lambda turn_rad: log_signal(
            camera, source, min(abs(flare.field_angle_rad + turn_rad), 0.5 * math.pi - 1e-6)
        ),
        sigma_rad,
    )


def _either_way(log_k: Callable[[float], float], sigma: float) -> float:
    """Return the root of the mean square of a logarithm's changes by one σ up and down."""
    if sigma == 0.0:
        return 0.0
    middle = log_k(0.0)
    return math.sqrt(0.5 * ((log_k(sigma) - middle) ** 2 + (log_k(-sigma) - middle) ** 2))
