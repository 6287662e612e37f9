"""From a place to a light on the device: choosing one by the guide, and drawing a direction to it.

All lights are drawn evenly over the solid angle that they fill. A rectangle's is after Ureña, Fajardo & King,
An Area-Preserving Parametrization for Spherical Rectangles, Computer Graphics Forum 32 (4), 2013, listings
SphQuadInit and SphQuadSample. In the paper's local reference system R the place is the origin and the
rectangle lies in the plane z = z₀ < 0, between x₀ and x₁, y₀ and y₁; γᵢ are the inner angles of its image on
the unit sphere. `b0`, `b1` and `k` are the paper's constants, `solid_angle` its S.
"""

from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.tables import Choice, Lights, along_table
from nir_render.transport.indirect.kernel.types import Float, Mask, Point, UInt, Vector
from nir_render.transport.world.emitters import RECTANGLE, SKY, SUN

# A rectangle that fills less than this, in sr, is sampled by area: its solid angle loses digits, and far away
# the two are nearly the same.
_SMALL_SR = 0.02
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
        sampled = _aim_at_rectangle(lights, row, place, u, v, active & (kind == RECTANGLE))
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


class RectangleInView:
    """A rectangular light of a row of `lights`, as seen from a place."""

    def __init__(self, lights: Lights, row: UInt, place: Point, active: Mask) -> None:
        half_u = dr.gather(mi.Vector3f, lights.half_u, row, active)
        half_v = dr.gather(mi.Vector3f, lights.half_v, row, active)
        self.normal = dr.gather(mi.Vector3f, lights.normal, row, active)
        self.center = dr.gather(mi.Point3f, lights.center, row, active) - place
        width, height = dr.norm(half_u), dr.norm(half_v)
        self.across, self.up = half_u / width, half_v / height
        self.size = 4.0 * width * height
        self.width, self.height = width, height
        # R: the rectangle's own axes at the place, z away from the rectangle.
        x, y = dr.dot(self.center, self.across), dr.dot(self.center, self.up)
        facing = dr.cross(self.across, self.up)
        z = dr.dot(self.center, facing)
        self.axis = dr.select(z > 0.0, -facing, facing)
        self.z = dr.minimum(-dr.abs(z), -1e-7)
        self.x0, self.x1 = x - width, x + width
        self.y0, self.y1 = y - height, y + height
        # The planes through the place and the four edges: nᵢ are the parts of their normals along z, whose
        # products are the cosines between them. These are cos γᵢ, and S = Σ γᵢ − 2π.
        n0, n1, n2, n3 = (
            offset * dr.rsqrt(self.z * self.z + offset * offset)
            for offset in (-self.y0, self.x1, self.y1, -self.x0)
        )
        gamma = [dr.safe_acos(-n * following) for n, following in ((n0, n1), (n1, n2), (n2, n3), (n3, n0))]
        self.b0, self.b1 = n0, n2
        self.k = 2.0 * dr.pi - gamma[2] - gamma[3]
        self.solid_angle = gamma[0] + gamma[1] - self.k
        # As large as it can look, from its nearest point: right before a large lamp its middle may be far.
        beside_x, beside_y = dr.maximum(dr.abs(x) - width, 0.0), dr.maximum(dr.abs(y) - height, 0.0)
        nearest2 = beside_x * beside_x + beside_y * beside_y + self.z * self.z
        roughly = self.size * dr.abs(self.z) / dr.power(nearest2, 1.5)
        # Almost in its plane, beside it, the solid angle can round to nothing, of which no part can be drawn.
        self.by_area = (roughly < _SMALL_SR) | (self.solid_angle <= 0.0)

    def density(self, direction: Vector) -> Float:
        """Return the density per sr with which `point` draws a direction that meets the rectangle."""
        slope = dr.abs(dr.dot(direction, self.axis))
        distance = -self.z / dr.maximum(slope, 1e-9)
        by_area = distance * distance / (self.size * dr.maximum(slope, 1e-9))
        return dr.select(self.by_area, by_area, dr.rcp(self.solid_angle))

    def point(self, u: Float, v: Float) -> Vector:
        """Return the offset from the place to a point drawn on the rectangle."""
        even = (
            self.center
            + self.across * (self.width * (2.0 * u - 1.0))
            + self.up * (self.height * (2.0 * v - 1.0))
        )
        turn = u * self.solid_angle + self.k
        sine, cosine = dr.sincos(turn)
        ratio = (cosine * self.b0 - self.b1) / sine
        cu = dr.clip(dr.sign(ratio) * dr.rsqrt(ratio * ratio + self.b0 * self.b0), -1.0, 1.0)
        x = dr.clip(-cu * self.z / dr.maximum(dr.safe_sqrt(1.0 - cu * cu), 1e-7), self.x0, self.x1)
        flat2 = x * x + self.z * self.z
        low = self.y0 / dr.sqrt(flat2 + self.y0 * self.y0)
        high = self.y1 / dr.sqrt(flat2 + self.y1 * self.y1)
        height = dr.clip(dr.lerp(low, high, v), -1.0 + 1e-6, 1.0 - 1e-6)
        y = dr.clip(height * dr.sqrt(flat2) / dr.safe_sqrt(1.0 - height * height), self.y0, self.y1)
        onto = self.across * x + self.up * y + self.axis * self.z
        return dr.select(self.by_area, even, onto)


def _aim_at_rectangle(
    lights: Lights, row: UInt, place: Point, u: Float, v: Float, active: Mask
) -> tuple[Vector, Float, Float]:
    """Return a unit direction to a point of a lamp, its distance and the density per sr of being drawn."""
    flat = RectangleInView(lights, row, place, active)
    to = flat.point(u, v)
    distance = dr.norm(to)
    direction = to / distance
    # Zero from behind: a density beyond all bounds.
    density = dr.select(dr.dot(direction, flat.normal) < 0.0, flat.density(direction), 1e30)
    return direction, distance, density
