"""The JSON Schema of scene files, for editors."""

from typing import Any

from nir_render.scene import devices, world
from nir_render.scene.base import PresetDocument, preset_names
from nir_render.scene.document import SceneDocument

_PRESET_MODELS: tuple[type[PresetDocument], ...] = (
    devices.Source,
    devices.Lens,
    devices.Bandpass,
    devices.Sensor,
    devices.Camera,
    devices.Rig,
    world.Lamp,
)


def scene_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of what a person writes: presets by name, includes, unit strings."""
    schema = SceneDocument.model_json_schema(by_alias=True)
    definitions = schema["$defs"]
    for model in _PRESET_MODELS:
        if model.__name__ in definitions:
            definitions[model.__name__] = _or_preset(definitions[model.__name__], model.preset_folder)
    curve = definitions["CurveDocument"]
    curve["properties"]["file"] = {"type": "string", "description": "CSV with the header wavelength_nm,value"}
    # Points are pairs of a wavelength with its unit and a value.
    pair = {
        "type": "array",
        "prefixItems": [{"type": "string"}, {"type": "number"}],
        "minItems": 2,
        "maxItems": 2,
    }
    curve["properties"]["points"] = {"type": "array", "items": pair, "minItems": 2}
    definitions["CurveDocument"] = {"title": "Curve", "anyOf": [{"type": "number"}, curve]}
    schema["properties"]["include"] = {"type": "array", "items": {"type": "string"}}
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "nir_render scene"
    return schema


def _or_preset(definition: dict[str, Any], folder: str) -> dict[str, Any]:
    """Return a definition that also takes a preset's name, alone or as the ground under changes.

    No key is required: a preset further up may hold it. What is missing in the end, the loader tells.
    """
    names = preset_names(folder)
    name = {"type": "string", "description": "a preset, or a .yaml file beside the scene", "examples": names}
    whole = {**definition, "properties": {**definition["properties"], "preset": name}}
    whole.pop("required", None)
    return {"title": definition["title"], "anyOf": [name, whole]}
