"""Models of what a robot carries: sources, and cameras with lens, filter and sensor."""

from typing import Annotated, ClassVar

from pydantic import field_validator

from nir_render.scene.bandpass import Bandpass
from nir_render.scene.base import PresetDocument
from nir_render.scene.curves import CurveDocument
from nir_render.scene.exposure import AutoExposure
from nir_render.scene.fields import Name, Orientation, Positive
from nir_render.scene.lens import Lens
from nir_render.scene.pattern import PatternDocument
from nir_render.scene.point_spread import PointSpread
from nir_render.scene.sensor import Sensor
from nir_render.scene.units import Length, Position, Power, Time


class Source(PresetDocument):
    """A 940 nm light source: a sphere, evenly bright over its disc.

    `flux` is the radiant flux over the whole spectrum and all directions, `spectrum` its shape (any scale),
    `position` the sphere's centre on the robot. Without `pattern` it shines the same in all directions;
    `orientation` turns the pattern's axes on the robot.
    """

    preset_folder: ClassVar[str] = "sources"

    flux_w: Annotated[Power, Positive]
    radius_m: Annotated[Length, Positive]
    spectrum: CurveDocument
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    pattern: PatternDocument | None = None

    @field_validator("spectrum")
    @classmethod
    def _spectrum_has_an_end(cls, spectrum: CurveDocument) -> CurveDocument:
        if spectrum.constant is not None:
            raise ValueError("a spectrum needs a shape; write 'gaussian', 'points' or 'file'")
        return spectrum


class Camera(PresetDocument):
    """A camera on a robot. Without orientation it looks along the robot's x axis, upright.

    With `auto_exposure`, `exposure` is only where it starts from before the first frame is taken.
    """

    preset_folder: ClassVar[str] = "cameras"

    lens: Lens
    filter: Bandpass | None = None
    sensor: Sensor
    point_spread: PointSpread
    exposure_s: Annotated[Time, Positive]
    auto_exposure: AutoExposure | None = None
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()


class Rig(PresetDocument):
    """What a robot carries: sources and cameras, by name."""

    preset_folder: ClassVar[str] = "rigs"

    sources: dict[Name, Source] = {}
    cameras: dict[Name, Camera] = {}
