"""A light as a file: a NumPy archive (.npz) with one array for each array of the light, and a JSON header.

It is written aside, synced and renamed; the archive's checksums are tested on reading.
"""

import dataclasses
import hashlib
import json
import os
import secrets
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.light import light as light_module
from nir_render.light.light import Light

ASIDE = ".partial-"
"""Part of the name of a file that is not whole yet."""

_HEADER = "header"


def write_light(path: Path, light: Light, *, compressed: bool = False) -> None:
    """Write a light; raise OSError where the disk refuses."""
    header, arrays = _taken_apart(light)
    aside = path.with_name(f".{path.name}{ASIDE}{os.getpid()}-{secrets.token_hex(4)}")
    save = np.savez_compressed if compressed else np.savez
    try:
        with aside.open("xb") as file:
            text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
            named: dict[str, Any] = {_HEADER: text, **arrays}
            save(file, **named)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def read_light(path: Path) -> Light:
    """Read a light; a damaged file raises a dozen types, from NumPy, zipfile, zlib, struct, …."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(arrays.pop(_HEADER).tobytes())
    light = _put_together(header, arrays)
    if not isinstance(light, Light):
        raise TypeError(f"{path}: holds no light")
    return light


def bytes_of(light: Light) -> int:
    """Return the size of a light's arrays."""
    return sum(array.nbytes for array in _taken_apart(light)[1].values())


def light_hash(light: Light) -> str:
    """Return the SHA-256 of a light, its numbers and its arrays bit by bit: 64 hexadecimal digits."""
    header, arrays = _taken_apart(light)
    hashed = hashlib.sha256(json.dumps(header).encode())
    for name, array in arrays.items():
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        hashed.update(f"{name}{little.dtype.str}{little.shape}".encode() + little.tobytes())
    return hashed.hexdigest()


def _taken_apart(value: Any, name: str = "light") -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return a dataclass as plain data, and its arrays by the names of the fields that lead to them."""
    if isinstance(value, np.ndarray):
        return {"array": name}, {name: value}
    if isinstance(value, np.generic):  # a seed out of an array is none that JSON knows
        return value.item(), {}
    if not dataclasses.is_dataclass(value):
        return value, {}
    fields: dict[str, Any] = {}
    arrays: dict[str, NDArray[Any]] = {}
    for field in (field for field in dataclasses.fields(value) if field.init):
        if field.metadata.get("may_be_missing") and getattr(value, field.name) is None:
            continue
        fields[field.name], inner = _taken_apart(getattr(value, field.name), f"{name}.{field.name}")
        arrays |= inner
    return {"class": type(value).__name__, "fields": fields}, arrays


def _put_together(data: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Undo `_taken_apart`; what is no class of the light's module raises AttributeError."""
    if isinstance(data, list):
        return tuple(data)
    if not isinstance(data, dict):
        return data
    if "array" in data:
        return arrays[data["array"]]
    fields = {field: _put_together(inner, arrays) for field, inner in data["fields"].items()}
    return getattr(light_module, data["class"])(**fields)
