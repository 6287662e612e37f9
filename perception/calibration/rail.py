"""Calibration on a rail: the range constants from frames of one source at known ranges, judged on others.

Every other range is fitted; the ranges between them are held out and judge what was fitted.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.calibration.range_constant import (
    RangeConstantFit,
    regress_range_constant,
    regress_with_spread,
)
from perception.calibration.result import CONVERGED_CHANGE, HeldOut, RailCalibration
from perception.causes import detection_causes
from perception.estimators import detect
from perception.files.fields import RecordingError
from perception.model.fisher import fixed_influence, flare_limit, range_causes
from perception.model.flare import PixelBox
from perception.model.ranging import effective_exposure_s
from perception.model.sensor import at_gain
from perception.paper import PaperRegression, regress_paper_range_constant
from perception.types import Calibration, Detection, RawFrame

LEAST_PLACES = 6
"""Three ranges to fit (a line, and one to contradict it), three to judge."""

MAX_PASSES = 8

_SAME_PLACE_M = 1e-6

Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all; begins anew with each pass."""


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A frame of the rail without its pixels, and what an estimator took for the source."""

    range_m: float
    exposure_s: float
    gain: float
    black_level_dn: float
    detection: Detection | None


@dataclass(frozen=True, eq=False)
class _ConvergedFit:
    """The last fit, how far it moved K, the number of passes, and what the last one saw."""

    fit: RangeConstantFit
    change: float
    passes: int
    sightings: tuple[_Sighting, ...]
    measured: "_Measured"
    share_spread: float


@dataclass(frozen=True, eq=False)
class _Measured:
    """The sightings that count, their flux over effective exposure and its σ, shape (n,), and by what."""

    sightings: Sequence[_Sighting]
    m_dn_per_s: NDArray[np.float64]
    sigma_dn_per_s: NDArray[np.float64]
    calibration: Calibration

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Their known ranges, shape (n,)."""
        return np.array([sighting.range_m for sighting in self.sightings])

    @property
    def share(self) -> NDArray[np.float64]:
        """By how much each of them makes K, as a share: of the line through the origin, shape (n,)."""
        share = self.m_dn_per_s / (self.sigma_dn_per_s**2 * self.range_m**2)
        return np.asarray(share / share.sum())


FindIn = Callable[[Sequence[int], Calibration, str], list[_Sighting]]
"""Lets an estimator look, with a calibration, at the frames of some indices."""


def calibrate_rail(
    ranges_m: Mapping[int, float],
    load: Callable[[int], RawFrame],
    calibration: Calibration,
    progress: Progress = lambda _done, _total: None,
    axis_sigma: float = 0.0,
) -> RailCalibration:
    """Fit the range constants of one camera, and judge them on ranges held out.

    Places are the different ranges. In order of range, the first, third, … are fitted, the others held out.
    The brightest detection of a frame is the source.

    The detector needs a K to know how large a source looks: K too large by 1 % makes the flux 0.1 % too
    small. So the frames are looked at again with the K just found, until that changes by less than 0.03 %;
    what is left in K is a tenth of that. A claimed σ holds for a given K, so that of the fitted K comes out
    up to a tenth too large.

    Parameters
    ----------
    ranges_m
        Known range of each frame, by its index.
    load
        Gives the frame of an index.
    calibration
        Of the camera. Its range constant is only a first guess.
    progress
        Told how far each pass is.
    axis_sigma
        Relative σ of the response on the axis where flat frames gave it, and what is known of each pixel is
        divided out: what response and pixels make of a place together is then known, and K, which holds for
        the mean pixel on the axis, has this error at all places alike.

    Returns
    -------
    RailCalibration

    Raises
    ------
    RecordingError
        If there are fewer than 6 different ranges, or the source is found at fewer than two of them.
    """
    fitted, held_out = _split_places(ranges_m, calibration.camera)
    # One number for each place: the regression pools what stands at the same range.
    place_m = {index: ranges_m[place[0]] for place in (*fitted, *held_out) for index in place}

    def find(indices: Sequence[int], known: Calibration, estimator: str) -> list[_Sighting]:
        sightings = []
        for done, index in enumerate(indices):
            sightings.append(_brightest_in(load(index), place_m[index], known, estimator))
            progress(done + 1, len(indices))
        return sightings

    to_fit = [index for place in fitted for index in place]
    to_judge = [index for place in held_out for index in place]
    converged = _iterate_fit(find, to_fit, calibration)
    shared_share = math.hypot(_pixels_share(converged.measured), axis_sigma)
    paper = _fit_paper(find(to_fit, calibration, "paper"))
    known = _with_constants(calibration, converged, shared_share, paper)
    robust = find(to_judge, known, "robust")
    # Without a claim (a clipped flare that cannot be recovered) the range is an upper bound, no estimate.
    claimed = [s for s in robust if s.detection and math.isfinite(s.detection.range_sigma_m)]
    return RailCalibration(
        calibration=known,
        fit=converged.fit,
        paper=paper,
        places_fitted=len(fitted),
        places_held_out=len(held_out),
        frames_fitted=len(to_fit),
        frames_held_out=len(to_judge),
        misfits=sum(s.detection.merged for s in (*converged.sightings, *robust) if s.detection),
        passes=converged.passes,
        last_change=converged.change,
        share_spread=converged.share_spread,
        range_limit_m=_mean([_range_limit_m(s, s.detection, known) for s in robust if s.detection]),
        robust=_held_out_errors(claimed),
        judged_m=_judged_m(claimed),
        causes=tuple(
            cause
            for s in claimed
            if s.detection
            for cause in detection_causes([s.detection], known, s.gain, s.black_level_dn)
        ),
        paper_held_out=_held_out_errors(find(to_judge, known, "paper")),
    )


