"""From a place to a light on the device: choosing one, aiming at it, and what arrives on the way.

A light's image in a flat smooth facet is a light of its own that stands behind the facet: a ray towards it
that crosses the facet goes on, mirrored, to the light itself. Panes weaken what passes and do not bend it.
"""

from dataclasses import dataclass
from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.emitters import RECTANGLE, SUN
from nir_render.transport.facets import MIRROR, PANE
from nir_render.transport.kernel.tables import Choice, Lights, Surfaces

# Shadow rays to facets and lamps end this share of their way before it: what float32 rounds, with room.
SHORTER = 1e-4
# A rectangle that fills less than this, in sr, is sampled by area: its solid angle loses digits, and far away
# the two are nearly the same.
_SMALL_SR = 0.02


@dataclass(frozen=True, eq=False)
class Aim:
    """A ray towards a light: unit direction, length, density per sr of being drawn, and the radiance."""

    direction: Any
    reach: Any
    density: Any
    radiance: Any


def cell_of(choice: Choice, place: Any) -> Any:
    """Return the guide's cell of a place; outside the grid the nearest."""
    mi, dr = backend().mi, backend().dr
    at = mi.Point3u(dr.clip((place - choice.low) * choice.cells_per_m, 0.0, choice.top))
    return at.x + choice.stride_y * at.y + choice.stride_z * at.z


def choose(choice: Choice, lights: Lights, cell: Any, u: Any) -> tuple[Any, Any]:
    """Return a light drawn by the guide, and the chance of it."""
    mi, dr = backend().mi, backend().dr
    first = cell * lights.count
    row = dr.binary_search(
        0, lights.rows - 1, lambda k: dr.gather(mi.Float, choice.cumulative, first + k) <= u
    )
    return row, dr.gather(mi.Float, choice.chance, first + row)


def chance_of(choice: Choice, lights: Lights, cell: Any, row: Any, active: Any) -> Any:
    """Return the chance that the guide draws a light in a cell."""
    mi, dr = backend().mi, backend().dr
    return dr.gather(mi.Float, choice.chance, cell * lights.count + row, active)


def versine_of(radius: Any, distance2: Any) -> Any:
    """Return 1 − cos of half the angle that a sphere fills; the difference itself would lose its digits."""
    dr = backend().dr
    sine2 = dr.minimum(radius * radius / distance2, 1.0)
    return sine2 / (1.0 + dr.sqrt(1.0 - sine2))


def aim(lights: Lights, row: Any, place: Any, u: Any, v: Any, active: Any) -> Aim:
    """Return a ray from a place towards a point of a light, drawn evenly over the solid angle it fills."""
    mi, dr = backend().mi, backend().dr
    radiance = dr.gather(mi.Float, lights.radiance, row, active)
    direction, reach, density = mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(1)
    kind = dr.gather(mi.UInt32, lights.kind, row, active)
    if lights.has_spheres:
        direction, reach, density = _aim_at_sphere(lights, row, place, u, v, active)
    if lights.has_rectangles:
        other = _aim_at_rectangle(lights, row, place, u, v, active & (kind == RECTANGLE))
        direction, reach, density = (
            dr.select(kind == RECTANGLE, new, old)
            for new, old in zip(other, (direction, reach, density), strict=True)
        )
    if lights.sun >= 0:
        other = _aim_at_sun(lights, row, u, v, active & (kind == SUN))
        direction, reach, density = (
            dr.select(kind == SUN, new, old)
            for new, old in zip(other, (direction, reach, density), strict=True)
        )
    return Aim(direction, reach, density, radiance)


def density_of(lights: Lights, row: Any, place: Any, direction: Any, active: Any) -> Any:
    """Return the density per sr with which `aim` draws a direction that does meet a light."""
    mi, dr = backend().mi, backend().dr
    kind = dr.gather(mi.UInt32, lights.kind, row, active)
    density = mi.Float(0)
    if lights.has_spheres:
        center = dr.gather(mi.Point3f, lights.center, row, active)
        radius = dr.gather(mi.Float, lights.radius, row, active)
        density = dr.rcp(2.0 * dr.pi * versine_of(radius, dr.squared_norm(center - place)))
    if lights.has_rectangles:
        flat = _Rectangle(lights, row, place, active & (kind == RECTANGLE))
        density = dr.select(kind == RECTANGLE, flat.density(direction), density)
    if lights.sun >= 0:
        versine = dr.gather(mi.Float, lights.versine, row, active)
        density = dr.select(kind == SUN, dr.rcp(2.0 * dr.pi * versine), density)
    return density


def in_sun(lights: Lights, direction: Any) -> Any:
    """Tell whether a direction meets the sun's disc."""
    mi, dr = backend().mi, backend().dr
    row = mi.UInt32(lights.sun)
    to_sun = dr.gather(mi.Vector3f, lights.normal, row)
    return 0.5 * dr.squared_norm(direction - to_sun) < dr.gather(mi.Float, lights.versine, row)


