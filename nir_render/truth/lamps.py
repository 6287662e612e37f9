"""The record of a lamp, or of the sun, in one frame: a line of `lamps.jsonl`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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
    ValueError
        A field is missing, or of another kind than it should be.
    """
    for name, kind in (("camera", str), ("index", int), ("lamp", str), ("outline_px", list)):
        if not isinstance(record.get(name), kind):
            raise ValueError(f"{name} is {record.get(name)!r}; wanted a {_KINDS[kind]}")
    corners = record["outline_px"]
    if len(corners) < 3 or not all(_is_corner(corner) for corner in corners):
        raise ValueError("outline_px: wanted at least three corners [u, v], numbers in pixels")
    outline = tuple((float(u_px), float(v_px)) for u_px, v_px in corners)
    return LampTruth(record["camera"], record["index"], record["lamp"], outline)


_KINDS = {str: "text", int: "whole number", list: "list"}


def _is_corner(corner: Any) -> bool:
    return isinstance(corner, list) and len(corner) == 2 and all(isinstance(at, int | float) for at in corner)
