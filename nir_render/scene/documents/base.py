"""What all models of a scene file share: closed fields, quantities as text, names, an orientation."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Generic, TypeVar, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema

from nir_render.errors import shown
from nir_render.scene.text import units
from nir_render.scene.text.units import (
    FRACTION,
    Quantity,
    format_quantity,
    format_vector,
    parse_quantity,
    parse_vector,
    wanted,
)

Part = TypeVar("Part")

_MAY_HOLD_TRUTH = (bool, list, tuple)

_UNIT_SUFFIXES = (
    "_m_per_k",
    "_k_per_w",
    "_per_k",
    "_e_per_s",
    "_dn_per_e",
    "_w_per_m3",
    "_per_m",
    "_px",
    "_dn",
    "_hz",
    "_rad",
    "_lm",
    "_lx",
    "_nm",
    "_m",
    "_s",
    "_w",
    "_e",
    "_k",
    "_a",
    "_v",
    "_bit",
)
_COLOUR_KEYS = {"rgb", "color", "colour", "srgb"}
RGB_REFUSED = "RGB colours have no meaning at 940 nm; give the value in the band, a number from 0 to 1"


@cache
def document_key(field: str) -> str:
    """Return a field's key in the document: `exposure_s` is written `exposure: 1 ms`."""
    for suffix in _UNIT_SUFFIXES:
        if field.endswith(suffix):
            return field.removesuffix(suffix)
    return field


@dataclass(frozen=True)
class Same(Generic[Part]):
    """A part of a document as itself: two are equal where they are one object, whatever they hold.

    What follows from a part that is read once (`files.ReadOnceDocument`) can be kept by it.
    """

    part: Part

    def __hash__(self) -> int:
        """Return the hash of the object."""
        return id(self.part)

    def __eq__(self, other: object) -> bool:
        """Tell whether it is the same object."""
        return isinstance(other, Same) and other.part is self.part


class Document(BaseModel):
    """A part of a scene file. Unknown keys are refused with the nearest known one.

    `example` shows how one is written; `read_keys` are keys of the document that become others
    when it is read.
    """

    example: ClassVar[str] = ""
    read_keys: ClassVar[tuple[str, ...]] = ()

    model_config = ConfigDict(
        extra="forbid", frozen=True, alias_generator=document_key, allow_inf_nan=False, strict=False
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        if isinstance(data, Document):
            return data
        wrong = {problem.key: problem for problem in cls.key_problems(data)}
        if any(problem.known for problem in wrong.values()):
            raise _error_of(cls.__name__, wrong.values())
        # Unknown keys go on, marked: then they are told of together with all else that is wrong.
        return {**data, **wrong} if wrong else data

    @classmethod
    def check_keys(cls, data: Any) -> None:
        """Raise ValidationError of all keys that are unknown here, or hold a truth value.

        For those who read keys before the model does; raises ValueError where data are no mapping.
        """
        problems = cls.key_problems(data)
        if problems:
            raise _error_of(cls.__name__, problems)

    @classmethod
    def key_problems(cls, data: Any) -> list["KeyProblem"]:
        """Return what is wrong with the keys of data; raise ValueError where they are no mapping."""
        known = _keys_of(cls)
        if not isinstance(data, Mapping):
            like = f"such as {cls.example}" if cls.example else f"known keys: {', '.join(sorted(known))}"
            raise ValueError(f"{shown(data)} stands where keys with values are wanted, {like}")
        found = (
            _key_problem(key, value, known)
            for key, value in data.items()
            if key not in known or isinstance(value, _MAY_HOLD_TRUTH)
        )
        return [problem for problem in found if problem is not None]


@cache
def _keys_of(model: type[Document]) -> tuple[str, ...]:
    """Return the keys that a model takes."""
    return *(document_key(name) for name in model.model_fields), *model.read_keys


@dataclass(frozen=True)
class KeyProblem:
    """What is wrong with a key: it stands for the key's value, and what explains errors tells of it.

    `meant` is the key that it may have been meant for; `known` tells that it is a key of the model.
    """

    key: str
    message: str
    meant: str = ""
    known: bool = False


def _error_of(model: str, problems: Iterable[KeyProblem]) -> ValidationError:
    """Return the error of a model whose keys are wrong, each at its place."""
    lines = [
        InitErrorDetails(
            type=PydanticCustomError("key", "{message}", {"message": problem.message}),
            loc=(problem.key,),
            input=problem,
        )
        for problem in problems
    ]
    return ValidationError.from_exception_data(model, lines)


def _key_problem(key: Any, value: Any, known: Sequence[str]) -> KeyProblem | None:
    """Return what is wrong with a key, or None."""
    truth = _truth_in(value)
    if truth is not None:  # Python counts true as 1
        inside = "is" if value is truth else "holds"
        return KeyProblem(
            key,
            f"{shown(key)} {inside} {str(truth).lower()}; nothing here is true or false; to do without it, "
            "leave the key out or write null (YAML takes yes, no, on and off for these: put text in quotes)",
            known=key in known,
        )
    if key in known:
        return None
    if str(key).lower() in _COLOUR_KEYS:
        return KeyProblem(key, f"{shown(key)}: {RGB_REFUSED}")
    near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(sorted(known))}"
    return KeyProblem(key, f"unknown key {shown(key)}; {hint}", meant=near[0] if near else "")


