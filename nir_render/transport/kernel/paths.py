"""The walk of light paths on the device: one lane is one pixel of one batch, and walks its samples in turn.

Every lane goes on to its next sample as soon as a path ends, so none waits for its neighbours' longer paths.
A lane alone adds to its place in the result, in the order of its samples: the sums are the same bits on any
number of threads.

Each step is a stretch of a path, from a vertex to the next: fog on the way scatters light of one light towards
the vertex (a place drawn where the phase function and the inverse square put it, Kulla & Fajardo 2012); at the
surface one light is asked for (next-event estimation), and the path goes on by the surface's own scattering.
Both ways to a light are weighted by the power heuristic (Veach 1995).
"""

from dataclasses import dataclass, replace
from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.emitters import RECTANGLE, SUN
from nir_render.transport.kernel import connect
from nir_render.transport.kernel import draws as use
from nir_render.transport.kernel import fog as foggy
from nir_render.transport.kernel.tables import Choice, FogTable, Lights, Surfaces

# How a path came here since its last vertex that scatters evenly: straight on (through panes at most), by one
# facet (its number), or by smooth surfaces that no image stands for.
_STRAIGHT, _OTHERWISE = -1, -2
_FAR = 1e15
_ROULETTE_DEPTH = 2
# Up to so many lights fog weighs each of them for each stretch; with more, the guide proposes so many.
_WEIGHED_LIGHTS = 8
_CANDIDATES = 4


@dataclass(frozen=True, eq=False)
class World:
    """All that a walk reads. `bodies` is Mitsuba's scene, `opaque` the same without panes."""

    bodies: Any
    opaque: Any
    lights: Lights
    surfaces: Surfaces
    choice: Choice
    fog: FogTable | None


@dataclass(frozen=True, eq=False)
class Film:
    """The rays of a camera and the part of its film to fill.

    `corners` holds directions at the corners of the sensor's pixels, `columns` + 1 to a row; a pixel of the
    film is `scale` × `scale` of these. `index` are the numbers of the film's pixels to fill, `pixels` and
    `pixel_count` how many.
    """

    origin: Any
    corners: Any
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
            dr.ReduceOp.Add, out, value, group * stride + lane, active, dr.ReduceMode.NoConflicts
        )

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
    """Return a unit direction in a pixel, evenly drawn, between the directions at its sensor pixel's corners."""
    mi, dr = backend().mi, backend().dr
    width = film.columns // film.scale
    row = pixel // width
    u = (mi.Float(pixel - row * width) + draw.pixel(sample, use.PIXEL_U)) * mi.Float(film.scale)
    v = (mi.Float(row) + draw.pixel(sample, use.PIXEL_V)) * mi.Float(film.scale)
    column, line = mi.UInt32(u), mi.UInt32(v)
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

    # Fog: what it scatters on this stretch, how much it leaves of the light beyond, and whether the path itself
    # turns in it. What lies at the end of the stretch is asked for whether it turns or not, so that this choice
    # brings no noise into it.
    turns, passing = mi.Bool(False), state.weight
    turned_at, turned_to = mi.Point3f(0), mi.Vector3f(0, 0, 1)
    if world.fog is not None:
        reach = dr.select(met, si.t, _FAR)
        begin, end = foggy.interval(world.fog, state.origin, state.direction, reach)
        in_fog = state.active & ~state.inside & (end > begin)
        _scatter_on_the_way(world, state, begin, end, in_fog & further, max_depth, number, add)
        flight = begin - dr.log(1.0 - number(use.FLIGHT)) / world.fog.extinction
        turns = in_fog & (flight < end)
        passing = passing * (dr.select(in_fog, dr.exp(-world.fog.extinction * (end - begin)), 1.0))
        turned_at = state.origin + state.direction * flight
        turned_to = foggy.turned(world.fog, state.direction, number(use.TURN_U), number(use.TURN_V))

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
    to = aim.direction * (aim.reach - aim.gap) - (shadow.o - si.p)
    reach = dr.norm(to)
    lifted = replace(aim, direction=to / reach, reach=reach + aim.gap)
    arriving = _arriving(world, row, shadow.o, lifted, state.depth, max_depth, seen)
    add(brought * arriving, row, seen & (arriving > 0.0))

    # On to the next vertex.
    smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    passes = dr.gather(mi.Bool, world.surfaces.pane_of_shape, shape, surface) & mi.has_flag(
        sample.sampled_type, mi.BSDFFlags.DeltaTransmission
    )
    facet = _facet(world.surfaces, si, shape, surface)
    mirrored = (
        smooth & (facet >= 0) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)
        & (state.way == _STRAIGHT)
    )  # fmt: skip
    way = dr.select(passes, state.way, dr.select(mirrored, facet, _OTHERWISE))
    glass = dr.gather(mi.Bool, world.surfaces.glass_of_shape, shape, surface)
    onward = si.spawn_ray(si.to_world(sample.wo))
    surface = surface & (~turns)
    evenly = (surface & ~smooth) | turns
    weight = state.weight * dr.select(turns, _albedo(world), sampled_weight[0])
    depth = state.depth + 1
    survival = dr.select(depth >= _ROULETTE_DEPTH, dr.minimum(weight, 0.95), 1.0)
    goes_on = ((surface & (sampled_weight[0] > 0.0)) | (turns & further)) & (number(use.SURVIVAL) < survival)
    sample_next = state.sample + dr.select(goes_on, mi.UInt32(0), mi.UInt32(1))
    return _State(
        sample=sample_next,
        depth=dr.select(goes_on, depth, 0),
        origin=dr.select(goes_on, dr.select(turns, turned_at, onward.o), camera),
        direction=dr.select(goes_on, dr.select(turns, turned_to, onward.d), begun(sample_next)),
        weight=dr.select(goes_on, weight / survival, 1.0),
        place=dr.select(evenly, dr.select(turns, turned_at, si.p), state.place),
        cell=dr.select(evenly, cell, state.cell),
        # A facet or pane on the way is drawn with its own chance, which belongs to the chance of the way.
        density=dr.select(turns, 0.0, dr.select(smooth, state.density * sample.pdf, sample.pdf)),
        scattered=goes_on & (state.scattered | evenly),
        way=dr.select(goes_on & ~evenly, way, _STRAIGHT),
        inside=goes_on & dr.select(surface & glass, sample.wo.z < 0.0, state.inside),
        active=state.active & (sample_next < draw.samples),
    )


