"""Models of what a robot carries: sources, and cameras with lens, filter and sensor."""

from typing import Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, field_validator, model_validator

from nir_render.scene.bandpass import Bandpass
from nir_render.scene.base import PresetDocument
from nir_render.scene.curves import CurveDocument
from nir_render.scene.drive import FULL_DRIVE, Drive
from nir_render.scene.exposure import AutoExposure, Bracket, Gain
from nir_render.scene.fields import Name, Orientation, Positive
from nir_render.scene.lens import Lens, check_field, check_focus
from nir_render.scene.pattern import PatternDocument
from nir_render.scene.point_spread import PointSpread
from nir_render.scene.sensor import Sensor
from nir_render.scene.shutter import GlobalShutter, Shutter
from nir_render.scene.units import Length, Position, Power, Time


class Source(PresetDocument):
    """A 940 nm light source: a sphere, evenly bright over its disc.

    `flux` is the radiant flux over the whole spectrum and all directions, `spectrum` its shape (any scale),
    `position` the sphere's centre on the robot. Without `pattern` it shines the same in all directions;
    `orientation` turns the pattern's axes on the robot. `drive` is what it sends over time; a calibration
    speaks of a source that is fully lit.
    """

    preset_folder: ClassVar[str] = "sources"

    flux_w: Annotated[Power, Positive]
    radius_m: Annotated[Length, Positive]
    spectrum: CurveDocument
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    pattern: PatternDocument | None = None
    drive: Drive = FULL_DRIVE

    @field_validator("spectrum")
    @classmethod
    def _spectrum_has_an_end(cls, spectrum: CurveDocument) -> CurveDocument:
        if spectrum.constant is not None:
            raise ValueError("a spectrum needs a shape; write 'gaussian', 'points' or 'file'")
        return spectrum


def _as_text(serial: Any) -> Any:
    if isinstance(serial, int | float):  # YAML reads 0012 as a number, in octal
        raise ValueError(f"{serial!r} is a number; write the serial number in quotes, such as '0012345'")
    return serial


class Camera(PresetDocument):
    """A camera on a robot. Without orientation it looks along the robot's x axis, upright.

    `gain` is a factor on the sensor's system gain. With `auto_exposure`, `exposure` is only where it starts
    from before the first frame is taken; with `bracket`, frames take its exposures by turns.
    """

    preset_folder: ClassVar[str] = "cameras"

    lens: Lens
    filter: Bandpass | None = None
    sensor: Sensor
    point_spread: PointSpread
    exposure_s: Annotated[Time, Positive]
    gain: Gain = 1.0
    auto_exposure: AutoExposure | None = None
    bracket: Bracket | None = None
    shutter: Shutter = GlobalShutter()
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    serial: Annotated[str, BeforeValidator(_as_text)] | None = None

    @model_validator(mode="after")
    def _one_choice_of_exposure(self) -> Self:
        auto = self.auto_exposure
        if auto is not None and self.bracket is not None:
            raise ValueError(
                "'auto_exposure' chooses each exposure by the frames before, 'bracket' by a list: write one "
                "of them, or set the other to null"
            )
        if auto is not None and auto.most_gain is not None and auto.most_gain < self.gain:
            raise ValueError(
                f"auto_exposure.most_gain, {auto.most_gain:g}, is below the camera's own gain, {self.gain:g}"
            )
        return self

    @model_validator(mode="after")
    def _lens_fits_the_sensor(self) -> Self:
        check_field(self.lens, self.sensor)
        check_focus(self.lens, self.sensor)
        return self


class Rig(PresetDocument):
    """What a robot carries: sources and cameras, by name."""

    preset_folder: ClassVar[str] = "rigs"

    sources: dict[Name, Source] = {}
    cameras: dict[Name, Camera] = {}
