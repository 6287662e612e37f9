"""The range constant of a recorded camera: from one frame at a known range, or from data sheets."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nir_render.run.recording.document import CameraGiven, Measured, SourceGiven
from nir_render.scene.text.units import LENGTH
from perception import detect
from perception.model.ranging import effective_exposure_s
from perception.types import Calibration, Detection, RawFrame

_H_J_S = 6.62607015e-34
_C_M_PER_S = 299_792_458.0
_MOST_PASSES = 8
_CONVERGED = 3e-4
_NEAR_PX = 12


@dataclass(frozen=True)
class Constant:
    """K of the integrated flux in DN m²/s, its standard deviation, and where it is from."""

    value_dn_m2_per_s: float
    sigma_dn_m2_per_s: float
    origin: str


def from_data_sheets(given: CameraGiven, source: SourceGiven, calibration: Calibration) -> Constant | None:
    """Return K = gain · π/4 (f/N)² · τ · QE · λ/(hc) · I; None where brightness or f-number are not given.

    I is the radiant intensity, Φ/4π of a power that goes evenly to all sides. The σ of all factors add in
    quadrature.
    """
    bright = source.intensity or source.power_w
    metric = given.focal_length.quantity is LENGTH or given.pixel_pitch_m is not None
    if bright is None or given.f_number is None or not metric:
        return None
    intensity_w_per_sr = bright.value if source.intensity is not None else bright.value / (4.0 * math.pi)
    focal_m = given.focal_length.value
    if given.focal_length.quantity is not LENGTH:
        assert given.pixel_pitch_m is not None
        focal_m *= given.pixel_pitch_m
    area_m2 = 0.25 * math.pi * (focal_m / given.f_number.value) ** 2
    electrons_per_j = (
        given.transmission.value
        * given.quantum_efficiency.value
        * source.wavelength_m
        / (_H_J_S * _C_M_PER_S)
    )
    constant = calibration.system_gain_dn_per_e * area_m2 * electrons_per_j * intensity_w_per_sr
    shares = (
        bright.relative,
        given.transmission.relative,
        given.quantum_efficiency.relative,
        2.0 * given.f_number.relative,
        2.0 * given.focal_length.relative,
        calibration.sigma.get("system_gain_dn_per_e", 0.0) / calibration.system_gain_dn_per_e,
        _response_share(calibration),
    )
    return Constant(constant, constant * math.hypot(*shares), "data sheets")


def from_known_ranges(
    ranges: Sequence[tuple[RawFrame, Measured]], calibration: Calibration, guess: Constant | None
) -> Constant:
    """Return the K that the flares of frames at known ranges tell, the brightest of each frame.

    How large a flare looks is not used: it would tell the K that is being tried. The frames are looked
    at again with the K just found until it changes no more.

    Raises
    ------
    ValueError
        A frame shows no flare that can be measured, by its number.
    """
    first = _rough_constant(*ranges[0], calibration) if guess is None else guess.value_dn_m2_per_s
    sigma = {**calibration.sigma, "source_radius_m": calibration.source_radius_m}
    known = replace(calibration, range_constant_dn_m2_per_s=first, sigma=sigma)
    for _ in range(_MOST_PASSES):
        single = [_constant_of(frame, distance, known) for frame, distance in ranges]
        weights = np.array([1.0 / sigma**2 for _, sigma in single])
        constant = float(np.average([value for value, _ in single], weights=weights))
        change = abs(constant / known.range_constant_dn_m2_per_s - 1.0)
        known = replace(known, range_constant_dn_m2_per_s=constant)
        if change < _CONVERGED:
            break
    values = np.array([value for value, _ in single])
    spread = float(1.0 / math.sqrt(weights.sum()))
    if len(values) > 1:  # they share the point spread and the response: the scatter tells what is left
        spread = max(spread, float(values.std(ddof=1)) / math.sqrt(len(values)))
    spread = math.hypot(spread, _response_share(calibration) * constant)
    count = len(ranges)
    return Constant(constant, spread, f"{count} frame{'s' if count > 1 else ''} at known range")


def _constant_of(frame: RawFrame, distance: Measured, known: Calibration) -> tuple[float, float]:
    """Return the K that one frame tells, and its σ."""
    found = [hit for hit in detect(frame, known) if math.isfinite(hit.range_sigma_m)]
    if not found:
        raise ValueError(
            f"frame {frame.index} of {frame.camera} shows no flare that can be measured; take one with a "
            "single source in view, not clipped"
        )
    hit: Detection = max(found, key=lambda hit: hit.flux_dn)
    exposed_s = float(effective_exposure_s(hit.u_px, hit.v_px, frame.exposure_s, frame.gain, known))
    constant = hit.flux_dn * distance.value**2 / exposed_s
    return constant, constant * 2.0 * math.hypot(hit.range_sigma_m / hit.range_m, distance.relative)


def _rough_constant(frame: RawFrame, distance: Measured, calibration: Calibration) -> float:
    """Return a first guess of K: all counts about the brightest pixel, above the rest of the frame."""
    counts = frame.data_dn.astype(np.float64) - np.median(frame.data_dn)
    row, column = np.unravel_index(int(np.argmax(counts)), counts.shape)
    near = counts[
        max(row - _NEAR_PX, 0) : row + _NEAR_PX + 1, max(column - _NEAR_PX, 0) : column + _NEAR_PX + 1
    ]
    exposed_s = float(
        effective_exposure_s(float(column), float(row), frame.exposure_s, frame.gain, calibration)
    )
    return max(float(near.sum()), 1.0) * distance.value**2 / exposed_s


def _response_share(calibration: Calibration) -> float:
    """Return what a response that is not known adds to K: its σ in the corner, half of it on the mean."""
    return 0.5 * calibration.sigma.get("response_relative", 0.0)
