"""Where scattered robots stand: drawn evenly from what their box leaves free, one after the other."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.randomness import generator
from nir_render.scene.bodies import carried, contains
from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.document import SceneDocument
from nir_render.scene.documents.robots.robot import Robot, Scatter
from nir_render.scene.documents.shapes import Box, Cylinder, ShapeDocument, Sphere
from nir_render.scene.motion import frame_pose, robot_positions_m
from nir_render.scene.pose import rotation_of
from nir_render.scene.scatter.outline import Hull, Outline, hull_of, outlines

Array = NDArray[np.float64]

_TRIES = (16, 84, 900)
"""How many places are tried for a robot: few at first, as the first free one is taken."""
_SLACK_M = 1e-9  # what float64 rounds
_DIGITS = 6  # of places in metres, of headings in radians


@dataclass(frozen=True, eq=False)
class _Standing:
    """What is taken already: upright cylinders, axes (n, 2), radii, lowest and highest heights (n,)."""

    axes_m: list[Array] = field(default_factory=list)
    hulls_m: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, place_m: Array, hull: Hull) -> None:
        """Add a robot at a place, shape (3,)."""
        self.axes_m.append(place_m[:2])
        self.hulls_m.append((hull.radius_m, place_m[2] + hull.low_m, place_m[2] + hull.high_m))

    def leaves_free(self, places_m: Array, hull: Hull, clearance_m: float) -> NDArray[np.bool_]:
        """Tell which places, shape (m, 3), are free of them, shape (m,)."""
        if not self.axes_m:
            return np.ones(len(places_m), dtype=bool)
        radii_m, lows_m, highs_m = np.array(self.hulls_m).T
        off_m = np.linalg.norm(places_m[:, None, :2] - np.array(self.axes_m), axis=-1)
        apart = off_m >= radii_m + hull.radius_m + clearance_m
        heights_m = places_m[:, 2:]
        apart |= (heights_m + hull.low_m >= highs_m) | (heights_m + hull.high_m <= lows_m)
        return np.asarray(apart.all(axis=1))


def scattered(document: SceneDocument) -> SceneDocument:
    """Return a document whose scattered robots stand at their places.

    Written robots and shapes that move are kept clear of wherever they are as a frame begins.

    Raises
    ------
    InputError
        A box is too small for one robot, or has no free place for all: how many found one.
    """
    if not document.scatter:
        return document
    times_s = np.array(document.frame_times_s())
    shapes = [shape for one in document.shapes.values() for shape in _wherever(one, times_s)]
    drawn = {name for group, scatter in document.scatter.items() for name in scatter.names(group)}
    standing = _Standing()
    for name, robot in document.robots.items():
        if name not in drawn:
            _add(standing, robot, times_s)
    robots = dict(document.robots)
    for group, scatter in document.scatter.items():
        robots |= _placed(group, scatter, shapes, standing)
    return document.model_copy(update={"robots": robots})


def _wherever(shape: ShapeDocument, times_s: Array) -> Iterator[ShapeDocument]:
    """Yield a shape where it is at each time; once where it stands still."""
    if not shape.moves:
        yield shape
        return
    for time_s in times_s:
        yield carried(shape, frame_pose(shape, float(time_s)))


def _add(standing: _Standing, robot: Robot, times_s: Array) -> None:
    """Add a robot wherever it is; one that moves as a ball, however it is turned then."""
    if not robot.moves:
        standing.add(np.array(robot.position_m), hull_of(robot.rig, rotation_of(robot.orientation)))
        return
    own = hull_of(robot.rig, np.eye(3))
    reach_m = math.hypot(own.radius_m, max(own.high_m, -own.low_m))
    for place_m in robot_positions_m(robot, times_s):
        standing.add(place_m, Hull(reach_m, -reach_m, reach_m))


def _placed(
    group: str, scatter: Scatter, shapes: Sequence[ShapeDocument], standing: _Standing
) -> dict[str, Robot]:
    """Return the robots of a group at their places, and add them to what stands."""
    hull = hull_of(scatter.rig, rotation_of(scatter.orientation or Orientation()))
    least_m, most_m = _bounds_m(group, scatter, hull)
    ways = _Ways(shapes, hull, scatter.clearance_m, least_m, most_m)
    robots: dict[str, Robot] = {}
    for number, name in enumerate(scatter.names(group), 1):
        rng = generator(scatter.seed, f"scatter/{group}", "", number)
        for tries in _TRIES:
            drawn = rng.random((tries, 4))
            places_m = np.round(least_m + drawn[:, :3] * (most_m - least_m), _DIGITS)
            free = np.flatnonzero(standing.leaves_free(places_m, hull, scatter.clearance_m))
            free = free[ways.leave_free(places_m[free])]
            if len(free):
                break
        else:
            raise InputError(
                f"scatter.{group}: {len(robots)} of {scatter.count} robots have found a free place, {name} "
                f"has not in {sum(_TRIES)} tries; lower 'count' or 'clearance', or make 'size' larger"
            )
        place_m = places_m[free[0]]
        yaw_rad = round(2.0 * math.pi * float(drawn[free[0], 3]) - math.pi, _DIGITS)
        standing.add(place_m, hull)
        robots[name] = Robot.model_construct(
            rig=scatter.rig,
            position_m=tuple(place_m.tolist()),
            orientation=scatter.orientation or Orientation.model_construct(yaw_rad=yaw_rad),
        )
    return robots


def _bounds_m(group: str, scatter: Scatter, hull: Hull) -> tuple[Array, Array]:
    """Return the least and the greatest place of an origin whose robot is within the box, shape (3,) each."""
    center_m, half_m = np.array(scatter.center_m), 0.5 * np.array(scatter.size_m)
    inset_m = np.array([hull.radius_m, hull.radius_m, 0.0])
    least_m, most_m = center_m - half_m + inset_m, center_m + half_m - inset_m
    if scatter.size_m[2] > 0.0:
        least_m[2] -= hull.low_m
        most_m[2] -= hull.high_m
    if (least_m > most_m + _SLACK_M).any():
        wide_m, high_m = 2.0 * hull.radius_m, hull.high_m - hull.low_m
        raise InputError(
            f"scatter.{group}.size: a robot is {wide_m:.3g} m wide and {high_m:.3g} m high, with all that it "
            "carries; make the box larger (a height of 0 has all stand at one)"
        )
    return least_m, most_m


class _Ways:
    """Shapes in the way of a group's robots; outlines are kept for the height that was asked for last."""

    def __init__(
        self, shapes: Sequence[ShapeDocument], hull: Hull, clearance_m: float, least_m: Array, most_m: Array
    ) -> None:
        self._shapes, self._hull = shapes, hull
        self._free_m = hull.radius_m + clearance_m
        self._near_m = np.array([least_m[:2] - self._free_m, most_m[:2] + self._free_m])
        self._height_m, self._outlines = math.nan, list[Outline]()

    def leave_free(self, places_m: Array) -> NDArray[np.bool_]:
        """Tell at which places of a robot's origin, shape (m, 3), no shape is in its way, shape (m,)."""
        free = np.ones(len(places_m), dtype=bool)
        for height_m in np.unique(places_m[:, 2]):
            level = np.flatnonzero(places_m[:, 2] == height_m)
            for one in self._outlines_at(float(height_m)):
                free[level] &= one.distances_m(places_m[level, :2]) >= self._free_m
        middles_m = places_m + np.array([0.0, 0.0, 0.5 * (self._hull.low_m + self._hull.high_m)])
        for shape in self._shapes:
            if isinstance(shape, Box | Cylinder | Sphere):
                free &= ~contains(shape, middles_m)
        return free

    def _outlines_at(self, height_m: float) -> list[Outline]:
        if height_m != self._height_m:
            low_m, high_m = height_m + self._hull.low_m, height_m + self._hull.high_m
            self._height_m = height_m
            self._outlines = [
                one for shape in self._shapes for one in outlines(shape, low_m, high_m, self._near_m)
            ]
        return self._outlines
