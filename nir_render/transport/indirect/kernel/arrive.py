"""What arrives of a light's radiance along a ray, on the device: shadow, mirrors, panes, fog, pattern."""

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import connect, nodes
from nir_render.transport.indirect.kernel.fog import transmittance
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.kernel.types import Float, Mask, Point, Shares, UInt, Vector
from nir_render.transport.world.facets import MIRROR


def arriving_share(
    scene: DeviceScene, row: UInt, origin: Point, aim: connect.Aim, depth: UInt, max_depth: UInt, active: Mask
) -> tuple[Float, Shares]:
    """Return the share of a light's mean radiance that reaches a place along a ray; 0 where it is in shadow.

    Mirrored images are followed by both their legs, each pane weakens and counts as a stretch of the path, as
    it does where a path meets it by itself. And what each node keeps of that share.
    """
    lights = scene.lights
    factor, stretches = mi.Float(1), depth + 1
    shares = nodes.whole(scene.nodes)
    reach, leaving = aim.reach, -aim.direction
    second, shown = None, mi.Bool(False)
    facet = mi.Int32(-1)
    if lights.has_images:
        facet = dr.gather(mi.Int32, lights.facet, row, active)
        shown = active & (facet >= 0)
        second = connect.mirror_ray(scene.surfaces, mi.UInt32(facet), origin, aim.direction, aim.reach, shown)
        active = active & (~shown | second.valid)
        factor = dr.select(shown, second.reflectance, factor)
        mirror = shown & (dr.gather(mi.UInt32, scene.surfaces.kind, mi.UInt32(facet), shown) == MIRROR)
        shares = nodes.where(mirror, nodes.off_facet(scene.nodes, facet, mirror), shares)
        stretches = dr.select(shown, stretches + 1, stretches)
        reach = dr.select(shown, second.distance, reach)
        leaving = dr.select(shown, -second.direction, leaving)
    if scene.surfaces.pane_count:
        left, count, kept = connect.pane_transmittance(
            scene.surfaces, scene.nodes, origin, aim.direction, reach, facet, active
        )
        factor, stretches = factor * left, stretches + count
        shares = nodes.times(shares, kept)
    if scene.fog is not None:
        factor = factor * transmittance(scene.fog, origin, aim.direction, reach)
    if second is not None:
        if scene.surfaces.pane_count:
            left, count, kept = connect.pane_transmittance(
                scene.surfaces, scene.nodes, second.place, second.direction, second.rest, facet, shown
            )
            shares = nodes.where(shown, nodes.times(shares, kept), shares)
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
        before = reach * (1.0 - connect.SHORTER)
        active = active & ~(shown & _hidden(scene, origin, aim.direction, before, active & shown))
        place, onward, rest = (
            dr.select(shown, leg, straight)
            for leg, straight in (
                (second.place, origin), (second.direction, aim.direction), (second.rest, aim.reach),
            )
        )  # fmt: skip
        active = active & _reaches(scene, row, light, place, onward, rest, active)
    factor = factor * connect.pattern_factor(lights, light, leaving, active)
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
    ray.maxt = dr.select(radius > 0.0, reach + 2.0 * radius, reach * (1.0 - connect.SHORTER))
    met = scene.opaque.ray_intersect_preliminary(ray, coherent=False, active=active)
    shape = dr.reinterpret_array(mi.UInt32, met.shape)
    hit_light = dr.gather(mi.Int32, scene.surfaces.light_of_shape, shape, active & met.is_valid())
    return ~met.is_valid() | (hit_light == mi.Int32(light))


def _hidden(scene: DeviceScene, origin: Point, direction: Vector, reach: Float, active: Mask) -> Mask:
    ray = mi.Ray3f(origin, direction)
    ray.maxt = reach
    return scene.opaque.ray_test(ray, coherent=mi.Bool(False), active=active)
