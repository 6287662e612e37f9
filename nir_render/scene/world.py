"""Models of the surroundings: shapes, their materials at 940 nm, lamps, the sun."""

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator

from nir_render.scene.base import RGB_REFUSED, Document, PresetDocument, resolve_file, typed
from nir_render.scene.drive import FULL_DRIVE, Drive
from nir_render.scene.fields import NotNegative, Orientation, Positive
from nir_render.scene.units import (
    Angle,
    Fraction,
    Length,
    LuminousFlux,
    Position,
    Size2,
    Size3,
    SpectralIrradiance,
    Temperature,
)


def _refuse_rgb(value: Any) -> Any:
    looks_rgb = isinstance(value, list | tuple) or (
        isinstance(value, str) and value.strip().startswith(("#", "[", "rgb"))
    )
    if looks_rgb:
        raise ValueError(f"{value!r}: {RGB_REFUSED}")
    return value


def _rough_enough(roughness: float) -> float:
    if roughness < _LEAST_ROUGHNESS:
        raise ValueError(
            f"{roughness:g} is nearly smooth: its sharp glints cannot be sampled; use at least "
            f"{_LEAST_ROUGHNESS}, or the type 'mirror'"
        )
    return roughness


def _smooth_or_rough_enough(roughness: float) -> float:
    return roughness if roughness == 0.0 else _rough_enough(roughness)


_LEAST_ROUGHNESS = 0.02
Reflectance = Annotated[Fraction, BeforeValidator(_refuse_rgb), Field(ge=0, le=1)]
Direction = tuple[float, float, float]


class Diffuse(Document):
    """Lambertian: reflects the share `reflectance` evenly."""

    type: Literal["diffuse"]
    reflectance: Reflectance


class RoughConductor(Document):
    """Rough metal: GGX microfacets of width `roughness` with the complex index n + ik at 940 nm."""

    type: Literal["rough_conductor"]
    index: Annotated[float, Positive]
    extinction_index: Annotated[float, NotNegative]
    roughness: Annotated[float, Field(le=1), AfterValidator(_rough_enough)]


class Mirror(Document):
    """A smooth mirror of the same reflectance at every angle."""

    type: Literal["mirror"]
    reflectance: Reflectance


class Dielectric(Document):
    """A smooth transparent solid of refractive index `index`."""

    type: Literal["dielectric"]
    index: Annotated[float, Field(ge=1)]


class Plastic(Document):
    """A diffuse ground of `reflectance` under a rough clear coat of refractive index `index`."""

    type: Literal["plastic"]
    index: Annotated[float, Field(ge=1)]
    reflectance: Reflectance
    roughness: Annotated[float, Field(ge=0, le=1), AfterValidator(_smooth_or_rough_enough)]


class Pane(Document):
    """A thin clear sheet of refractive index `index`: light passes straight, less what its two faces reflect.

    With both faces and all that goes to and fro between them it reflects 2R/(1 + R), R being Fresnel's
    reflectance of one face; of the rest it passes the share `transmission`. Only rectangles may be of it.
    """

    type: Literal["pane"]
    index: Annotated[float, Field(ge=1)] = 1.5
    transmission: Annotated[Fraction, Field(ge=0, le=1)] = 1.0


MaterialDocument = Annotated[
    Diffuse | RoughConductor | Mirror | Dielectric | Plastic | Pane,
    Field(discriminator="type"),
    typed("{type: diffuse, reflectance: 0.5}", Diffuse, RoughConductor, Mirror, Dielectric, Plastic, Pane),
]


class _Shape(Document):
    """What all shapes have: the name of a material of the scene, or of a preset."""

    material: str


def _positive(size: tuple[float, ...]) -> tuple[float, ...]:
    if min(size) <= 0:
        raise ValueError("each extent must be greater than 0")
    return size


def _not_zero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise ValueError("a direction must not be [0, 0, 0]")
    return vector


class Rectangle(_Shape):
    """A flat rectangle that faces along `normal`; both sides are of its material.

    `size` is width × height: width runs horizontally (along world x where the normal is vertical), turned
    about the normal by `rotation`.
    """

    type: Literal["rectangle"]
    center_m: Position
    size_m: Annotated[Size2, AfterValidator(_positive)]
    normal: Direction = (0.0, 0.0, 1.0)
    rotation_rad: Angle = 0.0

    _direction = field_validator("normal")(_not_zero)


class Box(_Shape):
    """A closed box; `size` is its extent along its own x, y and z."""

    type: Literal["box"]
    center_m: Position
    size_m: Annotated[Size3, AfterValidator(_positive)]
    orientation: Orientation = Orientation()


class Sphere(_Shape):
    """A closed sphere."""

    type: Literal["sphere"]
    center_m: Position
    radius_m: Annotated[Length, Positive]


class Cylinder(_Shape):
    """A closed cylinder between the centres of its two ends."""

    type: Literal["cylinder"]
    start_m: Position
    end_m: Position
    radius_m: Annotated[Length, Positive]


class Mesh(_Shape):
    """A triangle mesh from a PLY or OBJ file in metres, scaled, turned and moved."""

    type: Literal["mesh"]
    file: str
    scale: Annotated[float, Positive] = 1.0
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()

    @field_validator("file")
    @classmethod
    def _find(cls, name: str, info: ValidationInfo) -> str:
        if not name.lower().endswith((".ply", ".obj")):
            raise ValueError(f"{name!r} is neither a .ply nor an .obj file")
        return str(resolve_file(name, info))


ShapeDocument = Annotated[
    Rectangle | Box | Sphere | Cylinder | Mesh,
    Field(discriminator="type"),
    typed(
        '{type: sphere, center: "[1, 0, 0] m", radius: 0.1 m, material: black}',
        Rectangle, Box, Sphere, Cylinder, Mesh,
    ),
]  # fmt: skip


class Lamp(PresetDocument):
    """A rectangular lamp that shines along `normal`, an incandescent body of `temperature`.

    `drive` is what it sends over time.
    """

    preset_folder: ClassVar[str] = "lamps"

    center_m: Position
    size_m: Annotated[Size2, AfterValidator(_positive)]
    normal: Direction = (0.0, 0.0, -1.0)
    luminous_flux_lm: Annotated[LuminousFlux, Positive]
    temperature_k: Annotated[Temperature, Field(ge=500, le=20000)]
    drive: Drive = FULL_DRIVE

    _direction = field_validator("normal")(_not_zero)


class Sun(Document):
    """The sun: `azimuth` from world x towards y, `elevation` above the horizon.

    `irradiance` is its spectral irradiance across its direction, at 940 nm: 0.305 W/m²/nm by ASTM G173
    (global), which has 3.05 W/m² from 935 to 945 nm. Over the rest of what silicon sees the spectrum is taken
    as flat; assumed.
    """

    angular_radius_rad: ClassVar[float] = math.radians(0.2666)

    example: ClassVar[str] = "{azimuth: 30 deg, elevation: 40 deg, irradiance: 0.305 W/m^2/nm}"

    azimuth_rad: Angle
    elevation_rad: Annotated[Angle, Field(gt=0, le=math.pi / 2)]
    irradiance_w_per_m3: Annotated[SpectralIrradiance, Positive]

    @property
    def direction(self) -> Direction:
        """Unit vector towards the sun's centre, in the world."""
        flat = math.cos(self.elevation_rad)
        return (
            flat * math.cos(self.azimuth_rad),
            flat * math.sin(self.azimuth_rad),
            math.sin(self.elevation_rad),
        )
