"""The range constant of a recorded camera: from one frame at a known range, or from data sheets."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nir_render.run.recording.document import CameraGiven, Measured, SourceGiven
from nir_render.scene.text.units import LENGTH
from perception import detect
from perception.model.ranging import effective_exposure_s
from perception.types import Calibration, Detection, Detections, RawFrame

_H_J_S = 6.62607015e-34
_C_M_PER_S = 299_792_458.0
_MOST_PASSES = 8
_CONVERGED = 3e-4
_NEAR_PX = 12
_LEAST_OTHER = 0.005  # of the brightest's light: a source so faint is fourteen times as far
_MOST_TOLD = 6
_MOST_SIGMAS = 3.0
_MOST_DOUBT = 0.05  # of a range: a focal length that is known to some per cent brings that much
_FEWEST_TO_AGREE = 3


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


@dataclass(frozen=True, eq=False)
class KnownFlare:
    """A frame of a source at a range that was measured, and about where it is; None: it is alone.

    `name` is that of the picture.
    """

    name: str
    frame: RawFrame
    range_m: Measured
    place_px: tuple[float, float] | None = None


def from_known_ranges(flares: Sequence[KnownFlare], calibration: Calibration) -> Constant:
    """Return the K that the flares of frames at known ranges tell.

    How large a flare looks is not used: it would tell the K that is being tried. The frames are looked
    at again with the K just found until it changes no more.

    Raises
    ------
    ValueError
        A frame shows no flare that can be measured, none where it should be, or several and not which is
        meant: by its number.
    """
    first = _rough_constant(flares[0], calibration)
    known = replace(_by_light_alone(calibration), range_constant_dn_m2_per_s=first)
    for _ in range(_MOST_PASSES):
        single = [_constant_of(flare, known) for flare in flares]
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
    count = len(flares)
    return Constant(constant, spread, f"{count} flare{'s' if count > 1 else ''} at known range")


def _by_light_alone(calibration: Calibration) -> Calibration:
    """Return a calibration to which the size of a flare says nothing."""
    sigma = {**calibration.sigma, "source_radius_m": calibration.source_radius_m}
    return replace(calibration, sigma=sigma)


def contradictions(flares: Sequence[KnownFlare], calibration: Calibration) -> Iterator[str]:
    """Yield which known ranges do not come out again, flux and size taken together, by more than their σ.

    And those of which flux and size tell ranges that are more than `_MOST_DOUBT` apart.

    Of three or more the one that the light of all others contradicts, which agree, is told alone: it has
    moved the range constant, and with it the others.
    """
    if (odd := _odd_one(flares, calibration)) is not None:
        yield odd
        return
    for flare in flares:
        wanted = f"{flare.range_m.value:g} m was measured of {flare.name}"
        check = (
            "Check the range that was measured, and of which source, focal_length, pixel_pitch and the "
            "source's radius; do not trust ranges before"
        )
        try:
            found = detect(flare.frame, calibration)
            hit = _flare_of(flare, found)
        except ValueError:
            yield f"{wanted}, and nothing there looks like a source of that size at such a range. {check}"
            continue
        sigma_m = math.hypot(hit.range_sigma_m, flare.range_m.sigma)
        is_off = abs(hit.range_m - flare.range_m.value) > _MOST_SIGMAS * sigma_m
        if is_off or (found.range_doubt > _MOST_DOUBT and not found.psf_width_off):
            yield (
                f"{wanted}, and its flare at ({hit.u_px:.0f}, {hit.v_px:.0f}) px comes out at "
                f"{hit.range_m:.3f} ± {hit.range_sigma_m:.3f} m: its light, its size and what other frames "
                f"say do not fit one range. {check}"
            )


def _odd_one(flares: Sequence[KnownFlare], calibration: Calibration) -> str | None:
    """Return what to tell of the one known range whose K the others, agreeing among each other, exclude."""
    if len(flares) < _FEWEST_TO_AGREE:
        return None
    try:
        known = _by_light_alone(calibration)
        values, sigmas = np.array([_constant_of(flare, known) for flare in flares]).T
    except ValueError:
        return None
    told = []
    for number, flare in enumerate(flares):
        others, weights = np.delete(values, number), 1.0 / np.delete(sigmas, number) ** 2
        constant = float(np.average(others, weights=weights))
        agree = np.all(np.abs(others - constant) <= _MOST_SIGMAS * np.delete(sigmas, number))
        sigma = math.hypot(sigmas[number], 1.0 / math.sqrt(weights.sum()))
        if agree and abs(values[number] - constant) > _MOST_SIGMAS * sigma:
            range_m = flare.range_m.value * math.sqrt(constant / values[number])
            told.append(
                f"{flare.range_m.value:g} m was measured of {flare.name}, and by the light of the other "
                f"{len(others)}, which agree, it would be {range_m:.3g} m. Check it: all ranges lean on it"
            )
    return told[0] if len(told) == 1 else None


def _flare_of(flare: KnownFlare, detections: Detections) -> Detection:
    """Return which of the flares found is meant.

    Raises
    ------
    ValueError
        There is none, or there are several.
    """
    frame = flare.frame
    found = [hit for hit in detections if math.isfinite(hit.range_sigma_m)]
    where = f"frame {frame.index} of {frame.camera} ({flare.name})"
    if not found:
        raise ValueError(
            f"{where} shows no flare that can be measured; take one that is not clipped, and check "
            "focal_length, pixel_pitch and the source's radius: they say how large it should look"
        )
    found.sort(key=lambda hit: -hit.flux_dn)
    if flare.place_px is not None:
        u_px, v_px = flare.place_px
        nearest = min(found, key=lambda hit: math.hypot(hit.u_px - u_px, hit.v_px - v_px))
        if math.hypot(nearest.u_px - u_px, nearest.v_px - v_px) > _NEAR_PX:
            raise ValueError(
                f"{where} shows no flare within {_NEAR_PX} px of ({u_px:g}, {v_px:g}) px; there are "
                f"{_places(found)}"
            )
        return nearest
    others = [hit for hit in found[1:] if hit.flux_dn > _LEAST_OTHER * found[0].flux_dn]
    if others:
        one = found[0]
        raise ValueError(
            f"{where} shows {len(others) + 1} flares, {_places([one, *others])}; say which one's range is "
            f'known, such as place: "[{one.u_px:.0f}, {one.v_px:.0f}] px"'
        )
    return found[0]


def _places(found: Sequence[Detection]) -> str:
    return ", ".join(f"({hit.u_px:.0f}, {hit.v_px:.0f}) px" for hit in found[:_MOST_TOLD])


def _constant_of(flare: KnownFlare, known: Calibration) -> tuple[float, float]:
    """Return the K that one frame tells, and its σ."""
    frame, hit = flare.frame, _flare_of(flare, detect(flare.frame, known))
    exposed_s = float(effective_exposure_s(hit.u_px, hit.v_px, frame.exposure_s, frame.gain, known))
    constant = hit.flux_dn * flare.range_m.value**2 / exposed_s
    return constant, constant * 2.0 * math.hypot(hit.range_sigma_m / hit.range_m, flare.range_m.relative)


def _rough_constant(flare: KnownFlare, calibration: Calibration) -> float:
    """Return a first guess of K: all counts about the brightest pixel, above the rest of the frame."""
    frame = flare.frame
    counts = frame.data_dn.astype(np.float64) - np.median(frame.data_dn)
    seen = counts
    if flare.place_px is not None:
        rows, columns = np.ogrid[: counts.shape[0], : counts.shape[1]]
        u_px, v_px = flare.place_px
        seen = np.where((abs(rows - v_px) <= _NEAR_PX) & (abs(columns - u_px) <= _NEAR_PX), counts, -np.inf)
    row, column = np.unravel_index(int(np.argmax(seen)), counts.shape)
    near = counts[
        max(row - _NEAR_PX, 0) : row + _NEAR_PX + 1, max(column - _NEAR_PX, 0) : column + _NEAR_PX + 1
    ]
    exposed_s = float(
        effective_exposure_s(float(column), float(row), frame.exposure_s, frame.gain, calibration)
    )
    return max(float(near.sum()), 1.0) * flare.range_m.value**2 / exposed_s


def _response_share(calibration: Calibration) -> float:
    """Return what a response that is not known adds to K: its σ in the corner, half of it on the mean."""
    return 0.5 * calibration.sigma.get("response_relative", 0.0)
