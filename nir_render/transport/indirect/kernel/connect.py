"""Lights that a surface asks for on the device, and what arrives of a light on the way.

A light's image in a flat smooth facet is a light of its own that stands behind the facet: a ray towards it
that crosses the facet goes on, mirrored, to the light itself. Panes weaken what passes and do not bend it.
"""

from dataclasses import dataclass, replace
from typing import Any

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import draws
from nir_render.transport.indirect.kernel import nodes as of_nodes
from nir_render.transport.indirect.kernel.aim import Aim, aim_at_light, choose_light, guide_cell
from nir_render.transport.indirect.kernel.draws import power_heuristic
from nir_render.transport.indirect.kernel.fog import transmittance
from nir_render.transport.indirect.kernel.nodes import NodeTable
from nir_render.transport.indirect.kernel.tables import TURN, DeviceScene, Lights, Surfaces, along_table
from nir_render.transport.indirect.kernel.types import (
    AddLight,
    Float,
    Int,
    Interaction,
    Mask,
    PathState,
    Point,
    Random,
    Ray,
    Shares,
    UInt,
    Vector,
)
from nir_render.transport.world.facets import MIRROR, PANE

# Shadow rays to facets and lamps end this share of their way before it: what float32 rounds, with room.
SHORTER = 1e-4
# So far behind a pane, in metres and relative to lengths at hand, a ray goes on that passes it: what float32
# rounds, with room. What lies nearer behind it hides nothing.
_PAST = 1e-5


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """A surface's own scattering: Mitsuba's sample and its weight, and the guide's cell of the place."""

    bsdf: Any
    sample: Any
    weight: Float
    cell: UInt


def ask_lights(
    scene: DeviceScene,
    state: PathState,
    si: Interaction,
    weight: Float,
    surface: Mask,
    max_depth: UInt,
    number: Random,
    add: AddLight,
) -> SurfaceSample:
    """Add what a surface scatters of lights into the path, and return its sample of a way onwards.

    Both come from one call of Mitsuba's, which costs less than two. In clear air one light of each tier is
    asked for: so what weak ones bring needs no share of what the strong are asked.
    """
    bsdf = si.bsdf()
    cell = guide_cell(scene.choice, si.p, state.tier)
    row, chance = choose_light(scene.choice, scene.lights, cell, number(draws.LIGHT))
    aim = aim_at_light(scene.lights, row, si.p, number(draws.LIGHT_U), number(draws.LIGHT_V), surface)
    value, density, sample, sampled_weight = bsdf.eval_pdf_sample(
        mi.BSDFContext(), si, si.to_local(aim.direction), number(draws.LOBE),
        mi.Point2f(number(draws.LOBE_U), number(draws.LOBE_V)), surface,
    )  # fmt: skip
    asked = _AskedLight(row, chance, aim, weight * value[0], density)
    _add_asked_light(scene, state, si, asked, surface, max_depth, add)
    if scene.lights.tiers > 1 and state.tier is None:
        assert scene.lights.tiers == 2  # as many as are asked here
        weak = cell + scene.choice.cells
        row, chance = choose_light(scene.choice, scene.lights, weak, number(draws.WEAK))
        u, v = number(draws.WEAK_U), number(draws.WEAK_V)
        aim = aim_at_light(scene.lights, row, si.p, u, v, surface)
        value, density = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(aim.direction), surface)
        asked = _AskedLight(row, chance, aim, weight * value[0], density)
        _add_asked_light(scene, state, si, asked, surface, max_depth, add)
    return SurfaceSample(bsdf, sample, sampled_weight[0], cell)


@dataclass(frozen=True, eq=False)
class _AskedLight:
    """A light that a surface asks for: its row, the chance of it, a ray to it, and what scatters it back.

    `scattered` is the path's weight behind the surface, `density` that of the surface's own sampling.
    """

    row: UInt
    chance: Float
    aim: Aim
    scattered: Float
    density: Float