def _truth_in(value: Any) -> bool | None:
    """Return a truth value that is a value, or stands in lists within it; None where there is none."""
    if isinstance(value, list | tuple):
        return next((truth for item in value if (truth := _truth_in(item)) is not None), None)
    return value if isinstance(value, bool) else None


# What people call things that are called otherwise here.
_MEANT = {
    "plane": "rectangle", "quad": "rectangle", "wall": "rectangle", "floor": "rectangle",
    "square": "rectangle",
    "cube": "box", "cuboid": "box", "ball": "sphere", "tube": "cylinder", "pole": "cylinder", "obj": "mesh",
    "ply": "mesh", "lambertian": "diffuse", "matte": "diffuse", "metal": "rough_conductor",
    "conductor": "rough_conductor", "glass": "dielectric", "window": "pane", "specular": "mirror",
    "tape": "retroreflector", "retroreflective": "retroreflector",
    "hg": "henyey_greenstein",
}  # fmt: skip


def typed(example: str, *models: type[Document]) -> BeforeValidator:
    """Return what refuses data for one of some models where their key `type` tells none of them.

    `example` shows how one is written, for models that have none of their own.
    """
    kinds = {str(get_args(model.model_fields["type"].annotation)[0]): model for model in models}
    known = f"known: {', '.join(kinds)}; write it such as {example}"

    def check(data: Any) -> Any:
        if isinstance(data, Document):
            return data
        if not isinstance(data, Mapping):
            raise ValueError(
                f"{shown(data)} stands where keys with values are wanted, 'type' among them; {known}"
            )
        kind = data.get("type")
        if kind is None:
            raise ValueError(f"the key 'type' is missing; {known}")
        if not isinstance(kind, str) or kind not in kinds:
            near = [_MEANT[str(kind)]] if _MEANT.get(str(kind)) in kinds else []
            near = near or difflib.get_close_matches(str(kind), kinds, n=1, cutoff=0.5)
            if not near:
                raise ValueError(f"there is no type {shown(kind)}; {known}")
            like = kinds[near[0]].example
            raise ValueError(
                f"there is no type {shown(kind)}; did you mean {near[0]!r}?"
                + (f" write it such as {like}" if like else "")
            )
        return data

    return BeforeValidator(check)


