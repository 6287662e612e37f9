"""The response over the field angle from frames of an even surface.

An even surface gives a pixel cos θ · Ω · R(θ) of light, Ω the solid angle that it sees, R the response. What
is left of the frame after dividing by the first two is R, times what is fixed about each pixel, row, column.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.calibration.mixed_model import RadialFit, fit_radial
from perception.calibration.veil import Glare, veil_of
from perception.files.fields import RecordingError
from perception.model.bearing import angle_from_axis_rad, direction_camera
from perception.model.lens import distortion_of
from perception.model.sensor import gain_dn_per_e, saturation_dn, summed_floor_e2
from perception.types import Calibration, RawFrame

Array = NDArray[np.float64]

_ANGLES = 65
_BEYOND_CORNER = 1.2
_MOST_CLIPPED = 1e-3
_LEAST_E = 100.0
_MOST_UNEVEN = 0.02
_UNVEILINGS = 2  # each leaves some percent of what the one before left


@dataclass(frozen=True, eq=False)
class FlatCalibration:
    """What flat frames told of a camera.

    Attributes
    ----------
    calibration
        As it was, but for the response, and PRNU, with their σ.
    angle_rad, response, response_sigma
        The response relative to the axis, and its σ at each angle, shape (n,); held beyond the corner.
    axis_sigma
        Relative σ of the response on the axis, over that of the mean pixel.
    prnu, prnu_sigma
        Spread of the pixels' responses, of rows and columns too, and its σ.
    pixel_response, unknown_prnu
        Each pixel's response as far as the frames show it, shape (rows, columns); the spread of what they do
        not show.
    uneven
        By how much of the mean the surface is brighter at one edge of the frame than at the other.
    frames, clipped
        How many frames were used, and how many left out as they clip.
    """

    calibration: Calibration
    angle_rad: Array
    response: Array
    response_sigma: Array
    axis_sigma: float
    prnu: float
    prnu_sigma: float
    pixel_response: Array
    unknown_prnu: float
    uneven: float
    frames: int
    clipped: int


def calibrate_flat(
    frames: Iterable[RawFrame],
    calibration: Calibration,
    glare: Glare | None = None,
) -> FlatCalibration:
    """Learn the response over the field angle from frames of an even surface that fills the field.

    The response is a cubic spline in θ², which is even in θ as symmetry demands, fitted together with effects
    of rows and columns, of the variances that they show (a mixed model: Henderson, Biometrics 31, 423, 1975),
    and a tilt of the surface's brightness. What glare brings from elsewhere in the frame is taken off first.

    Parameters
    ----------
    frames
        Of one surface; their exposures may differ. Those that clip are left out, known offsets are off.
    calibration
        Of the camera: lens, black level, noise and gain.
    glare
        The lens's glare, where it is known.

    Raises
    ------
    RecordingError
        There are no frames that do not clip, or they are too dark, or the surface is uneven.
    """
    camera, stack = calibration.camera, _Stack.of(frames, calibration)
    if stack.frames == 0:
        raise RecordingError(
            f"{camera}: all of its {stack.clipped} flat frames clip (at {calibration.saturation_dn} DN, in "
            f"up to {stack.most_clipped:.1%} of their pixels); dim the surface or shorten the exposure until "
            "its brightest pixel is at about 70 % of full scale"
        )
    places = np.stack(np.meshgrid(np.arange(calibration.width_px), np.arange(calibration.height_px)), axis=-1)
    direction = direction_camera(places.reshape(-1, 2).astype(np.float64), calibration)
    shape = (calibration.height_px, calibration.width_px)
    cosine = direction[:, 2].reshape(shape)
    weight = cosine * distortion_of(calibration).solid_angle_sr(direction).reshape(shape)
    usable = np.isfinite(weight) & (cosine > 1e-3)
    middle_e = float(np.median(stack.sum_e[usable])) / stack.frames
    if middle_e < _LEAST_E:
        raise RecordingError(
            f"{camera}: its flat frames hold {middle_e:.0f} e in the median pixel, wanted {_LEAST_E:.0f} or "
            "more: brighten the surface or expose longer, up to about 70 % of full scale"
        )
    angle_rad = angle_from_axis_rad(direction).reshape(shape)
    weight, angle_rad = np.where(usable, weight, 1.0), np.where(usable, angle_rad, 0.0)
    floor_e2 = summed_floor_e2(calibration, stack.frames)

    def fitted(light_e: Array, like: RadialFit | None = None) -> RadialFit:
        return fit_radial(light_e / weight, weight, angle_rad, usable, floor_e2, like)

    def unveiled(own_e: Array, glare: Glare) -> RadialFit:
        # What is fixed about pixels scales all that falls on them: the veil is divided out, not taken off.
        return fitted(stack.sum_e * own_e / ((1.0 - glare.share) * own_e + veil_of(own_e, glare)), fit)

    table_rad = np.linspace(0.0, float(angle_rad[usable].max()), _ANGLES)
    fit, change = fitted(stack.sum_e), np.zeros((0, _ANGLES))
    if glare is not None:
        for _ in range(_UNVEILINGS):
            own_e = weight * fit.at(angle_rad)
            fit = unveiled(own_e, glare)
        off = [unveiled(own_e, other).relative(table_rad) for other in glare.off_by_sigma]
        change = np.array(off) - fit.relative(table_rad)
    response = fit.relative(table_rad)
    sigma = np.sqrt(fit.relative_sigma(table_rad) ** 2 + (change**2).sum(axis=0))
    if abs(fit.tilt) > _MOST_UNEVEN:
        raise RecordingError(
            f"{camera}: the surface of its flat frames is brighter by {abs(fit.tilt):.1%} at one edge "
            "than at the other: hold it square to the lens, nearer, or take a larger diffuser"
        )
    pixel_response, unknown_prnu = fit.pixel_response()
    prnu, prnu_sigma = math.sqrt(fit.spreads.total), fit.spreads.root_sigma
    corner_rad = table_rad[-1]
    table_rad = np.append(table_rad, _BEYOND_CORNER * corner_rad)
    response, sigma = np.append(response, response[-1]), np.append(sigma, sigma[-1])
    known = replace(
        calibration,
        response_angle_rad=table_rad,
        response_relative=response,
        prnu=prnu,
        sigma={**calibration.sigma, "response_relative": float(sigma.max()), "prnu": prnu_sigma},
    )
    return FlatCalibration(
        calibration=known,
        angle_rad=table_rad,
        response=response,
        response_sigma=sigma,
        axis_sigma=fit.axis_sigma,
        prnu=prnu,
        prnu_sigma=prnu_sigma,
        pixel_response=pixel_response,
        unknown_prnu=unknown_prnu,
        uneven=abs(fit.tilt),
        frames=stack.frames,
        clipped=stack.clipped,
    )


@dataclass(frozen=True, eq=False)
class _Stack:
    """The sum of the flat frames that do not clip, in electrons above black level."""

    sum_e: Array
    frames: int
    clipped: int
    most_clipped: float

    @staticmethod
    def of(frames: Iterable[RawFrame], calibration: Calibration) -> "_Stack":
        total = np.zeros((calibration.height_px, calibration.width_px))
        used, clipped, most = 0, 0, 0.0
        for frame in frames:
            share = float((frame.data_dn >= saturation_dn(calibration, frame.gain)).mean())
            if share > _MOST_CLIPPED:
                clipped, most = clipped + 1, max(most, share)
                continue
            total += (frame.data_dn - frame.black_level_dn) / gain_dn_per_e(frame, calibration)
            used += 1
        return _Stack(total, used, clipped, most)
