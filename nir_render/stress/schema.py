"""The JSON Schema of campaign files, for editors."""

from typing import Any

from nir_render.stress.campaign import CampaignDocument
from nir_render.stress.figures import FIGURES
from perception import ESTIMATORS


def campaign_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of what a person writes; an axis may be a list of values alone."""
    schema = CampaignDocument.model_json_schema(by_alias=True)
    definitions, properties = schema["$defs"], schema["properties"]
    values = {"type": "array", "minItems": 1, "description": "the values; the axis's name is the dotted path"}
    definitions["AxisDocument"] = {"title": "Axis", "anyOf": [values, definitions["AxisDocument"]]}
    figures = {name: {"description": figure.explained} for name, figure in FIGURES.items()}
    properties["bounds"] = {
        "type": "object",
        "properties": {name: {**own, "type": ["string", "number"]} for name, own in figures.items()},
        "additionalProperties": False,
    }
    properties["figures"]["items"] = {"enum": list(FIGURES)}
    properties["estimators"]["items"] = {"type": "string", "examples": [*ESTIMATORS, "file.py:function"]}
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "nir_render campaign"
    return schema
