"""The Gaussian by which perception knows a camera's point spread, and the share of the light that it finds.

Perception fits a Gaussian whatever the point spread is. Where that is one, both are known. Elsewhere they are
measured as a user would, on a rail: noise-free frames of the source on the axis, 0.5 to 10 m away, at two
exposures, and perception's own robust fit. The Gaussian is the one with which the fluxes found follow 1/d²
best. That takes seconds, so what was found is kept in the user's cache folder.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from nir_render.camera.beams import Beam, beam_electrons
from nir_render.camera.optics.gaussian_fit import gaussian_fit
from nir_render.camera.optics.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.optics.otf import core_of
from nir_render.camera.optics.response import Response, response
from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.camera import Camera, GlobalShutter
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.times.drives import FULL_DRIVE
from nir_render.spectra.nodes import BAND_M
from nir_render.transport.backend.llvm.choice import cpu_name
from nir_render.transport.backend.user_cache import cache_file, read_answers, write_answers
from nir_render.transport.cache_key import digest
from nir_render.transport.fingerprint import code_hash, matching
from perception.estimators import detect
from perception.types import Calibration, RawFrame

Progress = Callable[[int, int], None]  # told how many steps of how many are done

_RAIL_M = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
_PEAKS = (0.8, 0.16)  # of full scale at the nearest range: the rail's two exposures
_OFF_AXIS_PX = (0.1, 0.3)  # neither on a pixel's middle nor on a corner
_FRAME_PX = 161
_NEAR_PX = 8.0
_EQUAL_BELOW = 0.01  # relative shot noise: brighter flares have the same weight
_COARSE_STEP = 0.25
_REFINEMENTS = 5
_WIDEST = (0.8, 1.3)  # about the Gaussians that look most like the core
_BLACK_DN = 2000.0
_TOP_DN = 60000.0
_FULL_SCALE_DN = 65535
_SIZE_SPREAD = 0.1
_NOT_FOUND = 1e6  # a spread worse than any, and one that a minimiser can reckon with
# What the answer follows from, besides camera and source: a change of one is another version.
_CODE = (
    *(f"nir_render/{room}/**/*.py" for room in ("camera", "light", "scene", "spectra")),
    "nir_render/data/**/*.csv",
    "nir_render/geometry.py",
    "nir_render/simulation/flare_spread.py",
    "perception/**/*.py",
)


@dataclass(frozen=True)
class FlareSpread:
    """What perception is to take for the point spread of a camera.

    Attributes
    ----------
    sigma_px
        Of the Gaussian.
    share
        Of all light of a source, what perception finds: 1 where the point spread is a Gaussian.
    share_sigma
        Relative to `share`: so large that it covers how far off the shares found are anywhere on the rail,
        but for what shot noise covers; 0 where the point spread is a Gaussian.
    """

    sigma_px: float
    share: float
    share_sigma: float


def flare_spread(camera: Camera, source: Source, progress: Progress | None = None) -> FlareSpread:
    """Return the Gaussian and the share for a camera that looks at a source.

    Where the point spread is no Gaussian and no earlier run has left the answer in the user's cache folder,
    it is measured, which takes seconds and calls `progress`.
    """
    sigma_px = _gaussian_px(camera)
    if sigma_px is not None:
        return FlareSpread(sigma_px, 1.0, 0.0)
    # Neither where they are mounted nor how they are driven matters: cameras of one make are measured once.
    mount = {"position_m": (0.0, 0.0, 0.0), "orientation": Orientation()}
    free = {"exposure_s": 1.0, "gain": 1.0, "auto_exposure": None, "bracket": None, "serial": None}
    bare_camera = camera.model_copy(update={**mount, **free, "shutter": GlobalShutter()})
    bare_source = source.model_copy(update={**mount, "pattern": None, "drive": FULL_DRIVE})
    return _measurement(bare_camera, bare_source).result(progress)


def share_found(camera: Camera, source: Source, sigma_px: float) -> float:
    """Return the share of a source's light that perception finds with another Gaussian than `flare_spread`'s.

    Where the point spread is a Gaussian all of it is found, whatever small error that of perception has.
    """
    if _gaussian_px(camera) is not None:
        return 1.0
    return _law(_rail(camera, source), sigma_px, camera.point_spread.core_share).share


def _gaussian_px(camera: Camera) -> float | None:
    """Return the standard deviation of a point spread that is a Gaussian at all ranges, else None."""
    if camera.lens.focus_distance_m is not None or camera.point_spread.core_share != 1.0:
        return None
    return core_of(camera).gaussian_px


def source_beam(source: Source, unit: Response, direction: NDArray[np.float64], range_m: float) -> Beam:
    """Return the light of a source that nothing hides, from a direction in camera axes, shape (3,)."""
    return Beam(
        direction=direction,
        angular_radius_rad=float(np.arcsin(min(source.radius_m / range_m, 1.0))),
        irradiance_w_per_m2=source.sent_flux_w / (4.0 * np.pi * range_m**2),
        response=unit,
        distance_m=range_m,
    )


@dataclass(frozen=True, eq=False)
class _RailFrames:
    """Frames of a rail, what is known of their camera, and all electrons of a source one metre away in 1 s.

    Each frame is its range, its exposure, and its electrons in 1 s.
    """

    known: Calibration
    frames: tuple[tuple[float, float, NDArray[np.float64]], ...]
    at_one_metre_e: float


@dataclass(frozen=True)
class _FluxLaw:
    """The share of all light that the fluxes found give together, and how far each of them is from that.

    `spread` is the root of the weighted mean square of their relative distances, `_NOT_FOUND` where a flare
    was not found; `uncovered` the largest but for shot noise.
    """

    share: float
    spread: float
    uncovered: float


class _Measurement:
    """A flare spread, found when it is first asked for: in the user's cache folder, or on a rail."""

    def __init__(self, camera: Camera, source: Source) -> None:
        self._camera, self._source = camera, source
        self._spread: FlareSpread | None = None

    def result(self, progress: Progress | None) -> FlareSpread:
        if self._spread is None:
            file, key = cache_file("flare_spread.json"), digest((self._camera, self._source, *_versions()))
            self._spread = _kept(file, key)
            if self._spread is None:
                self._spread = _measured(self._camera, self._source, progress)
                write_answers(file, {**read_answers(file), key: asdict(self._spread)})
        return self._spread