def _add_asked_light(
    scene: DeviceScene,
    state: PathState,
    si: Interaction,
    one: _AskedLight,
    surface: Mask,
    max_depth: UInt,
    add: AddLight,
) -> None:
    """Add what arrives of a light that a surface asks for, as far as paths do not meet it by themselves."""
    aim = one.aim
    asked = aim.density * one.chance
    brought = one.scattered * aim.radiance / asked * power_heuristic(asked, one.density)
    if state.dealt is not None:
        brought = brought * state.dealt
    seen = surface & (brought > 0.0) & dr.isfinite(brought)
    shadow = si.spawn_ray(aim.direction)
    # Mitsuba lifts a ray's origin off the surface, up to 1e-4 of the coordinates; it aims at the same point.
    to = aim.direction * aim.reach - (shadow.o - si.p)
    reach = dr.norm(to)
    lifted = replace(aim, direction=to / reach, reach=reach)
    share, kept = arriving_share(scene, one.row, shadow.o, lifted, state.depth, max_depth, seen)
    shares = of_nodes.off_surface(scene.nodes, si, si.bsdf(), aim.direction, mi.Bool(False), seen)
    shares = of_nodes.times(of_nodes.times(state.shares, shares), kept)
    once_more = None if state.turns is None else state.turns + TURN
    add(brought * share, shares, one.row, seen & (share > 0.0), once_more)


def pattern_factor(lights: Lights, light: UInt, leaving: Vector, active: Mask) -> Float:
    """Return the radiance of a light, not an image, in a direction that leaves it, over its mean."""
    factor = _of_pattern(lights, light, leaving, active) if lights.pattern_polars else mi.Float(1)
    if lights.sky_table is None:
        return factor
    return dr.select(light == lights.sky, lights.sky_table.relative(-leaving), factor)


def _of_pattern(lights: Lights, light: UInt, leaving: Vector, active: Mask) -> Float:
    first = dr.gather(mi.Int32, lights.pattern_first, light, active)
    patterned = active & (first >= 0)
    azimuths = dr.gather(mi.UInt32, lights.pattern_azimuths, light, patterned)
    axes = dr.gather(mi.Matrix3f, lights.pattern_axes, light, patterned)
    on_source = axes.T @ leaving
    polar = dr.acos(dr.clip(on_source.z, -1.0, 1.0)) * ((lights.pattern_polars - 1) / dr.pi)
    azimuth = dr.atan2(on_source.y, on_source.x)
    azimuth = dr.select(azimuth < 0.0, azimuth + 2.0 * dr.pi, azimuth) * mi.Float(azimuths) / (2.0 * dr.pi)
    row = mi.UInt32(along_table(polar, lights.pattern_polars - 1.5))
    column = dr.minimum(mi.UInt32(azimuth), azimuths - 1)
    next_column = dr.select(column + 1 == azimuths, 0, column + 1)
    down, along = dr.clip(polar - mi.Float(row), 0.0, 1.0), dr.clip(azimuth - mi.Float(column), 0.0, 1.0)

    def value(at_row: UInt, at_column: UInt) -> Float:
        return dr.gather(
            mi.Float, lights.pattern, mi.UInt32(first) + at_row * azimuths + at_column, patterned
        )

    above = dr.lerp(value(row, column), value(row, next_column), along)
    below = dr.lerp(value(row + 1, column), value(row + 1, next_column), along)
    return dr.select(patterned, dr.lerp(above, below, down), 1.0)


def reflectance(surfaces: Surfaces, facet: UInt, cosine: Float, active: Mask) -> Float:
    """Return the reflectance of a facet at an angle of incidence."""
    kind = dr.gather(mi.UInt32, surfaces.kind, facet, active)
    single = mi.fresnel(cosine, dr.gather(mi.Float, surfaces.index, facet, active))[0]
    single = dr.select(kind == PANE, 2.0 * single / (1.0 + single), single)
    return dr.select(kind == MIRROR, dr.gather(mi.Float, surfaces.factor, facet, active), single)


def pane_transmittance(
    surfaces: Surfaces,
    nodes: NodeTable | None,
    origin: Point,
    direction: Vector,
    reach: Float,
    without: Int,
    active: Mask,
) -> tuple[Float, UInt, Shares]:
    """Return what panes on a straight way, but `without`, pass; their number; what nodes keep of that."""

    def more(k: UInt, _left: Float, _count: UInt, _shares: Shares) -> Mask:
        return k < surfaces.pane_count

    def step(k: UInt, left: Float, count: UInt, shares: Shares) -> tuple[UInt, Float, UInt, Shares]:
        pane = dr.gather(mi.UInt32, surfaces.panes, k, active)
        normal = dr.gather(mi.Vector3f, surfaces.normal, pane, active)
        at = _crossing(surfaces, pane, origin, direction, active)
        crossed = (
            active & at.inside & (at.distance > 0.0) & (at.distance < reach) & (mi.Int32(pane) != without)
        )
        reflected = reflectance(surfaces, pane, dr.abs(dr.dot(direction, normal)), active)
        passed = (1.0 - reflected) * dr.gather(mi.Float, surfaces.transmission, pane, active)
        kept = of_nodes.times(shares, of_nodes.off_facet(nodes, pane, active))
        left, count = dr.select(crossed, left * passed, left), dr.select(crossed, count + 1, count)
        return k + 1, left, count, of_nodes.where(crossed, kept, shares)

    width = dr.zeros(mi.UInt32, dr.width(reach))
    start = (width, mi.Float(width) + 1.0, mi.UInt32(width), of_nodes.whole(nodes, dr.width(reach)))
    _, left, count, shares = dr.while_loop(start, more, step)
    return left, count, shares