def emission(lights: Lights, light: Any, leaving: Any, active: Any) -> Any:
    """Return the radiance of a light, not an image, in a direction that leaves it, over its mean."""
    mi, dr = backend().mi, backend().dr
    if not lights.pattern_polars:
        return mi.Float(1)
    first = dr.gather(mi.Int32, lights.pattern_first, light, active)
    patterned = active & (first >= 0)
    azimuths = dr.gather(mi.UInt32, lights.pattern_azimuths, light, patterned)
    axes = dr.gather(mi.Matrix3f, lights.pattern_axes, light, patterned)
    own = axes.T @ leaving
    polar = dr.acos(dr.clip(own.z, -1.0, 1.0)) * ((lights.pattern_polars - 1) / dr.pi)
    azimuth = dr.atan2(own.y, own.x)
    azimuth = dr.select(azimuth < 0.0, azimuth + 2.0 * dr.pi, azimuth) * mi.Float(azimuths) / (2.0 * dr.pi)
    row = mi.UInt32(dr.clip(polar, 0.0, lights.pattern_polars - 1.5))
    column = dr.minimum(mi.UInt32(azimuth), azimuths - 1)
    next_column = dr.select(column + 1 == azimuths, 0, column + 1)
    down, along = dr.clip(polar - mi.Float(row), 0.0, 1.0), dr.clip(azimuth - mi.Float(column), 0.0, 1.0)

    def value(at_row: Any, at_column: Any) -> Any:
        return dr.gather(
            mi.Float, lights.pattern, mi.UInt32(first) + at_row * azimuths + at_column, patterned
        )

    above = dr.lerp(value(row, column), value(row, next_column), along)
    below = dr.lerp(value(row + 1, column), value(row + 1, next_column), along)
    return dr.select(patterned, dr.lerp(above, below, down), 1.0)


def reflectance(surfaces: Surfaces, facet: Any, cosine: Any, active: Any) -> Any:
    """Return the reflectance of a facet at an angle of incidence."""
    mi, dr = backend().mi, backend().dr
    kind = dr.gather(mi.UInt32, surfaces.kind, facet, active)
    single = mi.fresnel(cosine, dr.gather(mi.Float, surfaces.index, facet, active))[0]
    single = dr.select(kind == PANE, 2.0 * single / (1.0 + single), single)
    return dr.select(kind == MIRROR, dr.gather(mi.Float, surfaces.factor, facet, active), single)


def through_panes(
    surfaces: Surfaces, origin: Any, direction: Any, reach: Any, without: Any, active: Any
) -> tuple[Any, Any]:
    """Return the transmittance of all panes on a straight way but `without`, and their number."""
    mi, dr = backend().mi, backend().dr

    def more(k: Any, _left: Any, _count: Any) -> Any:
        return k < surfaces.pane_count

    def step(k: Any, left: Any, count: Any) -> tuple[Any, Any, Any]:
        pane = dr.gather(mi.UInt32, surfaces.panes, k, active)
        normal = dr.gather(mi.Vector3f, surfaces.normal, pane, active)
        at = _crossing(surfaces, pane, origin, direction, active)
        crossed = (
            active & at.inside & (at.distance > 0.0) & (at.distance < reach) & (mi.Int32(pane) != without)
        )
        both = reflectance(surfaces, pane, dr.abs(dr.dot(direction, normal)), active)
        passed = (1.0 - both) * dr.gather(mi.Float, surfaces.transmission, pane, active)
        return k + 1, dr.select(crossed, left * passed, left), dr.select(crossed, count + 1, count)

    width = dr.zeros(mi.UInt32, dr.width(reach))
    _, left, count = dr.while_loop((width, mi.Float(width) + 1.0, mi.UInt32(width)), more, step)
    return left, count


@dataclass(frozen=True, eq=False)
class Reflection:
    """A ray towards an image: where it meets the facet, how it goes on, and the share that is reflected.

    `place` stands a little off the facet; from there `direction` leads to the light over the length `rest`.
    """

    valid: Any
    distance: Any
    place: Any
    direction: Any
    rest: Any
    reflectance: Any


def reflected(
    surfaces: Surfaces, facet: Any, origin: Any, direction: Any, reach: Any, active: Any
) -> Reflection:
    """Return how a ray towards a light's image is mirrored by the facet that shows it."""
    mi, dr = backend().mi, backend().dr
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
    distance: Any
    inside: Any


def _crossing(surfaces: Surfaces, facet: Any, origin: Any, direction: Any, active: Any) -> _Crossing:
    mi, dr = backend().mi, backend().dr
    normal = dr.gather(mi.Vector3f, surfaces.normal, facet, active)
    center = dr.gather(mi.Point3f, surfaces.center, facet, active)
    distance = dr.dot(center - origin, normal) / dr.dot(direction, normal)
    off = origin + direction * distance - center
    along_u = dr.dot(off, dr.gather(mi.Vector3f, surfaces.half_u, facet, active))
    along_v = dr.dot(off, dr.gather(mi.Vector3f, surfaces.half_v, facet, active))
    return _Crossing(distance, (dr.abs(along_u) <= 1.0) & (dr.abs(along_v) <= 1.0))


