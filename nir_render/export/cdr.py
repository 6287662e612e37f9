"""Messages by their definitions: the text that a file describes itself by, bytes (CDR), ROS's own classes.

CDR is how ROS 2 writes messages (OMG, Common Data Representation, plain, little-endian): fields one after the
other, each primitive aligned to its size, counted from behind the four bytes of the head; strings and
sequences begin with their length.
"""

import importlib
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from nir_render.errors import InputError
from nir_render.export.ros_definitions import DEFINITIONS

_HEAD = b"\x00\x01\x00\x00"
_PRIMITIVES = {
    "bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
_RULE = "=" * 80
_FIELD = re.compile(r"^(?P<kind>[A-Za-z0-9_/]+)(?P<array>\[(?P<count>\d*)\])? (?P<name>\w+)$")


@dataclass(frozen=True)
class Field:
    """A field: its kind; whether it is an array, and of how many where that is fixed."""

    name: str
    kind: str
    is_array: bool
    count: int | None


def definition_text(kind: str) -> str:
    """Return the definition of a message and of all that it is made of, as a file describes itself by."""
    parts = [DEFINITIONS[kind], *(f"{_RULE}\nMSG: {one}\n{DEFINITIONS[one]}" for one in _needed(kind))]
    return "\n".join(parts) + "\n"


def encode(kind: str, value: Mapping[str, Any]) -> bytes:
    """Return a message as CDR.

    Parameters
    ----------
    kind
        Which, one of `DEFINITIONS`.
    value
        Its fields by name, all of them and no others; messages within it likewise. Bytes serve where a
        field is `uint8[]`.

    Raises
    ------
    ValueError
        A field is missing, unknown, or an array of another length than it is defined with.
    """
    buffer = bytearray()
    _write_into(buffer, kind, value)
    return _HEAD + bytes(buffer)


def _write_into(buffer: bytearray, kind: str, value: Mapping[str, Any]) -> None:
    fields = fields_of(kind)
    if value.keys() != {field.name for field in fields}:
        wrong = value.keys() ^ {field.name for field in fields}
        raise ValueError(f"{kind}: fields {', '.join(sorted(wrong))} are missing or unknown")
    for field in fields:
        content = value[field.name]
        if not field.is_array:
            _write_one_into(buffer, field.kind, content)
            continue
        if field.count is None:
            _write_one_into(buffer, "uint32", len(content))
        elif len(content) != field.count:
            raise ValueError(f"{kind}.{field.name}: wanted {field.count} values, not {len(content)}")
        _write_array_into(buffer, field.kind, content)


def _write_array_into(buffer: bytearray, kind: str, content: Sequence[Any]) -> None:
    if kind in _PRIMITIVES and len(content):
        form = _PRIMITIVES[kind]
        _align(buffer, struct.calcsize(form))
        if isinstance(content, bytes):
            buffer += content
        else:
            buffer += np.asarray(content, dtype=f"<{form}").tobytes()
        return
    for one in content:
        _write_one_into(buffer, kind, one)


def _write_one_into(buffer: bytearray, kind: str, content: Any) -> None:
    if kind == "string":
        text = content.encode() + b"\x00"
        _write_one_into(buffer, "uint32", len(text))
        buffer += text
    elif kind in _PRIMITIVES:
        form = _PRIMITIVES[kind]
        _align(buffer, struct.calcsize(form))
        buffer += struct.pack(f"<{form}", content)
    else:
        _write_into(buffer, kind, content)


def _align(buffer: bytearray, size: int) -> None:
    buffer += bytes(-len(buffer) % size)


@cache
def fields_of(kind: str) -> tuple[Field, ...]:
    """Return the fields of a message of `DEFINITIONS`, in their order."""
    found = []
    for line in DEFINITIONS[kind].split("\n"):
        match = _FIELD.match(line)
        if match is None:
            raise ValueError(f"{kind}: {line!r} is no field")
        count = int(match["count"]) if match["count"] else None
        found.append(Field(match["name"], match["kind"], match["array"] is not None, count))
    return tuple(found)


def _needed(kind: str) -> list[str]:
    """Return the messages that one is made of, each once."""
    needed: dict[str, None] = {}
    for field in fields_of(kind):
        if field.kind in DEFINITIONS:
            needed |= dict.fromkeys([field.kind, *_needed(field.kind)])
    return list(needed)


MakeMessage = Callable[..., Any]
"""The class of a message: its fields by name make one."""


def made(kind: str, value: Any, message_of: Callable[[str], MakeMessage]) -> Any:
    """Return a message with fields as `ros_messages` has them, and those within it, of ROS's own classes."""
    if kind not in DEFINITIONS:
        return value
    fields: dict[str, Any] = {}
    for field in fields_of(kind):
        content = value[field.name]
        nested = isinstance(content, Sequence) and not isinstance(content, str | bytes)
        if nested and field.kind in DEFINITIONS:
            content = [made(field.kind, one, message_of) for one in content]
        elif not nested:
            content = made(field.kind, content, message_of)
        fields[field.name] = content
    return message_of(kind)(**fields)


def class_of(kind: str) -> MakeMessage:
    """Return the class of a message of the installed ROS."""
    package, _, name = kind.partition("/")
    try:
        found: MakeMessage = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise InputError(
            f"{kind} is not to be had: run this where ROS 2 is installed and sourced "
            f"(source /opt/ros/…/setup.bash), with the package {package}"
        ) from None
    return found


def quality_of_sensors() -> Any:
    """Return ROS's own quality of service for data of sensors."""
    try:
        return importlib.import_module("rclpy.qos").qos_profile_sensor_data
    except ImportError:
        raise InputError(
            "rclpy is not to be had: run this where ROS 2 is installed and sourced "
            "(source /opt/ros/…/setup.bash)"
        ) from None