def _scatter_on_the_way(
    world: World, state: _State, begin: Any, end: Any, active: Any, max_depth: Any, number: Any, add: Any
) -> None:
    """Add the light of one light that fog on a stretch scatters into the path."""
    mi, dr = backend().mi, backend().dr
    fog = world.fog
    assert fog is not None  # noqa: S101 (only called in fog)
    row, chance = _light_for_stretch(world, state, begin, end, active, number(use.FOG_LIGHT))
    distance, density = _place_on_stretch(world, row, state, begin, end, number(use.FOG_PLACE), active)
    place = state.origin + state.direction * distance
    aim = connect.aim(world.lights, row, place, number(use.FOG_U), number(use.FOG_V), active)
    turn = 0.5 * dr.squared_norm(aim.direction - state.direction)
    brought = (
        state.weight * fog.extinction * fog.albedo * dr.exp(-fog.extinction * (distance - begin))
        * foggy.phase(fog, turn) * aim.radiance / (chance * density * aim.density)
    )  # fmt: skip
    seen = active & (brought > 0.0) & dr.isfinite(brought)
    arriving = _arriving(world, row, place, aim, state.depth, max_depth, seen)
    add(brought * arriving, row, seen & (arriving > 0.0))


def _light_for_stretch(
    world: World, state: _State, begin: Any, end: Any, active: Any, u: Any
) -> tuple[Any, Any]:
    """Return a light drawn by what it brings to the fog on a stretch, and the chance of it.

    Without shadows and extinction that is power · ∫ p(β) / d² dt = power · (arc(β₁) − arc(β₀)) / D, with D the
    ray's distance from the light. Few lights are all weighed by it. Of many, the guide proposes some for places
    along the stretch, and one of these is taken by its weight (resampling, Talbot et al. 2005); the chance
    returned is then the one that makes the estimate right on average.
    """
    mi, dr = backend().mi, backend().dr
    fog, lights = world.fog, world.lights
    few = lights.rows <= _WEIGHED_LIGHTS

    def more(k: Any, *_rest: Any) -> Any:
        return k < (lights.count if few else _CANDIDATES)

    def weigh(k: Any, row: Any, mine: Any, total: Any, rest: Any) -> tuple[Any, ...]:
        candidate, chance = (k, 1.0) if few else _candidate(world, state, begin, end, k, u)
        weight = _brought_to_stretch(world, candidate, state, begin, end, active)
        total = total + weight / chance
        share = weight / (chance * total)
        taken = rest < share
        # The same number serves all the way: what is left of it is even again after each choice.
        rest = dr.select(taken, rest / share, (rest - share) / dr.maximum(1.0 - share, 1e-9))
        return (
            k + 1, dr.select(taken, candidate, row), dr.select(taken, weight, mine), total,
            dr.clip(rest, 0.0, 1.0),
        )  # fmt: skip

    zero = dr.zeros(mi.UInt32, dr.width(u))
    nothing = dr.zeros(mi.Float, dr.width(u))
    _, row, mine, total, _ = dr.while_loop(
        (zero, mi.UInt32(zero), nothing, mi.Float(nothing), mi.Float(u)), more, weigh
    )
    return row, mine / total if few else _CANDIDATES * mine / total


