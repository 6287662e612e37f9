"""Point spread and glare from the frames of a rail: gathers the flares, and says what is known of them."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.calibration.glare_shape import averaged_over_glare
from perception.calibration.point_spread import (
    HALF_WINDOW_PX,
    PointSpreadFit,
    PointSpreadShape,
    StackedFlare,
    fit_point_spread,
)
from perception.calibration.rail import Progress, places_of
from perception.estimators import detect
from perception.files.fields import RecordingError
from perception.model.flare import PixelBox
from perception.model.sensor import gain_dn_per_e, saturation_dn, summed_floor_e2
from perception.types import Calibration, Detection, RawFrame

LEAST_PLACES = 2

_NOMINAL = PointSpreadShape(0.7, 0.01, 10.0, 2.5)
_GLARE_GAIN = 16.0
"""By how much glare must better χ² to be there: chance does so once in a thousand, for three numbers more."""

_STILL_PX = 0.05
_WIDE_CHI2 = 1.2
"""A fit whose reduced χ² is larger does not have the form of the model."""


@dataclass(frozen=True, eq=False)
class PointSpreadCalibration:
    """What a rail told of the point spread.

    Attributes
    ----------
    calibration
        As it was, but for width and glare, with their σ.
    sigma_px, sigma_sigma_px
        The Gaussian's width, and its σ.
    glare_share, glare_share_sigma
        0 where no glare shows; its σ then holds for glare of the shape 10 px, 2.5.
    glare_radius_px, glare_radius_sigma_px, glare_exponent, glare_exponent_sigma
        Its shape; NaN are the σ where no glare shows.
    glare_covariance
        Of g, ln r₀ and ln (γ − 1), shape (3, 3).
    reduced_chi2
        Of the pixels about their expectation.
    places, frames
        How many were used.
    """

    calibration: Calibration
    sigma_px: float
    sigma_sigma_px: float
    glare_share: float
    glare_share_sigma: float
    glare_radius_px: float
    glare_radius_sigma_px: float
    glare_exponent: float
    glare_exponent_sigma: float
    glare_covariance: NDArray[np.float64]
    reduced_chi2: float
    places: int
    frames: int

    @property
    def has_glare(self) -> bool:
        """Whether glare shows."""
        return self.glare_share > 0.0


def calibrate_point_spread(
    ranges_m: Mapping[int, float],
    load: Callable[[int], RawFrame],
    calibration: Calibration,
    progress: Progress = lambda _done, _total: None,
) -> PointSpreadCalibration:
    """Learn the width of the point spread, and glare, from one source at known ranges.

    Frames of one range are added up where the source rests, so that offsets that are fixed count once. Frames
    with a clipped pixel near the source are left out.

    Parameters
    ----------
    ranges_m
        Known range of each frame, by its index.
    load
        Gives the frame of an index.
    calibration
        Of the camera: noise, gain, intrinsics and the sources' radius. Its point spread is a first guess.
    progress
        Told how many frames are done, of how many.

    Raises
    ------
    RecordingError
        If at fewer than two ranges the source is found unclipped.
    """
    flares, done = [], 0
    for place in places_of(ranges_m):
        flares += _stacked([load(index) for index in place], ranges_m[place[0]], calibration)
        done += len(place)
        progress(done, len(ranges_m))
    if len(flares) < LEAST_PLACES:
        raise RecordingError(
            f"{calibration.camera}: its source shows unclipped at {len(flares)} places of the rail, wanted "
            f"{LEAST_PLACES} or more: shorten the exposure until the brightest pixel is below "
            f"saturation_dn = {calibration.saturation_dn}, and check that one source is in view"
        )
    has_radius_sigma = calibration.sigma.get("source_radius_m", 0.0) > 0.0
    start = replace(_NOMINAL, sigma_px=calibration.psf_sigma_px)
    plain = fit_point_spread(
        flares, calibration, replace(start, glare_share=0.0), (True, False, False, False, has_radius_sigma)
    )
    of_share = fit_point_spread(flares, calibration, start, (True, True, False, False, has_radius_sigma))
    best = of_share
    if of_share.shape.glare_share > 0.0:
        full = fit_point_spread(
            flares, calibration, of_share.shape, (True, True, True, True, has_radius_sigma)
        )
        if plain.chi2 - full.chi2 > _GLARE_GAIN and full.shape.glare_share > 0.0:
            best = averaged_over_glare(flares, calibration, full)
    return _told(best, best is not of_share, calibration, flares)


def _told(
    fit: PointSpreadFit, has_glare: bool, calibration: Calibration, flares: Sequence[StackedFlare]
) -> PointSpreadCalibration:
    reduced = fit.chi2 / fit.freedom
    # Where the model has not the form of what is seen, its σ are of no use as they are.
    widening = math.sqrt(max(reduced, 1.0)) if reduced > _WIDE_CHI2 else 1.0
    width, share, radius, exponent = (widening * np.sqrt(np.diagonal(fit.covariance)[:4])).tolist()
    shape, unknown = fit.shape, math.nan
    if not has_glare:
        shape = replace(_NOMINAL, sigma_px=shape.sigma_px, glare_share=0.0)
    sigma_sigma_px = shape.sigma_px * width
    radius_sigma_px = shape.glare_radius_px * radius if has_glare else unknown
    exponent_sigma = (shape.glare_exponent - 1.0) * exponent if has_glare else unknown
    sigma = {**calibration.sigma, "psf_sigma_px": sigma_sigma_px, "glare_share": share}
    if has_glare:
        sigma |= {"glare_radius_px": radius_sigma_px, "glare_exponent": exponent_sigma}
    else:
        sigma = {name: value for name, value in sigma.items() if name not in _GLARE_SHAPE}
    known = replace(
        calibration,
        psf_sigma_px=shape.sigma_px,
        glare_share=shape.glare_share,
        glare_radius_px=shape.glare_radius_px,
        glare_exponent=shape.glare_exponent,
        sigma=sigma,
    )
    return PointSpreadCalibration(
        calibration=known,
        sigma_px=shape.sigma_px,
        sigma_sigma_px=sigma_sigma_px,
        glare_share=shape.glare_share,
        glare_share_sigma=share,
        glare_radius_px=shape.glare_radius_px,
        glare_radius_sigma_px=radius_sigma_px,
        glare_exponent=shape.glare_exponent,
        glare_exponent_sigma=exponent_sigma,
        glare_covariance=widening**2 * fit.covariance[1:4, 1:4],
        reduced_chi2=reduced,
        places=len(flares),
        frames=sum(one.frames for one in flares),
    )


_GLARE_SHAPE = ("glare_radius_px", "glare_exponent")


def _stacked(frames: Sequence[RawFrame], range_m: float, calibration: Calibration) -> list[StackedFlare]:
    """Add up the frames of a range in which the source rests; those in which it does not stay apart."""
    groups: list[list[tuple[RawFrame, Detection]]] = []
    for frame in frames:
        found = max(detect(frame, calibration, "robust"), key=lambda one: one.flux_dn, default=None)
        if found is None or _is_clipped(frame, found, calibration):
            continue
        for group in groups:
            other = group[0][1]
            off_px = math.hypot(found.u_px - other.u_px, found.v_px - other.v_px)
            noise_px = math.hypot(found.u_sigma_px, found.v_sigma_px)
            if off_px < _STILL_PX + 5.0 * noise_px and frame.gain == group[0][0].gain:
                group.append((frame, found))
                break
        else:
            groups.append([(frame, found)])
    return [_sum(group, range_m, calibration) for group in groups]


def _sum(
    group: Sequence[tuple[RawFrame, Detection]], range_m: float, calibration: Calibration
) -> StackedFlare:
    first, count = group[0][1], len(group)
    gain = gain_dn_per_e(group[0][0], calibration)
    box = PixelBox.around(first.u_px, first.v_px, HALF_WINDOW_PX, calibration)
    total = np.zeros((box.height, box.width))
    for frame, _ in group:
        total += (frame.data_dn[box.slices] - frame.black_level_dn) / gain
    floor_e2 = summed_floor_e2(replace(calibration, dsnu_e=0.0), count, group[0][0].gain)
    return StackedFlare(range_m, count, first.u_px, first.v_px, box, total, floor_e2)


def _is_clipped(frame: RawFrame, found: Detection, calibration: Calibration) -> bool:
    box = PixelBox.around(found.u_px, found.v_px, HALF_WINDOW_PX, calibration)
    return bool((frame.data_dn[box.slices] >= saturation_dn(calibration, frame.gain)).any())
