"""Light that fog scatters into a stretch of a path, on the device: which light, and where on the way.

One light is drawn for each stretch, and one place, both by what they bring: the phase function and the
inverse square cancel where the place is drawn evenly in ∫ p dβ, β being the angle at which the light stands
off the ray (equiangular sampling, Kulla & Fajardo 2012, with the phase function in it). That is so for lights
much smaller than the forward peak; of a larger one the peak picks a part, which asking for evenly drawn
points of it seldom meets. Paths that turn do: so both ways bring the light, weighted by the power heuristic.
"""

from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import connect, draws, nodes
from nir_render.transport.indirect.kernel.aim import aim_at_light, choose_light, guide_cell
from nir_render.transport.indirect.kernel.fog import (
    absorbed_share,
    arc_integral,
    draw_angle,
    draw_flight,
    extinction_at,
    flight_density,
    optical_depth,
    phase_function,
    table_slope,
    versine,
)
from nir_render.transport.indirect.kernel.tables import TURN_IN_FOG, DeviceScene
from nir_render.transport.indirect.kernel.types import (
    AddLight,
    Float,
    Mask,
    PathState,
    Point,
    Random,
    UInt,
    Vector,
)
from nir_render.transport.world.emitters import SKY, SUN

# Up to so many lights fog weighs each of them for each stretch; with more, the guide proposes so many.
_WEIGHED_LIGHTS = 16
_CANDIDATES = 4  # for each of which `draws` has two numbers
# How many paths turn at a place in fog for each light that is asked for there, roughly: it weighs the two
# ways to a light, and moves nothing but noise.
TURNED = 0.25
# What is drawn towards lights, places and directions, is drawn so by a half, or what `leaving` says, on a
# path's first stretches. Each time that a path goes elsewhere its weight grows; on long paths, whose light is
# faint, that would bring much at once, and it is drawn so by this share of that.
_FIRST_STRETCHES, _LATER = 4, 0.3


@dataclass(frozen=True, eq=False)
class FogScattering:
    """What fog does on a stretch.

    The share of light lost on it; a place where a path may turn, the weight of turning there, the new
    direction apart, and whether it may.
    """

    lost: Float
    place: Point
    weight: Float
    may_turn: Mask


def scatter_on_stretch(
    scene: DeviceScene,
    state: PathState,
    begin: Float,
    end: Float,
    active: Mask,
    max_depth: UInt,
    number: Random,
    add: AddLight,
) -> FogScattering:
    """Add the light of one light that fog on a stretch scatters into the path."""
    fog = scene.fog
    assert fog is not None  # only called in fog
    depth = optical_depth(fog, state.origin, state.direction, begin, end)
    lost = dr.select(active, absorbed_share(depth), 0.0)
    active = active & (state.depth + 1 < max_depth)
    row, chance = _light_for_stretch(scene, state, begin, end, active, number)
    distance, density = _place_on_stretch(scene, row, state, begin, end, number(draws.FOG_PLACE), active)
    place = state.origin + state.direction * distance
    aim = aim_at_light(scene.lights, row, place, number(draws.FOG_U), number(draws.FOG_V), active)
    turn = versine(state.direction, aim.direction)
    before = optical_depth(fog, state.origin, state.direction, begin, distance)
    weight = extinction_at(fog, place) * fog.albedo * dr.exp(-before) / density
    phase = phase_function(fog, turn)
    brought = state.weight * weight * phase * aim.radiance / (chance * aim.density)
    brought = brought * draws.power_heuristic(aim.density, TURNED * phase)
    if state.dealt is not None:
        brought = brought * state.dealt
    seen = active & (brought > 0.0) & dr.isfinite(brought)
    share, kept = connect.arriving_share(scene, row, place, aim, state.depth, max_depth, seen)
    turns = None
    if scene.narrow is not None:
        turns = state.turns + dr.select(turn > scene.narrow, mi.UInt32(TURN_IN_FOG), 0)
    add(brought * share, nodes.times(state.shares, kept), row, seen & (share > 0.0), turns)
    return FogScattering(lost, place, weight, active)


def _light_for_stretch(
    scene: DeviceScene, state: PathState, begin: Float, end: Float, active: Mask, number: Random
) -> tuple[UInt, Float]:
    """Return a light drawn by what it brings to the fog on a stretch, and the chance of it.

    Without shadows and extinction that is power · ∫ p(β) / d² dt = power · (arc(β₁) − arc(β₀)) / D, with D
    the ray's distance from the light. Few lights are all weighed by it. Of many, the guide proposes some for
    places along the stretch, and one of these is taken by its weight (resampling, Talbot et al. 2005); the
    chance returned is then the one that makes the estimate right on average.
    """
    few = weighs_all(scene)
    first, count = scene.lights.of_tier(state.tier, active) if few else (0, _CANDIDATES)

    def weigh(k: UInt) -> tuple[UInt, Float]:
        if few:
            row, chance = scene.lights.row_of_tier(state.tier, first + k, active), 1.0
        else:
            row, chance = _candidate(scene, state, begin, end, k, number)
        return row, brought_to_stretch(scene, row, state.origin, state.direction, begin, end, active) / chance

    row, weight, total = draws.draw_by_weight(count, weigh, number(draws.FOG_LIGHT))
    if few:
        return row, weight / total
    weight = brought_to_stretch(scene, row, state.origin, state.direction, begin, end, active)
    return row, _CANDIDATES * weight / total


