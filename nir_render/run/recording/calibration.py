"""The calibration of a recorded camera, all but its range constant.

It is made of what a person says of the camera, and of what its pictures show.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from nir_render.run.recording.document import CameraGiven, Measured, SourceGiven
from nir_render.run.recording.pictures import Pictures
from nir_render.scene.pose import Pose
from nir_render.scene.text.units import COUNTS, ELECTRONS, LENGTH, SYSTEM_GAIN
from perception.model.bearing import field_angle_rad
from perception.types import Calibration

# The camera's x (right), y (down) and z (forward) in a mount that looks along x, y left, z up.
_MOUNT_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_LEAST_NOISE_DN = 0.1  # a sensor that shows no noise is clipped at black
_MEASURED_NOISE_SHARE = 0.2  # σ of a read noise that is measured in frames with light in them
_HIDDEN_SIGMA = 0.5  # a white diffuser sends back about as much ambient light as it hides, to a half
_ANGLES = 9


@dataclass(frozen=True)
class Assumed:
    """What was taken for something that the document leaves out."""

    what: str
    value: Measured

    def __str__(self) -> str:
        """Say it in a line."""
        unit = f" {self.value.quantity.unit}".rstrip()
        return f"{self.what}: {self.value.value:.4g} ± {self.value.sigma:.2g}{unit}"


def camera_calibration(
    name: str, given: CameraGiven, source: SourceGiven, pictures: Pictures
) -> tuple[Calibration, list[Assumed]]:
    """Return the calibration of a camera, its range constants NaN, and what was assumed for it.

    Raises
    ------
    ValueError
        What is given cannot be: a black level beyond saturation, pixels beyond the lens's image.
    """
    assumed: list[Assumed] = []

    def known(what: str, value: Measured | None, otherwise: Measured) -> Measured:
        if value is None:
            assumed.append(Assumed(what, otherwise))
        return otherwise if value is None else value

    dark = pictures.darkness
    full_scale_dn = 2 ** int(given.bit_depth_bit) - 1
    saturation_dn = int(given.saturation_dn or full_scale_dn)
    black = known(
        "black_level (from dark pixels)",
        given.black_level_dn,
        Measured(dark.level_dn, dark.level_sigma_dn, COUNTS),
    )
    if not black.value < saturation_dn:
        raise ValueError(
            f"black level {black.value:g} DN is not below saturation, {saturation_dn} DN; give black_level, "
            "the mean count of a frame in the dark"
        )
    capacity = given.saturation_capacity_e
    by_capacity = (saturation_dn - black.value) / capacity.value
    gain = known(
        "gain (from saturation_capacity)",
        given.gain_dn_per_e,
        Measured(by_capacity, capacity.relative * by_capacity, SYSTEM_GAIN),
    )
    seen_e = max(dark.noise_dn, _LEAST_NOISE_DN) / gain.value
    noise = known(
        "read_noise (from dark pixels)",
        given.read_noise_e,
        Measured(seen_e, _MEASURED_NOISE_SHARE * seen_e, ELECTRONS),
    )
    assumed += [
        Assumed(what.removesuffix("_px"), getattr(given, what))
        for what in ("psf_px", "response_at_corner")
        if what not in given.model_fields_set
    ]
    lossy_e = pictures.lossy_sigma_dn / gain.value
    focal_px, focal_share = _focal_length_px(given), given.focal_length.relative
    centre_px = _principal_point_px(given, pictures)
    psf_px = given.psf_px.value / given.binning
    mount = Pose.of(
        given.position_m, given.orientation.yaw_rad, given.orientation.pitch_rad, given.orientation.roll_rad
    )
    calibration = Calibration(
        camera=name,
        width_px=pictures.width_px,
        height_px=pictures.height_px,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=centre_px[0],
        cy_px=centre_px[1],
        rotation_body_camera=mount.rotation @ _MOUNT_FROM_CAMERA,
        position_body_m=mount.position_m,
        system_gain_dn_per_e=gain.value,
        read_noise_e=math.hypot(noise.value, lossy_e),
        black_level_dn=black.value,
        saturation_dn=saturation_dn,
        bit_depth=int(given.bit_depth_bit),
        psf_sigma_px=psf_px,
        response_angle_rad=np.array([0.0, 1.5]),
        response_relative=np.ones(2),
        range_constant_dn_m2_per_s=math.nan,
        range_constant_paper_dn_m2_per_s=math.nan,
        source_radius_m=source.radius_m.value,
        wavelength_m=source.wavelength_m,
        prnu=given.fixed_pattern,
        lens_model=given.lens_model,
        distortion=tuple(given.distortion),
        sigma=_positive(
            fx_px=focal_share * focal_px,
            fy_px=focal_share * focal_px,
            system_gain_dn_per_e=gain.sigma,
            read_noise_e=noise.sigma,
            black_level_dn=black.sigma,
            psf_sigma_px=given.psf_px.relative * psf_px,
            response_relative=given.response_at_corner.sigma,
            source_radius_m=source.radius_m.sigma,
            hidden_background=_HIDDEN_SIGMA,
        ),
    )
    return _with_response(calibration, given.response_at_corner.value), assumed


def _positive(**sigmas: float) -> dict[str, float]:
    return {name: sigma for name, sigma in sigmas.items() if sigma > 0.0}


def _focal_length_px(given: CameraGiven) -> float:
    """Return the focal length in pixels of the frame: binning makes them larger and it shorter."""
    focal = given.focal_length
    in_sensor_px = focal.value
    if focal.quantity is LENGTH:
        assert given.pixel_pitch_m is not None  # the document holds this
        in_sensor_px = focal.value / given.pixel_pitch_m
    return in_sensor_px / given.binning


def _principal_point_px(given: CameraGiven, pictures: Pictures) -> tuple[float, float]:
    """Return the principal point in pixels of the frame.

    (0, 0) is the centre of a pixel: what stands at u on the sensor, cropped from u₀ on and binned by b, is at
    (u − u₀ + ½)/b − ½.
    """
    binned = given.binning
    width_px, height_px = given.sensor_size_px or (binned * pictures.width_px, binned * pictures.height_px)
    u_px, v_px = given.principal_point_px or (0.5 * (width_px - 1.0), 0.5 * (height_px - 1.0))
    return (
        (u_px - given.roi_left_px + 0.5) / binned - 0.5,
        (v_px - given.roi_top_px + 0.5) / binned - 0.5,
    )


def _with_response(calibration: Calibration, at_corner: float) -> Calibration:
    """Let the response fall with the square of the field angle to what it is in the farthest corner."""
    right, bottom = calibration.width_px - 0.5, calibration.height_px - 0.5
    corners = [(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)]
    angle_rad = field_angle_rad(corners, calibration)
    if np.isnan(angle_rad).any():
        raise ValueError(
            "corners of the frame lie beyond the image that lens_model and distortion can make; check them, "
            "focal_length and pixel_pitch"
        )
    widest_rad = float(np.max(angle_rad)) * (1.0 + 1e-6)
    shares = np.linspace(0.0, 1.0, _ANGLES)
    return replace(
        calibration,
        response_angle_rad=shares * widest_rad,
        response_relative=1.0 - (1.0 - at_corner) * shares**2,
    )
