"""The light of small sources, seen straight or as a ghost: closed form, only the visibility is traced.

A sphere of uniform radiance L = Φ / (4π² r²) fills the cap of half angle α, sin α = r/d, and its directions
bring ∫ L cos ψ dΩ = π L sin² α: so E = π L (r/d)² = Φ / (4π d²) across its direction, at every distance,
resolved or not (docs/physics.md, From source to pixel). A row of the table covers the disc with rays of equal
solid angle and takes the mean of what each brings: nothing where it is hidden, else the emission pattern in
the direction of leaving, Beer–Lambert's exp(−σ_t ℓ) over its way through fog up to the source's surface, what
panes pass, and, for a ghost, what the mirror reflects. Where an edge cuts the disc the share is right to
about 1.5 / rays^(3/4), 0.8 % for 1024 rays; a fully hidden or free disc is exact.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.light.light import DirectTable
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.direct.rays import Surroundings, trace_ghosts, trace_straight
from nir_render.transport.direct.ways import Ways, ghosts, small_lights, source_around, straight
from nir_render.transport.world import mitsuba_scene
from nir_render.transport.world.facets import facets, no_facets

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RAYS_AT_ONCE = 2**19


def direct_table(snapshot: Snapshot, pose: Pose, *, specular: bool, bodies: Any = None) -> DirectTable:
    """Return the rows of all small sources in front of the lens, and of their ghosts.

    Parameters
    ----------
    pose
        The camera's axes in the world.
    specular
        Whether ghosts and what is seen through panes belong to the table. Without, they are left to the
        indirect light, and panes hide what is behind them.
    bodies
        What `bodies_of` built of this world, for several cameras at once; built here where it is left out.

    Raises
    ------
    InputError
        The camera is inside a source.
    """
    rays = snapshot.render.visibility_rays
    bodies = bodies_of(snapshot, specular=specular) if bodies is None else bodies
    lights, surfaces = small_lights(snapshot), facets(snapshot) if specular else no_facets()
    around = Surroundings(bodies, mitsuba_scene.source_spheres(bodies), lights, surfaces, snapshot.fog)
    inside = source_around(lights, pose.position_m)
    if inside is not None:
        raise InputError(
            f"{snapshot.origin}: the camera is inside the source {inside} at {snapshot.time_s:g} s; "
            "move one of them"
        )
    direct = straight(lights, pose)
    mirrored = ghosts(lights, surfaces, pose)
    traced = [_in_parts(trace_straight, direct, around, pose, rays)]
    traced.append(_in_parts(trace_ghosts, mirrored, around, pose, rays))
    shown = np.asarray(traced[1][0].any(axis=1), dtype=bool)
    ways = [direct, mirrored[shown]]
    seen = np.concatenate([traced[0][0], traced[1][0][shown]])
    share = np.concatenate([traced[0][1], traced[1][1][shown]])
    distance_m = np.concatenate([part.distance_m for part in ways])
    per_unit = np.where(np.isfinite(distance_m), 1.0 / (4.0 * np.pi * distance_m**2), 1.0)
    return DirectTable(
        group=lights.group[np.concatenate([part.light for part in ways])],
        facet=np.concatenate([part.facet for part in ways]),
        direction=np.concatenate([part.direction for part in ways]),
        distance_m=distance_m,
        angular_radius_rad=np.concatenate([part.angular_radius_rad for part in ways]),
        seen=seen,
        visible_fraction=seen.mean(axis=1),
        irradiance_per_w=(per_unit * share.mean(axis=1))[:, None],
        visibility_rays=rays,
    )


def bodies_of(snapshot: Snapshot, *, specular: bool) -> Any:
    """Return what hides small sources from each other's view: the same for every camera."""
    return mitsuba_scene.build(snapshot, panes=not specular)


def _in_parts(
    trace: Callable[[Ways, Surroundings, Pose, int], tuple[Mask, Array]],
    ways: Ways,
    around: Surroundings,
    pose: Pose,
    rays: int,
) -> tuple[Mask, Array]:
    """Trace so many ways at once as memory holds."""
    step = max(_RAYS_AT_ONCE // rays, 1)
    parts = [
        trace(ways[begin : begin + step], around, pose, rays) for begin in range(0, len(ways.light), step)
    ]
    none = np.empty((0, rays))
    return (
        np.concatenate([none.astype(bool), *(seen for seen, _ in parts)]),
        np.concatenate([none, *(share for _, share in parts)]),
    )
