"""The robust detector: flares found against the noise of one frame, and measured by maximum likelihood."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import bearing_body
from perception.model.discs.nodes import smoothing_px
from perception.model.fog import loosened, may_be_in_fog, range_in_fog_m, ranged_in_fog, size_alone
from perception.model.ranging import flux_at_one_metre_dn
from perception.model.sensor import check_frame, gain_dn_per_e
from perception.model.window import Camera
from perception.robust.clusters import Cluster, brightest, candidates, clusters, is_extended
from perception.robust.flare import MeasuredFlare
from perception.robust.goodness import is_likely
from perception.robust.measure import as_it_turns, measure
from perception.robust.overlap.free_fits import log_range_of_calibration
from perception.robust.search.blobs import Blob, blobs_at, is_large, split_at_peaks
from perception.robust.search.frame import levels_around
from perception.robust.search.hills import prominent, summit
from perception.robust.search.near import most_brightness
from perception.robust.search.prepare import PreparedFrame, prepare
from perception.robust.search.reason import reason_of_none
from perception.robust.solve import Solution
from perception.robust.starts.at_rest import by_blobs
from perception.robust.together.free_width import (
    NOTHING_SEEN,
    log_range_slopes,
    log_width_of_calibration,
    seen_log_width,
    tells_width,
)
from perception.types import Calibration, Detection, Detections, RawFrame

CONTRAST_SIGMAS = 6.03
"""As for detection against the coarse background: Gaussian noise passes 8e-10 of the time."""

MOST_FLARES = 1000
"""The robust detector measures no more blobs of a frame than this, the brightest: it bounds the time."""

_AT_ONCE = 8  # clusters between two looks at the clock
_TELL_OF_TURN = 32  # clusters that are asked whether the camera turns, where time is limited
_RING_PX = 4
_SUMMIT_REACH = 4.0  # σ of the point spread: three of what it is filtered to, √2 times as wide
_FEWEST_RING_PIXELS = 8
_LEAST_DISC_PX2 = 30
_MOSTLY_SEEN = 0.7  # of the brightness of sources
_LEAST_OF_PART = 0.25
_TELLS_SIZE_PX, _MOST_TESTED = 3.0, 8
_TELLS_WIDTH_SNR = 20.0
_LARGE_HILL = 8  # times the square that a point's image reaches


def detect_robust(frame: RawFrame, calibration: Calibration, limit_s: float = math.inf) -> Detections:
    """Flares found against the local background and measured by maximum likelihood.

    Counts become electrons; a background on a coarse mesh is subtracted; the rest is matched to the image of
    a point and compared with the level that noise alone passes once in a thousand frames. Each component
    is fitted with the image of a source of known size and strength, or with those of several.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Its camera's calibration.
    limit_s
        After so much time no further flares are begun with; the brightest come first.

    Returns
    -------
    Detections
        From top to bottom; `truncated` where time, or the number of blobs or of flares in one, ended the
        search, and with the `reason` if there are none. `area_px` and `mean_dn` are those of the pixels above
        the detection limit, and above what lies beside a flare that stands on a hill of light.
        `saturated`: a pixel is clipped, which counts as censored. Where that does not determine the range
        `range_sigma_m` is NaN, the flux a lower bound and the range an upper one; of a disc of more than 28
        px radius also where none explains it whole: of one not clipped that is `merged`. Flares that
        overlap are fitted together (`deblend`), and their sigmas know of it; behind a rolling shutter a blob
        stays one. One that moves is drawn out (`motion`): its place is that in the middle of the exposure.
        `merged`: what is seen does not look like one source, nor like several that can be told apart; its
        sigmas are then widened by √χ². So is called what may be one that moves or two at rest; its sigmas
        cover both. `ghost` is never set: one frame cannot tell a mirror image from a source. What is no
        source by shape, size or brightness is left out, and so is what does not stand out from what lies
        right beside it, and all but the brightest thousand.

    Raises
    ------
    ValueError
        If frame and calibration do not belong together (`sensor.check_frame`).
    """
    started = time.perf_counter()
    check_frame(frame, calibration)
    in_fog = may_be_in_fog(calibration)
    prepared = prepare(frame, loosened(calibration) if in_fog else calibration)
    found = blobs_at(prepared.lit_at, prepared.lit_e, calibration.width_px)
    middles_e = _middles_e(found, prepared)
    blobs = [
        blob
        for component, middle_e in zip(found, middles_e, strict=True)
        for blob in _split(component, middle_e, prepared)
    ]
    if blobs != found:  # divided, or cut
        middles_e = _middles_e(blobs, prepared)
    blobs = _above_surroundings(blobs, middles_e, prepared)
    flares = [each for each in candidates(blobs, prepared) if not is_extended(each, prepared)]
    groups = clusters(brightest(flares, MOST_FLARES), prepared)
    camera = Camera(prepared.calibration, frame.exposure_s, frame.gain)
    measured, late, camera = _measured(groups, prepared, camera, started + limit_s)
    truncated = late or len(flares) > MOST_FLARES or any(found.may_be_more for _, found in measured)
    measured.sort(key=lambda each: (each[0].box.top, each[0].box.left))
    reported = [(blob, found) for blob, found in measured if found.stands_out]
    if not reported:
        return Detections(reason=reason_of_none(prepared, len(blobs), late=late), truncated=truncated)
    range_doubt = psf_width_off = 0.0
    seen = NOTHING_SEEN
    if in_fog:
        reported = list(_in_fog(reported, frame, calibration))
    else:
        seen = seen_log_width(_telling_points([found for _, found in reported]), camera)
        log_width = log_width_of_calibration(seen, camera)
        doubts = _log_range_doubts(
            [found for _, found in reported], log_width, camera, is_at_once=frame.line_time_s == 0.0
        )
        if any(doubts):
            range_doubt, psf_width_off = median(filter(None, doubts)), math.expm1(log_width)
            reported = [
                (blob, found.doubted(doubt)) for (blob, found), doubt in zip(reported, doubts, strict=True)
            ]
    bearings = bearing_body([[found.u_px, found.v_px] for _, found in reported], calibration).tolist()
    return Detections(
        (
            _detection(blob, found, (x, y, z), frame, calibration)
            for (blob, found), (x, y, z) in zip(reported, bearings, strict=True)
        ),
        truncated=truncated,
        range_doubt=range_doubt,
        psf_width_off=psf_width_off,
        psf_width_seen=seen,
        swept_px=_swept_px([found for _, found in reported], camera),
    )


def _measured(
    found: Sequence[Cluster], prepared: PreparedFrame, camera: Camera, until_s: float
) -> tuple[list[tuple[Blob, MeasuredFlare]], bool, Camera]:
    """Measure clusters, the brightest first where time is limited; tell whether it was up before all.

    And return the camera as it turns, if it does.
    """
    if until_s == math.inf:
        measured, camera = measure(found, prepared, camera)
        return measured, False, camera
    by_flux = sorted(found, key=lambda each: -max(each.members[k].flux_e for k in each.wanted))
    measured = []
    if time.perf_counter() < until_s:  # all of the flares are to be fitted alike
        lone = [each for each in by_flux if len(each.members) == 1 and not each.members[0].is_beyond_fit]
        camera = as_it_turns(by_blobs(lone[:_TELL_OF_TURN], prepared, camera), prepared, camera)
    for first in range(0, len(by_flux), _AT_ONCE):
        if time.perf_counter() >= until_s:
            return measured, True, camera
        more, camera = measure(by_flux[first : first + _AT_ONCE], prepared, camera)
        measured += more
    return measured, False, camera


def _swept_px(found: Sequence[MeasuredFlare], camera: Camera) -> float:
    """Return how far the flares of a frame are swept as the camera turns, in their median."""
    swept_px = camera.swept_px(np.array([(one.u_px, one.v_px) for one in found]))
    return 0.0 if swept_px is None else float(np.median(np.hypot(*swept_px.T)))


def _log_range_doubts(
    found: Sequence[MeasuredFlare], log_width: float, camera: Camera, *, is_at_once: bool
) -> list[float]:
    """Return how far the range of each flare may be off because the calibration is, as all of them tell.

    By how much ln of the point spread's width is is known.
    """
    discs = _telling_discs(found, is_at_once=is_at_once)
    by_discs = log_range_of_calibration(discs, camera)
    # One disc may be a mirror image, and says nothing of others.
    doubts = [by_discs if len(discs) > 1 or one.alone in discs else 0.0 for one in found]
    if log_width != 0.0:
        lone = {k: one.lone for k, one in enumerate(found) if one.lone is not None}
        slopes = abs(log_range_slopes(list(lone.values()), camera))
        usual = float(np.nanmedian(slopes))
        known = dict(zip(lone, np.where(np.isnan(slopes), usual, slopes).tolist(), strict=True))
        doubts = [max(doubt, abs(log_width) * known.get(k, usual)) for k, doubt in enumerate(doubts)]
    return doubts


def _telling_points(found: Sequence[MeasuredFlare]) -> list[Solution]:
    """Return lone flares that are hardly resolved: their width tells of the point spread."""
    return [
        one
        for flare in found
        if (one := flare.lone) is not None and tells_width(one)
        if one.window.is_even
        if float(one.image_radius_px[0]) <= _TELLS_SIZE_PX
        if float(one.flux_e[0]) > _TELLS_WIDTH_SNR * float(one.flux_noise_e[0])
    ]


def _telling_discs(found: Sequence[MeasuredFlare], *, is_at_once: bool) -> list[Solution]:
    """Return the largest lone discs: their flux and their size tell of the calibration.

    Behind a rolling shutter motion draws them out, and is not fitted.
    """
    lone = [one.alone for one in found if one.alone is not None]
    discs = [one for one in lone if float(one.radius_at_rest_px[0]) > _TELLS_SIZE_PX]
    if not is_at_once:
        discs = [one for one in discs if is_likely(2, one.drawn_out[0])]
    discs.sort(key=lambda one: -float(one.radius_at_rest_px[0]))
    return discs[:_MOST_TESTED]


def _in_fog(
    found: Sequence[tuple[Blob, MeasuredFlare]], frame: RawFrame, calibration: Calibration
) -> Iterator[tuple[Blob, MeasuredFlare]]:
    """Yield flares that were fitted with any size, with ranges as fog allows; bounds by flux."""
    u_px, v_px, flux_e, flux_sigma_e, both_m, both_sigma_m, doubt, doubt_common = np.array(
        [
            (
                one.u_px, one.v_px, one.flux_e, one.flux_sigma_e, one.range_m, one.range_sigma_m,
                one.log_range_doubt, one.log_range_doubt_common,
            )
            for _, one in found
        ]
    ).T  # fmt: skip
    at_1_m_dn = flux_at_one_metre_dn(u_px, v_px, frame.exposure_s, frame.gain, calibration)
    with np.errstate(invalid="ignore"):
        by_flux_m = np.sqrt(at_1_m_dn / (flux_e * gain_dn_per_e(frame, calibration)))
    share_sigma = flux_sigma_e / flux_e
    known = np.isfinite(both_sigma_m) & np.isfinite(by_flux_m)
    bound_m = range_in_fog_m(np.where(known, 1.0, by_flux_m), calibration.extinction_per_m)
    by_flux_m = np.where(known, by_flux_m / (1.0 + 0.375 * np.minimum(share_sigma, 1.0) ** 2), 1.0)
    both_m, both_sigma_m = np.where(known, both_m, 1.0), np.where(known, both_sigma_m, 1.0)
    size_m, size_sigma_m = size_alone(both_m, both_sigma_m, by_flux_m, share_sigma)
    ranges = ranged_in_fog(by_flux_m, share_sigma, size_m, size_sigma_m, calibration)
    slope = 1.0 / (1.0 + 0.5 * calibration.extinction_per_m * ranges.range_m)
    ranges = ranges.doubted(slope * doubt, slope * doubt_common)
    for k, (blob, one) in enumerate(found):
        if not known[k]:
            yield blob, replace(one, range_m=float(bound_m[k]))
            continue
        yield (
            blob,
            replace(
                one,
                range_m=float(ranges.range_m[k]),
                range_sigma_m=float(ranges.range_sigma_m[k]),
                range_sigma_common_m=float(ranges.range_sigma_common_m[k]),
                range_by_size_m=float(size_m[k]),
                range_by_size_sigma_m=float(size_sigma_m[k]),
            ),
        )


def _above_surroundings(
    blobs: Sequence[Blob], middles_e: Sequence[float], prepared: PreparedFrame
) -> list[Blob]:
    """Return the blobs whose peak exceeds the level of a ring around them by more than noise does.

    The sheen of a lamp on metal, or a wall's lit corner, bends within a cell of the background mesh; on the
    slope that is left, noise alone passes the detection limit. The ring lies just outside the PSF's reach and
    takes that slope with it. Its median is blind to other flares in less than half of it. Also returned are
    those of whose ring the frame's edges leave too little.

    Parameters
    ----------
    blobs, middles_e
        What exceeds the detection limit, and the background in the middle of each.
    prepared
        The frame it was found in.
    """
    boxes = np.array([blob.box.corner_and_size for blob in blobs], dtype=np.int64).reshape(-1, 4)
    gap_px = math.ceil(3.0 * prepared.calibration.psf_sigma_px) + 1
    levels_e, counts = levels_around(
        prepared.pixels, prepared.kernel, prepared.bad_at, boxes, gap_px, _RING_PX
    )
    kept = []
    rows = zip(blobs, middles_e, levels_e.tolist(), counts.tolist(), strict=True)
    for blob, middle_e, level_e, count in rows:
        noise_e = prepared.filtered_noise * math.sqrt(max(level_e + middle_e, 0.0) + prepared.floor_e2)
        if count < _FEWEST_RING_PIXELS or blob.peak_e - level_e > CONTRAST_SIGMAS * noise_e:
            kept.append(blob)
    return kept


def _middles_e(blobs: Sequence[Blob], prepared: PreparedFrame) -> list[float]:
    """Return the background in the middle of each blob's box."""
    boxes = [blob.box for blob in blobs]
    return prepared.backgrounds_e((b.left + 0.5 * b.width, b.top + 0.5 * b.height) for b in boxes)


