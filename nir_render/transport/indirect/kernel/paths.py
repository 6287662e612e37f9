"""The walk of light paths on the device: one lane is one pixel of one batch, and walks its samples in turn.

Every lane goes on to its next sample as soon as a path ends, so none waits for its neighbours' longer paths.
A lane alone adds to its places in the result, in its samples' order: the same bits on any number of threads.

Each step is a stretch of a path, from a vertex to the next: fog on the way scatters light of one light
towards the vertex (a place drawn where the phase function and the inverse square put it, Kulla & Fajardo
2012); at the surface one light, in clear air one of each tier, is asked for (next-event estimation), and
the path goes on by the surface's own scattering, or by the fog's. Both ways to a light are weighted by the
power heuristic (Veach 1995).
"""

from collections.abc import Callable
from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import connect, draws, nodes
from nir_render.transport.indirect.kernel.aim import aim_density, light_chance, meets_sun
from nir_render.transport.indirect.kernel.begin import Film, camera_direction, deal_of
from nir_render.transport.indirect.kernel.draws import Draws, power_heuristic
from nir_render.transport.indirect.kernel.fog import fog_interval, versine
from nir_render.transport.indirect.kernel.fog_scatter import FogScattering, scatter_on_stretch
from nir_render.transport.indirect.kernel.leaving import NextDirection, leave_in_fog, leave_surface
from nir_render.transport.indirect.kernel.tables import TURN, TURN_IN_FOG, DeviceScene, Surfaces
from nir_render.transport.indirect.kernel.types import (
    AddLight,
    Float,
    Int,
    Interaction,
    Mask,
    PathState,
    Point,
    Random,
    Shares,
    UInt,
    Vector,
)
from nir_render.transport.world.emitters import RECTANGLE

# How a path came here since its last vertex that scatters evenly: straight on (through panes at most), by one
# facet (its number), or by smooth surfaces that no image stands for.
_STRAIGHT, _OTHERWISE = -1, -2
_FAR = 1e15
# Paths of which surfaces and fog have left less than this go on by chance, as if this were left. How a path
# was drawn does not count: what goes towards a light weighs little, and brings as much as any.
_DIM = 0.1
# Less than this, in 1/(m² sr), is nothing: near 1e-38 some threads round to zero and others do not.
_NOTHING = 1e-15
# And more is no light (the scenes of this repository bring 300 at most): its squares would leave float32.
_TOO_MUCH = 1e12

_Begin = tuple[Vector, UInt | None, Float | None]  # of a path: direction, tier, and one over its share


def walk(
    scene: DeviceScene, film: Film, pixel: UInt, draw: Draws, lanes: int, groups: int, max_depth: UInt
) -> Float:
    """Return the sum over a batch's samples of each pixel's radiance per unit of each group, by node.

    Parameters
    ----------
    pixel
        Number of each lane's pixel.
    lanes
        Batches × pixels; a batch's pixels lie together.
    max_depth
        Longest path, in stretches, as Mitsuba counts.

    Returns
    -------
    Flat array, (group, node, batch, pixel); where turns are counted the light of many comes behind the other.
    """
    lane = dr.arange(mi.UInt32, lanes)
    out = dr.zeros(mi.Float, (1 if scene.narrow is None else 2) * groups * scene.node_count * lanes)
    stride = dr.opaque(mi.UInt32, lanes)
    of_part = dr.opaque(mi.UInt32, groups)

    def add(value: Float, shares: Shares, row: UInt, active: Mask, turns: UInt | None) -> None:
        group = dr.gather(mi.UInt32, scene.lights.group, row, active)
        if turns is not None:
            group = dr.select((turns >= TURN_IN_FOG) & ((turns & 0xFFFF) > 1), group + of_part, group)
        if scene.nodes is not None:
            group = group * scene.nodes.count
        for node, part in enumerate([value * share for share in shares] or [value]):
            place = (group + node) * stride + lane
            some = active & (part > _NOTHING) & (part < _TOO_MUCH)
            dr.scatter_reduce(dr.ReduceOp.Add, out, part, place, some, dr.ReduceMode.NoConflicts)

    deal = deal_of(scene, film.origin, camera_direction(film, pixel, mi.Float(0.5), mi.Float(0.5)))

    def begin(sample: UInt) -> _Begin:
        along, down = (draw.pixel(sample, purpose) for purpose in (draws.PIXEL_U, draws.PIXEL_V))
        return camera_direction(film, pixel, along, down), *deal.tier_of(draw.tier(sample))

    def step(state: PathState) -> tuple[PathState]:
        return (_step(scene, state, draw, max_depth, add, begin, film.origin),)

    zero = dr.zeros(mi.UInt32, lanes)
    direction, tier, dealt = begin(zero)
    state = PathState(
        sample=mi.UInt32(zero),
        depth=mi.UInt32(zero),
        origin=film.origin + dr.zeros(mi.Point3f, lanes),
        direction=direction,
        weight=dr.ones(mi.Float, lanes),
        shares=nodes.whole(scene.nodes, lanes),
        left=dr.ones(mi.Float, lanes),
        place=dr.zeros(mi.Point3f, lanes),
        cell=mi.UInt32(zero),
        density=dr.zeros(mi.Float, lanes),
        scattered=dr.zeros(mi.Bool, lanes),
        turns=None if scene.narrow is None else dr.zeros(mi.UInt32, lanes),
        way=dr.full(mi.Int32, _STRAIGHT, lanes),
        inside=dr.zeros(mi.Bool, lanes),
        in_fog=None if scene.fog is None else dr.zeros(mi.Bool, lanes),
        tier=tier,
        dealt=dealt,
        active=dr.full(mi.Bool, True, lanes),
    )
    dr.while_loop((state,), lambda state: state.active, step)
    return out


