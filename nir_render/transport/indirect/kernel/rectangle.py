"""A rectangle as seen from a place, on the device, sampled evenly over the solid angle that it fills.

After Ureña, Fajardo & King, An Area-Preserving Parametrization for Spherical Rectangles, Computer Graphics
Forum 32 (4), 2013, listings SphQuadInit and SphQuadSample. In the paper's local reference system R the place
is the origin and the rectangle lies in the plane z = z₀ < 0, between x₀ and x₁, y₀ and y₁; γᵢ are the inner
angles of its image on the unit sphere. `b0`, `b1` and `k` are the paper's constants, `solid_angle` its S.
"""

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.tables import Lights
from nir_render.transport.indirect.kernel.types import Float, Mask, Point, UInt, Vector

# A rectangle that fills less than this, in sr, is sampled by area: its solid angle loses digits, and far away
# the two are nearly the same.
_SMALL_SR = 0.02


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


def aim_at_rectangle(
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
