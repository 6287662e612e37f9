"""What arrives of a light's radiance along a ray, on the device: shadow, mirrors, panes, fog, pattern."""

from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.kernel import connect
from nir_render.transport.kernel import fog as foggy
from nir_render.transport.kernel.tables import World


def arriving(
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
        if world.surfaces.pane_count:
            left, count = connect.through_panes(
                world.surfaces, second.place, second.direction, second.rest, facet, shown
            )
            factor, stretches = (
                dr.select(shown, factor * left, factor),
                dr.select(shown, stretches + count, stretches),
            )
        if world.fog is not None:
            further = foggy.transmittance(world.fog, second.place, second.direction, second.rest)
            factor = dr.select(shown, factor * further, factor)
    active = active & (stretches < max_depth) & (factor > 0.0)
    light = dr.gather(mi.UInt32, lights.group, row, active)
    if second is None:
        active = active & _reaches(world, row, light, origin, aim.direction, aim.reach, active)
    else:
        mirror = reach * (1.0 - connect.SHORTER)
        active = active & ~(shown & _hidden(world, origin, aim.direction, mirror, active & shown))
        place, onward, rest = (
            dr.select(shown, leg, straight)
            for leg, straight in (
                (second.place, origin), (second.direction, aim.direction), (second.rest, aim.reach),
            )
        )  # fmt: skip
        active = active & _reaches(world, row, light, place, onward, rest, active)
    factor = factor * connect.emission(lights, light, leaving, active)
    return dr.select(active, factor, 0.0)


def _reaches(world: World, row: Any, light: Any, origin: Any, direction: Any, reach: Any, active: Any) -> Any:
    """Tell whether a ray reaches the light that it aims at.

    The first body that it meets, as far as the light's other side, is the light's own, or there is none:
    float32 places the surface of a small far sphere too badly to end before it. Nothing behind a lamp counts,
    which may lie in a ceiling.
    """
    mi, dr = backend().mi, backend().dr
    radius = dr.gather(mi.Float, world.lights.radius, row, active)
    ray = mi.Ray3f(origin, direction)
    ray.maxt = dr.select(radius > 0.0, reach + 2.0 * radius, reach * (1.0 - connect.SHORTER))
    met = world.opaque.ray_intersect_preliminary(ray, coherent=False, active=active)
    shape = dr.reinterpret_array(mi.UInt32, met.shape)
    own = dr.gather(mi.Int32, world.surfaces.light_of_shape, shape, active & met.is_valid())
    return ~met.is_valid() | (own == mi.Int32(light))


def _hidden(world: World, origin: Any, direction: Any, reach: Any, active: Any) -> Any:
    mi = backend().mi
    ray = mi.Ray3f(origin, direction)
    ray.maxt = reach
    return world.opaque.ray_test(ray, coherent=mi.Bool(False), active=active)
