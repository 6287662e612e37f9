"""Motion within an exposure: the flare of a source that moves is drawn out along its path.

Over an exposure the pose of each robot goes on at the velocity that it has in the middle: straight on, and
turning evenly. So the place of a source in the camera's axes is known at each instant, and what it brings is
an integral over the exposure of images of known place and size, weighted with the drive: by Gauss's rule
where the drive does not change, else a sum over short stretches of time, with the mean of the drive in each
exact, and the flare where it is at the mean time of that light.
What is hidden, and what a mirror or the fog leaves, is as at mid-exposure. The flare of a ghost moves as its
source's image does in a mirror that stands still.

With a rolling shutter each row has its own exposure, and the same geometry in the middle of it: rows of a
frame differ in their drive, not in place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.beams import Beam
from nir_render.camera.optics.psf import Window, place_of
from nir_render.camera.timing.drive import mean_level
from nir_render.camera.timing.shutter import on_fractions, row_profile, row_starts_s
from nir_render.geometry import legendre, sunflower
from nir_render.light.light import DirectTable
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.times.drives import Drive
from nir_render.scene.motion import Velocity
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import Snapshot

Array = NDArray[np.float64]

STILL_PX = 0.01
"""Flares whose path in an exposure is shorter are drawn in one place."""

_LEAST_STRETCHES, _MOST_STRETCHES = 8, 256
_STRETCH_PX = 0.2
_PARTS = 64
_NODE_PX, _MOST_NODES = 0.75, 64


@dataclass(frozen=True, eq=False)
class Path:
    """Where the disc of one row of the direct table is at times from mid-exposure on.

    `direction` are unit vectors in camera axes, shape (n, 3), `distance_m` is shape (n,).
    """

    direction: Array
    distance_m: Array


def may_move(snapshot: Snapshot, camera: str, group: str) -> bool:
    """Tell whether a source may move as a camera, `robot.camera`, sees it; the sun counts as still."""
    if group not in snapshot.sources:
        return False
    return _velocity(snapshot, camera) is not None or _velocity(snapshot, group) is not None


def path_of(
    snapshot: Snapshot, camera: str, group: str, table: DirectTable, row: int, offsets_s: Array
) -> Path:
    """Return where a row's disc is at times, shape (n,), from that of the snapshot on."""
    eye = snapshot.robots[camera.partition(".")[0]]
    here = snapshot.camera(camera).pose
    source_m = snapshot.sources[group].pose.position_m
    shown_m = here.rotation @ (table.distance_m[row] * table.direction[row]) + here.position_m
    velocity = _velocity(snapshot, group)
    # A beacon is no robot's, and rests.
    at = eye.pose if velocity is None else snapshot.robots[group.partition(".")[0]].pose
    there_m = _carried(source_m, at, velocity, offsets_s)
    if table.facet[row] >= 0:
        # A mirror stands halfway between a source and its image, across the line that joins them.
        apart_m = source_m - shown_m
        normal = apart_m / max(float(np.linalg.norm(apart_m)), 1e-300)
        height_m = (there_m - 0.5 * (source_m + shown_m)) @ normal
        there_m = there_m - 2.0 * height_m[:, None] * normal
    else:
        there_m = there_m + (shown_m - source_m)  # the table says where the flare is in the middle
    lens_m = _carried(here.position_m, eye.pose, eye.velocity, offsets_s)
    offset_m = np.einsum("nji,nj->ni", _turns(eye.velocity, offsets_s), there_m - lens_m)
    distance_m = np.linalg.norm(offset_m, axis=1)
    return Path((offset_m / distance_m[:, None]) @ here.rotation, distance_m)


def _velocity(snapshot: Snapshot, name: str) -> Velocity | None:
    """Return the velocity of the robot of a camera or source; None of what stands."""
    robot = snapshot.robots.get(name.partition(".")[0])
    return None if robot is None else robot.velocity


def moved_beam(beam: Beam, direction: Array, distance_m: float, seen: NDArray[np.bool_] | None) -> Beam:
    """Return a beam whose disc has come to another place: its light goes by 1/distance².

    `seen` tells which rays of `sunflower` reach the disc where a part of it is hidden, else it is None.
    """
    nearer = beam.distance_m / distance_m
    angle_rad = math.asin(min(nearer * math.sin(beam.angular_radius_rad), 1.0))
    return replace(
        beam,
        direction=direction,
        angular_radius_rad=angle_rad,
        irradiance_w_per_m2=beam.irradiance_w_per_m2 * nearer**2,
        seen=None if seen is None else sunflower(direction, angle_rad, len(seen))[seen],
        distance_m=distance_m,
    )


