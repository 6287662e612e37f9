"""The JSON Schema of scene files, for editors."""

from typing import Any

from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.scene.documents.ambient.lamps import Lamp
from nir_render.scene.documents.ambient.sun import Air
from nir_render.scene.documents.camera import Camera, Rig
from nir_render.scene.documents.document import SceneDocument
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.files import PresetDocument, preset_names
from nir_render.scene.documents.fog import MOST_HEIGHTS
from nir_render.scene.documents.lens import Lens
from nir_render.scene.documents.sensor import Sensor
from nir_render.scene.documents.spectral.bandpass import Bandpass
from nir_render.scene.documents.spectral.led import Led
from nir_render.scene.text.units import SPEED, VISIBILITY

_PRESET_MODELS: tuple[type[PresetDocument], ...] = (
    Source,
    Lens,
    Bandpass,
    Led,
    Sensor,
    Camera,
    Rig,
    Lamp,
    Air,
    Droplets,
)


def scene_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) of what a person writes: presets by name, includes, unit strings."""
    schema = SceneDocument.model_json_schema(by_alias=True)
    definitions = schema["$defs"]
    for key in ("power_at_current", "voltage_at_current"):
        definitions["Led"]["properties"][key] = {"type": "array", "minItems": 2}
    for model in _PRESET_MODELS:
        if model.__name__ in definitions:
            definitions[model.__name__] = _or_preset(definitions[model.__name__], model.preset_folder)
    _describe_curves(definitions)
    _describe_materials(schema)
    fog = definitions["Fog"]
    fog["properties"]["visibility"] = {**fog["properties"]["extinction"], "examples": [VISIBILITY.example]}
    fog["properties"]["visibility"]["description"] = "3.912 / extinction at 550 nm, in place of it"
    del fog["required"]
    fog["oneOf"] = [{"required": ["extinction"]}, {"required": ["visibility"]}]
    for name, key in (("Waypoint", "time"), ("Circle", "period")):
        _or_speed(definitions[name], key)
    schema["properties"]["include"] = {"type": "array", "items": {"type": "string"}}
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "nir_render scene"
    return schema


def _or_speed(definition: dict[str, Any], key: str) -> None:
    """Let a speed stand in place of a time."""
    definition["properties"]["speed"] = {"type": "string", "examples": [SPEED.example]}
    definition["required"].remove(key)
    definition["oneOf"] = [{"required": [key]}, {"required": ["speed"]}]


def _describe_materials(schema: dict[str, Any]) -> None:
    """Let a material be a preset's name, or stand on one; and tables of tape be written as they are read."""
    (written,) = schema["properties"]["materials"]["patternProperties"].values()
    any_type = {**written, "anyOf": written["oneOf"]}
    del any_type["oneOf"]
    named = _or_preset({"title": "Material", "type": "object", "properties": {}}, "materials")["anyOf"]
    changed = {"type": "object", "not": {"required": ["type"]}, "properties": named[1]["properties"]}
    written.clear()
    written["anyOf"] = [any_type, named[0], changed]
    properties = schema["$defs"]["Retroreflector"]["properties"]
    for key in ("observation", "entrance"):
        properties[key] = {
            "type": "string", "pattern": r"^\s*\[.*\]\s*\S+\s*$", "examples": ["[0.2, 1] deg"],
        }  # fmt: skip


def _describe_curves(definitions: dict[str, Any]) -> None:
    """Describe curves as they are written: points with a unit, or a CSV file that becomes points."""
    # Points are pairs of a place with its unit and a value.
    pair = {
        "type": "array",
        "prefixItems": [{"type": "string"}, {"type": "number"}],
        "minItems": 2,
        "maxItems": 2,
    }
    points = {"type": "array", "items": pair, "minItems": 2}
    headers = {
        "CurveDocument": "wavelength_nm,value",
        "SpectrumDocument": "wavelength_nm,value",
        "PatternDocument": "polar_deg,azimuth_deg,value",
        "TabulatedPhase": "angle_deg,value",
    }
    for name, header in headers.items():
        properties = definitions[name]["properties"]
        properties["file"] = {"type": "string", "description": f"CSV with the header {header}"}
        properties["points"] = points
    definitions["TabulatedPhase"]["required"].remove("points")
    profile = definitions["Fog"]["properties"]["profile"]
    profile["anyOf"] = [{**points, "maxItems": MOST_HEIGHTS}, {"type": "null"}]
    for name, key in (
        ("Diffuse", "reflectance"),
        ("Mirror", "reflectance"),
        ("Plastic", "reflectance"),
        ("Pane", "transmission"),
        ("Retroreflector", "reflectance"),
    ):
        either = definitions[name]["properties"][key]
        either["anyOf"] = either.pop("oneOf")  # a curve may be a number too
    definitions["CurveDocument"] = {
        "title": "Curve",
        "anyOf": [{"type": "number"}, definitions["CurveDocument"]],
    }
    angles = {"type": "string", "pattern": r"^\s*\[.*\]\s*\S+\s*$", "examples": ["[0, 90, 180] deg"]}
    row = {"type": "string", "pattern": r"^\s*\[.*\]\s*$", "examples": ["[1, 0.5, 0.2]"]}
    definitions["PatternGrid"]["properties"] |= {
        "polar": angles,
        "azimuth": angles,
        "values": {"type": "array", "items": row, "minItems": 2},
    }
    definitions["MeasuredKernel"]["properties"] |= {
        "file": {"type": "string", "description": "CSV of rows of numbers, without a header"},
        "values": {"type": "array", "items": row, "minItems": 3},
    }
    definitions["MeasuredKernel"]["required"].remove("values")


def _or_preset(definition: dict[str, Any], folder: str) -> dict[str, Any]:
    """Return a definition that also takes a preset's name, alone or as the ground under changes.

    No key is required: a preset further up may hold it. What is missing in the end, the loader tells.
    """
    names = list(preset_names(folder))
    name = {"type": "string", "description": "a preset, or a .yaml file beside the scene", "examples": names}
    whole = {**definition, "properties": {**definition["properties"], "preset": name}}
    whole.pop("required", None)
    return {"title": definition["title"], "anyOf": [name, whole]}
