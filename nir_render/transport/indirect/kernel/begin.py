"""How a path begins, on the device: its ray through the film, and the tier of lights that it serves.

In fog lights say where paths turn and whereto. A path that serves them all goes where the strongest wants it,
and what a weak source would need, turn after turn, is drawn so seldom that its light comes from few samples,
most of it from none. So samples are dealt out to tiers of lights: a path asks for the lights of
its tier, meets them, and goes as if the others were off. A tier gets samples by what it brings to the pixel's
ray, roughly, and each a floor; the share is known beforehand, and one over it is the weight. What the camera
sees straight is in all samples.
"""

from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.aim import guide_cell
from nir_render.transport.indirect.kernel.fog import absorbed_share, fog_interval, optical_depth
from nir_render.transport.indirect.kernel.fog_scatter import brought_to_stretch, weighs_all
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.kernel.types import Float, Mask, Point, UInt, Vector

FLOOR = 1.0 / 32.0
_FAR = 1e15


@dataclass(frozen=True, eq=False)
class Film:
    """The rays of a camera and the part of its film to fill.

    `corners` holds directions at the corners of the sensor's pixels, `rows` + 1 times `columns` + 1; a pixel
    of the film is `scale` × `scale` of these. `index` are the numbers of the film's pixels to fill, `pixels`
    and `pixel_count` how many.
    """

    origin: Point
    corners: Float
    rows: UInt
    columns: UInt
    scale: UInt
    index: UInt
    pixels: UInt
    pixel_count: int


def camera_direction(film: Film, pixel: UInt, along: Float, down: Float) -> Vector:
    """Return the unit direction at a place in a pixel, between those at the sensor pixel's corners."""
    width = film.columns // film.scale
    row = pixel // width
    u = (mi.Float(pixel - row * width) + along) * mi.Float(film.scale)
    v = (mi.Float(row) + down) * mi.Float(film.scale)
    # In float32 the sum can round up to the next whole number.
    column, line = dr.minimum(mi.UInt32(u), film.columns - 1), dr.minimum(mi.UInt32(v), film.rows - 1)
    corner = line * (film.columns + 1) + column
    above, above_right, below, below_right = (
        dr.gather(mi.Vector3f, film.corners, corner + offset)
        for offset in (0, 1, film.columns + 1, film.columns + 2)
    )
    along, down = u - mi.Float(column), v - mi.Float(line)
    return dr.normalize(dr.lerp(dr.lerp(above, above_right, along), dr.lerp(below, below_right, along), down))


@dataclass(frozen=True, eq=False)
class Deal:
    """The share of each tier in the samples of each lane's pixel; none where paths serve all lights."""

    shares: list[Float]

    def tier_of(self, u: Float) -> tuple[UInt | None, Float | None]:
        """Return the tier that a sample serves, drawn with `u`, and one over its share."""
        if not self.shares:
            return None, None
        tier, share, below = dr.zeros(mi.UInt32, dr.width(u)), self.shares[0], self.shares[0]
        for number, more in enumerate(self.shares[1:], start=1):
            later = u >= below
            tier, share = dr.select(later, number, tier), dr.select(later, more, share)
            below = below + more
        return tier, 1.0 / share


def deal_of(scene: DeviceScene, origin: Point, direction: Vector) -> Deal:
    """Return how samples are dealt out for pixels with rays through their middles.

    A tier's share goes with what it brings to the fog on the ray's first stretch, and to the surface behind,
    by what the fog takes and leaves.
    """
    tiers, fog = scene.lights.tiers, scene.fog
    if tiers == 1 or fog is None:  # in clear air each path serves all
        return Deal([])
    si = scene.bodies.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=True)
    met = si.is_valid()
    begin, end = fog_interval(fog, origin, direction, dr.select(met, si.t, _FAR))
    end = dr.maximum(begin, end)
    lost = dr.select(met, absorbed_share(optical_depth(fog, origin, direction, begin, end)), 1.0)
    in_fog = _brought_to_fog(scene, origin, direction, begin, end)
    surface = origin + direction * dr.select(met, si.t, 0.0)
    on_surface = _brought_to_place(scene, surface)
    even = dr.full(mi.Float, FLOOR, dr.width(direction))
    shares = [
        dr.fma(1.0 - FLOOR * tiers, dr.lerp(there, here, lost), even)
        for here, there in zip(in_fog, on_surface, strict=True)
    ]
    # What rounding and places without light leave is the strongest tier's.
    shares[0] = 1.0 - sum(shares[1:], mi.Float(0.0))
    dr.eval(shares)
    return Deal(shares)


def _brought_to_fog(
    scene: DeviceScene, origin: Point, direction: Vector, begin: Float, end: Float
) -> list[Float]:
    """Return each tier's share in what lights bring to the fog on a ray."""
    fog = scene.fog
    assert fog is not None  # only called in fog
    if not weighs_all(scene):
        within = dr.minimum(0.5 * (end - begin), 1.0 / fog.typical)
        return _brought_to_place(scene, origin + direction * (begin + within))
    active, tiers = mi.Bool(end > begin), scene.lights.tiers
    lost = absorbed_share(optical_depth(fog, origin, direction, begin, end)) / fog.typical
    row = mi.UInt32(max(scene.lights.sky, 0))
    of_sky = dr.gather(mi.Float, scene.lights.power, row) * lost / (2.0 * dr.pi)

    def more(k: UInt, _sums: list[Float]) -> Mask:
        return k < scene.lights.count

    def add(k: UInt, sums: list[Float]) -> tuple[UInt, list[Float]]:
        brought = brought_to_stretch(scene, k, origin, direction, begin, end, active)
        if scene.lights.sky >= 0:  # fog does not ask for it, but its paths come from there
            brought = dr.select(k == scene.lights.sky, of_sky, brought)
        tier = dr.gather(mi.UInt32, scene.lights.tier, k)
        sums = [total + dr.select(tier == number, brought, 0.0) for number, total in enumerate(sums)]
        return k + 1, sums

    width = dr.width(direction)
    start = dr.zeros(mi.UInt32, width), [dr.zeros(mi.Float, width) for _ in range(tiers)]
    _, sums = dr.while_loop(start, more, add)
    whole = sum(sums[1:], sums[0])
    return [dr.select(whole > 0.0, one / whole, 0.0) for one in sums]


def _brought_to_place(scene: DeviceScene, place: Point) -> list[Float]:
    """Return each tier's share in what lights bring to places, by the guide's cells."""
    cell = guide_cell(scene.choice, place)
    return [
        dr.gather(mi.Float, scene.choice.tier_share, cell + scene.choice.cells * number)
        for number in range(scene.lights.tiers)
    ]