def _split(component: Blob, middle_e: float, prepared: PreparedFrame) -> list[Blob]:
    """Divide a component, on such a background, at maxima that differ by more than their noise.

    Parts are cut off hills, where they are large or the background has structure; but not where they are
    discs as bright as near sources, whose many maxima are noise, several or not.
    """
    expected_e = np.maximum(component.filtered_e + np.float32(middle_e), np.float32(0.0))
    noise_e = np.sqrt(expected_e + np.float32(prepared.floor_e2)) * np.float32(prepared.filtered_noise)
    reach_px = math.ceil(_SUMMIT_REACH * smoothing_px(prepared.calibration))
    least_px = _LARGE_HILL * (reach_px + 1) ** 2
    clips = component.pixels & prepared.clipped_in(component.box) if is_large(component) else None
    disc_e = _disc_level_e(component, prepared)
    if disc_e < math.inf:
        clips = component.filtered_e > disc_e
    parts = split_at_peaks(component, noise_e, flat=clips, most_e=disc_e)
    return [
        flare
        for part in parts
        for flare in (
            _off_hill(part, component, noise_e, reach_px, prepared)
            if not _is_disc(part, disc_e) and (part.area_px >= least_px or prepared.is_structured(part.box))
            else [part]
        )
    ]


def _disc_level_e(component: Blob, prepared: PreparedFrame) -> float:
    """Return from which level on what is lit in a component belongs to near sources; infinite if to none."""
    box = component.box
    if component.area_px < _LEAST_DISC_PX2 or prepared.clipped_in(box).any():
        return math.inf
    of_source_e = prepared.brightness_e(box.left + 0.5 * box.width, box.top + 0.5 * box.height)
    if not 0.0 < of_source_e < math.inf:
        return math.inf
    most_e = most_brightness(prepared.calibration) * of_source_e
    level_e = _MOSTLY_SEEN * of_source_e
    if not level_e < component.peak_e < most_e:
        return math.inf
    is_disc = np.count_nonzero(component.filtered_e > level_e) >= _LEAST_DISC_PX2
    return level_e if is_disc else math.inf