def _step(
    scene: DeviceScene,
    state: PathState,
    draw: Draws,
    max_depth: UInt,
    add: AddLight,
    begin: Callable[[UInt], _Begin],
    camera: Point,
) -> PathState:
    """Return a lane's state after one more stretch of its path, its light added on the way."""

    def number(purpose: UInt) -> Float:
        return draw.vertex(state.sample, state.depth, purpose)

    si = _meet(scene, state)
    met = state.active & si.is_valid()
    passing, scattering = _pass_fog(scene, state, si, met, max_depth, number, add)
    light = _add_met_light(scene, state, si, met, passing, add)
    surface = met & (light < 0) & (state.depth + 1 < max_depth)
    sampled = connect.ask_lights(scene, state, si, passing, surface, max_depth, number, add)
    onward_path = _scatter(scene, state, si, sampled, surface, scattering, number)
    return _survive(state, onward_path, draw, number(draws.SURVIVAL), begin, camera, scene.narrow)


def _meet(scene: DeviceScene, state: PathState) -> Interaction:
    """Return where a path's next stretch meets a surface, Mitsuba's surface interaction."""
    return scene.bodies.ray_intersect(
        mi.Ray3f(state.origin, state.direction),
        ray_flags=mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame | (mi.RayFlags.UV if scene.pictures else 0),
        coherent=state.depth == 0,
        active=state.active,
    )


def _pass_fog(
    scene: DeviceScene,
    state: PathState,
    si: Interaction,
    met: Mask,
    max_depth: UInt,
    number: Random,
    add: AddLight,
) -> tuple[Float, FogScattering | None]:
    """Return a path's weight behind the fog on its stretch, and what the fog scatters; add that light.

    What lies at the end is asked for whether the path turns in fog or not, so that this choice brings no
    noise into it.
    """
    if scene.fog is None:
        return state.weight, None
    begin, end = fog_interval(scene.fog, state.origin, state.direction, dr.select(met, si.t, _FAR))
    in_it = state.active & ~state.inside & (end > begin)
    scattering = scatter_on_stretch(scene, state, begin, end, in_it, max_depth, number, add)
    return state.weight * (1.0 - scattering.lost), scattering


def _add_met_light(
    scene: DeviceScene, state: PathState, si: Interaction, met: Mask, weight: Float, add: AddLight
) -> Int:
    """Add the light that a path meets; return its number, below 0 where there is none."""
    light = dr.gather(mi.Int32, scene.surfaces.light_of_shape, _shape(si), met)
    shines = met & (light >= 0)
    if scene.lights.sun >= 0:
        leaves = state.active & ~si.is_valid() & meets_sun(scene.lights, state.direction)
        light = dr.select(leaves, scene.lights.sun, light)
        shines = shines | leaves
    if scene.lights.sky >= 0:  # behind the sun's disc too
        sky = dr.full(mi.UInt32, scene.lights.sky, dr.width(light))
        _add_unasked_light(scene, state, weight, sky, state.active & ~si.is_valid(), add)
    front = (dr.dot(state.direction, si.n) < 0.0) | ~met  # lamps shine from one side, suns from everywhere
    _add_unasked_light(scene, state, weight, mi.UInt32(light), shines & front, add)
    return light


