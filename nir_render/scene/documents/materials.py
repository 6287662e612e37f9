"""Models of materials: numbers as they are at 940 nm, or curves over wavelength."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from nir_render.errors import shown
from nir_render.scene.documents.base import RGB_REFUSED, Document, Fraction, typed
from nir_render.scene.documents.curves import CurveDocument


def _refuse_rgb(value: Any) -> Any:
    looks_rgb = isinstance(value, list | tuple) or (
        isinstance(value, str) and value.strip().startswith(("#", "[", "rgb"))
    )
    if looks_rgb:
        raise ValueError(f"{shown(value)}: {RGB_REFUSED}")
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
    return "dict[curve]" if isinstance(value, Mapping | CurveDocument) else "float"


def _share(curve: CurveDocument) -> CurveDocument:
    if curve.points is None or max(value for _, value in curve.points) > 1.0:
        raise ValueError("wanted 'points' or 'file': values from 0 to 1 over wavelength, or one number")
    return curve


_LEAST_ROUGHNESS = 0.02
_LARGEST_INDEX = 100.0
_TRACE = 1e-9
_Number = Annotated[Fraction, Field(ge=0, le=1), Tag("float")]
_Curve = Annotated[CurveDocument, AfterValidator(_share), Tag("dict[curve]")]
Share = Annotated[_Number | _Curve, Discriminator(_form)]
Reflectance = Annotated[Share, BeforeValidator(_refuse_rgb)]


class Diffuse(Document):
    """Lambertian: reflects the share `reflectance` evenly."""

    type: Literal["diffuse"]
    reflectance: Reflectance


class RoughConductor(Document):
    """Rough metal: GGX microfacets of width `roughness` with the complex index n + ik at 940 nm."""

    type: Literal["rough_conductor"]
    index: Annotated[float, Field(gt=0, le=_LARGEST_INDEX)]
    extinction_index: Annotated[float, Field(ge=0, le=_LARGEST_INDEX)]
    roughness: Annotated[float, Field(le=1), AfterValidator(_rough_enough)]


class Mirror(Document):
    """A smooth mirror of the same reflectance at every angle."""

    type: Literal["mirror"]
    reflectance: Reflectance


class Dielectric(Document):
    """A smooth transparent solid of refractive index `index`."""

    type: Literal["dielectric"]
    index: Annotated[float, Field(ge=1, le=_LARGEST_INDEX)]


class Plastic(Document):
    """A diffuse ground of `reflectance` under a rough clear coat of refractive index `index`."""

    type: Literal["plastic"]
    index: Annotated[float, Field(ge=1, le=_LARGEST_INDEX)]
    reflectance: Reflectance
    roughness: Annotated[float, Field(ge=0, le=1), AfterValidator(_smooth_or_rough_enough)]


class Pane(Document):
    """A thin clear sheet of refractive index `index`: light passes straight, less what its two faces reflect.

    With both faces and all that goes to and fro between them it reflects 2R/(1 + R), R being Fresnel's
    reflectance of one face; of the rest it passes the share `transmission`. Only rectangles may be of it.
    """

    type: Literal["pane"]
    index: Annotated[float, Field(ge=1, le=_LARGEST_INDEX)] = 1.5
    transmission: Share = 1.0


MaterialDocument = Annotated[
    Diffuse | RoughConductor | Mirror | Dielectric | Plastic | Pane,
    Field(discriminator="type"),
    typed("{type: diffuse, reflectance: 0.5}", Diffuse, RoughConductor, Mirror, Dielectric, Plastic, Pane),
]


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


def number(share: float | CurveDocument) -> float:
    """Return a value of a material that is known at one wavelength (`at_wavelength`)."""
    assert isinstance(share, float)
    return share


def is_black(material: MaterialDocument) -> bool:
    """Tell whether a material reflects and passes nothing at any wavelength."""
    if not isinstance(material, Diffuse):
        return False
    value = material.reflectance
    return value == 0.0 if isinstance(value, float) else max(one for _, one in value.points or ()) == 0.0
