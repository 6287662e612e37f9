"""How a path leaves a vertex, on a surface or in fog, on the device.

Seen from a place, fog that scatters a light's light shines about as 1/θ, θ being the angle off the light, and
as the phase function about the sun. A path that only now and then goes there brings much at once; so some
directions are drawn by that shine.
"""

from dataclasses import dataclass
from typing import Any

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import draws
from nir_render.transport.indirect.kernel.aim import choose_light, guide_cell
from nir_render.transport.indirect.kernel.fog import (
    draw_angle,
    draw_scattering,
    phase_function,
    table_slope,
    versine,
)
from nir_render.transport.indirect.kernel.fog_scatter import TURNED, FogScattering, towards_lights, weighs_all
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.kernel.types import (
    Float,
    Interaction,
    Mask,
    PathState,
    Point,
    Random,
    UInt,
    Vector,
)
from nir_render.transport.world.emitters import SKY, SUN

# Shares of directions that go into the halo of a light, from surfaces in fog and from fog itself. Each turn
# that misses the halo weighs by one over what is left: near 1 it must be, as paths turn often.
_FROM_SURFACE, _FROM_FOG = 0.5, 0.15
# Where the sun shines: on all stretches so much, and up to so much of a path that heads for the sun, as far
# as the phase function there exceeds so much.
_FROM_FOG_IN_SUN, _INTO_SUN, _AHEAD_PER_SR = 0.07, 0.5, 3.0
# So many times more often than light do paths turn in fog: what comes of it varies more than what comes from
# surfaces.
_TURNS = 1.5
_BRIGHTEST_PER_SR = 10.0  # how bright a halo counts, at most, in front of a path that turns


@dataclass(frozen=True, eq=False)
class NextDirection:
    """How a path goes on.

    From a place in a unit direction, which the surface, or fog by itself, draws with a density per sr; the
    weight of it; the share of light that goes on at such a vertex, however it was drawn; whether by a smooth
    part of the surface; whether by turning in fog.
    """

    place: Point
    direction: Vector
    density: Float
    weight: Float
    left: Float
    smooth: Mask
    turned: Mask


def leave_surface(si: Interaction, sample: Any, weight: Float) -> NextDirection:
    """Return how a path leaves a surface, from a sample of Mitsuba's."""
    smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    direction = si.to_world(sample.wo)
    return NextDirection(
        mi.Point3f(si.p), direction, mi.Float(sample.pdf), weight, weight, smooth, mi.Bool(False)
    )


def leave_in_fog(
    scene: DeviceScene,
    state: PathState,
    si: Interaction,
    bsdf: Any,
    sampled: NextDirection,
    surface: Mask,
    scattering: FogScattering,
    number: Random,
) -> NextDirection:
    """Return how a path goes on after a stretch of fog: turned in it, or from the surface behind it.

    It turns where light was scattered into it: near lights; and always where the surface lets nothing go on.
    Some of the directions go into the halo of a light; all weigh by the density of the mixture.

    Parameters
    ----------
    sampled
        How it would leave the surface.
    surface
        Whether it could.
    scattering
        What fog has scattered on the stretch; where that is nothing, paths do not turn.
    """
    fog = scene.fog
    assert fog is not None  # only called in fog
    lost = scattering.lost
    chance = dr.select(surface, _TURNS * lost / (1.0 + (_TURNS - 1.0) * lost), 1.0)
    chance = dr.select(scattering.may_turn, chance, 0.0)
    turned = number(draws.FLIGHT) < chance

    rough = surface & ~turned & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    from_fog, from_surface = _shares_into_halos(scene, state)
    share = dr.select(turned, from_fog, dr.select(rough, from_surface, 0.0))
    in_halo = number(draws.HALO) < share
    place = dr.select(turned, scattering.place, sampled.place)
    light = number(draws.HALO_LIGHT)
    halos = _Halos(scene, place, state.direction, turned, state.tier, light, turned | rough)
    u, v = number(draws.HALO_U), number(draws.HALO_V)
    plain = dr.select(turned, draw_scattering(fog, state.direction, u, v), sampled.direction)
    direction = dr.select(in_halo, halos.direction(u, v), plain)
    halo = halos.density(direction)

    phase = phase_function(fog, versine(state.direction, direction))
    turned_weight = scattering.weight * phase / dr.lerp(phase, halo, from_fog)

    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direction), in_halo & rough)
    density = dr.select(in_halo, density, sampled.density)
    smooth = sampled.smooth & ~in_halo
    weight = dr.select(in_halo, value[0], sampled.weight * sampled.density) / dr.maximum(
        dr.lerp(density, halo, from_surface), 1e-30
    )
    weight = dr.select(
        rough, dr.select(smooth, sampled.weight / (1.0 - from_surface), weight), sampled.weight
    )
    left = dr.select(in_halo, value[0] / dr.maximum(density, 1e-30), sampled.left)
    stays = (1.0 - lost) / (1.0 - chance)
    return NextDirection(
        place=place,
        direction=direction,
        density=dr.select(turned, TURNED * phase, density),
        weight=dr.select(turned, turned_weight / chance, weight * stays),
        left=dr.select(turned, fog.albedo * lost / chance, left * stays),
        smooth=smooth & ~turned,
        turned=turned,
    )


