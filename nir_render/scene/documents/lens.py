"""The model of a camera's lens."""

import math
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WithJsonSchema, field_serializer, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    FocusShift,
    Fraction,
    Length,
    Pixels2,
    Positive,
)
from nir_render.scene.documents.curves import Points, parse_points, write_points
from nir_render.scene.documents.files import PresetDocument
from nir_render.scene.documents.sensor import Sensor
from nir_render.scene.text.units import ANGLE
from perception.model.lens import Distortion, LensModel

_COEFFICIENTS = {
    "brown_conrady": ((4, 5, 8), "k1, k2, p1, p2, then k3, then k4, k5, k6"),
    "fisheye": ((4,), "k1, k2, k3, k4"),
}
_VIGNETTING_SCHEMA = {
    "type": "array",
    "minItems": 2,
    "items": {
        "type": "array",
        "prefixItems": [{"type": "string"}, {"type": "number"}],
        "minItems": 2,
        "maxItems": 2,
    },
    "examples": [[["0 deg", 1.0], ["60 deg", 0.7]]],
}
_BORDER_POINTS = 33  # on each side
_ANGLE_SLACK_RAD = 1e-9
_LARGEST_BLUR_PX = 100.0


class Lens(PresetDocument):
    """A lens: rectilinear, or one of OpenCV's models (`brown_conrady`, `fisheye`) with its coefficients.

    `distortion` is in OpenCV's order: k1, k2, p1, p2[, k3[, k4, k5, k6]] of brown_conrady, k1, k2, k3, k4 of
    fisheye. `principal_point` is where the axis meets the sensor, its middle if not given. `vignetting` is
    the throughput against field angle, relative to the axis, beside the cosine of the tilted aperture; it
    may exceed 1, for the pupil of wide lenses grows. Without `focus_distance` all is in focus;
    `thermal_focus_shift` is how far the image moves away from the lens per kelvin above 25 °C.
    """

    preset_folder: ClassVar[str] = "lenses"

    model: LensModel = "rectilinear"
    focal_length_m: Annotated[Length, Positive]
    f_number: Annotated[float, Field(gt=0, le=1000)]
    transmission: Annotated[Fraction, Field(gt=0, le=1)]
    distortion: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] = ()
    principal_point_px: Pixels2 | None = None
    vignetting: Annotated[Points, WithJsonSchema(_VIGNETTING_SCHEMA)] | None = None
    focus_distance_m: Annotated[Length, Positive] | None = None
    thermal_focus_shift_m_per_k: FocusShift = 0.0

    @field_validator("distortion", mode="before")
    @classmethod
    def _distortion_is_a_list(cls, numbers: Any) -> Any:
        if isinstance(numbers, str | int | float):
            raise ValueError(
                f"{shown(numbers)} is no list; write the numbers in brackets and without quotes, "
                "such as distortion: [-0.1, 0.01, 0, 0]"
            )
        return numbers

    @field_validator("vignetting", mode="before")
    @classmethod
    def _parse_vignetting(cls, points: Any) -> Any:
        if points is None:
            return None
        pairs = parse_points(points, ANGLE, "field angle", "['40 deg', 0.7]")
        if pairs[0] != (0.0, 1.0):
            raise ValueError(
                f"begins with {pairs[0][1]:g} at {math.degrees(pairs[0][0]):g} deg; it is relative to the "
                "axis: begin with ['0 deg', 1.0], and put what the whole lens loses into 'transmission'"
            )
        return pairs

    @field_serializer("vignetting")
    def _write_vignetting(self, points: Points | None) -> list[list[Any]] | None:
        return write_points(points, ANGLE)

    @model_validator(mode="after")
    def _coefficients_fit_the_model(self) -> Self:
        given = len(self.distortion)
        if self.model == "rectilinear":
            if given:
                raise ValueError(
                    "distortion: a rectilinear lens has none; write 'model: brown_conrady' or "
                    "'model: fisheye', or leave 'distortion' out"
                )
            return self
        counts, order = _COEFFICIENTS[self.model]
        if given in counts:
            return self
        wanted = " or ".join(str(count) for count in counts)
        reason = ""
        if self.model == "brown_conrady" and given in (12, 14):
            reason = "; OpenCV's thin prism and tilt terms are not built: fit the lens anew without them"
        raise ValueError(
            f"distortion: {given} numbers; a {self.model} lens takes {wanted} in OpenCV's order, "
            f"{order}{reason}; give as many"
        )

    @model_validator(mode="after")
    def _focus_is_real(self) -> Self:
        if self.focus_distance_m is not None and self.focus_distance_m <= self.focal_length_m:
            raise ValueError(
                f"focus_distance: {self.focus_distance_m:g} m is not beyond the focal length of "
                f"{self.focal_length_m:g} m, so that there is no image; give a larger one"
            )
        if self.focus_distance_m is None and self.thermal_focus_shift_m_per_k:
            raise ValueError(
                "thermal_focus_shift: without 'focus_distance' all is in focus; give it, such as '3 m'"
            )
        return self