def _add_unasked_light(
    scene: DeviceScene, state: PathState, weight: Float, light: UInt, active: Mask, add: AddLight
) -> None:
    """Add a light that the path has met, as far as asking for it has not brought it.

    Small lights that the camera sees straight, or by one facet, are left out: the direct table holds them.
    """
    lights = scene.lights
    if state.tier is not None:
        others = dr.gather(mi.UInt32, lights.tier, light, active) != state.tier
        active = active & ~(state.scattered & others)
        weight = dr.select(state.scattered, weight * state.dealt, weight)
    row = mi.Int32(light)
    towards = state.direction
    if lights.has_images:
        mirrored = active & (state.way >= 0)
        image = dr.gather(mi.Int32, lights.image, mi.UInt32(state.way) * lights.lights + light, mirrored)
        row = dr.select(mirrored, image, row)
        normal = dr.gather(mi.Vector3f, scene.surfaces.normal, mi.UInt32(state.way), mirrored)
        towards = dr.select(mirrored, towards - 2.0 * dr.dot(towards, normal) * normal, towards)
    asked = active & state.scattered & (state.way != _OTHERWISE) & (row >= 0)
    if lights.sky >= 0 and state.in_fog is not None:  # fog does not ask for it
        asked = asked & ((light != lights.sky) | ~state.in_fog)
    known = mi.UInt32(dr.maximum(row, 0))
    density = aim_density(lights, known, state.place, towards, asked)
    cell = state.cell
    if lights.tiers > 1 and state.tier is None:
        cell = cell + scene.choice.cells * dr.gather(mi.UInt32, lights.tier, known, asked)
    chance = light_chance(scene.choice, lights, cell, known, asked)
    if state.in_fog is not None:
        chance = dr.select(state.in_fog, 1.0, chance)
    share = dr.select(asked, power_heuristic(state.density, density * chance), 1.0)
    small = dr.gather(mi.UInt32, lights.kind, light, active) != RECTANGLE
    if scene.lights.sky >= 0:
        small = small & (light != scene.lights.sky)
    in_table = small & ~state.scattered & (state.way != _OTHERWISE)
    share = dr.select(in_table, 0.0, share)
    radiance = dr.gather(mi.Float, lights.radiance, light, active)
    radiance = radiance * connect.pattern_factor(lights, light, -state.direction, active)
    brings = weight * radiance * share
    add(brings, state.shares, light, active & (share > 0.0) & dr.isfinite(brings), state.turns)


@dataclass(frozen=True, eq=False)
class _NextStretch:
    """How a path leaves the vertex at the end of a stretch, if it does.

    `shares` is what nodes keep there, `origin` that of its next stretch, `leaves` whether there is one,
    `evenly` whether the vertex scatters evenly; `cell`, `way` and `inside` are those of `PathState`.
    """

    leaving: NextDirection
    shares: Shares
    origin: Point
    cell: UInt
    leaves: Mask
    evenly: Mask
    way: Int
    inside: Mask