def _candidate(world: World, state: _State, begin: Any, end: Any, number: Any, u: Any) -> tuple[Any, Any]:
    """Return a light that the guide draws at one of the places spread over a stretch, and its chance there."""
    mi, dr = backend().mi, backend().dr
    # Fractions of the one number, scaled up, stand for numbers of their own.
    along = u * 1021.0 - dr.floor(u * 1021.0)
    pick = u * 16381.0 + mi.Float(number) * 0.6180339887
    pick = dr.minimum(pick - dr.floor(pick), 1.0 - 2.0**-24)
    distance = _flight_within(world, begin, end, (mi.Float(number) + along) / _CANDIDATES)
    cell = connect.cell_of(world.choice, state.origin + state.direction * distance)
    return connect.choose(world.choice, world.lights, cell, pick)


def _brought_to_stretch(world: World, row: Any, state: _State, begin: Any, end: Any, active: Any) -> Any:
    """Return what a light brings to the fog on a stretch, towards its begin, if nothing hides or weakens it."""
    mi, dr = backend().mi, backend().dr
    fog, lights = world.fog, world.lights
    assert fog is not None  # noqa: S101 (only called in fog)
    _, off, low, high = _arcs(world, row, state, begin, end, active)
    weight = dr.maximum(high - low, 1e-6) / (4.0 * dr.pi * off)
    if lights.sun >= 0:
        kind = dr.gather(mi.UInt32, lights.kind, row, active)
        to_sun = dr.gather(mi.Vector3f, lights.normal, row, active)
        turn = 0.5 * dr.squared_norm(to_sun - state.direction)
        of_sun = foggy.phase(fog, turn) * _absorbed(fog.extinction * (end - begin)) / fog.extinction
        weight = dr.select(kind == SUN, of_sun, weight)
    return weight * dr.gather(mi.Float, lights.power, row, active)


def _place_on_stretch(
    world: World, row: Any, state: _State, begin: Any, end: Any, u: Any, active: Any
) -> tuple[Any, Any]:
    """Return a distance on a stretch, and the density per metre with which it was drawn.

    The angle β at which a light stands off the ray grows along it by D/d² for each metre. Drawn evenly in the
    integral of the phase function over β, inverse square and phase function cancel. Where that integral is too
    short for float32, and for the sun, the distance is drawn by the extinction.
    """
    mi, dr = backend().mi, backend().dr
    fog = world.fog
    middle, off, low, high = _arcs(world, row, state, begin, end, active)
    angle, slope = foggy.angle_of_arc(fog, dr.lerp(low, high, u))
    sine, cosine = dr.sincos(angle)
    by_arc = middle - off * cosine / dr.maximum(sine, 1e-9)
    density = slope / (high - low) * off / (off * off + dr.square(by_arc - middle))
    short = high - low <= 1e-4
    if world.lights.sun >= 0:
        short = short | (dr.gather(mi.UInt32, world.lights.kind, row, active) == SUN)
    by_arc = dr.clip(by_arc, begin, end)
    by_flight = _flight_within(world, begin, end, u)
    whole = _absorbed(fog.extinction * (end - begin))
    flight_density = fog.extinction * dr.exp(-fog.extinction * (by_flight - begin)) / whole
    return dr.select(short, by_flight, by_arc), dr.select(short, flight_density, density)