def places_of(ranges_m: Mapping[int, float]) -> list[list[int]]:
    """Return the frames of each place, a range of its own, in order of range."""
    places: list[list[int]] = []
    for index in sorted(ranges_m, key=lambda index: ranges_m[index]):
        if places and ranges_m[index] - ranges_m[places[-1][0]] < _SAME_PLACE_M:
            places[-1].append(index)
        else:
            places.append([index])
    return places


def _split_places(ranges_m: Mapping[int, float], camera: str) -> tuple[list[list[int]], list[list[int]]]:
    """Return the frames of the places to fit, and those of the places to judge on."""
    places = places_of(ranges_m)
    if len(places) < LEAST_PLACES:
        raise RecordingError(
            f"{camera}: {len(places)} different ranges are known. Record at least {LEAST_PLACES}: "
            "one half is fitted, the other judges it."
        )
    return places[0::2], places[1::2]


def _brightest_in(frame: RawFrame, range_m: float, calibration: Calibration, estimator: str) -> _Sighting:
    found = detect(frame, calibration, estimator)
    brightest = max(found, key=lambda detection: detection.flux_dn, default=None)
    return _Sighting(range_m, frame.exposure_s, frame.gain, frame.black_level_dn, brightest)


def _iterate_fit(find: FindIn, indices: Sequence[int], calibration: Calibration) -> _ConvergedFit:
    """Look and fit until the range constant does not change any more, or all passes are used up."""
    # The constant that is sought has no sigma yet, so a detection claims that of its flux alone. The size may
    # not say how far a source is, or the flux would follow from the constant that is being tried.
    free_size = {"source_radius_m": calibration.source_radius_m}
    known = replace(calibration, sigma={**_without_constants(calibration.sigma), **free_size})
    for passes in range(1, MAX_PASSES + 1):
        sightings = find(indices, known, "robust")
        measured = _measured(sightings, known)
        fit, share_spread = _fit_range_constant(measured, len(sightings))
        change = fit.range_constant_dn_m2_per_s / known.range_constant_dn_m2_per_s - 1.0
        converged = _ConvergedFit(fit, change, passes, tuple(sightings), measured, share_spread)
        if abs(change) < CONVERGED_CHANGE:
            break
        known = replace(known, range_constant_dn_m2_per_s=fit.range_constant_dn_m2_per_s)
    return converged


