"""Models of materials: numbers as they are at 940 nm, or curves over wavelength."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    field_serializer,
    field_validator,
    model_validator,
)

from nir_render.errors import shown
from nir_render.scene.documents.base import RGB_REFUSED, Fraction, typed
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.matter.evidence import Matter, factor
from nir_render.scene.documents.matter.retroreflection import (
    Coefficients,
    check_coefficients,
    parse_rows,
    reflected_share,
)
from nir_render.scene.documents.matter.texture import TextureDocument
from nir_render.scene.text.units import ANGLE, format_vector, parse_vector
from nir_render.spectra.nodes import BAND_M


def _refuse_rgb(value: Any) -> Any:
    looks_rgb = isinstance(value, list | tuple) or (
        isinstance(value, str) and value.strip().startswith(("#", "[", "rgb"))
    )
    if looks_rgb:
        raise ValueError(f"{shown(value)}: {RGB_REFUSED}")
    return value


def _refuse_texture(value: Any) -> Any:
    if isinstance(value, Mapping) and "texture" in value:
        raise ValueError(
            "a picture can be the reflectance of what is diffuse or plastic alone; give a number or a curve"
        )
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


def _form(value: Any) -> str:
    if isinstance(value, TextureDocument) or (isinstance(value, Mapping) and "texture" in value):
        return "dict[texture]"
    return "dict[curve]" if isinstance(value, Mapping | CurveDocument) else "float"


def _share(curve: CurveDocument) -> CurveDocument:
    wanted = "wanted 'points' or 'file': values from 0 to 1 over wavelength, or one number"
    if curve.points is None:
        raise ValueError(wanted)
    above = [(place_m, value) for place_m, value in curve.points if value > 1.0]
    if above:
        raise ValueError(f"{above[0][1]:g} at {1e9 * above[0][0]:g} nm is above 1; {wanted}")
    return curve


_LEAST_ROUGHNESS = 0.02
_LARGEST_INDEX = 100.0
_TRACE = 1e-9
_Number = Annotated[Fraction, Field(ge=0, le=1), Tag("float")]
_Curve = Annotated[CurveDocument, AfterValidator(_share), Tag("dict[curve]")]
_Texture = Annotated[TextureDocument, Tag("dict[texture]")]
Share = Annotated[_Number | _Curve, Discriminator(_form), BeforeValidator(_refuse_texture)]
Reflectance = Annotated[Share, BeforeValidator(_refuse_rgb)]
LaidReflectance = Annotated[_Number | _Curve | _Texture, Discriminator(_form), BeforeValidator(_refuse_rgb)]


class _Known(Matter):
    """A material; `deviates` is the field that differs from one such surface to another."""

    deviates: ClassVar[str] = "reflectance"

    @model_validator(mode="after")
    def _deviates_from_what_is_known(self) -> Self:
        if self.deviation and (self.evidence is None or not self.deviates):
            raise ValueError(
                f"deviation: {self.deviation:g} standard deviations of what? "
                + (
                    f"write 'evidence' with an 'uncertainty' of its {self.deviates}, or leave it out"
                    if self.deviates
                    else "no figure of such a material varies; leave it out"
                )
            )
        return self


class Diffuse(_Known):
    """Lambertian: reflects the share `reflectance` evenly."""

    type: Literal["diffuse"]
    reflectance: LaidReflectance


class RoughConductor(_Known):
    """Rough metal: GGX microfacets of width `roughness` with the complex index n + ik at 940 nm.

    Of what these say a dull or weathered surface reflects the `share`; 1 where it is not written.
    """

    deviates: ClassVar[str] = "share"

    type: Literal["rough_conductor"]
    share: Annotated[Fraction, Field(ge=0, le=1)] | None = None
    index: Annotated[float, Field(gt=0, le=_LARGEST_INDEX)]
    extinction_index: Annotated[float, Field(ge=0, le=_LARGEST_INDEX)]
    roughness: Annotated[float, Field(le=1), AfterValidator(_rough_enough)]


class Mirror(_Known):
    """A smooth mirror of the same reflectance at every angle."""

    type: Literal["mirror"]
    reflectance: Reflectance


class Dielectric(_Known):
    """A smooth transparent solid of refractive index `index`."""

    deviates: ClassVar[str] = ""

    type: Literal["dielectric"]
    index: Annotated[float, Field(ge=1, le=_LARGEST_INDEX)]


class Plastic(_Known):
    """A diffuse ground of `reflectance` under a rough clear coat of refractive index `index`."""

    type: Literal["plastic"]
    index: Annotated[float, Field(ge=1, le=_LARGEST_INDEX)]
    reflectance: LaidReflectance
    roughness: Annotated[float, Field(ge=0, le=1), AfterValidator(_smooth_or_rough_enough)]


class Pane(_Known):
    """A thin clear sheet of refractive index `index`: light passes straight, less what its two faces reflect.

    With both faces and all that goes to and fro between them it reflects 2R/(1 + R), R being Fresnel's
    reflectance of one face; of the rest it passes the share `transmission`. Only rectangles may be of it.
    """

    deviates: ClassVar[str] = "transmission"

    type: Literal["pane"]
    index: Annotated[float, Field(ge=1, le=_LARGEST_INDEX)] = 1.5
    transmission: Share = 1.0


class Retroreflector(_Known):
    """A tape or tile that sends light back to where it came from, over a Lambertian ground of `reflectance`.

    `coefficients` of retroreflection in cd/(lx m²) as EN ISO 20471 and ASTM E810 state them: a row for each
    angle of `observation`, a value in it for each angle of `entrance`. What is assumed between these and
    beyond them: `Coefficients`.
    """

    deviates: ClassVar[str] = "coefficients"

    type: Literal["retroreflector"]
    reflectance: Reflectance = 0.0
    observation_rad: tuple[float, ...]
    entrance_rad: tuple[float, ...]
    coefficients: tuple[tuple[float, ...], ...]

    @field_validator("observation_rad", "entrance_rad", mode="before")
    @classmethod
    def _parse_angles(cls, text: Any) -> tuple[float, ...]:
        return parse_vector(text, ANGLE, None)

    @field_validator("coefficients", mode="before")
    @classmethod
    def _parse_rows(cls, rows: Any) -> Any:
        return parse_rows(rows)

    @field_serializer("observation_rad", "entrance_rad")
    def _write_angles(self, angles_rad: tuple[float, ...]) -> str:
        return format_vector(angles_rad, ANGLE)

    @model_validator(mode="after")
    def _gains_nothing(self) -> Self:
        check_coefficients(self.observation_rad, self.entrance_rad, self.coefficients)
        back = reflected_share(self.table())
        total = back + largest(self.reflectance)
        if total > 1.0:
            raise ValueError(
                f"coefficients: {100.0 * back:.3g} % of the light would go back and "
                f"{100.0 * (total - back):.3g} % off the ground, more than falls in; lower them, or "
                "give larger entrance angles, where they fall"
            )
        return self

    def table(self) -> Coefficients:
        """Return the coefficients over both angles."""
        return Coefficients(
            np.array(self.observation_rad), np.array(self.entrance_rad), np.array(self.coefficients)
        )


MaterialDocument = Annotated[
    Diffuse | RoughConductor | Mirror | Dielectric | Plastic | Pane | Retroreflector,
    Field(discriminator="type"),
    typed(
        "{type: diffuse, reflectance: 0.5}",
        Diffuse, RoughConductor, Mirror, Dielectric, Plastic, Pane, Retroreflector,
    ),
]  # fmt: skip


def curves_of(material: MaterialDocument) -> dict[str, CurveDocument]:
    """Return what of a material varies with the wavelength, by field."""
    values = {name: getattr(material, name) for name in type(material).model_fields}
    return {name: value for name, value in values.items() if isinstance(value, CurveDocument)}


def at_wavelength(material: MaterialDocument, wavelength_m: float) -> MaterialDocument:
    """Return a material as it is at one wavelength, or at the nearest at which it is known: all numbers.

    A mirror or pane keeps a trace of light where its curve is 0, so that it shows the same images throughout.
    """
    least = _TRACE if isinstance(material, Mirror | Pane) else 0.0
    numbers = {}
    for name, written in curves_of(material).items():
        curve = written.curve(name)
        value = curve(min(max(wavelength_m, curve.low_m), curve.high_m))
        numbers[name] = max(float(value), least)
    return material.model_copy(update=numbers) if numbers else material


def number(share: float | CurveDocument | TextureDocument) -> float:
    """Return a value of a material that is known at one wavelength (`at_wavelength`)."""
    assert isinstance(share, float)
    return share


def is_black(material: MaterialDocument) -> bool:
    """Tell whether a material reflects and passes nothing at any wavelength."""
    return isinstance(material, Diffuse) and largest(material.reflectance) == 0.0


def largest(share: float | CurveDocument | TextureDocument) -> float:
    """Return the largest value of a share at any wavelength and place."""
    if isinstance(share, TextureDocument):
        return max(share.of)
    return share if isinstance(share, float) else max(value for _, value in share.points or ())


def texture_of(material: MaterialDocument) -> TextureDocument | None:
    """Return the picture of a material's reflectance, None where it is the same everywhere."""
    share = material.reflectance if isinstance(material, Diffuse | Plastic) else None
    return share if isinstance(share, TextureDocument) else None