def _shares_into_halos(scene: DeviceScene, state: PathState) -> tuple[Float, Float]:
    """Return the shares of directions from fog and from surfaces that go into halos: 0 for the sky alone."""
    share = towards_lights(state)
    lights, shares = scene.lights, (_FROM_FOG * share, _FROM_SURFACE * share)
    if lights.sun >= 0:
        shares = _share_into_sun(scene, state, shares[0]), shares[1]
    if not lights.sky_alone:
        return shares
    if state.tier is None:
        return mi.Float(0.0), mi.Float(0.0)
    serves = state.tier == dr.gather(mi.UInt32, lights.tier, mi.UInt32(lights.sky))
    from_fog, from_surface = (dr.select(serves, 0.0, share) for share in shares)
    return from_fog, from_surface


def _share_into_sun(scene: DeviceScene, state: PathState, else_share: Float) -> Float:
    """Return the share of directions from fog that go into halos, where the sun is among the lights.

    Droplets turn light by little, and so comes most of what is near the sun after several turns; what the
    phase function draws next brings much where it comes nearer to the sun, and that is seldom.
    """
    fog, lights = scene.fog, scene.lights
    assert fog is not None  # only in fog
    ahead = phase_function(
        fog, versine(state.direction, dr.gather(mi.Vector3f, lights.normal, mi.UInt32(lights.sun)))
    )
    share = dr.maximum(_FROM_FOG_IN_SUN, _INTO_SUN * ahead / (ahead + _AHEAD_PER_SR))
    if state.tier is None:
        return mi.Float(share)
    serves = state.tier == dr.gather(mi.UInt32, lights.tier, mi.UInt32(lights.sun))
    return mi.Float(dr.select(serves, share, else_share))


class _Halos:
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
            self.first, self.count = self.lights.of_tier(tier, active)
            self.row, _, self.total = draws.draw_by_weight(self.count, self._weighed, u)
        else:
            cell = guide_cell(scene.choice, place, tier)
            self.row, _ = choose_light(scene.choice, scene.lights, cell, u)

    def direction(self, u: Float, v: Float) -> Vector:
        """Return a unit direction, drawn."""
        sine, cosine = dr.sincos(draw_angle(self.fog, self.fog.halo, u))
        sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * v)
        axis, _ = self._axis(self.row)
        of_halo = mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, cosine))
        if self.lights.sun < 0:
            return mi.Vector3f(of_halo)
        return mi.Vector3f(dr.select(self._is_sun(self.row), draw_scattering(self.fog, axis, u, v), of_halo))

    def density(self, direction: Vector) -> Float:
        """Return the density per sr with which `direction` draws a unit direction."""
        if self.total is None:
            return self._density(self.row, self._axis(self.row)[0], direction)

        def more(k: UInt, _sum: Float) -> Mask:
            return k < self.count

        def add(k: UInt, density: Float) -> tuple[UInt, Float]:
            row, weight = self._weighed(k)
            return k + 1, density + weight * self._density(row, self._axis(row)[0], direction)

        width = dr.width(direction)
        start = (dr.zeros(mi.UInt32, width), dr.zeros(mi.Float, width))
        return dr.while_loop(start, more, add)[1] / self.total

    def _weighed(self, k: UInt) -> tuple[UInt, Float]:
        """Return a light of the tier, and how much of its halo a path brings on, roughly: never nothing."""
        row = self.lights.row_of_tier(self.tier, self.first + k, self.active)
        axis, distance = self._axis(row)
        spread = dr.gather(mi.Float, self.lights.spread, row, self.active)
        weight = dr.gather(mi.Float, self.lights.power, row, self.active)
        weight = weight * dr.exp(-self.fog.typical * distance) / dr.maximum(distance, spread)
        if self.lights.sky >= 0:  # it has no halo
            kind = dr.gather(mi.UInt32, self.lights.kind, row, self.active)
            weight = dr.select(kind == SKY, 0.0, weight)
        ahead = phase_function(self.fog, versine(self.heading, axis)) + dr.minimum(
            self._density(row, axis, self.heading), _BRIGHTEST_PER_SR
        )
        return row, dr.maximum(dr.select(self.turned, weight * ahead, weight), 1e-12)

    def _axis(self, row: UInt) -> tuple[Vector, Float]:
        """Return the direction of a light, and its distance; the sun counts as a metre away."""
        to = dr.gather(mi.Point3f, self.lights.center, row, self.active) - self.place
        if self.lights.sun >= 0:
            to = dr.select(
                self._is_sun(row), dr.gather(mi.Vector3f, self.lights.normal, row, self.active), to
            )
        distance = dr.maximum(dr.norm(to), 1e-9)
        return mi.Vector3f(to) / distance, distance

    def _density(self, row: UInt, axis: Vector, direction: Vector) -> Float:
        """Return the density per sr around one light: that of the angle θ off it over 2π sin θ.

        What the sun has around it comes from far: it shines as the phase function does.
        """
        across = dr.norm(dr.cross(direction, axis))
        angle = dr.atan2(across, dr.dot(direction, axis))
        density = table_slope(self.fog, self.fog.halo, angle) / (2.0 * dr.pi * dr.maximum(across, 1e-7))
        if self.lights.sun < 0:
            return density
        return dr.select(self._is_sun(row), phase_function(self.fog, versine(axis, direction)), density)

    def _is_sun(self, row: UInt) -> Mask:
        return dr.gather(mi.UInt32, self.lights.kind, row, self.active) == SUN