@lru_cache(maxsize=16)
def _measurement(camera: Camera, source: Source) -> _Measurement:
    return _Measurement(camera, source)


def _kept(file: Path | None, key: str) -> FlareSpread | None:
    """Return what a file holds under a key, None where that is nothing or no three numbers."""
    fields = read_answers(file).get(key, {})
    if not all(isinstance(value, float) and math.isfinite(value) for value in fields.values()):
        return None
    try:
        return FlareSpread(**fields)
    except TypeError:
        return None


@cache
def _versions() -> tuple[str, ...]:
    """Return what the bits of an answer follow from besides camera and source: versions, processor, code."""
    packages = (f"{module.__name__} {module.__version__}" for module in (np, scipy, cv2))
    return (*packages, cpu_name(), code_hash(matching(Path(__file__).parents[2], _CODE)))


def _measured(camera: Camera, source: Source, progress: Progress | None) -> FlareSpread:
    alike = [gaussian_fit(core_of(camera, range_m)) for range_m in _RAIL_M]
    low, high = (
        factor * end(fit.sigma_px for fit in alike) for factor, end in zip(_WIDEST, (min, max), strict=True)
    )
    rail = _rail(camera, source)
    count = 2 + math.ceil(math.log(high / low) / _COARSE_STEP)
    done, steps = 0, count + _REFINEMENTS + 1

    def look(sigma_px: float, share: float) -> _FluxLaw:
        nonlocal done
        law = _law(rail, sigma_px, share)
        done = min(done + 1, steps)
        if progress is not None:
            progress(done, steps)
        return law

    @cache
    def law(log_sigma: float) -> _FluxLaw:
        return look(math.exp(log_sigma), camera.point_spread.core_share)

    trials = np.linspace(math.log(low), math.log(high), count).tolist()
    step = trials[1] - trials[0]
    start = min(trials, key=lambda trial: law(trial).spread)
    best = minimize_scalar(
        lambda log_sigma: law(float(log_sigma)).spread,
        bounds=(start - step, start + step),
        method="bounded",
        options={"maxiter": _REFINEMENTS},
    ).x
    sigma_px = math.exp(best)
    found = look(sigma_px, law(float(best)).share)
    if found.spread < _NOT_FOUND:
        return FlareSpread(sigma_px, found.share, found.uncovered)
    # Perception misses some of the flares whatever the Gaussian: what a point's image has is all there is.
    share = camera.point_spread.core_share * alike[-1].share
    return FlareSpread(alike[-1].sigma_px, share, 1.0 - share)