@dataclass(frozen=True)
class Unit:
    """Annotation of a model's field: text with a unit in the document, SI floats in the model."""

    quantity: Quantity
    size: int | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Parse before, and write after, the field's own validation."""
        return core_schema.no_info_before_validator_function(
            self._parse,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(self._write),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the text, not the float that it becomes."""
        if self.size is not None:
            example = f"[{', '.join('123'[: self.size])}] {self.quantity.unit}"
            return {"type": "string", "pattern": r"^\s*\[.*\]\s*\S+\s*$", "examples": [example]}
        kind = "string" if self.quantity is not FRACTION else ["number", "string"]
        most = f"{self.quantity.most:g} {self.quantity.unit}".rstrip()
        described = f"{wanted(self.quantity)}; at most {most} either way"
        return {"type": kind, "description": described, "examples": [self.quantity.example]}

    def _parse(self, text: object) -> float | tuple[float, ...]:
        if self.size is None:
            return parse_quantity(text, self.quantity)
        return parse_vector(text, self.quantity, self.size)

    def _write(self, value: Any) -> str | float:
        if self.size is not None:
            return format_vector(value, self.quantity)
        return format_quantity(value, self.quantity) if self.quantity.unit else float(value)


Length = Annotated[float, Unit(units.LENGTH)]
Time = Annotated[float, Unit(units.TIME)]
Frequency = Annotated[float, Unit(units.FREQUENCY)]
Angle = Annotated[float, Unit(units.ANGLE)]
Power = Annotated[float, Unit(units.POWER)]
Temperature = Annotated[float, Unit(units.TEMPERATURE)]
LuminousFlux = Annotated[float, Unit(units.LUMINOUS_FLUX)]
Illuminance = Annotated[float, Unit(units.ILLUMINANCE)]
Electrons = Annotated[float, Unit(units.ELECTRONS)]
Counts = Annotated[float, Unit(units.COUNTS)]
SystemGain = Annotated[float, Unit(units.SYSTEM_GAIN)]
DarkCurrent = Annotated[float, Unit(units.DARK_CURRENT)]
FocusShift = Annotated[float, Unit(units.FOCUS_SHIFT)]
WavelengthShift = Annotated[float, Unit(units.WAVELENGTH_SHIFT)]
TemperatureCoefficient = Annotated[float, Unit(units.TEMPERATURE_COEFFICIENT)]
Current = Annotated[float, Unit(units.CURRENT)]
Voltage = Annotated[float, Unit(units.VOLTAGE)]
ThermalResistance = Annotated[float, Unit(units.THERMAL_RESISTANCE)]
Pixels = Annotated[float, Unit(units.PIXELS)]
Pixels2 = Annotated[tuple[float, float], Unit(units.PIXELS, 2)]
Bits = Annotated[float, Unit(units.BITS)]
Fraction = Annotated[float, Unit(units.FRACTION)]
Extinction = Annotated[float, Unit(units.EXTINCTION)]
SpectralIrradiance = Annotated[float, Unit(units.SPECTRAL_IRRADIANCE)]
Position = Annotated[tuple[float, float, float], Unit(units.LENGTH, 3)]
Size2 = Annotated[tuple[float, float], Unit(units.LENGTH, 2)]
Size3 = Annotated[tuple[float, float, float], Unit(units.LENGTH, 3)]

Positive = Field(gt=0)
NotNegative = Field(ge=0)
# Names become parts of dotted paths and of file names.
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]{0,99}$")]


class Orientation(Document):
    """A rotation by yaw about z (to the left), then pitch about the new y (nose down), then roll about x."""

    example: ClassVar[str] = "{yaw: 90 deg}"

    yaw_rad: Angle = 0.0
    pitch_rad: Angle = 0.0
    roll_rad: Angle = 0.0


Direction = tuple[float, float, float]


def positive_extents(size: tuple[float, ...]) -> tuple[float, ...]:
    """Raise ValueError where an extent is not above 0."""
    if min(size) <= 0:
        raise ValueError("each extent must be greater than 0")
    return size


def usable_direction(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a direction; raise ValueError where it has no length, or one far from 1."""
    if not any(vector):
        raise ValueError("a direction must not be [0, 0, 0]; write such as [0, 0, 1]")
    if not 1e-6 <= max(map(abs, vector)) <= 1e6:
        raise ValueError(f"{list(vector)} is no direction; write one about as long as 1, such as [0, 0, 1]")
    return vector
