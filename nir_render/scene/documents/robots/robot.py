"""The model of a robot, and of a group of robots that are scattered over a room."""

from typing import Annotated, ClassVar, Self

from pydantic import AfterValidator, Field, model_validator

from nir_render.scene.documents.base import Document, Length, NotNegative, Orientation, Position, Size3
from nir_render.scene.documents.camera import Rig
from nir_render.scene.documents.times.motion import Moving

_MOST_SCATTERED = 1000
_LARGEST_SEED = 2**63 - 1


class Robot(Moving):
    """A robot: its rig, and either a fixed pose or a motion: through waypoints, or along a path."""

    rig: Rig
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()

    @model_validator(mode="after")
    def _one_way_to_move(self) -> Self:
        told = self.model_fields_set & {"position_m", "orientation"}
        if self.motion and told:
            raise ValueError("write either 'position' and 'orientation', or 'motion', not both")
        if self.path is not None and told:
            raise ValueError("write either 'position' and 'orientation', or 'path', not both")
        return self


def _no_negative_extents(size_m: tuple[float, float, float]) -> tuple[float, float, float]:
    if min(size_m) < 0.0:
        raise ValueError("an extent is negative; 0 is allowed for the height alone: all then stand at one")
    return size_m


class Scatter(Document):
    """Robots of one rig at random free places of a box of air, which stand still: `NAME_1` to `NAME_count`.

    No two robots overlap, nor a robot and a shape, and each is within the box, whose extents are `size`. Of a
    height of 0 all stand at that of `center`, with their origins. `clearance` is what is left free about each
    to all sides, at its own heights. Without `orientation` each heads anywhere. All is keyed by `seed`, which
    is not the scene's: robot 7 is at the same place whatever the count.
    """

    example: ClassVar[str] = '{rig: infra_swarm, count: 12, center: "[0, 0, 0] m", size: "[8, 6, 0] m"}'

    rig: Rig
    count: Annotated[int, Field(ge=0, le=_MOST_SCATTERED)]
    center_m: Position
    size_m: Annotated[Size3, AfterValidator(_no_negative_extents)]
    clearance_m: Annotated[Length, NotNegative] = 0.0
    orientation: Orientation | None = None
    seed: Annotated[int, Field(ge=0, le=_LARGEST_SEED)] = 1

    def names(self, group: str) -> list[str]:
        """Return how its robots are called, where it is called `group` itself."""
        return [f"{group}_{number}" for number in range(1, self.count + 1)]
