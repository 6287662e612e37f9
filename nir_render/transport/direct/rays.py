"""What each ray of a disc brings: whether it arrives, and how much of its light is left on the way."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.geometry import sunflower
from nir_render.scene.documents.fog import Fog
from nir_render.scene.pose import Pose
from nir_render.transport.backend.variant import blocked
from nir_render.transport.direct.ways import SmallLights, Ways
from nir_render.transport.world.facets import PANE, Facets, pane_transmittance, reflectance
from nir_render.transport.world.fog_depth import optical_depth
from nir_render.transport.world.pattern import relative_intensity

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# So far above a mirror, times its distance from the origin in metres where that is more than 1, do rays end
# and start: Mitsuba computes in float32.
_LIFT_M = 1e-5


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All that rays meet: Mitsuba's scene without panes, its sources' spheres, the smooth facets, the fog."""

    bodies: Any
    spheres: list[Any]
    lights: SmallLights
    facets: Facets
    fog: Fog | None


@dataclass(frozen=True, eq=False)
class _Leg:
    """A straight part of the way of rays: start and unit direction, shape (n, 3), and length, shape (n,).

    Light goes against the direction: legs lead from the lens to the source.
    """

    start_m: Array
    direction: Array
    length_m: Array


def trace_straight(ways: Ways, around: Surroundings, pose: Pose, rays: int) -> tuple[Mask, Array]:
    """Return which rays of each disc arrive, and the share of their light that they bring.

    Parameters
    ----------
    pose
        The camera's axes in the world.
    rays
        For each disc: those of `geometry.sunflower` in camera axes.

    Returns
    -------
    Shape (ways, rays) each. The share is 0 where a ray does not arrive; 1 is a ray that comes through clear
    air from a source that shines the same in all directions.
    """
    row, direction, surface_m = _fans(ways, around.lights, pose, rays)
    light = ways.light[row]
    start_m = np.broadcast_to(pose.position_m, direction.shape)
    seen = ~_hidden(around, _Leg(start_m, direction, ways.distance_m[row]), light)
    share = _left(around, _Leg(start_m, direction, surface_m), None)
    share *= seen * _intensity(around.lights, light, -direction)
    return seen.reshape(-1, rays), share.reshape(-1, rays)


def trace_ghosts(ways: Ways, around: Surroundings, pose: Pose, rays: int) -> tuple[Mask, Array]:
    """Return the same of discs that are mirrored by a facet: a ray arrives if both its legs are free."""
    row, direction, surface_m = _fans(ways, around.lights, pose, rays)
    facet, start_m = ways.facet[row], np.broadcast_to(pose.position_m, direction.shape)
    mirror_m, within = crossing(around.facets, facet, start_m, direction)
    seen = within & (mirror_m > 0.0) & (mirror_m < surface_m)
    share = np.zeros(len(row))
    rest = np.flatnonzero(seen)
    row, direction, facet, start_m = row[rest], direction[rest], facet[rest], start_m[rest]
    light, mirror_m = ways.light[row], mirror_m[rest]
    normal = around.facets.normal[facet]
    slope = (direction * normal).sum(axis=1)
    hit_m = start_m + mirror_m[:, None] * direction
    turned = direction - 2.0 * slope[:, None] * normal
    lift_m = _LIFT_M * np.maximum(np.abs(hit_m).max(axis=1, initial=0.0), 1.0)
    short_m = np.maximum(mirror_m - lift_m / np.abs(slope), 0.0)
    lifted_m = hit_m - (np.sign(slope) * lift_m)[:, None] * normal
    free = ~_hidden(around, _Leg(start_m, direction, short_m), None)
    free &= ~_hidden(around, _Leg(lifted_m, turned, ways.distance_m[row] - mirror_m), light)
    seen[rest] = free
    brought = _left(around, _Leg(start_m, direction, mirror_m), facet)
    brought *= _left(around, _Leg(hit_m, turned, surface_m[rest] - mirror_m), facet)
    brought *= reflectance(around.facets, facet, np.abs(slope))
    share[rest] = free * brought * _intensity(around.lights, light, -turned)
    return seen.reshape(-1, rays), share.reshape(-1, rays)