@dataclass(frozen=True, eq=False)
class Reflection:
    """A ray towards an image: where it meets the facet, how it goes on, and the share that is reflected.

    `place` stands a little off the facet; from there `direction` leads to the light over the length `rest`.
    """

    valid: Mask
    distance: Float
    place: Point
    direction: Vector
    rest: Float
    reflectance: Float


def mirror_ray(
    surfaces: Surfaces, facet: UInt, origin: Point, direction: Vector, reach: Float, active: Mask
) -> Reflection:
    """Return how a ray towards a light's image is mirrored by the facet that shows it."""
    normal = dr.gather(mi.Vector3f, surfaces.normal, facet, active)
    at = _crossing(surfaces, facet, origin, direction, active)
    slope = dr.dot(direction, normal)
    facing = dr.gather(mi.Bool, surfaces.two_sided, facet, active) | (slope < 0.0)
    valid = active & at.inside & facing & (at.distance > 0.0) & (at.distance < reach)
    place = origin + direction * at.distance
    # A step off the facet, on the side from which the light comes; as far as Mitsuba's own rays take.
    step = dr.sign(slope) * 1e-4 * (1.0 + dr.max(dr.abs(place))) * normal
    # From there to the same point.
    to = (direction - 2.0 * slope * normal) * (reach - at.distance) + step
    rest = dr.norm(to)
    return Reflection(
        valid=valid,
        distance=at.distance,
        place=place - step,
        direction=to / rest,
        rest=rest,
        reflectance=reflectance(surfaces, facet, dr.abs(slope), valid),
    )


@dataclass(frozen=True, eq=False)
class _Crossing:
    distance: Float
    inside: Mask


def _crossing(surfaces: Surfaces, facet: UInt, origin: Point, direction: Vector, active: Mask) -> _Crossing:
    normal = dr.gather(mi.Vector3f, surfaces.normal, facet, active)
    center = dr.gather(mi.Point3f, surfaces.center, facet, active)
    distance = dr.dot(center - origin, normal) / dr.dot(direction, normal)
    off = origin + direction * distance - center
    along_u = dr.dot(off, dr.gather(mi.Vector3f, surfaces.half_u, facet, active))
    along_v = dr.dot(off, dr.gather(mi.Vector3f, surfaces.half_v, facet, active))
    return _Crossing(distance, (dr.abs(along_u) <= 1.0) & (dr.abs(along_v) <= 1.0))


def arriving_share(
    scene: DeviceScene, row: UInt, origin: Point, aim: Aim, depth: UInt, max_depth: UInt, active: Mask
) -> tuple[Float, Shares]:
    """Return the share of a light's mean radiance that reaches a place along a ray; 0 where it is in shadow.

    Mirrored images are followed by both their legs, each pane weakens and counts as a stretch of the path, as
    it does where a path meets it by itself. And what each node keeps of that share.
    """
    lights = scene.lights
    factor, stretches = mi.Float(1), depth + 1
    shares = of_nodes.whole(scene.nodes)
    reach, leaving = aim.reach, -aim.direction
    second, shown = None, mi.Bool(False)
    facet = mi.Int32(-1)
    if lights.has_images:
        facet = dr.gather(mi.Int32, lights.facet, row, active)
        shown = active & (facet >= 0)
        second = mirror_ray(scene.surfaces, mi.UInt32(facet), origin, aim.direction, aim.reach, shown)
        active = active & (~shown | second.valid)
        factor = dr.select(shown, second.reflectance, factor)
        mirror = shown & (dr.gather(mi.UInt32, scene.surfaces.kind, mi.UInt32(facet), shown) == MIRROR)
        shares = of_nodes.where(mirror, of_nodes.off_facet(scene.nodes, facet, mirror), shares)
        stretches = dr.select(shown, stretches + 1, stretches)
        reach = dr.select(shown, second.distance, reach)
        leaving = dr.select(shown, -second.direction, leaving)
    if scene.surfaces.pane_count:
        left, count, kept = pane_transmittance(
            scene.surfaces, scene.nodes, origin, aim.direction, reach, facet, active
        )
        factor, stretches = factor * left, stretches + count
        shares = of_nodes.times(shares, kept)
    if scene.fog is not None:
        factor = factor * transmittance(scene.fog, origin, aim.direction, reach)
    if second is not None:
        if scene.surfaces.pane_count:
            left, count, kept = pane_transmittance(
                scene.surfaces, scene.nodes, second.place, second.direction, second.rest, facet, shown
            )
            shares = of_nodes.where(shown, of_nodes.times(shares, kept), shares)
            factor, stretches = (
                dr.select(shown, factor * left, factor),
                dr.select(shown, stretches + count, stretches),
            )
        if scene.fog is not None:
            further = transmittance(scene.fog, second.place, second.direction, second.rest)
            factor = dr.select(shown, factor * further, factor)
    active = active & (stretches < max_depth) & (factor > 0.0)
    light = dr.gather(mi.UInt32, lights.group, row, active)
    if second is None:
        active = active & _reaches(scene, row, light, origin, aim.direction, aim.reach, active)
    else:
        before = reach * (1.0 - SHORTER)
        active = active & ~(shown & _hidden(scene, origin, aim.direction, before, active & shown))
        place, onward, rest = (
            dr.select(shown, leg, straight)
            for leg, straight in (
                (second.place, origin), (second.direction, aim.direction), (second.rest, aim.reach),
            )
        )  # fmt: skip
        active = active & _reaches(scene, row, light, place, onward, rest, active)
    factor = factor * pattern_factor(lights, light, leaving, active)
    return dr.select(active, factor, 0.0), shares


