"""The record of where a robot truly is at one time, and how fast it goes: a line of `poses.jsonl`."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from nir_render.errors import InputError, shown
from nir_render.truth.sources import is_number

_UNIT_SLACK = 1e-3


@dataclass(frozen=True)
class PoseTruth:
    """A robot's pose and velocity in the world; the quaternion, (x, y, z, w), takes body axes to its axes."""

    robot: str
    time_s: float
    position_m: tuple[float, ...]
    quaternion_xyzw: tuple[float, ...]
    velocity_m_per_s: tuple[float, ...]
    angular_velocity_rad_per_s: tuple[float, ...]

    def record(self) -> dict[str, Any]:
        """Return the line of `poses.jsonl`."""
        return {"format": 1, **asdict(self)}


_LENGTHS = {
    "position_m": 3, "quaternion_xyzw": 4, "velocity_m_per_s": 3, "angular_velocity_rad_per_s": 3,
}  # fmt: skip


def parse_pose(record: Mapping[str, Any]) -> PoseTruth:
    """Return what a line of `poses.jsonl` says; fields that it does not know are passed over.

    Raises
    ------
    InputError
        All fields that are missing or of another kind than they should be.
    """
    if not isinstance(record, Mapping):
        raise InputError(f"wanted an object with 'robot', 'position_m' and others, not {shown(record)}")
    problems = []
    if not isinstance(record.get("robot"), str):
        problems.append(f"robot is {shown(record.get('robot'))}; wanted a name")
    if not is_number(record.get("time_s")):
        problems.append(f"time_s is {shown(record.get('time_s'))}; wanted a number")
    for name, length in _LENGTHS.items():
        value = record.get(name)
        if not isinstance(value, list | tuple) or len(value) != length or not all(map(is_number, value)):
            problems.append(f"{name} is {shown(value)}; wanted {length} numbers")
    if not problems and abs(math.hypot(*record["quaternion_xyzw"]) - 1.0) > _UNIT_SLACK:
        problems.append(f"quaternion_xyzw is {shown(record['quaternion_xyzw'])}; wanted one of length 1")
    if problems:
        raise InputError(*problems)
    return PoseTruth(record["robot"], record["time_s"], *(tuple(record[name]) for name in _LENGTHS))