def _is_disc(part: Blob, disc_e: float) -> bool:
    """Tell whether much of a part is as bright as near sources are, and not a flare's middle on a hill."""
    bright_px = np.count_nonzero(part.filtered_e > disc_e)
    return bool(bright_px >= max(_LEAST_DISC_PX2, _LEAST_OF_PART * part.area_px))


def _off_hill(
    part: Blob, component: Blob, noise_e: NDArray[np.float32], reach_px: int, prepared: PreparedFrame
) -> list[Blob]:
    """Cut a part of a component, and what else stands out of it, off the hill that it stands on."""
    peak = np.argmax(np.where(part.pixels, part.filtered_e, np.float32(-np.inf)))
    row, column = divmod(int(peak), part.box.width)
    down, across = part.box.top - component.box.top + row, part.box.left - component.box.left + column
    clips = part.pixels & prepared.clipped_in(part.box)
    if clips[row, column] and not is_large(part):
        return [part]  # as `summit` would
    around = component.filtered_e[max(down - 1, 0) : down + 2, max(across - 1, 0) : across + 2]
    # What is clipped is left alone, but where it is too large to be fitted with its hill.
    left_alone = np.zeros_like(clips) if is_large(part) else clips
    # Its brightest pixel may be the flank of another, larger one.
    flare = part if around.max() > part.peak_e else summit(part, left_alone, reach_px)
    if flare is not part or part.area_px < _LARGE_HILL * (reach_px + 1) ** 2 or clips.any():
        return [flare]
    return prominent(part, component, noise_e, reach_px, prepared.shape) or [part]


def _detection(
    blob: Blob,
    measured: MeasuredFlare,
    bearing: tuple[float, float, float],
    frame: RawFrame,
    calibration: Calibration,
) -> Detection:
    gain = gain_dn_per_e(frame, calibration)
    return Detection(
        camera=frame.camera,
        index=frame.index,
        time_s=frame.time_s,
        u_px=measured.u_px,
        v_px=measured.v_px,
        u_sigma_px=measured.u_sigma_px,
        v_sigma_px=measured.v_sigma_px,
        flux_dn=measured.flux_e * gain,
        mean_dn=float(frame.data_dn[blob.box.slices][blob.pixels].mean()),
        background_dn=frame.black_level_dn + measured.background_e * gain,
        area_px=blob.area_px,
        saturated=measured.saturated,
        merged=measured.misfit or measured.is_doubtful,
        ghost=False,
        range_m=measured.range_m,
        range_sigma_m=measured.range_sigma_m,
        bearing_body=bearing,
        flux_sigma_dn=measured.flux_sigma_e * gain,
        range_sigma_common_m=measured.range_sigma_common_m,
        range_by_size_m=measured.range_by_size_m,
        range_by_size_sigma_m=measured.range_by_size_sigma_m,
    )