def realised(material: MaterialDocument) -> MaterialDocument:
    """Return a material as its surface is: its deviation in its figures, and nothing said of evidence."""
    plain = material.model_copy(update={"evidence": None, "deviation": None})
    if not material.deviation:
        return plain
    if isinstance(material, Retroreflector):
        by = _kept_within(material, factor(material, None))
        rows = tuple(tuple(by * value for value in row) for row in material.coefficients)
        return plain.model_copy(update={"coefficients": rows})
    share = getattr(material, material.deviates)
    return plain.model_copy(update={material.deviates: _times(1.0 if share is None else share, material)})


def _kept_within(material: Retroreflector, by: float) -> float:
    """Return a factor of coefficients with which no more light goes back than falls in."""
    back = reflected_share(material.table())
    return min(by, (1.0 - largest(material.reflectance)) / back) if back > 0.0 else by


def _times(
    share: float | CurveDocument | TextureDocument, material: MaterialDocument
) -> float | CurveDocument | TextureDocument:
    if isinstance(share, float):
        return min(share * factor(material, share), 1.0)
    if isinstance(share, TextureDocument):
        by = factor(material, None)
        black, white = (min(by * end, 1.0) for end in share.of)
        return share.model_copy(update={"of": (black, white)})
    curve = share.curve(material.deviates)
    by = factor(material, float(curve(min(max(BAND_M, curve.low_m), curve.high_m))))
    points = tuple((place_m, min(by * value, 1.0)) for place_m, value in share.points or ())
    return share.model_copy(update={"points": points})
