"""From a place to a light on the device: choosing one, aiming at it, and what arrives on the way.

A light's image in a flat smooth facet is a light of its own that stands behind the facet: a ray towards it
that crosses the facet goes on, mirrored, to the light itself. Panes weaken what passes and do not bend it.
"""

from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import nodes as of_nodes
from nir_render.transport.indirect.kernel.fog import transmittance
from nir_render.transport.indirect.kernel.nodes import NodeTable
from nir_render.transport.indirect.kernel.rectangle import RectangleInView, aim_at_rectangle
from nir_render.transport.indirect.kernel.tables import Choice, DeviceScene, Lights, Surfaces, along_table
from nir_render.transport.indirect.kernel.types import Float, Int, Mask, Point, Ray, Shares, UInt, Vector
from nir_render.transport.world.emitters import RECTANGLE, SKY, SUN
from nir_render.transport.world.facets import MIRROR, PANE

# Shadow rays to facets and lamps end this share of their way before it: what float32 rounds, with room.
SHORTER = 1e-4
# So far behind a pane, in metres and relative to lengths at hand, a ray goes on that passes it: what float32
# rounds, with room. What lies nearer behind it hides nothing.
_PAST = 1e-5
_ENDLESS = 1e15


@dataclass(frozen=True, eq=False)
class Aim:
    """A ray towards a light: unit direction, length, density per sr of being drawn, and the radiance."""

    direction: Vector
    reach: Float
    density: Float
    radiance: Float


def guide_cell(choice: Choice, place: Point, tier: UInt | None = None) -> UInt:
    """Return the guide's cell of a place, of all tiers' cells that of one; outside the grid the nearest."""
    at = mi.Point3u(along_table((place - choice.low) * choice.cells_per_m, choice.top))
    cell = at.x + choice.stride_y * at.y + choice.stride_z * at.z
    return cell if tier is None else cell + choice.cells * tier


def choose_light(choice: Choice, lights: Lights, cell: UInt, u: Float) -> tuple[UInt, Float]:
    """Return a light drawn by the guide, and the chance of it."""
    first = cell * lights.count
    row = dr.binary_search(
        0, lights.rows - 1, lambda k: dr.gather(mi.Float, choice.cumulative, first + k) <= u
    )
    return row, dr.gather(mi.Float, choice.chance, first + row)


def light_chance(choice: Choice, lights: Lights, cell: UInt, row: UInt, active: Mask) -> Float:
    """Return the chance that the guide draws a light in a cell."""
    return dr.gather(mi.Float, choice.chance, cell * lights.count + row, active)


def versine_of(radius: Float, distance2: Float) -> Float:
    """Return 1 − cos of half the angle that a sphere fills; the difference itself would lose its digits."""
    sine2 = dr.minimum(radius * radius / distance2, 1.0)
    return sine2 / (1.0 + dr.sqrt(1.0 - sine2))


def aim_at_light(lights: Lights, row: UInt, place: Point, u: Float, v: Float, active: Mask) -> Aim:
    """Return a ray from a place towards a point of a light, drawn evenly over the solid angle it fills."""
    radiance = dr.gather(mi.Float, lights.radiance, row, active)
    direction, reach, density = mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(1)
    kind = dr.gather(mi.UInt32, lights.kind, row, active)
    if lights.has_spheres:
        direction, reach, density = _aim_at_sphere(lights, row, place, u, v, active)
    if lights.has_rectangles:
        sampled = aim_at_rectangle(lights, row, place, u, v, active & (kind == RECTANGLE))
        direction, reach, density = (
            dr.select(kind == RECTANGLE, new, old)
            for new, old in zip(sampled, (direction, reach, density), strict=True)
        )
    if lights.sun >= 0:
        sampled = _aim_at_sun(lights, row, u, v, active & (kind == SUN))
        direction, reach, density = (
            dr.select(kind == SUN, new, old)
            for new, old in zip(sampled, (direction, reach, density), strict=True)
        )
    if lights.sky_table is not None:
        towards = lights.sky_table.aim(u, v)
        direction = dr.select(kind == SKY, towards, direction)
        reach = dr.select(kind == SKY, _ENDLESS, reach)
        density = dr.select(kind == SKY, lights.sky_table.density(towards), density)
    return Aim(direction, reach, density, radiance)


def aim_density(lights: Lights, row: UInt, place: Point, direction: Vector, active: Mask) -> Float:
    """Return the density per sr with which `aim_at_light` draws a direction that does meet a light."""
    kind = dr.gather(mi.UInt32, lights.kind, row, active)
    density = mi.Float(0)
    if lights.has_spheres:
        center = dr.gather(mi.Point3f, lights.center, row, active)
        radius = dr.gather(mi.Float, lights.radius, row, active)
        density = dr.rcp(2.0 * dr.pi * versine_of(radius, dr.squared_norm(center - place)))
    if lights.has_rectangles:
        flat = RectangleInView(lights, row, place, active & (kind == RECTANGLE))
        density = dr.select(kind == RECTANGLE, flat.density(direction), density)
    if lights.sun >= 0:
        versine = dr.gather(mi.Float, lights.versine, row, active)
        density = dr.select(kind == SUN, dr.rcp(2.0 * dr.pi * versine), density)
    if lights.sky_table is not None:
        density = dr.select(kind == SKY, lights.sky_table.density(direction), density)
    return density


def meets_sun(lights: Lights, direction: Vector) -> Mask:
    """Tell whether a direction meets the sun's disc."""
    row = mi.UInt32(lights.sun)
    to_sun = dr.gather(mi.Vector3f, lights.normal, row)
    return 0.5 * dr.squared_norm(direction - to_sun) < dr.gather(mi.Float, lights.versine, row)


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


def _aim_at_sphere(
    lights: Lights, row: UInt, place: Point, u: Float, v: Float, active: Mask
) -> tuple[Vector, Float, Float]:
    to = dr.gather(mi.Point3f, lights.center, row, active) - place
    radius = dr.gather(mi.Float, lights.radius, row, active)
    distance2 = dr.squared_norm(to)
    distance = dr.sqrt(distance2)
    whole = versine_of(radius, distance2)
    versine = whole * u
    sine2 = versine * (2.0 - versine)
    direction = _around(to / distance, dr.safe_sqrt(sine2), versine, v)
    reach = distance * (1.0 - versine) - dr.safe_sqrt(radius * radius - distance2 * sine2)
    return direction, reach, dr.rcp(2.0 * dr.pi * whole)


def _aim_at_sun(lights: Lights, row: UInt, u: Float, v: Float, active: Mask) -> tuple[Vector, Float, Float]:
    whole = dr.gather(mi.Float, lights.versine, row, active)
    versine = whole * u
    axis = dr.gather(mi.Vector3f, lights.normal, row, active)
    direction = _around(axis, dr.safe_sqrt(versine * (2.0 - versine)), versine, v)
    return direction, mi.Float(_ENDLESS), dr.rcp(2.0 * dr.pi * whole)


def _around(axis: Vector, sine: Float, versine: Float, turn: Float) -> Vector:
    sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * turn)
    return mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, 1.0 - versine))


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
