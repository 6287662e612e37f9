"""Models of motion: waypoints with times or speeds, circles, recorded trajectories."""

import itertools
import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Angle,
    Document,
    Length,
    NotNegative,
    Orientation,
    Position,
    Positive,
    Time,
    typed,
)
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.documents.times.recorded import scene_times_s, trajectory_of
from nir_render.scene.text.units import (
    LENGTH,
    SPEED,
    TIME,
    format_quantity,
    parse_quantity,
    parse_vector,
)

Between = Literal["straight", "smooth"]


class Waypoint(Document):
    """Where a robot is from one time on, for as long as `hold`; then it moves to the next.

    From the second on, `speed` may stand in place of `time`: then it arrives when it has gone the straight
    line from the one before at that speed.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("speed",)

    time_s: Time
    hold_s: Annotated[Time, NotNegative] = 0.0
    position_m: Position
    orientation: Orientation = Orientation()


class Circle(Document):
    """A level circle, run for ever: at time 0 at `phase` from the x axis, to the left or to the right.

    `period` is the time of a round; or `speed`, of which it is made. With the heading `tangent` the x axis
    points along the way, turned further by `orientation`; `fixed` keeps the orientation.
    """

    example: ClassVar[str] = '{type: circle, center: "[0, 0, 0] m", radius: 1 m, period: 10 s}'
    read_keys: ClassVar[tuple[str, ...]] = ("speed",)

    type: Literal["circle"]
    center_m: Position
    radius_m: Annotated[Length, Positive]
    period_s: Annotated[Time, Positive]
    phase_rad: Angle = 0.0
    turn: Literal["left", "right"] = "left"
    heading: Literal["tangent", "fixed"] = "tangent"
    orientation: Orientation = Orientation()

    @model_validator(mode="before")
    @classmethod
    def _read_speed(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or data.get("speed") is None:
            return data
        cls.check_keys(data)
        if data.get("period") is not None:
            raise ValueError("write either 'period' or 'speed', not both")
        radius_m = parse_quantity(data.get("radius"), LENGTH)
        period_s = 2.0 * math.pi * radius_m / _speed(data["speed"], "speed")
        others = {key: value for key, value in data.items() if key != "speed"}
        return {**others, "period": format_quantity(period_s, TIME)}


class Recorded(Document):
    """A trajectory from a file: CSV with the header `time_s,x_m,y_m,z_m,qx,qy,qz,qw`, or TUM's text.

    Between its rows positions lie on straight lines and orientations on the shortest turn (`straight`), or
    both on cubic splines (`smooth`). Its times are the scene's, `delay` later; with `start` its first row is
    at that time, whenever it was recorded.
    """

    example: ClassVar[str] = "{type: recorded, file: path.tum}"

    type: Literal["recorded"]
    file: str
    between: Between = "straight"
    delay_s: Time = 0.0
    start_s: Time | None = None

    @model_validator(mode="after")
    def _in_reach(self) -> Self:
        first_s, *_ = scene_times_s(trajectory_of(self.file)[:, 0], self.delay_s, self.start_s)
        if self.start_s is not None and self.delay_s:
            raise ValueError("write either 'delay' or 'start', not both")
        if abs(first_s) > TIME.most:
            raise ValueError(
                f"its first row is at {first_s:g} s, beyond the {TIME.most:g} s that are taken: times since "
                "1970? Write such as 'start: 0 s', when in the scene it begins"
            )
        return self

    @field_validator("file")
    @classmethod
    def _find(cls, name: str, info: ValidationInfo) -> str:
        file = str(resolve_file(name, info))
        trajectory_of(file)
        return file


PathDocument = Annotated[
    Circle | Recorded, Field(discriminator="type"), typed(Circle.example, Circle, Recorded)
]


class Moving(Document):
    """What moves: through the waypoints of `motion`, `straight` or `smooth` between them; or along a `path`.

    They are straight where `between` is left out. Smooth is a cubic spline, twice continuously
    differentiable, through the positions, and one of the angular velocity through the orientations; it comes
    to rest at both ends and at each hold.
    """

    motion: tuple[Waypoint, ...] = ()
    between: Between | None = None
    path: PathDocument | None = None

    @property
    def moves(self) -> bool:
        """Whether a motion or a path says where it is."""
        return bool(self.motion) or self.path is not None

    @model_validator(mode="before")
    @classmethod
    def _read_speeds(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not isinstance(data.get("motion"), list | tuple):
            return data
        return {**data, "motion": _with_times(list(data["motion"]))}

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.motion and self.path is not None:
            raise ValueError("write either 'motion' or 'path', not both")
        for way in self.motion:
            if way.hold_s > 0.0 and way.time_s + way.hold_s <= way.time_s:
                raise ValueError(
                    f"motion: the hold of {way.hold_s:g} s is too short to count at {way.time_s:g} s; "
                    "lengthen it, or leave it out"
                )
        for earlier, later in itertools.pairwise(self.motion):
            if later.time_s <= earlier.time_s + earlier.hold_s:
                raise ValueError(
                    f"the times of 'motion' must increase: {later.time_s:g} s is not after "
                    f"{earlier.time_s:g} s and its hold of {earlier.hold_s:g} s; put the waypoints in order"
                )
        return self


def _with_times(ways: list[Any]) -> list[Any]:
    """Return waypoints as written, those with a speed with the time that it makes."""
    for index, way in enumerate(ways):
        if not isinstance(way, Mapping) or way.get("speed") is None:
            continue
        Waypoint.check_keys(way)
        place = f"motion.{index}.speed"
        before = ways[index - 1] if index else None
        if way.get("time") is not None:
            raise ValueError(f"{place}: write either 'time' or 'speed', not both")
        if not isinstance(before, Mapping):
            raise ValueError(f"{place}: the first waypoint has none before it; give it a time, such as '0 s'")
        try:
            left_s = parse_quantity(before.get("time"), TIME)
            left_s += parse_quantity("0 s" if before.get("hold") is None else before["hold"], TIME)
            ends = [parse_vector(one.get("position"), LENGTH, 3) for one in (before, way)]
        except ValueError as error:
            raise ValueError(f"{place}: of the waypoint before it, or its own: {error}") from None
        arrival_s = left_s + math.dist(*ends) / _speed(way["speed"], place)
        others = {key: value for key, value in way.items() if key != "speed"}
        ways[index] = {"time": format_quantity(arrival_s, TIME), **others}
    return ways


def _speed(text: Any, place: str) -> float:
    try:
        speed_m_per_s = parse_quantity(text, SPEED)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None
    if speed_m_per_s <= 0.0:
        raise ValueError(f"{place}: {shown(text)} is not greater than 0; write such as '0.1 m/s'")
    return speed_m_per_s
