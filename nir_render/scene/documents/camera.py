"""Models of a camera: what it is made of, its shutter, how it chooses its exposures; and of a rig."""

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Document,
    Fraction,
    Name,
    NotNegative,
    Orientation,
    Position,
    Positive,
    Time,
    typed,
)
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.files import PresetDocument
from nir_render.scene.documents.lens import Lens, check_field, check_focus
from nir_render.scene.documents.point_spread import PointSpread
from nir_render.scene.documents.sensor import Sensor
from nir_render.scene.documents.shapes import ShapeDocument
from nir_render.scene.documents.spectral.bandpass import Bandpass
from nir_render.scene.documents.times.clocks import CameraClock, OdometryNoise

MOST_GAIN = 64.0

Gain = Annotated[float, Field(ge=1, le=MOST_GAIN)]
Bracket = Annotated[tuple[Annotated[Time, Positive], ...], Field(min_length=2, max_length=1024)]


class GlobalShutter(Document):
    """All rows expose at once; then they are read from the top, one every `line_time`.

    While a row waits, light still adds to it: `parasitic_light_sensitivity` times what it would add in an
    exposure, the inverse of what data sheets call shutter ratio or shutter efficiency.
    """

    type: Literal["global"] = "global"
    line_time_s: Annotated[Time, NotNegative] = 0.0
    parasitic_light_sensitivity: Annotated[Fraction, Field(ge=0, lt=1)] = 0.0

    @property
    def row_delay_s(self) -> float:
        """How much later than the row above each row begins its exposure: not at all."""
        return 0.0

    @model_validator(mode="after")
    def _rows_wait(self) -> Self:
        if self.parasitic_light_sensitivity > 0.0 and self.line_time_s == 0.0:
            raise ValueError(
                "parasitic light adds up while rows wait to be read; write 'line_time' too, such as 10 us"
            )
        return self


class RollingShutter(Document):
    """Rows expose one after the other from the top, each `line_time` later than the one above."""

    type: Literal["rolling"]
    line_time_s: Annotated[Time, Positive]

    @property
    def row_delay_s(self) -> float:
        """How much later than the row above each row begins its exposure."""
        return self.line_time_s


Shutter = Annotated[
    GlobalShutter | RollingShutter,
    Field(discriminator="type"),
    typed("{type: rolling, line_time: 10 us}", GlobalShutter, RollingShutter),
]


class AutoExposure(Document):
    """Exposure that brings the brightest pixel to `target` of the range up to clipping.

    Pixels that stand out alone, hot or stuck ones, do not count. A choice takes effect `latency` frames after
    the frame that it follows from; 1 is the next one. With `most_gain`, gain rises above the camera's own
    where the longest exposure is too short. The brightest frame of the time `hold` counts, not only the last:
    for sources that blink it should be as long as their dark runs. A step is at most a factor of 4; it is a
    whole one after a frame that clipped.
    """

    target: Annotated[Fraction, Field(gt=0, lt=1)] = 0.7
    shortest_s: Annotated[Time, Positive]
    longest_s: Annotated[Time, Positive]
    latency: Annotated[int, Field(ge=1, le=16)] = 1
    most_gain: Gain | None = None
    hold_s: Annotated[Time, NotNegative] = 0.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.shortest_s > self.longest_s:
            raise ValueError(
                f"shortest, {self.shortest_s:g} s, is longer than longest, {self.longest_s:g} s; shorten it"
            )
        return self


def _as_text(serial: Any) -> Any:
    if isinstance(serial, int | float):  # YAML reads 0012 as a number, in octal
        raise ValueError(f"{shown(serial)} is a number; write the serial number in quotes, such as '0012345'")
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
    clock: CameraClock | None = None
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
    """What a robot carries: sources and cameras, by name, and its body: shapes in the robot's own axes.

    `odometry` is how well it knows its way; left out, exactly.
    """

    preset_folder: ClassVar[str] = "rigs"

    sources: dict[Name, Source] = {}
    cameras: dict[Name, Camera] = {}
    body: dict[Name, ShapeDocument] = {}
    odometry: OdometryNoise | None = None

    @model_validator(mode="after")
    def _bodies_move_with_the_robot(self) -> Self:
        for name, shape in self.body.items():
            if shape.moves:
                raise ValueError(
                    f"body.{name}: moves with its robot and has no motion of its own; leave it out"
                )
        return self
