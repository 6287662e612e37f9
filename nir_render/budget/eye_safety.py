"""Eye safety of infrared sources by IEC 62471:2006, at 0.2 m, for exposures of any length.

Held against the limits of the exempt group for exposures beyond 1000 s: of cornea and lens, 100 W/m² from 780
to 3000 nm; of the retina behind an eye that no visible light warns, 6000/α W/m²/sr of radiance weighted with
R(λ), 780 to 1400 nm. What pulses is held with its mean against these, and each pulse, of a length t, against
those of single exposures: 18 000 t^−3/4 W/m² up to 1000 s; 50 000/α t^−1/4 W/m²/sr from 10 µs to 10 s.
Lasers, VCSELs among them, are IEC 60825's and are not judged by these.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.budget.flares import largest_relative_intensity
from nir_render.scene.documents.emitters import Source
from nir_render.scene.emission import emission_spectrum
from nir_render.spectra.bandpass import width_at_half_m

DISTANCE_M = 0.2
CORNEA_LIMIT_W_PER_M2 = 100.0
RETINA_LIMIT_W_PER_M_SR = 6000.0  # over α
CORNEA_AT_1_S_W_PER_M2 = 18_000.0  # for one exposure, falling as t^(−3/4)
RETINA_AT_1_S_W_PER_M_SR = 50_000.0  # over α, for one exposure, falling as t^(−1/4)
LEAST_ANGLE_RAD, LARGEST_ANGLE_RAD = 0.011, 0.1
PULSE_ANGLE_RAD, STEADY_EYE_S = 0.0017, 0.25  # the least angle while the eye has not moved; it grows with √t
_LASER_WIDTH_M = 5e-9
_CORNEA_M, _RETINA_M = (780e-9, 3000e-9), (780e-9, 1400e-9)


@dataclass(frozen=True)
class EyeSafety:
    """What a source brings to an eye 0.2 m from its middle, where it is brightest, and the limits.

    `cornea_w_per_m2` and `retina_w_per_m2_sr` are of a source that is lit all the time, `mean_…` with the
    mean of its drive (None of what sends messages: then as lit). `angle_rad` is the one that limit and
    field of view go by, `retina_w_per_m2_sr` the mean over a field of 0.011 rad where a source fills less.
    `exempt_as_driven` is by the mean and by each pulse of `pulse_s` (None of what does not pulse), the larger
    of whose shares of its two limits is `pulse_of_limit`. `narrow_spectrum` is one less than 5 nm wide:
    perhaps a laser, which is not judged by these.
    """

    sources: tuple[str, ...]
    drive_mean: float | None
    intensity_w_per_sr: float
    cornea_w_per_m2: float
    mean_cornea_w_per_m2: float
    cornea_limit_w_per_m2: float
    angle_rad: float
    retina_w_per_m2_sr: float
    mean_retina_w_per_m2_sr: float
    retina_limit_w_per_m2_sr: float
    exempt_lit: bool
    exempt_as_driven: bool
    pulse_s: float | None
    pulse_of_limit: float | None
    cornea_limit_at_m: float
    narrow_spectrum: bool


def eye_safety(sources: Sequence[str], source: Source) -> EyeSafety:
    """Return the eye safety of a source, by its largest intensity and its sphere's even radiance."""
    spectrum = emission_spectrum(source)
    wavelength_m, density = spectrum.wavelength_m, spectrum.value

    def weighted(low_m: float, high_m: float, weight: NDArray[np.float64]) -> float:
        inside = (wavelength_m >= low_m) & (wavelength_m <= high_m)
        return float(np.trapezoid(np.where(inside, weight * density, 0.0), wavelength_m))

    intensity = source.sent_flux_w / (4.0 * math.pi) * largest_relative_intensity(source)
    cornea = intensity / DISTANCE_M**2 * weighted(*_CORNEA_M, np.ones_like(density))
    fills_rad = 2.0 * source.radius_m / DISTANCE_M
    radiance = intensity / (math.pi * source.radius_m**2) * weighted(*_RETINA_M, retinal_weight(wavelength_m))
    angle_rad, retina = _angle_and_radiance(radiance, fills_rad, LEAST_ANGLE_RAD)
    limit = RETINA_LIMIT_W_PER_M_SR / angle_rad
    mean, square = source.drive.mean, source.drive.square
    share = 1.0 if mean is None else mean
    pulse_s = of_limit = None
    if square is not None and 0.0 < square.duty < 1.0:
        pulse_s = square.duty / square.frequency_hz
        of_limit = _pulse_of_limit(pulse_s, cornea, radiance, fills_rad)
    return EyeSafety(
        sources=tuple(sources),
        drive_mean=mean,
        intensity_w_per_sr=intensity,
        cornea_w_per_m2=cornea,
        mean_cornea_w_per_m2=share * cornea,
        cornea_limit_w_per_m2=CORNEA_LIMIT_W_PER_M2,
        angle_rad=angle_rad,
        retina_w_per_m2_sr=retina,
        mean_retina_w_per_m2_sr=share * retina,
        retina_limit_w_per_m2_sr=limit,
        exempt_lit=cornea <= CORNEA_LIMIT_W_PER_M2 and retina <= limit,
        exempt_as_driven=share * cornea <= CORNEA_LIMIT_W_PER_M2
        and share * retina <= limit
        and (of_limit is None or of_limit <= 1.0),
        pulse_s=pulse_s,
        pulse_of_limit=of_limit,
        cornea_limit_at_m=DISTANCE_M * math.sqrt(cornea / CORNEA_LIMIT_W_PER_M2),
        narrow_spectrum=width_at_half_m(wavelength_m, density) < _LASER_WIDTH_M,
    )


def _angle_and_radiance(radiance: float, fills_rad: float, least_rad: float) -> tuple[float, float]:
    """Return α and the mean radiance over a field of `least_rad` of a source that fills an angle."""
    angle_rad = min(max(fills_rad, least_rad), LARGEST_ANGLE_RAD)
    return angle_rad, radiance * min(1.0, (fills_rad / least_rad) ** 2)


def _pulse_of_limit(pulse_s: float, cornea_w_per_m2: float, radiance: float, fills_rad: float) -> float:
    """Return by how much one pulse comes up to the nearer of its limits."""
    cornea_limit = max(CORNEA_AT_1_S_W_PER_M2 * math.pow(pulse_s, -0.75), CORNEA_LIMIT_W_PER_M2)
    moved = math.sqrt(max(pulse_s / STEADY_EYE_S, 1.0))
    least_rad = min(PULSE_ANGLE_RAD * moved, LEAST_ANGLE_RAD)
    angle_rad, retina = _angle_and_radiance(radiance, fills_rad, least_rad)
    limit = RETINA_AT_1_S_W_PER_M_SR / angle_rad * math.pow(min(max(pulse_s, 1e-5), 10.0), -0.25)
    return max(cornea_w_per_m2 / cornea_limit, retina / limit)


def retinal_weight(wavelength_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R(λ), the burn hazard's weight, from 700 to 1400 nm (IEC 62471:2006, table 4.2).

    10^((700 − λ)/500) up to 1050 nm, 0.2 up to 1150, falling to 0.02 at 1200, and that up to 1400.
    """
    nm = 1e9 * np.asarray(wavelength_m, dtype=np.float64)
    falling = 10.0 ** ((700.0 - np.maximum(nm, 700.0)) / 500.0)
    beyond = np.clip(0.2 * 10.0 ** (0.02 * (1150.0 - nm)), 0.02, 0.2)
    return np.where(nm <= 1050.0, falling, beyond)
