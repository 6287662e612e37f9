"""Light that fog scatters into a stretch of a path, on the device: which light, and where on the way.

One light is drawn for each stretch, and one place, both by what they bring: the phase function and the
inverse square cancel where the place is drawn evenly in ∫ p dβ, β being the angle at which the light stands
off the ray (equiangular sampling, Kulla & Fajardo 2012, with the phase function in it).
"""

from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.emitters import SUN
from nir_render.transport.kernel import connect
from nir_render.transport.kernel import draws as use
from nir_render.transport.kernel import fog as foggy
from nir_render.transport.kernel.arrive import arriving
from nir_render.transport.kernel.tables import World

# Up to so many lights fog weighs each of them for each stretch; with more, the guide proposes so many.
_WEIGHED_LIGHTS = 8
_CANDIDATES = 4


def scatter_on_the_way(
    world: World, state: Any, begin: Any, end: Any, active: Any, max_depth: Any, number: Any, add: Any
) -> tuple[Any, Any, Any]:
    """Add the light of one light that fog on a stretch scatters into the path.

    Returns
    -------
    The light, the distance at which its light was scattered, and the density per metre with which that was
    drawn.
    """
    dr = backend().dr
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
    share = arriving(world, row, place, aim, state.depth, max_depth, seen)
    add(brought * share, row, seen & (share > 0.0))
    return row, distance, density


def _light_for_stretch(
    world: World, state: Any, begin: Any, end: Any, active: Any, u: Any
) -> tuple[Any, Any]:
    """Return a light drawn by what it brings to the fog on a stretch, and the chance of it.

    Without shadows and extinction that is power · ∫ p(β) / d² dt = power · (arc(β₁) − arc(β₀)) / D, with D
    the ray's distance from the light. Few lights are all weighed by it. Of many, the guide proposes some for
    places along the stretch, and one of these is taken by its weight (resampling, Talbot et al. 2005); the
    chance returned is then the one that makes the estimate right on average.
    """
    mi, dr = backend().mi, backend().dr
    lights = world.lights
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


def _candidate(world: World, state: Any, begin: Any, end: Any, number: Any, u: Any) -> tuple[Any, Any]:
    """Return a light that the guide draws at one of some places on a stretch, and its chance."""
    mi, dr = backend().mi, backend().dr
    # Fractions of the one number, scaled up, stand for numbers of their own.
    along = u * 1021.0 - dr.floor(u * 1021.0)
    pick = u * 16381.0 + mi.Float(number) * 0.6180339887
    pick = dr.minimum(pick - dr.floor(pick), 1.0 - 2.0**-24)
    distance = _flight_within(world, begin, end, (mi.Float(number) + along) / _CANDIDATES)
    cell = connect.cell_of(world.choice, state.origin + state.direction * distance)
    return connect.choose(world.choice, world.lights, cell, pick)


def _brought_to_stretch(world: World, row: Any, state: Any, begin: Any, end: Any, active: Any) -> Any:
    """Return what a light brings to the fog on a stretch, towards its begin, if nothing hides it, roughly.

    The way over the fog is at least the straight one; by that, light is weakened.
    """
    mi, dr = backend().mi, backend().dr
    fog, lights = world.fog, world.lights
    assert fog is not None  # noqa: S101 (only called in fog)
    _, off, low, high = _arcs(world, row, state, begin, end, active)
    weight = dr.maximum(high - low, 1e-6) / (4.0 * dr.pi * off)
    to = dr.gather(mi.Point3f, lights.center, row, active) - state.origin
    weight = weight * dr.maximum(dr.exp(-fog.extinction * dr.norm(to)), 1e-6)
    if lights.sun >= 0:
        kind = dr.gather(mi.UInt32, lights.kind, row, active)
        to_sun = dr.gather(mi.Vector3f, lights.normal, row, active)
        turn = 0.5 * dr.squared_norm(to_sun - state.direction)
        of_sun = foggy.phase(fog, turn) * foggy.absorbed(fog.extinction * (end - begin)) / fog.extinction
        weight = dr.select(kind == SUN, of_sun, weight)
    return weight * dr.gather(mi.Float, lights.power, row, active)


