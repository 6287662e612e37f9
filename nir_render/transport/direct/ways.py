"""The ways of small sources into the lens: straight, and by way of each flat smooth surface.

A way ends in a disc: that of the source, or that of its mirrored image, which stands behind the surface.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.world import mitsuba_scene
from nir_render.transport.world.facets import MIRROR, Facets
from nir_render.transport.world.pattern import Pattern, pattern_of

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SmallLights:
    """The robots' sources, then the sun.

    Attributes
    ----------
    group
        Light group, shape (n,).
    name
        Of the groups.
    center_m
        Centres in the world; of the sun, the unit vector towards it, shape (n, 3).
    radius_m
        Of the spheres; of the sun, the sine of its angular radius, shape (n,).
    endless
        Whether it is infinitely far, shape (n,).
    rotation
        From the source's own axes to the world's, shape (n, 3, 3).
    pattern
        Emission patterns, None where it shines the same in all directions.
    """

    group: NDArray[np.int64]
    name: tuple[str, ...]
    center_m: Array
    radius_m: Array
    endless: NDArray[np.bool_]
    rotation: Array
    pattern: tuple[Pattern | None, ...]


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways into one lens: which light, by which facet (−1: straight), and the disc that is seen.

    `direction` are unit vectors to the disc's centre in camera axes, shape (n, 3); `distance_m` is infinite
    for the sun; `angular_radius_rad` half the angle that the disc fills. All other columns have shape (n,).
    """

    light: NDArray[np.int64]
    facet: NDArray[np.int64]
    direction: Array
    distance_m: Array
    angular_radius_rad: Array

    def __getitem__(self, rows: NDArray[np.bool_] | slice) -> "Ways":
        """Return some of the ways."""
        return Ways(
            self.light[rows],
            self.facet[rows],
            self.direction[rows],
            self.distance_m[rows],
            self.angular_radius_rad[rows],
        )


def small_lights(snapshot: Snapshot) -> SmallLights:
    """Return the small sources of a scene at a time."""
    placed = snapshot.sources.values()
    names, groups = list(snapshot.sources), list(range(len(placed)))
    centers = [at.pose.position_m for at in placed]
    radii = [at.source.radius_m for at in placed]
    rotations = [at.pose.rotation for at in placed]
    patterns = [pattern_of(at.source) for at in placed]
    sun = snapshot.sun
    if sun is not None:
        names.append("sun")
        groups.append(snapshot.groups.index("sun"))
        centers.append(mitsuba_scene.sun_direction(sun))
        radii.append(float(np.sin(mitsuba_scene.SUN_RADIUS_RAD)))
        rotations.append(np.eye(3))
        patterns.append(None)
    return SmallLights(
        group=np.array(groups, dtype=np.int64),
        name=tuple(names),
        center_m=np.array(centers, dtype=np.float64).reshape(-1, 3),
        radius_m=np.array(radii, dtype=np.float64),
        endless=np.array([name == "sun" for name in names], dtype=bool),
        rotation=np.array(rotations, dtype=np.float64).reshape(-1, 3, 3),
        pattern=tuple(patterns),
    )


def source_around(lights: SmallLights, point_m: Array) -> str | None:
    """Return the name of a source that holds a point, or None."""
    distance_m = np.linalg.norm(lights.center_m - point_m, axis=1)
    inside = np.flatnonzero(~lights.endless & (distance_m <= lights.radius_m))
    return lights.name[inside[0]] if inside.size else None


def straight(lights: SmallLights, pose: Pose) -> Ways:
    """Return the ways of all lights of which a part is in front of the lens."""
    every = np.arange(len(lights.group))
    ways, _ = _ways(lights, every, np.full(len(every), -1), lights.center_m, pose)
    return ways[_in_front(ways)]


def ghosts(lights: SmallLights, surfaces: Facets, pose: Pose) -> Ways:
    """Return the ways by one facet that can be: both ends before it, its outline crossing the disc's cone."""
    facet, light = (grid.ravel() for grid in np.indices((len(surfaces.name), len(lights.group))))
    normal = surfaces.normal[facet]
    camera_m = ((pose.position_m - surfaces.center_m[facet]) * normal).sum(axis=1)
    from_m = np.where(lights.endless[light, None], 0.0, surfaces.center_m[facet])
    height_m = ((lights.center_m[light] - from_m) * normal).sum(axis=1)
    side = np.sign(camera_m)
    metal = surfaces.kind[facet] == MIRROR
    reflects = np.where(metal, surfaces.factor[facet] > 0.0, surfaces.index[facet] > 1.0)
    before = (side * height_m > -lights.radius_m[light]) & ((side > 0.0) | surfaces.two_sided[facet])
    chosen = np.flatnonzero(reflects & before & (side != 0.0))
    mirrored_m = lights.center_m[light] - 2.0 * height_m[:, None] * normal
    ways, distance_m = _ways(lights, light[chosen], facet[chosen], mirrored_m[chosen], pose)
    outside = lights.endless[ways.light] | (distance_m > lights.radius_m[ways.light])
    return ways[outside & _in_front(ways) & _may_cross(ways, surfaces, pose)]


def _ways(
    lights: SmallLights, light: NDArray[np.int64], facet: NDArray[np.int64], center_m: Array, pose: Pose
) -> tuple[Ways, Array]:
    """Return ways to discs about centres, and the lengths of the vectors to them."""
    endless = lights.endless[light]
    offset_m = center_m - np.where(endless[:, None], 0.0, pose.position_m)
    length_m = np.linalg.norm(offset_m, axis=1)
    safe_m = np.maximum(length_m, 1e-300)
    ways = Ways(
        light=light,
        facet=facet,
        direction=(offset_m / safe_m[:, None]) @ pose.rotation,
        distance_m=np.where(endless, np.inf, length_m),
        angular_radius_rad=np.arcsin(np.minimum(lights.radius_m[light] / safe_m, 1.0)),
    )
    return ways, length_m


def _in_front(ways: Ways) -> NDArray[np.bool_]:
    return np.asarray(ways.direction[:, 2] > -np.sin(ways.angular_radius_rad))


def _may_cross(ways: Ways, surfaces: Facets, pose: Pose) -> NDArray[np.bool_]:
    """Tell where the cone of a disc meets the ball about its facet."""
    offset_m = pose.to_local(surfaces.center_m[ways.facet])
    distance_m = np.linalg.norm(offset_m, axis=1)
    half2_m2 = surfaces.half_u_m[ways.facet] ** 2 + surfaces.half_v_m[ways.facet] ** 2
    radius_m = np.sqrt(half2_m2.sum(axis=1))
    within = distance_m <= radius_m
    safe_m = np.maximum(distance_m, 1e-300)
    cosine = (offset_m * ways.direction).sum(axis=1) / safe_m
    reach_rad = np.arcsin(np.minimum(radius_m / safe_m, 1.0)) + ways.angular_radius_rad
    return np.asarray(within | (np.arccos(np.clip(cosine, -1.0, 1.0)) <= reach_rad + 1e-9))
