"""What perception reads: raw frames, calibration, the robot's own odometry.

Pixel coordinates follow OpenCV: (0, 0) is the centre of the top left pixel, u to the right, v down.
Camera axes: x right, y down, z forward. Body axes: x forward, y left, z up.
"""

import math
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
        from perception.types.picture import frame_png

        return frame_png(self.data_dn, self.black_level_dn)


@dataclass(frozen=True)
class Layout:
    """Where the robots of one kind carry their sources.

    Attributes
    ----------
    kind
        Its name.
    places_body_m
        The sources' centres in the robot's own body axes.
    relative_flux
        Flux of each, over that which the range constant is of.
    flux_sigma_common, flux_sigma_own
        Relative σ of these fluxes: of all sources of a robot together, and of each by itself. NaN: they are
        together as uncertain as the range constant.
    """

    kind: str
    places_body_m: tuple[tuple[float, float, float], ...]
    relative_flux: tuple[float, ...]
    flux_sigma_common: float = math.nan
    flux_sigma_own: float = 0.0


@dataclass(frozen=True)
class ForwardLight:
    """What fog scatters forward about a source seen through it, at one optical depth.

    Attributes
    ----------
    depth
        Optical depth of the way from the source, extinction times range.
    angle_rad
        Angles off the source, increasing, above 0.
    share
        Light within each, over that which comes straight.
    share_sigma
        Relative σ of all shares together.
    deviations
        Where the fog may be of several kinds: the shares of each less `share`, one kind after the other. The
        mean of their products is the covariance of the shares.
    """

    depth: float
    angle_rad: tuple[float, ...]
    share: tuple[float, ...]
    share_sigma: float = 0.0
    deviations: tuple[float, ...] = ()


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
        Standard deviations of the pixels' fixed offsets and relative responses (EMVA 1288), so far as it is
        not known which pixel has which: they add to the noise of a place, and do not average over frames.
    offset_dn, offset_file
        Each pixel's offset from the black level at gain 1, whole counts, int16, shape (rows, columns), where
        it is known; and the picture that holds it, from the calibration's folder. A `Recording` takes it off
        its frames as it reads them; elsewhere `without_offsets` does. `dsnu_e` is what it leaves.
    psf_sigma_px
        Standard deviation of the Gaussian point spread function, without the pixel's own aperture.
    glare_share, glare_radius_px, glare_exponent
        What share g of all light the lens scatters far off, and how: w(r) = (γ − 1) / (π r₀²)
        (1 + (r / r₀)²)^−γ. Flares are fitted without it: what of it they find is in the range constant.
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
    extinction_per_m
        Of the fog, 0 in clear air. Where it is not known a σ says so (0.05 /m: anything from clear air to
        a visibility of 40 m): ranges by flux are then no better than that allows.
    forward_light
        What fog of this kind scatters forward about a source, by rising optical depth; where it is not known
        flares are taken to have none of it.
    hidden_background
        Share of the background's light that a source takes away where it stands before it: 1 for a black
        sphere in clear air, 0 where it sends back as much of the ambient light as it hides.
    own_sources_body_m
        Where the robot's own sources sit, in body axes, shape (n, 3): mirrors show them too.
    layouts
        Of robots that carry several sources, where these are known.
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
    extinction_per_m: float = 0.0
    hidden_background: float = 0.0
    offset_dn: NDArray[np.int16] | None = None
    offset_file: str = ""
    glare_share: float = 0.0
    glare_radius_px: float = 10.0
    glare_exponent: float = 2.5
    own_sources_body_m: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    layouts: tuple[Layout, ...] = ()
    forward_light: tuple[ForwardLight, ...] = ()


@dataclass(frozen=True, eq=False)
class Odometry:
    """Where a robot takes itself to be at one time, in a frame of its own that starts anywhere and drifts.

    `position_m`, shape (3,), is the body's origin in that frame, `rotation`, shape (3, 3), takes body axes to
    its axes. Per axis, `position_sigma_m` and `rotation_sigma_rad` are the errors of each record by itself
    (tilt, vibration); the walks say by how much the error of a later record departs, by the root of time.
    """

    robot: str
    time_s: float
    position_m: NDArray[np.float64]
    rotation: NDArray[np.float64]
    position_sigma_m: float = 0.0
    rotation_sigma_rad: float = 0.0
    position_walk_m_per_sqrt_s: float = 0.0
    rotation_walk_rad_per_sqrt_s: float = 0.0
