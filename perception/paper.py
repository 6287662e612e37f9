"""The paper's estimators to the letter, in the order of its text, to be read beside it.

"Infra-Swarm: Robust Vision-Based Multi-Robot Swarming via Near-Infrared Spectral Vision", Chen, Li et al.
Section "Methodology": the range from the mean grey value (eq. 1), how flares are found and their grey values
taken, the bearing (eqs. 4 to 6); section "Experimental Results": the range constant (Exp1). They are kept to
be measured, biases included; the sound estimates lie in `model` and `robust`. What the paper leaves open, and
what is done here, stands at each function.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.model.bearing import direction_camera
from perception.model.flare import PixelBox
from perception.model.sensor import check_frame, saturation_dn
from perception.robust.search.blobs import components
from perception.types import Calibration, Detection, RawFrame

# --- Grayscale-based Ranging ----------------------------------------------------------------------------

THRESHOLD_OF_MEAN = 2.0
"""The threshold is "twice the global mean grayscale value of the current frame"."""

MIN_AREA_PX = 5
"""A_k > 4."""

ASPECT = (0.8, 1.2)
"""Aspect ratio "between 0.8 and 1.2"; both ends are taken to pass."""

# Free choices where the paper says "sampled from the immediate vicinity": a ring of 3 px about the bounding
# box, kept 2 px away from it because the skirt of the flare lies below the paper's threshold.
RING_GAP_PX = 2
RING_WIDTH_PX = 3


def range_paper_m(mean_dn: float, background_dn: float, exposure_s: float, calibration: Calibration) -> float:
    """Range from the mean grey value, the paper's eq. 1 to the letter.

    d = √(K t / (N_d - N̄)). It knows neither gain nor field angle, and N_d does not fall as 1/d²: the flux
    does, but N_d is the flux over an area that changes with the range. A disc that the pixels resolve keeps
    its grey value; the mask of a point shrinks as it fades (docs/physics.md, Ranging). The
    sound estimate is `ranging.range_from_flux`.

    Parameters
    ----------
    mean_dn
        N_d, mean counts over the flare.
    background_dn
        N̄, local background in counts.
    exposure_s
        Exposure time t.
    calibration
        K is `range_constant_paper_dn_m2_per_s`.

    Returns
    -------
    Range in metres, NaN where the flare is not brighter than its background.
    """
    signal_dn = mean_dn - background_dn
    if not signal_dn > 0.0:
        return math.nan
    return math.sqrt(calibration.range_constant_paper_dn_m2_per_s * exposure_s / signal_dn)  # eq. 1


@dataclass(frozen=True)
class GreyLevels:
    """Mean grey value of a blob and of its surroundings, counts as read (black level included)."""

    mean_dn: float
    background_dn: float


def grey_levels_paper(
    data_dn: NDArray[np.uint16], blob: NDArray[np.bool_], lit: NDArray[np.bool_], box: PixelBox
) -> GreyLevels:
    """N_d and N̄ of the paper's eq. 1.

    N_d is the mean over the blob's pixels, clipped ones included: the paper does not look at them. N̄ is the
    mean over a ring about the blob's bounding box (gap 2 px, width 3 px, our choice), leaving out every
    pixel above the frame's threshold, so that a neighbour does not count as background.

    Parameters
    ----------
    data_dn
        The whole frame, shape (rows, columns).
    blob
        The blob's pixels within its box, shape (box.height, box.width).
    lit
        All pixels above the threshold, shape (rows, columns).
    box
        Bounding box of the blob.

    Returns
    -------
    GreyLevels
        `background_dn` is NaN if no pixel of the ring lies within the frame and below the threshold.
    """
    reach = RING_GAP_PX + RING_WIDTH_PX
    top, left = max(0, box.top - reach), max(0, box.left - reach)
    around = (slice(top, box.top + box.height + reach), slice(left, box.left + box.width + reach))
    ring = ~lit[around]
    gap_top, gap_left = max(0, box.top - RING_GAP_PX), max(0, box.left - RING_GAP_PX)
    ring[
        gap_top - top : box.top + box.height + RING_GAP_PX - top,
        gap_left - left : box.left + box.width + RING_GAP_PX - left,
    ] = False
    background = data_dn[around][ring]
    return GreyLevels(
        mean_dn=float(data_dn[box.slices][blob].mean()),
        background_dn=float(background.mean()) if background.size else math.nan,
    )


def detect_paper(frame: RawFrame, calibration: Calibration) -> list[Detection]:
    """Flares as the paper finds and ranges them (its section "Grayscale-based Ranging"), to the letter.

    Pixels above twice the frame's mean grey value (raw: black level included), connected components of
    area > 4 px whose bounding box has an aspect within [0.8, 1.2]; range from the mean grey (eq. 1), bearing
    from the centroid (eqs. 4 to 6).

    What the paper leaves open, and what is done here: components have 8 neighbours; the aspect is width /
    height, both ends included; the centroid is that of the blob's pixels, unweighted; N̄ comes from a ring
    (`grey_levels_paper`); the range constant is used as it is, whatever the frame's gain.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Its camera's calibration.

    Returns
    -------
    Detections
        From top to bottom. The paper claims no uncertainty: all sigmas are NaN. `flux_dn` is
        (N_d - N̄) · area. `saturated` is set where a pixel of the blob is clipped; `merged` and `ghost`
        never.

    Raises
    ------
    ValueError
        If frame and calibration do not belong together (`sensor.check_frame`).
    """
    check_frame(frame, calibration)
    data = frame.data_dn
    lit = data > THRESHOLD_OF_MEAN * float(data.mean(dtype=np.float64))
    clipped_dn = saturation_dn(calibration, frame.gain)
    found = []
    for blob in components(lit, MIN_AREA_PX):
        aspect = blob.box.width / blob.box.height
        if not ASPECT[0] <= aspect <= ASPECT[1]:
            continue
        grey = grey_levels_paper(data, blob.pixels, lit, blob.box)
        rows, columns = np.nonzero(blob.pixels)
        u_px, v_px = blob.box.left + float(columns.mean()), blob.box.top + float(rows.mean())
        x, y, z = bearing_body_paper([[u_px, v_px]], calibration)[0].tolist()
        found.append(
            Detection(
                camera=frame.camera,
                index=frame.index,
                time_s=frame.time_s,
                u_px=u_px,
                v_px=v_px,
                u_sigma_px=math.nan,
                v_sigma_px=math.nan,
                flux_dn=(grey.mean_dn - grey.background_dn) * blob.area_px,
                mean_dn=grey.mean_dn,
                background_dn=grey.background_dn,
                area_px=blob.area_px,
                saturated=bool(np.any(data[blob.box.slices][blob.pixels] >= clipped_dn)),
                merged=False,
                ghost=False,
                range_m=range_paper_m(grey.mean_dn, grey.background_dn, frame.exposure_s, calibration),
                range_sigma_m=math.nan,
                bearing_body=(x, y, z),
            )
        )
    return found


# --- Directional Bearing Estimation ---------------------------------------------------------------------


def bearing_body_paper(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """Bearings by the paper's eqs. 4 to 6 to the letter: a biased estimate, kept to be measured.

    Eq. 6 puts [p_cam; 1] through the full pose T_c^b and normalises the first three components. p_cam is a
    *unit* vector, so the camera's offset on the robot is added as if every source were one metre away: the
    bearing leans towards the offset, by up to atan(offset / 1 m), whatever the range. (The sound estimate is
    `bearing.bearing_body`.)

    Parameters
    ----------
    points_px
        Image points (u, v), shape (n, 2).
    calibration
        Intrinsics, and the camera's pose on the robot.

    Returns
    -------
    Unit vectors, shape (n, 3).
    """
    p_cam = direction_camera(points_px, calibration)  # eqs. 4 and 5; R_i2c is the identity here
    p_body = p_cam @ calibration.rotation_body_camera.T + calibration.position_body_m  # eq. 6
    return np.asarray(p_body / np.linalg.norm(p_body, axis=1, keepdims=True))


# --- Exp1: Calibration and Ranging Accuracy -------------------------------------------------------------


@dataclass(frozen=True)
class PaperRegression:
    """Line m = slope / d² + intercept with the standard errors of both.

    `slope_dn_m2_per_s` is the paper's K (`Calibration.range_constant_paper_dn_m2_per_s`). An intercept that
    differs from zero by more than its sigma says that the law does not hold over these ranges.
    """

    slope_dn_m2_per_s: float
    intercept_dn_per_s: float
    slope_sigma_dn_m2_per_s: float
    intercept_sigma_dn_per_s: float


def regress_paper_range_constant(
    mean_dn: ArrayLike, background_dn: ArrayLike, exposure_s: ArrayLike, range_m: ArrayLike
) -> PaperRegression:
    """Fit the paper's range constant: m = (N_d - N̄)/t against 1/d², ordinary least squares.

    Unweighted, with an intercept, as the paper's Exp1 states it ("the slope is K").

    Parameters
    ----------
    mean_dn, background_dn
        N_d and N̄ of each image, shape (n,).
    exposure_s
        Exposure of each image, shape (n,), or one for all.
    range_m
        Known distances, shape (n,).

    Returns
    -------
    PaperRegression
        The sigmas are the usual standard errors (residual variance over n - 2); NaN for n = 2.

    Raises
    ------
    ValueError
        If there are fewer than two different ranges, or a value is not finite, or a range or exposure is
        not positive.

    Examples
    --------
    >>> regress_paper_range_constant([864.0, 264.0], 64.0, 2e-3, [1.0, 2.0]).slope_dn_m2_per_s
    400000.0
    """
    mean, background, exposure, distance = np.broadcast_arrays(
        *(
            np.atleast_1d(np.asarray(a, dtype=np.float64))
            for a in (mean_dn, background_dn, exposure_s, range_m)
        )
    )
    if not all(np.all(np.isfinite(a)) for a in (mean, background, exposure, distance)):
        raise ValueError("the regression takes finite values only; leave out frames without a detection")
    if np.any(exposure <= 0.0) or np.any(distance <= 0.0):
        raise ValueError("exposures and ranges must be positive")
    m = (mean - background) / exposure
    x = 1.0 / distance**2  # m = K d⁻² (Exp1)
    spread = float(np.sum((x - x.mean()) ** 2))
    if np.unique(distance).size < 2 or spread == 0.0:
        raise ValueError("a slope needs at least two different ranges")
    slope = float(np.sum((x - x.mean()) * (m - m.mean()))) / spread
    intercept = float(m.mean()) - slope * float(x.mean())
    slope_sigma = intercept_sigma = math.nan
    if m.size > 2:
        residual_variance = float(np.sum((m - slope * x - intercept) ** 2)) / (m.size - 2)
        slope_sigma = math.sqrt(residual_variance / spread)
        intercept_sigma = math.sqrt(residual_variance * (1.0 / m.size + float(x.mean()) ** 2 / spread))
    return PaperRegression(slope, intercept, slope_sigma, intercept_sigma)
