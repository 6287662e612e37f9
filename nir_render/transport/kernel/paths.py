"""The walk of light paths on the device: one lane is one pixel of one batch, and walks its samples in turn.

Every lane goes on to its next sample as soon as a path ends, so none waits for its neighbours' longer paths.
A lane alone adds to its place in the result, in the order of its samples: the sums are the same bits on any
number of threads.

Each step is a stretch of a path, from a vertex to the next: fog on the way scatters light of one light
towards the vertex (a place drawn where the phase function and the inverse square put it, Kulla & Fajardo
2012); at the surface one light is asked for (next-event estimation), and the path goes on by the surface's
own scattering. Both ways to a light are weighted by the power heuristic (Veach 1995).
"""

from dataclasses import dataclass, replace
from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.emitters import RECTANGLE
from nir_render.transport.kernel import connect
from nir_render.transport.kernel import draws as use
from nir_render.transport.kernel import fog as foggy
from nir_render.transport.kernel.arrive import arriving
from nir_render.transport.kernel.leaving import in_fog, off_surface
from nir_render.transport.kernel.scatter import scatter_on_the_way
from nir_render.transport.kernel.tables import Surfaces, World

# How a path came here since its last vertex that scatters evenly: straight on (through panes at most), by one
# facet (its number), or by smooth surfaces that no image stands for.
_STRAIGHT, _OTHERWISE = -1, -2
_FAR = 1e15
# Paths of which surfaces and fog have left less than this go on by chance, as if this were left. How a path
# was drawn does not count: what goes towards a light weighs little, and brings as much as any.
_DIM = 0.1
# Less than this, in 1/(m² sr), is nothing: near 1e-38 some threads round to zero and others do not.
_NOTHING = 1e-15


@dataclass(frozen=True, eq=False)
class Film:
    """The rays of a camera and the part of its film to fill.

    `corners` holds directions at the corners of the sensor's pixels, `rows` + 1 times `columns` + 1; a pixel
    of the film is `scale` × `scale` of these. `index` are the numbers of the film's pixels to fill, `pixels`
    and `pixel_count` how many.
    """

    origin: Any
    corners: Any
    rows: Any
    columns: Any
    scale: Any
    index: Any
    pixels: Any
    pixel_count: int


@dataclass
class _State:
    """Where a lane stands."""

    sample: Any
    depth: Any
    origin: Any
    direction: Any
    weight: Any
    left: Any  # what surfaces and fog have left of a path's light
    place: Any  # the last vertex that scatters evenly
    cell: Any
    density: Any  # with which its direction was drawn; 0 after fog, where lights have been asked for already
    scattered: Any  # whether there is such a vertex
    way: Any
    inside: Any  # a transparent solid
    active: Any


def walk(
    world: World, film: Film, pixel: Any, draw: use.Draws, lanes: int, groups: int, max_depth: Any
) -> Any:
    """Return the sum over a batch's samples of each pixel's radiance per unit of each group's emission.

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
    Flat array, (group, batch, pixel).
    """
    mi, dr = backend().mi, backend().dr
    lane = dr.arange(mi.UInt32, lanes)
    out = dr.zeros(mi.Float, groups * lanes)
    stride = dr.opaque(mi.UInt32, lanes)

    def add(value: Any, row: Any, active: Any) -> None:
        group = dr.gather(mi.UInt32, world.lights.group, row, active)
        dr.scatter_reduce(
            dr.ReduceOp.Add, out, value, group * stride + lane, active & (value > _NOTHING),
            dr.ReduceMode.NoConflicts,
        )  # fmt: skip

    def begun(sample: Any) -> Any:
        return _camera_direction(film, pixel, draw, sample)

    def step(state: _State) -> tuple[_State]:
        return (_step(world, state, draw, max_depth, add, begun, film.origin),)

    zero = dr.zeros(mi.UInt32, lanes)
    state = _State(
        sample=mi.UInt32(zero),
        depth=mi.UInt32(zero),
        origin=film.origin + dr.zeros(mi.Point3f, lanes),
        direction=begun(zero),
        weight=dr.ones(mi.Float, lanes),
        left=dr.ones(mi.Float, lanes),
        place=dr.zeros(mi.Point3f, lanes),
        cell=mi.UInt32(zero),
        density=dr.zeros(mi.Float, lanes),
        scattered=dr.zeros(mi.Bool, lanes),
        way=dr.full(mi.Int32, _STRAIGHT, lanes),
        inside=dr.zeros(mi.Bool, lanes),
        active=dr.full(mi.Bool, True, lanes),
    )
    dr.while_loop((state,), lambda state: state.active, step)
    return out


