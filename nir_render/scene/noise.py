"""The target for the noise of rendering: "5 % of temporal variance"."""

import re
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

LEAST_PERCENT, MOST_PERCENT = 0.1, 100.0
_EXAMPLE = "5 % of temporal variance"
_FORM = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*%\s+of\s+temporal\s+variance\s*")


def parse_noise(text: object) -> float:
    """Read "5 % of temporal variance" as the share 0.05.

    Raises
    ------
    ValueError
        It is written otherwise, or lies outside 0.1 to 100 %.
    """
    match = _FORM.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"{text!r} is no target for the noise; write it such as {_EXAMPLE!r}")
    percent = float(match[1])
    if not LEAST_PERCENT <= percent <= MOST_PERCENT:
        raise ValueError(f"{text!r} lies outside {LEAST_PERCENT:g} to {MOST_PERCENT:g} %")
    return percent / 100.0


def format_noise(share: float) -> str:
    """Write a share so that `parse_noise` reads it."""
    return f"{100.0 * share:.12g} % of temporal variance"


@dataclass(frozen=True)
class _Share:
    """Annotation of a model's field: the target as text in the document, its share in the model."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(
            parse_noise,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(format_noise),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "pattern": f"^{_FORM.pattern}$", "examples": [_EXAMPLE]}


NoiseTarget = Annotated[float, _Share()]
