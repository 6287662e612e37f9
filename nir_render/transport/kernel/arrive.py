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
        second = connect.reflected(
            world.surfaces, mi.UInt32(facet), origin, aim.direction, aim.reach, aim.gap, shown
        )
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
        active = active & ((stretches < max_depth) & (factor > 0.0))
        active = active & (
            ~(shown & _hidden(world, second.place, second.direction, second.rest - aim.gap, active & shown))
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