def _scatter(
    scene: DeviceScene,
    state: PathState,
    si: Interaction,
    sampled: connect.SurfaceSample,
    surface: Mask,
    scattering: FogScattering | None,
    number: Random,
) -> _NextStretch:
    """Return how a path goes on: scattered by the surface that it meets, or turned in the fog before it."""
    leaving = leave_surface(si, sampled.sample, sampled.weight)
    surface = surface & (leaving.weight > 0.0)
    if scattering is not None:
        leaving = leave_in_fog(scene, state, si, sampled.bsdf, leaving, surface, scattering, number)
    turned, smooth = leaving.turned, leaving.smooth
    sampled_type, shape = sampled.sample.sampled_type, _shape(si)
    passes = dr.gather(mi.Bool, scene.surfaces.pane_of_shape, shape, surface) & mi.has_flag(
        sampled_type, mi.BSDFFlags.Null
    )
    facet = _facet(scene.surfaces, si, shape, surface)
    mirrored = (
        smooth & (facet >= 0) & mi.has_flag(sampled_type, mi.BSDFFlags.DeltaReflection)
        & (state.way == _STRAIGHT)
    )  # fmt: skip
    way = dr.select(passes, state.way, dr.select(mirrored, facet, _OTHERWISE))
    glass = dr.gather(mi.Bool, scene.surfaces.glass_of_shape, shape, surface)
    sharp = smooth & mi.has_flag(sampled_type, mi.BSDFFlags.DeltaReflection)
    shares = nodes.off_surface(scene.nodes, si, sampled.bsdf, leaving.direction, sharp, surface)
    onward = si.spawn_ray(leaving.direction)
    surface = surface & ~turned & (leaving.weight > 0.0)
    return _NextStretch(
        leaving=leaving,
        shares=nodes.where(turned, nodes.whole(scene.nodes), shares),
        origin=dr.select(turned, leaving.place, onward.o),
        cell=sampled.cell,
        leaves=surface | turned,
        evenly=(surface & ~smooth) | turned,
        way=way,
        inside=dr.select(surface & glass, dr.dot(leaving.direction, si.n) < 0.0, state.inside),
    )


def _survive(
    state: PathState,
    onward_path: _NextStretch,
    draw: Draws,
    u: Float,
    begin: Callable[[UInt], _Begin],
    camera: Point,
    narrow: Float | None,
) -> PathState:
    """Return the state of a path that goes on, by chance `u` where it is dim, or of the next sample's."""
    leaving, evenly, left = onward_path.leaving, onward_path.evenly, state.left * onward_path.leaving.left
    whole = tuple(mi.Float(1) for _ in state.shares)
    survival = dr.minimum(left / _DIM, 1.0)
    goes_on = onward_path.leaves & (u < survival)
    sample_next = state.sample + dr.select(goes_on, mi.UInt32(0), mi.UInt32(1))
    direction, tier, dealt = begin(sample_next)
    turns = state.turns
    if turns is not None:
        in_fog = leaving.turned & (versine(state.direction, leaving.direction) > narrow)
        of_surface = dr.select(evenly & ~leaving.turned, mi.UInt32(TURN), 0)
        turns = dr.select(goes_on, turns + dr.select(in_fog, mi.UInt32(TURN_IN_FOG), of_surface), 0)
    return PathState(
        sample=sample_next,
        depth=dr.select(goes_on, state.depth + 1, 0),
        origin=dr.select(goes_on, onward_path.origin, camera),
        direction=dr.select(goes_on, leaving.direction, direction),
        weight=dr.select(goes_on, state.weight * leaving.weight / survival, 1.0),
        shares=nodes.where(goes_on, nodes.times(state.shares, onward_path.shares), whole),
        left=dr.select(goes_on, left / survival, 1.0),
        place=dr.select(evenly, leaving.place, state.place),
        cell=dr.select(evenly, onward_path.cell, state.cell),
        # Smooth surfaces on the way leave it: asking for light weighs with the same density.
        density=dr.select(leaving.smooth, state.density, leaving.density),
        scattered=goes_on & (state.scattered | evenly),
        turns=turns,
        way=dr.select(goes_on & ~evenly, onward_path.way, _STRAIGHT),
        inside=goes_on & onward_path.inside,
        in_fog=None if state.in_fog is None else dr.select(evenly, leaving.turned, state.in_fog),
        tier=None if tier is None else dr.select(goes_on, state.tier, tier),
        dealt=None if dealt is None else dr.select(goes_on, state.dealt, dealt),
        active=state.active & (sample_next < draw.samples),
    )


def _shape(si: Interaction) -> UInt:
    """Return the number of the shape that a path meets."""
    return dr.reinterpret_array(mi.UInt32, si.shape)


def _facet(surfaces: Surfaces, si: Interaction, shape: UInt, active: Mask) -> Int:
    """Return the facet that a path has met, −1 where the surface is none."""
    first = dr.gather(mi.Int32, surfaces.facet_of_shape, shape, active)
    box = dr.gather(mi.Bool, surfaces.box_of_shape, shape, active)
    return dr.select(active, dr.select(box, first + mi.Int32(si.prim_index >> 1), first), -1)