def crossing(surfaces: Facets, facet: Any, start_m: Array, direction: Array) -> tuple[Array, Mask]:
    """Return how far along rays the planes of facets are, and whether the rays cross the facets there.

    `facet` broadcasts against the rays, shape (n, 3) each; the distance is in metres, negative or infinite
    where a ray leads away from the plane.
    """
    normal = surfaces.normal[facet]
    height_m = ((surfaces.center_m[facet] - start_m) * normal).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along_m = height_m / (direction * normal).sum(axis=-1)
    along_m = np.where(np.isfinite(along_m), along_m, np.inf)
    place_m = start_m + np.where(np.isfinite(along_m), along_m, 0.0)[:, None] * direction
    within = np.isfinite(along_m)
    for half_m in (surfaces.half_u_m[facet], surfaces.half_v_m[facet]):
        offset_m2 = ((place_m - surfaces.center_m[facet]) * half_m).sum(axis=-1)
        within &= np.abs(offset_m2) <= (half_m**2).sum(axis=-1)
    return along_m, within


def _fans(ways: Ways, lights: SmallLights, pose: Pose, rays: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Return each ray's way, its direction in the world, and its length up to the source's surface."""
    discs = zip(ways.direction, ways.angular_radius_rad, strict=True)
    fans = [sunflower(axis, float(angle_rad), rays) for axis, angle_rad in discs]
    direction = np.array(fans, dtype=np.float64).reshape(-1, 3)
    row = np.repeat(np.arange(len(ways.light)), rays)
    near = np.isfinite(ways.distance_m[row])
    distance_m = np.where(near, ways.distance_m[row], 0.0)
    middle_m = distance_m * (direction * ways.direction[row]).sum(axis=1)
    half_chord2_m2 = lights.radius_m[ways.light[row]] ** 2 - (distance_m**2 - middle_m**2)
    surface_m = middle_m - np.sqrt(np.maximum(half_chord2_m2, 0.0))
    return row, direction @ pose.rotation.T, np.where(near, surface_m, np.inf)


def _hidden(around: Surroundings, leg: _Leg, light: NDArray[np.int64] | None) -> Mask:
    """Tell on which legs a body stands, the light's own left out: these legs end beside its centre."""
    own = None if light is None else np.where(around.lights.endless[light], -1, light)
    return blocked(around.bodies, leg.start_m, leg.direction, leg.length_m, around.spheres, own)


def _left(around: Surroundings, leg: _Leg, mirror: NDArray[np.int64] | None) -> Array:
    """Return the share of light that fog and panes leave on legs; `mirror` is the facet at an end of each."""
    share = np.ones(len(leg.length_m))
    if around.fog is not None and around.fog.extinction_per_m > 0.0:
        share *= np.exp(-optical_depth(around.fog, leg.start_m, leg.direction, leg.length_m))
    for pane in np.flatnonzero(around.facets.kind == PANE):
        along_m, within = crossing(around.facets, pane, leg.start_m, leg.direction)
        crossed = within & (along_m > 0.0) & (along_m < leg.length_m)
        if mirror is not None:
            crossed &= mirror != pane
        cosine = np.abs(leg.direction[crossed] @ around.facets.normal[pane])
        share[crossed] *= pane_transmittance(around.facets, pane, cosine)
    return share


def _intensity(lights: SmallLights, light: NDArray[np.int64], leaving: Array) -> Array:
    """Return 4π I/Φ of lights in the world's directions in which their light leaves."""
    intensity = np.ones(len(light))
    for index, pattern in enumerate(lights.pattern):
        if pattern is not None:
            own = light == index
            intensity[own] = relative_intensity(pattern, leaving[own] @ lights.rotation[index])
    return intensity
