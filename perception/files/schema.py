"""The files of a recording, published: JSON Schemas for programs, tables of fields for pages."""

from collections.abc import Sequence
from typing import Any

from perception.files.calibration import CALIBRATION_ENTRIES
from perception.files.detections import DETECTION_ENTRIES
from perception.files.entries import Entry, wanted
from perception.files.recording import FRAME_ENTRIES

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_FORMAT = {"const": 1, "description": "version of the format"}
_KINDS = {"text": "string", "choice": "string", "whole": "integer", "number": "number", "flag": "boolean"}


def frames_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a line of `frames.jsonl`."""
    return {"$schema": _DRAFT, "title": "a line of frames.jsonl", **_object(FRAME_ENTRIES, marked=True)}


def detections_schema() -> dict[str, Any]:
    """Return the JSON Schema of a line of `detections.NAME.jsonl`."""
    title = "a line of detections.NAME.jsonl"
    return {"$schema": _DRAFT, "title": title, **_object(DETECTION_ENTRIES, marked=True)}


def calibration_schema() -> dict[str, Any]:
    """Return the JSON Schema of `calibration.json`."""
    cameras = {"type": "object", "additionalProperties": _object(CALIBRATION_ENTRIES, marked=False)}
    return {
        "$schema": _DRAFT,
        "title": "calibration.json",
        "type": "object",
        "properties": {"format": _FORMAT, "cameras": {**cameras, "description": "by name, `robot.camera`"}},
        "required": ["format", "cameras"],
    }


def entry_table(entries: Sequence[Entry]) -> str:
    """Return a table of fields, Markdown: name, what it holds, what it says; those with * must be there."""
    lines = ["| field | value | is |", "|---|---|---|"]
    for entry in entries:
        star = "*" if entry.required else ""
        held = wanted(entry) + (f", or null: {entry.null}" if entry.null else "")
        default = "" if entry.required or entry.default != entry.default else _default(entry)
        held = held.replace("|", "\\|")
        lines.append(f"| `{entry.name}`{star} | {held} | {entry.meaning}{default} |")
    return "\n".join(lines) + "\n"


def _default(entry: Entry) -> str:
    if entry.default == "":
        return "; none where it is missing"
    shown = "[]" if entry.default == () else f"{entry.default:g}" if entry.kind != "choice" else entry.default
    return f"; `{shown}` where it is missing"


def _object(entries: Sequence[Entry], marked: bool) -> dict[str, Any]:
    properties = {"format": _FORMAT} if marked else {}
    required = ["format"] if marked else []
    return {
        "type": "object",
        "properties": properties | {entry.name: _field(entry) for entry in entries},
        "required": required + [entry.name for entry in entries if entry.required],
    }


def _field(entry: Entry) -> dict[str, Any]:
    value: dict[str, Any]
    if entry.kind in ("list", "bearing"):
        number: dict[str, Any] = {"type": "number", **_bounds(entry)}
        if entry.kind == "bearing":
            number = {"type": ["number", "null"]}
        value = {"type": "array", "items": number, "minItems": entry.size or (0 if not entry.required else 1)}
        value |= {"maxItems": entry.size} if entry.size else {}
    elif entry.kind == "places":
        place = {"type": "array", "items": {"type": "number", **_bounds(entry)}, "minItems": 3, "maxItems": 3}
        value = {"type": "array", "items": place}
    elif entry.kind == "objects":
        value = {"type": "array", "items": _object(entry.fields, marked=False)}
    else:
        value = {"type": _KINDS[entry.kind], **_bounds(entry)}
        value |= {"enum": list(entry.choices)} if entry.choices else {}
        value |= {"minLength": 1} if entry.kind == "text" else {}
    forms = [value]
    if entry.sigma:
        sigma = {"type": "number", "minimum": 0}
        forms.append({
            "type": "object", "properties": {"value": value, "sigma": sigma}, "required": ["value", "sigma"],
        })  # fmt: skip
    if entry.null:
        forms.append({"type": "null", "description": entry.null})
    described = {"description": entry.meaning}
    return {**described, **forms[0]} if len(forms) == 1 else {**described, "anyOf": forms}


def _bounds(entry: Entry) -> dict[str, float]:
    if entry.kind in ("text", "flag", "choice"):
        return {}
    low = {"exclusiveMinimum" if entry.above else "minimum": entry.least} if entry.least > -1e300 else {}
    return low | ({"maximum": entry.most} if entry.most < 1e300 else {})