def _aim_at_sphere(lights: Lights, row: Any, place: Any, u: Any, v: Any, active: Any) -> tuple[Any, Any, Any]:
    mi, dr = backend().mi, backend().dr
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


def _aim_at_sun(lights: Lights, row: Any, u: Any, v: Any, active: Any) -> tuple[Any, Any, Any]:
    mi, dr = backend().mi, backend().dr
    whole = dr.gather(mi.Float, lights.versine, row, active)
    versine = whole * u
    axis = dr.gather(mi.Vector3f, lights.normal, row, active)
    direction = _around(axis, dr.safe_sqrt(versine * (2.0 - versine)), versine, v)
    return direction, mi.Float(1e15), dr.rcp(2.0 * dr.pi * whole)


def _around(axis: Any, sine: Any, versine: Any, turn: Any) -> Any:
    mi, dr = backend().mi, backend().dr
    sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * turn)
    return mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, 1.0 - versine))


def _aim_at_rectangle(
    lights: Lights, row: Any, place: Any, u: Any, v: Any, active: Any
) -> tuple[Any, Any, Any]:
    dr = backend().dr
    flat = _Rectangle(lights, row, place, active)
    to = flat.point(u, v)
    distance = dr.norm(to)
    direction = to / distance
    # Zero from behind: a density beyond all bounds.
    density = dr.select(dr.dot(direction, flat.normal) < 0.0, flat.density(direction), 1e30)
    return direction, distance, density


class _Rectangle:
    """A rectangle as seen from a place, sampled evenly over its solid angle (Ureña, Fajardo & King 2013)."""

    def __init__(self, lights: Lights, row: Any, place: Any, active: Any) -> None:
        mi, dr = backend().mi, backend().dr
        half_u = dr.gather(mi.Vector3f, lights.half_u, row, active)
        half_v = dr.gather(mi.Vector3f, lights.half_v, row, active)
        self.normal = dr.gather(mi.Vector3f, lights.normal, row, active)
        self.center = dr.gather(mi.Point3f, lights.center, row, active) - place
        width, height = dr.norm(half_u), dr.norm(half_v)
        self.across, self.up = half_u / width, half_v / height
        self.size = 4.0 * width * height
        self.width, self.height = width, height
        # The corners in the rectangle's own axes, seen from the place; its plane is at −depth.
        x, y = dr.dot(self.center, self.across), dr.dot(self.center, self.up)
        facing = dr.cross(self.across, self.up)
        z = dr.dot(self.center, facing)
        self.axis = dr.select(z > 0.0, -facing, facing)
        self.z = dr.minimum(-dr.abs(z), -1e-7)
        self.x0, self.x1 = x - width, x + width
        self.y0, self.y1 = y - height, y + height
        # The planes through the place and the four edges: their normals' part along the axis, whose products
        # are the cosines between them; the angles give the solid angle.
        n0, n1, n2, n3 = (
            offset * dr.rsqrt(self.z * self.z + offset * offset)
            for offset in (-self.y0, self.x1, self.y1, -self.x0)
        )
        angles = [dr.safe_acos(-one * other) for one, other in ((n0, n1), (n1, n2), (n2, n3), (n3, n0))]
        self.b0, self.b1 = n0, n2
        self.rest = 2.0 * dr.pi - angles[2] - angles[3]
        self.solid_angle = angles[0] + angles[1] - self.rest
        # As large as it can look, from its nearest point: right before a large lamp its middle may be far.
        beside_x, beside_y = dr.maximum(dr.abs(x) - width, 0.0), dr.maximum(dr.abs(y) - height, 0.0)
        nearest2 = beside_x * beside_x + beside_y * beside_y + self.z * self.z
        roughly = self.size * dr.abs(self.z) / dr.power(nearest2, 1.5)
        self.by_area = roughly < _SMALL_SR

    def density(self, direction: Any) -> Any:
        dr = backend().dr
        slope = dr.abs(dr.dot(direction, self.axis))
        distance = -self.z / dr.maximum(slope, 1e-9)
        by_area = distance * distance / (self.size * dr.maximum(slope, 1e-9))
        return dr.select(self.by_area, by_area, dr.rcp(self.solid_angle))

    def point(self, u: Any, v: Any) -> Any:
        """Return the offset from the place to a point drawn on the rectangle."""
        dr = backend().dr
        even = (
            self.center
            + self.across * (self.width * (2.0 * u - 1.0))
            + self.up * (self.height * (2.0 * v - 1.0))
        )
        turn = u * self.solid_angle + self.rest
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