def _rail(camera: Camera, source: Source) -> _RailFrames:
    """Return frames of a small sensor about the axis; ghosts, which fall elsewhere, only take their light."""
    sensor, spread = camera.sensor, camera.point_spread
    rows, columns = min(sensor.rows, _FRAME_PX), min(sensor.columns, _FRAME_PX)
    middle_px = ((columns - 1) / 2, (rows - 1) / 2)
    ghosts = sum(ghost.share for ghost in spread.ghosts)
    glare = spread.glare
    if glare is not None:
        glare = glare.model_copy(update={"share": glare.share / (1.0 - ghosts)})
    small = camera.model_copy(
        update={
            "sensor": sensor.model_copy(update={"rows": rows, "columns": columns}),
            "lens": camera.lens.model_copy(update={"principal_point_px": middle_px}),
            "point_spread": spread.model_copy(update={"glare": glare, "ghosts": ()}),
        }
    )
    on_axis = response(camera, source)
    direction = intrinsics_of(small).unproject(np.add(middle_px, _OFF_AXIS_PX))
    images = [
        (1.0 - ghosts) * beam_electrons(small, [source_beam(source, on_axis, direction, range_m)], 1.0)
        for range_m in _RAIL_M
    ]
    headroom_e = min(sensor.well_e, sensor.full_scale_dn / sensor.system_gain_dn_per_e)
    frames = tuple(
        (range_m, peak * headroom_e / float(images[0].max()), image)
        for peak in _PEAKS
        for range_m, image in zip(_RAIL_M, images, strict=True)
    )
    known = _finely_read(small, source, on_axis, headroom_e)
    irradiance_w_per_m2 = source.sent_flux_w / (4.0 * math.pi)
    at_one_metre_e = aperture_area_m2(camera) * float(on_axis.electrons_per_j[0]) * irradiance_w_per_m2
    return _RailFrames(known, frames, at_one_metre_e)


def _finely_read(camera: Camera, source: Source, on_axis: Response, headroom_e: float) -> Calibration:
    """Return what is known of a camera whose ADC is so fine that its rounding tells nothing.

    The noise of the real one's rounding is counted as read noise, so that pixels weigh as they do in its
    frames.
    """
    lens, sensor = intrinsics_of(camera), camera.sensor
    return Calibration(
        camera="rail",
        width_px=lens.width_px,
        height_px=lens.height_px,
        fx_px=lens.fx_px,
        fy_px=lens.fy_px,
        cx_px=lens.cx_px,
        cy_px=lens.cy_px,
        rotation_body_camera=np.eye(3),
        position_body_m=np.zeros(3),
        system_gain_dn_per_e=_TOP_DN / headroom_e,
        read_noise_e=math.hypot(sensor.read_noise_e, 1.0 / (math.sqrt(12.0) * sensor.system_gain_dn_per_e)),
        black_level_dn=_BLACK_DN,
        saturation_dn=_FULL_SCALE_DN,
        bit_depth=16,
        psf_sigma_px=math.nan,
        response_angle_rad=on_axis.angle_rad,
        response_relative=on_axis.electrons_per_j / on_axis.electrons_per_j[0],
        range_constant_dn_m2_per_s=math.nan,
        range_constant_paper_dn_m2_per_s=math.nan,
        source_radius_m=source.radius_m,
        wavelength_m=BAND_M,
        lens_model=camera.lens.model,
        distortion=camera.lens.distortion,
        dsnu_e=sensor.dsnu.total_e,
        prnu=sensor.prnu.total,
    )


def _law(rail: _RailFrames, sigma_px: float, share: float) -> _FluxLaw:
    """Return what a rail gives with a Gaussian; `share` is that by which perception judges a flare's size."""
    gain = rail.known.system_gain_dn_per_e
    constant = share * gain * rail.at_one_metre_e
    # The size may hardly say how far a source is: what is sought is the flux that perception finds.
    known = replace(
        rail.known,
        psf_sigma_px=sigma_px,
        range_constant_dn_m2_per_s=constant,
        sigma={"source_radius_m": _SIZE_SPREAD * rail.known.source_radius_m},
    )
    found = []
    for range_m, exposure_s, image_e in rail.frames:
        counts_dn = np.rint(gain * exposure_s * image_e + _BLACK_DN)
        data_dn = np.minimum(counts_dn, _FULL_SCALE_DN).astype(np.uint16)
        frame = RawFrame(known.camera, 0, 0.0, exposure_s, data_dn, _BLACK_DN)
        near = [
            one.flux_dn / gain
            for one in detect(frame, known)
            if math.hypot(one.u_px - known.cx_px, one.v_px - known.cy_px) < _NEAR_PX
        ]
        if len(near) != 1 or not near[0] > 0.0:
            return _FluxLaw(share, _NOT_FOUND, _NOT_FOUND)
        found.append((near[0], exposure_s * rail.at_one_metre_e / range_m**2))
    flux_e, all_e = np.array(found).T
    shot = 1.0 / np.sqrt(flux_e)
    weight = 1.0 / (shot**2 + _EQUAL_BELOW**2)
    mean = float(np.average(flux_e / all_e, weights=weight))
    away = flux_e / (all_e * mean) - 1.0
    spread = math.sqrt(float(np.average(away**2, weights=weight)))
    uncovered = math.sqrt(max(float((away**2 - shot**2).max()), 0.0))
    return _FluxLaw(mean, spread, uncovered)
