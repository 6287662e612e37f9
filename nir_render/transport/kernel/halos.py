"""Where fog shines: directions of paths, drawn into the bright fog around lights, on the device.

Seen from a place, fog that scatters a light's light shines about as 1/θ, θ being the angle off the light. A
path that only now and then goes there brings much at once; so some directions are drawn by that shine.
"""

from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.emitters import SUN
from nir_render.transport.kernel import connect
from nir_render.transport.kernel import draws as use
from nir_render.transport.kernel import fog as foggy
from nir_render.transport.kernel.scatter import weighs_all
from nir_render.transport.kernel.tables import World

_BRIGHTEST_PER_SR = 10.0  # how bright a halo counts, at most, in front of a path that turns


class Halos:
    """The shining fog around lights, as seen from a place.

    One light is drawn, by how bright its halo is. Of few lights the density of a direction counts all; of
    many, drawn by the guide, that one alone: an estimate weighted so is as right on average for each light.
    """

    def __init__(self, world: World, place: Any, heading: Any, turned: Any, u: Any, active: Any) -> None:
        """Draw a light with the number `u`; a path that turns in fog prefers those ahead of its `heading`."""
        assert world.fog is not None  # noqa: S101 (only in fog)
        self.fog, self.lights = world.fog, world.lights
        self.place, self.heading, self.turned, self.active = place, heading, turned, active
        self.total = None
        if weighs_all(world):
            self.row, _, self.total = use.drawn_by_weight(self.lights.count, self._weighed, u)
        else:
            cell = connect.cell_of(world.choice, place)
            self.row, _ = connect.choose(world.choice, world.lights, cell, u)

    def direction(self, u: Any, v: Any) -> Any:
        """Return a unit direction, drawn."""
        mi, dr = backend().mi, backend().dr
        sine, cosine = dr.sincos(foggy.drawn_angle(self.fog, self.fog.halo, u))
        sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * v)
        axis, _ = self._axis(self.row)
        return mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, cosine))

    def density(self, direction: Any) -> Any:
        """Return the density per sr with which `direction` draws a unit direction."""
        mi, dr = backend().mi, backend().dr
        if self.total is None:
            return self._density(self._axis(self.row)[0], direction)

        def more(k: Any, _sum: Any) -> Any:
            return k < self.lights.count

        def add(k: Any, density: Any) -> tuple[Any, Any]:
            return k + 1, density + self._weighed(k)[1] * self._density(self._axis(k)[0], direction)

        width = dr.width(direction)
        start = (dr.zeros(mi.UInt32, width), dr.zeros(mi.Float, width))
        return dr.while_loop(start, more, add)[1] / self.total

    def _weighed(self, row: Any) -> tuple[Any, Any]:
        """Return a light and how much of its halo a path brings on, roughly: never nothing."""
        mi, dr = backend().mi, backend().dr
        axis, distance = self._axis(row)
        spread = dr.gather(mi.Float, self.lights.spread, row, self.active)
        weight = dr.gather(mi.Float, self.lights.power, row, self.active)
        weight = weight * dr.exp(-self.fog.extinction * distance) / dr.maximum(distance, spread)
        turn = 0.5 * dr.squared_norm(axis - self.heading)
        ahead = foggy.phase(self.fog, turn) + dr.minimum(self._density(axis, self.heading), _BRIGHTEST_PER_SR)
        return row, dr.maximum(dr.select(self.turned, weight * ahead, weight), 1e-12)

    def _axis(self, row: Any) -> tuple[Any, Any]:
        """Return the direction of a light, and its distance; the sun counts as a metre away."""
        mi, dr = backend().mi, backend().dr
        to = dr.gather(mi.Point3f, self.lights.center, row, self.active) - self.place
        if self.lights.sun >= 0:
            sun = dr.gather(mi.UInt32, self.lights.kind, row, self.active) == SUN
            to = dr.select(sun, dr.gather(mi.Vector3f, self.lights.normal, row, self.active), to)
        distance = dr.maximum(dr.norm(to), 1e-9)
        return mi.Vector3f(to) / distance, distance

    def _density(self, axis: Any, direction: Any) -> Any:
        """Return the density per sr around one light: that of the angle θ off it over 2π sin θ."""
        dr = backend().dr
        across = dr.norm(dr.cross(direction, axis))
        angle = dr.atan2(across, dr.dot(direction, axis))
        return foggy.slope(self.fog, self.fog.halo, angle) / (2.0 * dr.pi * dr.maximum(across, 1e-7))
