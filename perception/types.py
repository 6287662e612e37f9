"""What perception reads and what it says: raw frames, calibration, detections, measurements of a rig.

Pixel coordinates follow OpenCV: (0, 0) is the centre of the top left pixel, u to the right, v down.
Camera axes: x right, y down, z forward. Body axes: x forward, y left, z up.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

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
    own_sources_body_m
        Where the robot's own sources sit, in body axes, shape (n, 3): mirrors show them too.
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
    own_sources_body_m: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class Detection:
    """One flare found in one frame.

    `flux_dn` is the background-subtracted integral, `mean_dn` the mean grey value over the blob as read
    (black level included), `background_dn` the local background as read. `range_sigma_m` and the pixel
    sigmas are what the estimator claims; NaN where it makes no claim. `range_m` is NaN where no range
    could be had, and a lower bound of the flux (so an upper bound of the range) where `saturated` and not
    recovered. `bearing_body` is the unit vector from the camera's centre in body axes. `flux_sigma_dn` is the
    flux's standard deviation. `range_sigma_common_m` is the part of `range_sigma_m` that measurements of one
    source share, in whatever frame or camera: by range constant, the robot's own flux, the source's radius.
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
    flux_sigma_dn: float = math.nan
    range_sigma_common_m: float = math.nan


Ghost = Literal["no", "possible", "yes"]
"""Whether something is the mirror image of a robot."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """One source, as all cameras of a rig saw it in one set of frames.

    Attributes
    ----------
    robot
        The observer's name.
    time_s
        Mid-exposure, the mean over its detections weighted by how well each places it.
    cameras
        Those that saw it, each once.
    detections
        Of which detections it is made: camera, index of the frame, place among that frame's detections.
    origin_body_m
        The point that bearing and range count from, in body axes: the camera's centre, of several their mean.
    bearing_body
        Unit vector from there, in body axes.
    range_m
        Distance from there; NaN where no detection has a range, or only a bound of it.
    covariance
        Of the bearing's angle to the left (about the body's z), its angle upwards, and the range, in rad²,
        rad m and m², shape (3, 3); NaN where no σ is claimed.
    range_sigma_common_m
        The part of the range's σ that every measurement of this source shares.
    saturated, merged
        Whether one of its detections is.
    ghost
        Whether it is a mirror image: `yes` where mirror images of several robots, or of the observer itself,
        agree on one plane; `possible` where no more than chance speaks for or against it.
    ghost_probability
        What geometry and brightness say of that, from 0 to 1.
    """

    robot: str
    time_s: float
    cameras: tuple[str, ...]
    detections: tuple[tuple[str, int, int], ...]
    origin_body_m: tuple[float, float, float]
    bearing_body: tuple[float, float, float]
    range_m: float
    covariance: NDArray[np.float64]
    range_sigma_common_m: float
    saturated: bool
    merged: bool
    ghost: Ghost = "no"
    ghost_probability: float = 0.0

    @property
    def position_body_m(self) -> NDArray[np.float64]:
        """Where it is, from the body's origin, shape (3,)."""
        return np.asarray(self.origin_body_m) + self.range_m * np.asarray(self.bearing_body)

    @property
    def axes_body(self) -> NDArray[np.float64]:
        """Unit vectors to the left, upwards and along the bearing, as rows, shape (3, 3)."""
        return bearing_axes(np.asarray(self.bearing_body))

    @property
    def position_covariance_m2(self) -> NDArray[np.float64]:
        """Covariance of `position_body_m`, shape (3, 3)."""
        scaled = self.axes_body * np.array([self.range_m, self.range_m, 1.0])[:, None]
        return np.asarray(scaled.T @ self.covariance @ scaled)


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """A flat mirror that a set of measurements shows: n · x = c in body axes.

    Attributes
    ----------
    normal_body
        Unit vector n from the observer to the mirror.
    distance_m
        c, from the body's origin.
    kind
        `constant` reflectance, as metal has; `surface` or `pane`: one side of a dielectric, or both of it.
    parameter
        The reflectance of a `constant` one, the refractive index of the others.
    covariance
        Of the normal's angles to the left and upwards (rad), of the distance (m) and of the parameter,
        shape (4, 4).
    images
        How many mirror images it explains.
    """

    normal_body: tuple[float, float, float]
    distance_m: float
    kind: Literal["constant", "surface", "pane"]
    parameter: float
    covariance: NDArray[np.float64]
    images: int


@dataclass(frozen=True, eq=False)
class SetMeasurements:
    """What a rig measures in one set of frames.

    Attributes
    ----------
    measurements
        One for each source and each mirror image.
    detections
        Of each frame, in the order of the frames: what they are made of.
    planes
        Mirrors found, and those handed in that show something.
    """

    measurements: tuple[Measurement, ...]
    detections: tuple[tuple[Detection, ...], ...]
    planes: tuple[MirrorPlane, ...] = ()


def bearing_axes(bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors to the left (about z), upwards and along bearings, shape (..., 3) → (..., 3, 3).

    A bearing straight up or down counts y as left.
    """
    x, y, z = bearing[..., 0], bearing[..., 1], bearing[..., 2]
    level = np.hypot(x, y)
    flat = level > 1e-12
    level = np.where(flat, level, 1.0)
    axes = np.zeros((*bearing.shape[:-1], 3, 3))
    axes[..., 0, 0] = left_x = np.where(flat, -y, 0.0) / level
    axes[..., 0, 1] = left_y = np.where(flat, x, 1.0) / level
    axes[..., 1, 0], axes[..., 1, 1] = -z * left_y, z * left_x
    axes[..., 1, 2] = x * left_y - y * left_x
    axes[..., 2, :] = bearing
    return axes