def _arcs(
    world: World, row: Any, state: _State, begin: Any, end: Any, active: Any
) -> tuple[Any, Any, Any, Any]:
    """Return where a ray is nearest to a light, how near, and `arc` at both ends of a stretch of it."""
    mi, dr = backend().mi, backend().dr
    to = dr.gather(mi.Point3f, world.lights.center, row, active) - state.origin
    middle = dr.dot(to, state.direction)
    off = dr.norm(to - state.direction * middle)
    off = dr.maximum(off, dr.gather(mi.Float, world.lights.spread, row, active))
    low = foggy.arc(world.fog, dr.atan2(off, middle - begin))
    high = foggy.arc(world.fog, dr.atan2(off, middle - end))
    return middle, off, low, high


def _flight_within(world: World, begin: Any, end: Any, u: Any) -> Any:
    """Return a distance on a stretch, drawn by the extinction, never beyond its end."""
    dr = backend().dr
    assert world.fog is not None  # noqa: S101 (only called in fog)
    whole = _absorbed(world.fog.extinction * (end - begin))
    return dr.minimum(begin - dr.log(1.0 - u * whole) / world.fog.extinction, end)


def _absorbed(depth: Any) -> Any:
    """Return 1 − exp(−depth), with its digits where the depth is small."""
    dr = backend().dr
    series = depth * (1.0 - depth * (0.5 - depth * (1.0 / 6.0 - depth / 24.0)))
    return dr.select(depth < 0.05, series, 1.0 - dr.exp(-depth))


def _arriving(
    world: World, row: Any, origin: Any, aim: connect.Aim, depth: Any, max_depth: Any, active: Any
) -> Any:
    """Return the share of a light's mean radiance that reaches a place along a ray; 0 where it is in shadow.

    Mirrored images are followed by both their legs, each pane weakens and counts as a stretch of the path, as
    it does where a path meets it by itself.
    """
    mi, dr = backend().mi, backend().dr
    lights = world.lights
    factor, stretches = mi.Float(1), depth + 1
    reach, leaving = aim.reach, -aim.direction
    second, shown = None, mi.Bool(False)
    facet = mi.Int32(-1)
    if lights.has_images:
        facet = dr.gather(mi.Int32, lights.facet, row, active)
        shown = active & (facet >= 0)
        second = connect.reflected(world.surfaces, mi.UInt32(facet), origin, aim.direction, aim.reach, shown)
        active = active & (~shown | second.valid)
        factor = dr.select(shown, second.reflectance, factor)
        stretches = dr.select(shown, stretches + 1, stretches)
        reach = dr.select(shown, second.distance, reach)
        leaving = dr.select(shown, -second.direction, leaving)
    if world.surfaces.pane_count:
        left, count = connect.through_panes(world.surfaces, origin, aim.direction, reach, facet, active)
        factor, stretches = factor * left, stretches + count
    if world.fog is not None:
        factor = factor * (foggy.transmittance(world.fog, origin, aim.direction, reach))
    if second is not None:
        rest = aim.reach - second.distance
        if world.surfaces.pane_count:
            left, count = connect.through_panes(
                world.surfaces, second.place, second.direction, rest, facet, shown
            )
            factor, stretches = (
                dr.select(shown, factor * left, factor),
                dr.select(shown, stretches + count, stretches),
            )
        if world.fog is not None:
            further = foggy.transmittance(world.fog, second.place, second.direction, rest)
            factor = dr.select(shown, factor * further, factor)
        active = active & ((stretches < max_depth) & (factor > 0.0))
        active = active & (
            ~(shown & _hidden(world, second.place, second.direction, rest - aim.gap, active & shown))
        )
    else:
        active = active & ((stretches < max_depth) & (factor > 0.0))
    end = dr.select(shown, reach * (1.0 - connect.SHORTER), reach - aim.gap)
    active = active & ~_hidden(world, origin, aim.direction, end, active)
    factor = factor * (
        connect.emission(lights, dr.gather(mi.UInt32, lights.group, row, active), leaving, active)
    )
    return dr.select(active, factor, 0.0)


def _hidden(world: World, origin: Any, direction: Any, reach: Any, active: Any) -> Any:
    mi = backend().mi
    ray = mi.Ray3f(origin, direction)
    ray.maxt = reach
    return world.opaque.ray_test(ray, coherent=mi.Bool(False), active=active)


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
    """Return the power heuristic's weight of the way whose density is `mine`; written so as not to overflow."""
    dr = backend().dr
    ratio = other / dr.maximum(mine, 1e-30)
    return dr.select(mine > 0.0, 1.0 / (1.0 + ratio * ratio), 0.0)


def _albedo(world: World) -> Any:
    return backend().mi.Float(1) if world.fog is None else world.fog.albedo