def principal_point_px(lens: Lens, sensor: Sensor) -> tuple[float, float]:
    """Return where the axis meets a sensor, (u, v)."""
    middle_px = ((sensor.columns - 1) / 2, (sensor.rows - 1) / 2)
    return middle_px if lens.principal_point_px is None else lens.principal_point_px


def check_focus(lens: Lens, sensor: Sensor) -> None:
    """Raise ValueError where what is infinitely far becomes a huge disc: f² / (N (d_f − f)) wide."""
    if lens.focus_distance_m is None:
        return
    beyond_m = lens.focus_distance_m - lens.focal_length_m
    blur_px = lens.focal_length_m**2 / (lens.f_number * beyond_m * sensor.pixel_pitch_m)
    if blur_px > _LARGEST_BLUR_PX:
        least_m = lens.focal_length_m + beyond_m * blur_px / _LARGEST_BLUR_PX
        raise ValueError(
            f"lens.focus_distance: focused at {lens.focus_distance_m:g} m, the lens makes of what is far "
            f"away a disc of {blur_px:.0f} px; wanted at most {_LARGEST_BLUR_PX:.0f} px, which is at "
            f"{least_m:.3g} m: give a focus_distance from there on, and check its unit"
        )


def check_field(lens: Lens, sensor: Sensor) -> None:
    """Raise ValueError where what is known of a lens does not reach to the corners of a sensor.

    Or where its axis lies more than a frame's width or height beside the sensor.
    """
    size_px = (sensor.columns, sensor.rows)
    for axis_px, pixels in zip(principal_point_px(lens, sensor), size_px, strict=True):
        if not -pixels <= axis_px <= 2 * pixels:
            raise ValueError(
                f"lens.principal_point: {axis_px:g} px lies more than a frame, {pixels} px, beside the "
                "sensor, where no lens has its axis; give (u, v) from the middle of the top left pixel"
            )
    distortion = Distortion(lens.model, lens.distortion)
    focal_px = lens.focal_length_m / sensor.pixel_pitch_m
    points = _border(lens, sensor) / focal_px
    direction = distortion.direction(points)
    angle_rad = np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])
    if np.isnan(angle_rad).any() and distortion.fold_rad < 0.5 * math.pi:
        fold_px = focal_px * float(distortion.image_height(np.array(distortion.fold_rad)))
        corner_px = focal_px * float(np.hypot(*points.T).max())
        raise ValueError(
            f"lens.distortion: the image folds at a field angle of {math.degrees(distortion.fold_rad):.1f} "
            f"deg, {fold_px:.0f} px from the principal point, but the sensor reaches {corner_px:.0f} px from "
            "it, where the image height must still increase; give coefficients that were fitted over the "
            "whole sensor, in OpenCV's order, and check focal_length and pixel_pitch"
        )
    corner_rad = float(np.where(np.isnan(angle_rad), 0.5 * math.pi, angle_rad).max())
    if lens.vignetting is not None and lens.vignetting[-1][0] < corner_rad - _ANGLE_SLACK_RAD:
        raise ValueError(
            f"lens.vignetting: ends at {math.degrees(lens.vignetting[-1][0]):.4g} deg, but the image reaches "
            f"{math.degrees(corner_rad):.4g} deg; data are not extrapolated: give points up to there"
        )


def _border(lens: Lens, sensor: Sensor) -> NDArray[np.float64]:
    """Return points all around a sensor, in pixels from the principal point, shape (n, 2)."""
    across = np.linspace(-0.5, sensor.columns - 0.5, _BORDER_POINTS)
    down = np.linspace(-0.5, sensor.rows - 0.5, _BORDER_POINTS)
    sides = [(across, end) for end in down[[0, -1]]], [(end, down) for end in across[[0, -1]]]
    points = [np.stack(np.broadcast_arrays(*side), axis=-1) for side in (*sides[0], *sides[1])]
    return np.concatenate(points) - principal_point_px(lens, sensor)