def _camera_direction(film: Film, pixel: Any, draw: use.Draws, sample: Any) -> Any:
    """Return a unit direction in a pixel, evenly drawn between those at the sensor pixel's corners."""
    mi, dr = backend().mi, backend().dr
    width = film.columns // film.scale
    row = pixel // width
    u = (mi.Float(pixel - row * width) + draw.pixel(sample, use.PIXEL_U)) * mi.Float(film.scale)
    v = (mi.Float(row) + draw.pixel(sample, use.PIXEL_V)) * mi.Float(film.scale)
    # In float32 the sum can round up to the next whole number.
    column, line = dr.minimum(mi.UInt32(u), film.columns - 1), dr.minimum(mi.UInt32(v), film.rows - 1)
    corner = line * (film.columns + 1) + column
    above, above_right, below, below_right = (
        dr.gather(mi.Vector3f, film.corners, corner + offset)
        for offset in (0, 1, film.columns + 1, film.columns + 2)
    )
    along, down = u - mi.Float(column), v - mi.Float(line)
    return dr.normalize(dr.lerp(dr.lerp(above, above_right, along), dr.lerp(below, below_right, along), down))


def _step(
    world: World, state: _State, draw: use.Draws, max_depth: Any, add: Any, begun: Any, camera: Any
) -> _State:
    """Return a lane's state after one more stretch of its path, its light added on the way."""
    mi, dr = backend().mi, backend().dr
    ctx = mi.BSDFContext()

    def number(purpose: int) -> Any:
        return draw.vertex(state.sample, state.depth, purpose)

    si = world.bodies.ray_intersect(
        mi.Ray3f(state.origin, state.direction),
        ray_flags=mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame,
        coherent=state.depth == 0,
        active=state.active,
    )
    met = state.active & si.is_valid()
    further = state.depth + 1 < max_depth

    # Fog: what it scatters on this stretch, and how much it leaves of the light beyond. What lies at the end
    # is asked for whether the path turns in fog or not, so that this choice brings no noise into it.
    passing, scattered = state.weight, None
    if world.fog is not None:
        begin, end = foggy.interval(world.fog, state.origin, state.direction, dr.select(met, si.t, _FAR))
        in_it = state.active & ~state.inside & (end > begin)
        scattered = scatter_on_the_way(world, state, begin, end, in_it, max_depth, number, add)
        passing = state.weight * (1.0 - scattered.lost)

    # Light that the path meets.
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    light = dr.gather(mi.Int32, world.surfaces.light_of_shape, shape, met)
    shines = met & (light >= 0)
    if world.lights.sun >= 0:
        leaves = state.active & ~si.is_valid() & connect.in_sun(world.lights, state.direction)
        light = dr.select(leaves, world.lights.sun, light)
        shines = shines | (leaves)
    front = (dr.dot(state.direction, si.n) < 0.0) | ~met  # lamps shine from one side, suns from everywhere
    _add_met_light(world, state, passing, mi.UInt32(light), shines & front, add)

    # The surface: ask for a light, and scatter.
    surface = met & (light < 0) & further
    bsdf = si.bsdf()
    cell = connect.cell_of(world.choice, si.p)
    row, chance = connect.choose(world.choice, world.lights, cell, number(use.LIGHT))
    aim = connect.aim(world.lights, row, si.p, number(use.LIGHT_U), number(use.LIGHT_V), surface)
    value, density, sample, sampled_weight = bsdf.eval_pdf_sample(
        ctx, si, si.to_local(aim.direction), number(use.LOBE),
        mi.Point2f(number(use.LOBE_U), number(use.LOBE_V)), surface,
    )  # fmt: skip
    asked = aim.density * chance
    brought = passing * value[0] * aim.radiance / asked * _power(asked, density)
    seen = surface & (brought > 0.0) & dr.isfinite(brought)
    shadow = si.spawn_ray(aim.direction)
    # Mitsuba lifts a ray's origin off the surface, up to 1e-4 of the coordinates; it aims at the same point.
    to = aim.direction * aim.reach - (shadow.o - si.p)
    reach = dr.norm(to)
    lifted = replace(aim, direction=to / reach, reach=reach)
    share = arriving(world, row, shadow.o, lifted, state.depth, max_depth, seen)
    add(brought * share, row, seen & (share > 0.0))

    # On to the next vertex.
    leaving = off_surface(si, sample, sampled_weight[0])
    surface = surface & (leaving.weight > 0.0)
    if scattered is not None:
        leaving = in_fog(world, state, si, bsdf, leaving, surface, scattered, number)
    turned, smooth = leaving.turned, leaving.smooth
    passes = dr.gather(mi.Bool, world.surfaces.pane_of_shape, shape, surface) & mi.has_flag(
        sample.sampled_type, mi.BSDFFlags.Null
    )
    facet = _facet(world.surfaces, si, shape, surface)
    mirrored = (
        smooth & (facet >= 0) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)
        & (state.way == _STRAIGHT)
    )  # fmt: skip
    way = dr.select(passes, state.way, dr.select(mirrored, facet, _OTHERWISE))
    glass = dr.gather(mi.Bool, world.surfaces.glass_of_shape, shape, surface)
    onward = si.spawn_ray(leaving.direction)
    surface = surface & ~turned & (leaving.weight > 0.0)
    evenly = (surface & ~smooth) | turned
    left = state.left * leaving.left
    depth = state.depth + 1
    survival = dr.minimum(left / _DIM, 1.0)
    goes_on = (surface | turned) & (number(use.SURVIVAL) < survival)
    sample_next = state.sample + dr.select(goes_on, mi.UInt32(0), mi.UInt32(1))
    return _State(
        sample=sample_next,
        depth=dr.select(goes_on, depth, 0),
        origin=dr.select(goes_on, dr.select(turned, leaving.place, onward.o), camera),
        direction=dr.select(goes_on, leaving.direction, begun(sample_next)),
        weight=dr.select(goes_on, state.weight * leaving.weight / survival, 1.0),
        left=dr.select(goes_on, left / survival, 1.0),
        place=dr.select(evenly, leaving.place, state.place),
        cell=dr.select(evenly, cell, state.cell),
        # Smooth surfaces on the way leave it: asking for light weighs with the same density.
        density=dr.select(smooth, state.density, leaving.density),
        scattered=goes_on & (state.scattered | evenly),
        way=dr.select(goes_on & ~evenly, way, _STRAIGHT),
        inside=goes_on & dr.select(surface & glass, dr.dot(leaving.direction, si.n) < 0.0, state.inside),
        active=state.active & (sample_next < draw.samples),
    )


