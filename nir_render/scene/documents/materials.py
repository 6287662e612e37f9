"""Models of materials, as they are at 940 nm."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from nir_render.errors import shown
from nir_render.scene.documents.base import RGB_REFUSED, Document, Fraction, typed


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


_LEAST_ROUGHNESS = 0.02
_LARGEST_INDEX = 100.0
Reflectance = Annotated[Fraction, BeforeValidator(_refuse_rgb), Field(ge=0, le=1)]


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
    transmission: Annotated[Fraction, Field(ge=0, le=1)] = 1.0


MaterialDocument = Annotated[
    Diffuse | RoughConductor | Mirror | Dielectric | Plastic | Pane,
    Field(discriminator="type"),
    typed("{type: diffuse, reflectance: 0.5}", Diffuse, RoughConductor, Mirror, Dielectric, Plastic, Pane),
]
