"""Where fog shines: directions of paths, drawn into the bright fog around lights, on the device.

Seen from a place, fog that scatters a light's light shines about as 1/θ, θ being the angle off the light. A
path that only now and then goes there brings much at once; so some directions are drawn by that shine.
"""

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import connect, draws
from nir_render.transport.indirect.kernel.fog import draw_angle, phase_function, table_slope
from nir_render.transport.indirect.kernel.fog_scatter import weighs_all
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.kernel.types import Float, Mask, Point, UInt, Vector
from nir_render.transport.world.emitters import SKY, SUN

_BRIGHTEST_PER_SR = 10.0  # how bright a halo counts, at most, in front of a path that turns


class Halos:
    """The shining fog around lights, as seen from a place.

    One light is drawn, by how bright its halo is. Of few lights the density of a direction counts all; of
    many, drawn by the guide, that one alone: an estimate weighted so is as right on average for each light.
    """

    def __init__(
        self,
        scene: DeviceScene,
        place: Point,
        heading: Vector,
        turned: Mask,
        tier: UInt | None,
        u: Float,
        active: Mask,
    ) -> None:
        """Draw a light, of a tier where there are several, with the number `u`.

        A path that turns in fog prefers those ahead of its `heading`.
        """
        assert scene.fog is not None  # only in fog
        self.fog, self.lights = scene.fog, scene.lights
        self.place, self.heading, self.turned, self.active = place, heading, turned, active
        self.tier, self.total = tier, None
        if weighs_all(scene):
            self.row, _, self.total = draws.draw_by_weight(self.lights.count, self._weigh, u)
        else:
            cell = connect.guide_cell(scene.choice, place, tier)
            self.row, _ = connect.choose_light(scene.choice, scene.lights, cell, u)

    def direction(self, u: Float, v: Float) -> Vector:
        """Return a unit direction, drawn."""
        sine, cosine = dr.sincos(draw_angle(self.fog, self.fog.halo, u))
        sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * v)
        axis, _ = self._axis(self.row)
        return mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, cosine))

    def density(self, direction: Vector) -> Float:
        """Return the density per sr with which `direction` draws a unit direction."""
        if self.total is None:
            return self._density(self._axis(self.row)[0], direction)

        def more(k: UInt, _sum: Float) -> Mask:
            return k < self.lights.count

        def add(k: UInt, density: Float) -> tuple[UInt, Float]:
            return k + 1, density + self._weigh(k)[1] * self._density(self._axis(k)[0], direction)

        width = dr.width(direction)
        start = (dr.zeros(mi.UInt32, width), dr.zeros(mi.Float, width))
        return dr.while_loop(start, more, add)[1] / self.total

    def _weigh(self, row: UInt) -> tuple[UInt, Float]:
        """Return a light and how much of its halo a path brings on, roughly: never nothing."""
        axis, distance = self._axis(row)
        spread = dr.gather(mi.Float, self.lights.spread, row, self.active)
        weight = dr.gather(mi.Float, self.lights.power, row, self.active)
        weight = weight * dr.exp(-self.fog.extinction * distance) / dr.maximum(distance, spread)
        if self.lights.sky >= 0:  # it has no halo
            kind = dr.gather(mi.UInt32, self.lights.kind, row, self.active)
            weight = dr.select(kind == SKY, 0.0, weight)
        turn = 0.5 * dr.squared_norm(axis - self.heading)
        ahead = phase_function(self.fog, turn) + dr.minimum(
            self._density(axis, self.heading), _BRIGHTEST_PER_SR
        )
        weight = dr.maximum(dr.select(self.turned, weight * ahead, weight), 1e-12)
        return row, connect.of_tier(self.lights, row, self.tier, weight)

    def _axis(self, row: UInt) -> tuple[Vector, Float]:
        """Return the direction of a light, and its distance; the sun counts as a metre away."""
        to = dr.gather(mi.Point3f, self.lights.center, row, self.active) - self.place
        if self.lights.sun >= 0:
            sun = dr.gather(mi.UInt32, self.lights.kind, row, self.active) == SUN
            to = dr.select(sun, dr.gather(mi.Vector3f, self.lights.normal, row, self.active), to)
        distance = dr.maximum(dr.norm(to), 1e-9)
        return mi.Vector3f(to) / distance, distance

    def _density(self, axis: Vector, direction: Vector) -> Float:
        """Return the density per sr around one light: that of the angle θ off it over 2π sin θ."""
        across = dr.norm(dr.cross(direction, axis))
        angle = dr.atan2(across, dr.dot(direction, axis))
        return table_slope(self.fog, self.fog.halo, angle) / (2.0 * dr.pi * dr.maximum(across, 1e-7))