def _add_met_light(world: World, state: _State, weight: Any, light: Any, active: Any, add: Any) -> None:
    """Add a light that the path has met, as far as asking for it has not brought it.

    Small lights that the camera sees straight, or by one facet, are left out: the direct table holds them.
    """
    mi, dr = backend().mi, backend().dr
    lights = world.lights
    row = mi.Int32(light)
    towards = state.direction
    if lights.has_images:
        mirrored = active & (state.way >= 0)
        image = dr.gather(mi.Int32, lights.image, mi.UInt32(state.way) * lights.lights + light, mirrored)
        row = dr.select(mirrored, image, row)
        normal = dr.gather(mi.Vector3f, world.surfaces.normal, mi.UInt32(state.way), mirrored)
        towards = dr.select(mirrored, towards - 2.0 * dr.dot(towards, normal) * normal, towards)
    asked = active & state.scattered & (state.way != _OTHERWISE) & (row >= 0)
    known = mi.UInt32(dr.maximum(row, 0))
    density = connect.density_of(lights, known, state.place, towards, asked)
    density = density * (connect.chance_of(world.choice, lights, state.cell, known, asked))
    share = dr.select(asked, _power(state.density, density), 1.0)
    small = dr.gather(mi.UInt32, lights.kind, light, active) != RECTANGLE
    in_table = small & ~state.scattered & (state.way != _OTHERWISE)
    share = dr.select(in_table, 0.0, share)
    radiance = dr.gather(mi.Float, lights.radiance, light, active)
    radiance = radiance * (connect.emission(lights, light, -state.direction, active))
    add(weight * radiance * share, light, active & (share > 0.0))


def _facet(surfaces: Surfaces, si: Any, shape: Any, active: Any) -> Any:
    """Return the facet that a path has met, −1 where the surface is none."""
    mi, dr = backend().mi, backend().dr
    first = dr.gather(mi.Int32, surfaces.facet_of_shape, shape, active)
    box = dr.gather(mi.Bool, surfaces.box_of_shape, shape, active)
    return dr.select(active, dr.select(box, first + mi.Int32(si.prim_index >> 1), first), -1)


def _power(mine: Any, other: Any) -> Any:
    """Return the power heuristic's weight of the way whose density is `mine`."""
    dr = backend().dr
    ratio = other / dr.maximum(mine, 1e-30)
    return dr.select(mine > 0.0, 1.0 / (1.0 + ratio * ratio), 0.0)