def _reaches(
    scene: DeviceScene, row: UInt, light: UInt, origin: Point, direction: Vector, reach: Float, active: Mask
) -> Mask:
    """Tell whether a ray reaches the light that it aims at.

    The first body that it meets, as far as the light's other side, is the light's own, or there is none:
    float32 places the surface of a small far sphere too badly to end before it. Nothing behind a lamp counts,
    which may lie in a ceiling.
    """
    radius = dr.gather(mi.Float, scene.lights.radius, row, active)
    ray = mi.Ray3f(origin, direction)
    ray.maxt = dr.select(radius > 0.0, reach + 2.0 * radius, reach * (1.0 - SHORTER))
    shape, met = _first_opaque(scene, ray, active)
    hit_light = dr.gather(mi.Int32, scene.surfaces.light_of_shape, shape, met)
    return ~met | (hit_light == mi.Int32(light))


def _hidden(scene: DeviceScene, origin: Point, direction: Vector, reach: Float, active: Mask) -> Mask:
    ray = mi.Ray3f(origin, direction)
    ray.maxt = reach
    if scene.opaque is None:
        return _first_opaque(scene, ray, active)[1]
    return scene.opaque.ray_test(ray, coherent=mi.Bool(False), active=active)


def _first_opaque(scene: DeviceScene, ray: Ray, active: Mask) -> tuple[UInt, Mask]:
    """Return the number of the first shape but panes that a ray meets, and whether it meets one."""
    if scene.opaque is not None:
        met = scene.opaque.ray_intersect_preliminary(ray, coherent=False, active=active)
        return dr.reinterpret_array(mi.UInt32, met.shape), active & met.is_valid()

    most = 2 * scene.surfaces.pane_count  # of panes, flat as they are, a ray meets each once

    def step(
        origin: Point, rest: Float, shape: UInt, looking: Mask, met: Mask, passed: UInt
    ) -> tuple[Point, Float, UInt, Mask, Mask, UInt]:
        onward = mi.Ray3f(origin, ray.d)
        onward.maxt = rest
        here = scene.bodies.ray_intersect_preliminary(onward, coherent=False, active=looking)
        number, hit = dr.reinterpret_array(mi.UInt32, here.shape), looking & here.is_valid()
        is_pane = dr.gather(mi.Bool, scene.surfaces.pane_of_shape, number, hit)
        past = here.t + _PAST * (1.0 + here.t + dr.max(dr.abs(origin)))
        passes = hit & is_pane & (past < rest) & (passed < most)
        return (
            dr.select(passes, origin + ray.d * past, origin),
            dr.select(passes, rest - past, rest),
            dr.select(hit, number, shape),
            passes,
            met | (hit & ~(is_pane & ((past >= rest) | passes))),
            passed + 1,
        )

    none, width = mi.Bool(False), dr.width(ray.d)
    start = (
        mi.Point3f(ray.o), mi.Float(ray.maxt), dr.zeros(mi.UInt32, width), mi.Bool(active), none, mi.UInt32(0)
    )  # fmt: skip
    _, _, shape, _, met, _ = dr.while_loop(start, lambda *state: state[3], step)
    return shape, met