def drawn_out(windows: Sequence[Window], weights_s: Array) -> Window:
    """Return the sum of windows, each row of pixels weighted with what it collects of each.

    Parameters
    ----------
    windows
        Electrons per second in each stretch of time.
    weights_s
        How long each row is lit in each stretch, shape (stretches, rows). What of a total lies elsewhere
        counts by the mean of its window's rows, or of all.
    """
    places = [place_of(window) for window in windows if window.values.size]
    if not places:
        means_s = weights_s.mean(axis=1)
        total = sum(window.total * mean_s for window, mean_s in zip(windows, means_s, strict=True))
        return Window(np.empty((0, 0)), 0, 0, float(total))
    top, left = (min(place[axis].start for place in places) for axis in (0, 1))
    bottom, right = (max(place[axis].stop for place in places) for axis in (0, 1))
    values, total = np.zeros((bottom - top, right - left)), 0.0
    for window, weight_s in zip(windows, weights_s, strict=True):
        rows, columns = place_of(window)
        lit = window.values * weight_s[rows, None]
        values[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] += lit
        own_s = weight_s[rows] if window.values.size else weight_s
        total += float(lit.sum()) + (window.total - float(window.values.sum())) * float(own_s.mean())
    return Window(values, top, left, total)


@dataclass(frozen=True, eq=False)
class Instants:
    """Times of an exposure that stand for all of it: from its middle on, shape (n,), and their weights.

    A weight is how long each row of pixels is lit there, in seconds, shape (n, rows).
    """

    offset_s: Array
    weight_s: Array


def instants(
    camera: Camera, drive: Drive, time_s: float, exposure_s: float, length_px: float, row: int
) -> Instants:
    """Return the instants of an exposure in which a flare goes so far, row 0 beginning at a time.

    Where the drive does not change in it they are those of Gauss and Legendre, enough for a path over a point
    spread of 0.5 px and more; else one in each of even stretches, with the exact mean of the drive there: the
    mean time of the light that a row of pixels, the flare's, collects in it. Its middle would be an eighth of
    the stretch off where the drive changes in it. What parasitic light adds while a row waits to be read
    counts to the last one.
    """
    count = min(max(_LEAST_STRETCHES, math.ceil(length_px / _STRETCH_PX)), _MOST_STRETCHES)
    stretch_s = exposure_s / count
    starts_s = row_starts_s(camera, time_s) + stretch_s * np.arange(count)[:, None]
    levels = mean_level(drive, starts_s, stretch_s)
    if (levels == levels[0]).all():
        nodes, weights = legendre(min(2 + math.ceil(length_px / _NODE_PX), _MOST_NODES))
        offset_s, weight_s = 0.5 * exposure_s * nodes, 0.5 * exposure_s * weights[:, None] * levels[0]
    else:
        middles_s = exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        offset_s = middles_s + _off_middle_s(drive, starts_s[:, row], stretch_s)
        weight_s = stretch_s * levels
    waiting = row_profile(camera, drive, time_s, exposure_s) - on_fractions(camera, drive, time_s, exposure_s)
    weight_s[-1] += exposure_s * waiting
    return Instants(offset_s, weight_s)


def _off_middle_s(drive: Drive, starts_s: Array, stretch_s: float) -> Array:
    """Return how long after its middle the mean time of a stretch's light is, shape (n,); 0 in the dark."""
    part_s = stretch_s / _PARTS
    parts_s = part_s * (np.arange(_PARTS) - 0.5 * (_PARTS - 1))
    levels = mean_level(drive, starts_s[:, None] + part_s * np.arange(_PARTS), part_s)
    lit = levels.sum(axis=1)
    return np.asarray(np.divide(levels @ parts_s, lit, out=np.zeros_like(lit), where=lit > 0.0))


def _carried(point_m: Array, pose: Pose, velocity: Velocity | None, offsets_s: Array) -> Array:
    """Return where a point that a robot carries is at times from now on, shape (n, 3)."""
    if velocity is None:
        return np.broadcast_to(point_m, (len(offsets_s), 3))
    arm_m = point_m - pose.position_m
    origin_m = pose.position_m + offsets_s[:, None] * velocity.linear_m_per_s
    return np.asarray(origin_m + _turns(velocity, offsets_s) @ arm_m)


def _turns(velocity: Velocity | None, offsets_s: Array) -> Array:
    """Return by what rotation something has turned at times from now on, shape (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    if velocity is None:
        return np.broadcast_to(np.eye(3), (len(offsets_s), 3, 3))
    return np.asarray(Rotation.from_rotvec(offsets_s[:, None] * velocity.angular_rad_per_s).as_matrix())