def _measured(sightings: Sequence[_Sighting], calibration: Calibration) -> _Measured:
    """Return what sightings tell of K.

    Flares that do not look like one source count too, with the wider sigmas that they claim: until K is near,
    that holds for all of them.
    """
    m, sigma, used = [], [], []
    frames_at = Counter(sighting.range_m for sighting in sightings if sighting.detection)
    fixed_at: dict[float, float] = {}
    for sighting in sightings:
        found = sighting.detection
        if found is None or not math.isfinite(found.range_sigma_m):
            continue
        effective_s = effective_exposure_s(
            found.u_px, found.v_px, sighting.exposure_s, sighting.gain, calibration
        )
        m.append(found.flux_dn / effective_s)
        # Offsets and responses of pixels are the same in each frame of a place: more frames do not help.
        if sighting.range_m not in fixed_at:
            fixed_at[sighting.range_m] = _fixed_share(sighting, found, calibration)
        together = math.sqrt(1.0 + (frames_at[sighting.range_m] - 1) * fixed_at[sighting.range_m])
        sigma.append(m[-1] * 2.0 * found.range_sigma_m / found.range_m * together)  # σ_d / d = ½ σ_F / F
        used.append(sighting)
    return _Measured(used, np.array(m), np.array(sigma), calibration)


def _fit_range_constant(measured: _Measured, sightings: int) -> tuple[RangeConstantFit, float]:
    """Regress the flux over its effective exposure; return the fit, and how the shares found spread.

    A detector that knows no glare finds of a flare's light a share that changes with its size, from place to
    place: how much that spreads is found too.
    """
    columns = measured.m_dn_per_s, measured.sigma_dn_per_s, measured.range_m
    try:
        if measured.calibration.glare_share > 0.0:
            return regress_with_spread(*columns)
        return regress_range_constant(*columns), 0.0
    except ValueError as error:
        raise RecordingError(
            f"{measured.calibration.camera}: the source was measured in {len(measured.sightings)} of "
            f"{sightings} frames to fit, and {error}. Look at the frames: is one source in view, alone, not "
            "clipped? Is the first guess of range_constant_dn_m2_per_s within a factor of 2?"
        ) from error


def _pixels_share(measured: _Measured) -> float:
    """Return the relative σ of K that comes of flares on the same pixels, beyond that of each place alone.

    Far along a rail the image hardly moves: what is fixed about its pixels is wrong at all of these places.
    """
    known, range_m, share = measured.calibration, measured.range_m, measured.share
    shape = (known.height_px, known.width_px)
    all_of, own_e2 = [np.zeros(shape), np.zeros(shape)], [0.0, 0.0]
    for place_m in np.unique(range_m):
        at = np.flatnonzero(range_m == place_m)
        parts = _fixed_influence(measured.sightings[int(at[0])], known)
        if parts is None:
            continue
        box, *of_causes = parts
        for number, cause in enumerate(of_causes):
            scaled = float(share[at].sum()) * cause
            all_of[number][box.slices] += scaled
            own_e2[number] += float((scaled**2).sum())
    shared = [float((total**2).sum()) - own for total, own in zip(all_of, own_e2, strict=True)]
    return math.sqrt(max(known.prnu**2 * shared[0] + known.dsnu_e**2 * shared[1], 0.0))


def _fixed_influence(
    sighting: _Sighting, calibration: Calibration
) -> tuple[PixelBox, NDArray[np.float64], NDArray[np.float64]] | None:
    found, camera = sighting.detection, at_gain(calibration, sighting.gain)
    if found is None or not found.flux_dn > 0.0:
        return None
    light_e = _light_e(sighting, found, camera)
    return fixed_influence(camera, found.u_px, found.v_px, sighting.range_m, *light_e)


def _light_e(sighting: _Sighting, found: Detection, camera: Calibration) -> tuple[float, float]:
    """Return flux and background in electrons, by a camera's calibration at the frame's gain."""
    gain = camera.system_gain_dn_per_e
    return found.flux_dn / gain, max(found.background_dn - sighting.black_level_dn, 0.0) / gain