def weighs_all(scene: DeviceScene) -> bool:
    """Tell whether lights are so few that fog weighs each of them for each stretch."""
    return scene.lights.rows <= _WEIGHED_LIGHTS


def _candidate(
    scene: DeviceScene, state: PathState, begin: Float, end: Float, k: UInt, number: Random
) -> tuple[UInt, Float]:
    """Return a light that the guide draws at one of some places on a stretch, and its chance."""
    along, pick = (number(draws.FOG_CANDIDATES + 2 * k + which) for which in range(2))
    assert scene.fog is not None  # only called in fog
    share = (mi.Float(k) + along) / _CANDIDATES
    distance = draw_flight(scene.fog, state.origin, state.direction, begin, end, share)
    cell = guide_cell(scene.choice, state.origin + state.direction * distance, state.tier)
    return choose_light(scene.choice, scene.lights, cell, pick)


def brought_to_stretch(
    scene: DeviceScene, row: UInt, origin: Point, direction: Vector, begin: Float, end: Float, active: Mask
) -> Float:
    """Return what a light brings to the fog on a stretch, towards its begin, if nothing hides it, roughly.

    The way over the fog is at least the straight one; by that, light is weakened.
    """
    fog, lights = scene.fog, scene.lights
    assert fog is not None  # only called in fog
    _, off, low, high = _arcs(scene, row, origin, direction, begin, end, active)
    weight = dr.maximum(high - low, 1e-6) / (4.0 * dr.pi * off)
    to = dr.gather(mi.Point3f, lights.center, row, active) - origin
    weight = weight * dr.maximum(dr.exp(-fog.typical * dr.norm(to)), 1e-6)
    if lights.sun >= 0:
        kind = dr.gather(mi.UInt32, lights.kind, row, active)
        to_sun = dr.gather(mi.Vector3f, lights.normal, row, active)
        turn = versine(direction, to_sun)
        lost = absorbed_share(optical_depth(fog, origin, direction, begin, end))
        of_sun = phase_function(fog, turn) * lost / fog.typical
        weight = dr.select(kind == SUN, of_sun, weight)
    if lights.sky >= 0:
        kind = dr.gather(mi.UInt32, lights.kind, row, active)
        weight = dr.select(kind == SKY, 0.0, weight)
    return weight * dr.gather(mi.Float, lights.power, row, active)


def _place_on_stretch(
    scene: DeviceScene, row: UInt, state: PathState, begin: Float, end: Float, u: Float, active: Mask
) -> tuple[Float, Float]:
    """Return a distance on a stretch, and the density per metre with which it was drawn.

    Half of the draws, of later stretches fewer, are even in the integral of the phase function over the angle
    β at which the light stands off the ray, which grows by D/d² for each metre; the others go by the
    extinction, which matters where the light is far. Where the integral is too short for float32, and for the
    sun, all go by the extinction.
    """
    fog = scene.fog
    assert fog is not None  # only called in fog
    middle, off, low, high = _arcs(scene, row, state.origin, state.direction, begin, end, active)
    far = high - low <= 1e-4
    if scene.lights.sun >= 0:
        far = far | (dr.gather(mi.UInt32, scene.lights.kind, row, active) == SUN)
    arcs = 0.5 * towards_lights(state)
    by_arc = ~far & (u < arcs)
    u = dr.select(far, u, dr.select(by_arc, u / arcs, (u - arcs) / (1.0 - arcs)))
    angle = draw_angle(fog, fog.arc, dr.lerp(low, high, u))
    sine, cosine = dr.sincos(angle)
    distance = dr.clip(middle - off * cosine / dr.maximum(sine, 1e-9), begin, end)
    flight = draw_flight(fog, state.origin, state.direction, begin, end, u)
    distance = dr.select(by_arc, distance, flight)
    beside = distance - middle
    slope = table_slope(fog, fog.arc, dr.atan2(off, -beside))
    arc_density = slope / dr.maximum(high - low, 1e-9) * off / (off * off + beside * beside)
    by_flight = flight_density(fog, state.origin, state.direction, begin, end, distance)
    return distance, dr.select(far, by_flight, dr.lerp(by_flight, arc_density, arcs))


def towards_lights(state: PathState) -> Float:
    """Return how much is drawn towards lights on a path's stretch, over that on its first ones."""
    return dr.select(state.depth < _FIRST_STRETCHES, mi.Float(1.0), mi.Float(_LATER))


def _arcs(
    scene: DeviceScene, row: UInt, origin: Point, direction: Vector, begin: Float, end: Float, active: Mask
) -> tuple[Float, Float, Float, Float]:
    """Return where a ray is nearest to a light, how near, and `arc` at both ends of a stretch of it."""
    to = dr.gather(mi.Point3f, scene.lights.center, row, active) - origin
    middle = dr.dot(to, direction)
    off = dr.norm(to - direction * middle)
    off = dr.maximum(off, dr.gather(mi.Float, scene.lights.spread, row, active))
    fog = scene.fog
    assert fog is not None  # only called in fog
    low = arc_integral(fog, dr.atan2(off, middle - begin))
    high = arc_integral(fog, dr.atan2(off, middle - end))
    return middle, off, low, high
