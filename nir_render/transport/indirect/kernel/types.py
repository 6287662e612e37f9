"""What a program for Dr.Jit handles: arrays of one value for each lane, and the state of a lane's path.

The types of these arrays depend on Mitsuba's variant, and no checker knows them: all are `Any`. Their names
say what a function takes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Float = Any
UInt = Any
Int = Any
Mask = Any
Vector = Any  # a unit direction, or an offset in metres; tables hold their vectors as flat Float
Point = Any  # in metres
Interaction = Any  # where rays meet surfaces: mi.SurfaceInteraction3f
MitsubaScene = Any
Ray = Any  # mi.Ray3f

Random = Callable[[Any], Float]  # a number in [0, 1) for a path's vertex, by what it is for (see `draws`)
Shares = tuple[Float, ...]  # what each node keeps of a path's light (see `nodes`); of one node alone none
# Adds radiance per unit of a light's emission, the nodes' shares of it, to the result; the last is how often
# the light was turned on its way (`tables.TURN`, `tables.TURN_IN_FOG`), None where that is not asked.
AddLight = Callable[[Float, Shares, UInt, Mask, UInt | None], None]


@dataclass
class PathState:
    """Where a lane stands."""

    sample: UInt
    depth: UInt
    origin: Point
    direction: Vector
    weight: Float
    shares: Shares
    left: Float  # what surfaces and fog have left of a path's light
    place: Point  # the last vertex that scatters evenly
    cell: UInt
    density: Float  # with which a surface there draws its direction; in fog `TURNED` of the phase function
    scattered: Mask  # whether there is such a vertex
    turns: UInt | None  # how often the path was turned, by what; None: not counted
    way: Int
    inside: Mask  # a transparent solid
    in_fog: Mask | None  # whether that vertex is fog's; None in clear air
    tier: UInt | None  # of lights that the path serves; None where it serves all
    dealt: Float | None  # one over the share of samples that serve it
    active: Mask
