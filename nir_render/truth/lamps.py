"""The record of a lamp, or of the sun, in one frame: a line of `lamps.jsonl`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nir_render.errors import InputError, shown

_MOST_PX = 1e6

Outline = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class LampTruth:
    """Where one lamp stands in one frame: `outline_px` are the corners (u, v) of a polygon, in order.

    `lamp` names it as `lamps.ceiling` or `sun`; an image of the sun in a mirror has a line of its own.
    """

    camera: str
    index: int
    lamp: str
    outline_px: Outline

    def record(self) -> dict[str, Any]:
        """Return the line of `lamps.jsonl`."""
        corners = [list(corner) for corner in self.outline_px]
        return {
            "format": 1, "camera": self.camera, "index": self.index, "lamp": self.lamp, "outline_px": corners,
        }  # fmt: skip


def parse_lamp(record: Mapping[str, Any]) -> LampTruth:
    """Return the lamp of a line of `lamps.jsonl`.

    Raises
    ------
    InputError
        All fields that are missing, or of another kind than they should be.
    """
    if not isinstance(record, Mapping):
        raise InputError(f"wanted an object with fields such as 'camera' and 'lamp', not {shown(record)}")
    problems = [
        f"{name} is {shown(record.get(name))}; wanted a {_KINDS[kind]}"
        for name, kind in (("camera", str), ("index", int), ("lamp", str), ("outline_px", list))
        if not isinstance(record.get(name), kind) or isinstance(record.get(name), bool)
    ]
    corners = record.get("outline_px")
    if isinstance(corners, list) and (len(corners) < 3 or not all(map(_is_corner, corners))):
        problems.append("outline_px: wanted at least three corners [u, v], numbers in pixels")
    if problems:
        raise InputError(*problems)
    assert corners is not None
    outline = tuple((float(u_px), float(v_px)) for u_px, v_px in corners)
    return LampTruth(record["camera"], record["index"], record["lamp"], outline)


_KINDS = {str: "text", int: "whole number", list: "list"}


def _is_corner(corner: Any) -> bool:
    return isinstance(corner, list) and len(corner) == 2 and all(map(_is_place, corner))


def _is_place(at: Any) -> bool:
    return isinstance(at, int | float) and not isinstance(at, bool) and -_MOST_PX <= at <= _MOST_PX