def _fixed_share(sighting: _Sighting, found: Detection, calibration: Calibration) -> float:
    """Return which share of the flux's variance is fixed about the pixels."""
    camera = replace(at_gain(calibration, sighting.gain), sigma={})
    if not found.flux_dn > 0.0:
        return 0.0
    light_e = _light_e(sighting, found, camera)
    causes = range_causes(camera, found.u_px, found.v_px, sighting.range_m, *light_e)
    if causes is None:
        return 0.0
    fixed = causes.prnu_m**2 + causes.dsnu_m**2
    other = (causes.own_light_m, causes.background_m, causes.read_noise_m, causes.rounding_m)
    return fixed / (fixed + sum(part**2 for part in other))


def _fit_paper(sightings: Sequence[_Sighting]) -> PaperRegression | None:
    found = [
        (s.detection.mean_dn, s.detection.background_dn, s.exposure_s, s.range_m)
        for s in sightings
        if s.detection is not None and math.isfinite(s.detection.background_dn)
    ]
    if len({range_m for *_, range_m in found}) < 2:
        return None
    return regress_paper_range_constant(*zip(*found, strict=True))


def _without_constants(sigma: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in sigma.items() if not name.startswith("range_constant")}


def _with_constants(
    calibration: Calibration, converged: _ConvergedFit, shared_share: float, paper: PaperRegression | None
) -> Calibration:
    fit, sigma = converged.fit, _without_constants(calibration.sigma)
    share = math.hypot(converged.share_spread, shared_share)
    sigma["range_constant_dn_m2_per_s"] = math.hypot(
        fit.range_constant_sigma_dn_m2_per_s, share * fit.range_constant_dn_m2_per_s
    )
    if converged.share_spread > 0.0:  # under glare, of which the detector knows nothing, a size is no range
        sigma["source_radius_m"] = calibration.source_radius_m
    fitted = replace(calibration, range_constant_dn_m2_per_s=fit.range_constant_dn_m2_per_s, sigma=sigma)
    if paper is None:
        return fitted
    if math.isfinite(paper.slope_sigma_dn_m2_per_s):
        sigma["range_constant_paper_dn_m2_per_s"] = paper.slope_sigma_dn_m2_per_s
    return replace(fitted, range_constant_paper_dn_m2_per_s=paper.slope_dn_m2_per_s)


def _judged_m(sightings: Sequence[_Sighting]) -> NDArray[np.float64]:
    """Return true range, error and claimed σ of what was ranged, shape (n, 3)."""
    hits = [(s.range_m, s.detection) for s in sightings if s.detection]
    rows = [
        (true_m, hit.range_m - true_m, hit.range_sigma_m)
        for true_m, hit in hits
        if math.isfinite(hit.range_m)
    ]
    return np.array(rows).reshape(-1, 3)


def _held_out_errors(sightings: Sequence[_Sighting]) -> HeldOut:
    _, errors_m, sigma_m = _judged_m(sightings).T
    return HeldOut(
        found=errors_m.size,
        range_mae_m=_mean(np.abs(errors_m)),
        range_rmse_m=math.sqrt(_mean(errors_m**2)),
        range_bias_m=_mean(errors_m),
        reduced_chi2=_mean((errors_m / sigma_m) ** 2),
    )


def _range_limit_m(sighting: _Sighting, found: Detection, calibration: Calibration) -> float:
    """Return the Cramér–Rao σ of the range, from the known range and the background found."""
    # `flare_limit` knows no gain: a frame at another gain is one of a camera that has it for good. Priors are
    # the same in every frame: what is asked here is what one frame adds.
    same_camera = replace(at_gain(calibration, sighting.gain), sigma={})
    effective_s = float(
        effective_exposure_s(found.u_px, found.v_px, sighting.exposure_s, sighting.gain, calibration)
    )
    flux_dn = calibration.range_constant_dn_m2_per_s * effective_s / sighting.range_m**2
    _, background_e = _light_e(sighting, found, same_camera)
    limit = flare_limit(
        same_camera,
        found.u_px,
        found.v_px,
        sighting.range_m,
        flux_dn / same_camera.system_gain_dn_per_e,
        background_e,
    )
    return limit.range_sigma_m


def _mean(values: Sequence[float] | NDArray[np.float64]) -> float:
    return float(np.mean(values)) if np.size(values) else math.nan