def _place_on_stretch(
    world: World, row: Any, state: Any, begin: Any, end: Any, u: Any, active: Any
) -> tuple[Any, Any]:
    """Return a distance on a stretch, and the density per metre with which it was drawn.

    Half of the draws are even in the integral of the phase function over the angle β at which the light
    stands off the ray, which grows by D/d² for each metre; half go by the extinction, which matters where the
    light is far. Where the integral is too short for float32, and for the sun, all go by the extinction.
    """
    mi, dr = backend().mi, backend().dr
    fog = world.fog
    assert fog is not None  # noqa: S101 (only called in fog)
    middle, off, low, high = _arcs(world, row, state, begin, end, active)
    far = high - low <= 1e-4
    if world.lights.sun >= 0:
        far = far | (dr.gather(mi.UInt32, world.lights.kind, row, active) == SUN)
    by_arc = ~far & (u < 0.5)
    u = dr.select(far, u, dr.select(by_arc, 2.0 * u, 2.0 * u - 1.0))
    angle = foggy.drawn_angle(fog, fog.arc, dr.lerp(low, high, u))
    sine, cosine = dr.sincos(angle)
    distance = dr.clip(middle - off * cosine / dr.maximum(sine, 1e-9), begin, end)
    distance = dr.select(by_arc, distance, _flight_within(world, begin, end, u))
    beside = distance - middle
    slope = foggy.slope(fog, fog.arc, dr.atan2(off, -beside))
    arc_density = slope / dr.maximum(high - low, 1e-9) * off / (off * off + beside * beside)
    whole = foggy.absorbed(fog.extinction * (end - begin))
    flight_density = fog.extinction * dr.exp(-fog.extinction * (distance - begin)) / whole
    return distance, dr.select(far, flight_density, 0.5 * (arc_density + flight_density))


def _arcs(world: World, row: Any, state: Any, begin: Any, end: Any, active: Any) -> tuple[Any, Any, Any, Any]:
    """Return where a ray is nearest to a light, how near, and `arc` at both ends of a stretch of it."""
    mi, dr = backend().mi, backend().dr
    to = dr.gather(mi.Point3f, world.lights.center, row, active) - state.origin
    middle = dr.dot(to, state.direction)
    off = dr.norm(to - state.direction * middle)
    off = dr.maximum(off, dr.gather(mi.Float, world.lights.spread, row, active))
    fog = world.fog
    assert fog is not None  # noqa: S101 (only called in fog)
    low = foggy.arc(fog, dr.atan2(off, middle - begin))
    high = foggy.arc(fog, dr.atan2(off, middle - end))
    return middle, off, low, high


def _flight_within(world: World, begin: Any, end: Any, u: Any) -> Any:
    """Return a distance on a stretch, drawn by the extinction, never beyond its end."""
    dr = backend().dr
    assert world.fog is not None  # noqa: S101 (only called in fog)
    whole = foggy.absorbed(world.fog.extinction * (end - begin))
    return dr.minimum(begin - dr.log(1.0 - u * whole) / world.fog.extinction, end)


def turned(
    world: World, row: Any, place: Any, direction: Any, u: Any, v: Any, active: Any
) -> tuple[Any, Any]:
    """Return the direction of a path that turns in fog, and its weight.

    Half of the draws go by the phase function, half into the halo of a light.
    """
    dr = backend().dr
    halo = Halo(world, row, place, active)
    by_phase = u < 0.5
    u = dr.select(by_phase, 2.0 * u, 2.0 * u - 1.0)
    onward = dr.select(by_phase, foggy.turned(halo.fog, direction, u, v), halo.direction(u, v))
    phase = foggy.phase(halo.fog, 0.5 * dr.squared_norm(onward - direction))
    return onward, phase / (0.5 * (phase + halo.density(onward)))


class Halo:
    """The shining fog around a light, as seen from a place: directions drawn by how it shines, roughly."""

    def __init__(self, world: World, row: Any, place: Any, active: Any) -> None:
        mi, dr = backend().mi, backend().dr
        assert world.fog is not None  # noqa: S101 (only in fog)
        self.fog = world.fog
        axis = dr.normalize(dr.gather(mi.Point3f, world.lights.center, row, active) - place)
        if world.lights.sun >= 0:
            sun = dr.gather(mi.UInt32, world.lights.kind, row, active) == SUN
            axis = dr.select(sun, dr.gather(mi.Vector3f, world.lights.normal, row, active), axis)
        self.axis = axis

    def direction(self, u: Any, v: Any) -> Any:
        """Return a unit direction, drawn."""
        mi, dr = backend().mi, backend().dr
        sine, cosine = dr.sincos(foggy.drawn_angle(self.fog, self.fog.halo, u))
        sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * v)
        return mi.Frame3f(self.axis).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, cosine))

    def density(self, direction: Any) -> Any:
        """Return the density per sr: that of the angle θ off the light over 2π sin θ."""
        dr = backend().dr
        across = dr.norm(dr.cross(direction, self.axis))
        angle = dr.atan2(across, dr.dot(direction, self.axis))
        return foggy.slope(self.fog, self.fog.halo, angle) / (2.0 * dr.pi * dr.maximum(across, 1e-7))
