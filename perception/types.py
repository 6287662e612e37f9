"""What perception reads and what it says: raw frames, calibration, detections.

Pixel coordinates follow OpenCV: (0, 0) is the centre of the top left pixel, u to the right, v down.
Camera axes: x right, y down, z forward. Body axes: x forward, y left, z up.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FrameKey = tuple[str, int]
"""Which frame of a recording: camera and index."""


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One raw frame as the sensor delivers it, without scaling or gamma.

    `time_s` is the start of the exposure of row 0, `line_time_s` the delay between rows (0 for a global
    shutter), `gain` the factor on the calibrated system gain (1: as calibrated), `data_dn` the counts,
    uint16, shape (rows, columns).
    """

    camera: str
    index: int
    time_s: float
    exposure_s: float
    data_dn: NDArray[np.uint16]
    black_level_dn: float
    line_time_s: float = 0.0
    gain: float = 1.0

    def _repr_png_(self) -> bytes:
        """Show the frame as a picture in a notebook, tone-mapped."""
        from perception.picture import frame_png

        return frame_png(self.data_dn, self.black_level_dn)


@dataclass(frozen=True, eq=False)
class Calibration:
    """All that perception may know about one camera, and about the sources it looks for.

    Attributes
    ----------
    camera
        Name, `robot.camera`.
    width_px, height_px, fx_px, fy_px, cx_px, cy_px
        Intrinsics.
    lens_model, distortion
        `rectilinear`, or a model of OpenCV's with its coefficients in OpenCV's order: `brown_conrady` (k1,
        k2, p1, p2[, k3[, k4, k5, k6]]) or `fisheye` (k1, k2, k3, k4).
    rotation_body_camera
        Rotation that takes camera axes to body axes, shape (3, 3).
    position_body_m
        The camera's centre in body axes, shape (3,).
    system_gain_dn_per_e, read_noise_e, black_level_dn, saturation_dn, bit_depth
        EMVA 1288 linear model. A pixel at or above `saturation_dn` is clipped.
    dsnu_e, prnu
        Standard deviations of the pixels' fixed offsets and relative responses (EMVA 1288). Which pixel
        has which is not known: they add to the noise of a place, and do not average over frames.
    psf_sigma_px
        Standard deviation of the Gaussian point spread function, without the pixel's own aperture.
    response_angle_rad, response_relative
        Response (filter, vignetting) against field angle (increasing from 0), relative to the axis, shape
        (n,) each.
        The cosine of the tilted lens aperture is not part of it.
    range_constant_dn_m2_per_s
        K of the *integrated* flux: flux_dn = K · exposure · cos θ · response(θ) / range².
    range_constant_paper_dn_m2_per_s
        K of the paper's mean grey value (its eq. 1), from the paper's own regression (Exp1); NaN where its
        detector finds too little to calibrate with.
    source_radius_m
        Radius of a source, a sphere.
    wavelength_m
        Centre wavelength.
    sigma
        Standard deviation of entries, by field name; an entry that is missing is taken as exact.
    """

    camera: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    rotation_body_camera: NDArray[np.float64]
    position_body_m: NDArray[np.float64]
    system_gain_dn_per_e: float
    read_noise_e: float
    black_level_dn: float
    saturation_dn: int
    bit_depth: int
    psf_sigma_px: float
    response_angle_rad: NDArray[np.float64]
    response_relative: NDArray[np.float64]
    range_constant_dn_m2_per_s: float
    range_constant_paper_dn_m2_per_s: float
    source_radius_m: float
    wavelength_m: float
    sigma: Mapping[str, float] = field(default_factory=dict)
    lens_model: str = "rectilinear"
    distortion: tuple[float, ...] = ()
    dsnu_e: float = 0.0
    prnu: float = 0.0


@dataclass(frozen=True, eq=False)
class Detection:
    """One flare found in one frame.

    `flux_dn` is the background-subtracted integral, `mean_dn` the mean grey value over the blob as read
    (black level included), `background_dn` the local background as read. `range_sigma_m` and the pixel
    sigmas are what the estimator claims; NaN where it makes no claim. `range_m` is NaN where no range
    could be had, and a lower bound of the flux (so an upper bound of the range) where `saturated` and not
    recovered. `bearing_body` is the unit vector from the camera's centre in body axes.
    """

    camera: str
    index: int
    time_s: float
    u_px: float
    v_px: float
    u_sigma_px: float
    v_sigma_px: float
    flux_dn: float
    mean_dn: float
    background_dn: float
    area_px: int
    saturated: bool
    merged: bool
    ghost: bool
    range_m: float
    range_sigma_m: float
    bearing_body: tuple[float, float, float]
