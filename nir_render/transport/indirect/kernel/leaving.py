"""How a path leaves a vertex, on a surface or in fog, on the device."""

from dataclasses import dataclass
from typing import Any

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel import draws
from nir_render.transport.indirect.kernel.fog import draw_scattering, phase_function
from nir_render.transport.indirect.kernel.fog_scatter import FogScattering
from nir_render.transport.indirect.kernel.halos import Halos
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.kernel.types import (
    Float,
    Interaction,
    Mask,
    PathState,
    Point,
    Random,
    Vector,
)

# Shares of directions that go into the halo of a light, from surfaces in fog and from fog itself. Each turn
# that misses the halo weighs by one over what is left: near 1 it must be for the sun, whose paths turn often.
_FROM_SURFACE, _FROM_FOG, _FROM_FOG_TO_SUN = 0.25, 0.5, 0.15
# So many times more often than light do paths turn in fog: what comes of it varies more than what comes from
# surfaces.
_TURNS = 3.0


@dataclass(frozen=True, eq=False)
class NextDirection:
    """How a path goes on.

    From a place in a unit direction, which the surface draws with a density per sr (0 in fog); the weight of
    it; the share of light that goes on at such a vertex, however it was drawn; whether by a smooth part of
    the surface; whether by turning in fog.
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
    chance = dr.select(scattering.turns, chance, 0.0)
    turned = number(draws.FLIGHT) < chance

    rough = surface & ~turned & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    from_fog = _share_from_fog(scene, state)
    share = dr.select(turned, from_fog, dr.select(rough, _FROM_SURFACE, 0.0))
    in_halo = number(draws.HALO) < share
    place = dr.select(turned, scattering.place, sampled.place)
    halos = Halos(scene, place, state.direction, turned, state.tier, number(draws.HALO_LIGHT), turned | rough)
    u, v = number(draws.HALO_U), number(draws.HALO_V)
    plain = dr.select(turned, draw_scattering(fog, state.direction, u, v), sampled.direction)
    direction = dr.select(in_halo, halos.direction(u, v), plain)
    halo = halos.density(direction)

    phase = phase_function(fog, 0.5 * dr.squared_norm(direction - state.direction))
    turned_weight = scattering.weight * phase / dr.lerp(phase, halo, from_fog)

    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direction), in_halo & rough)
    density = dr.select(in_halo, density, sampled.density)
    smooth = sampled.smooth & ~in_halo
    weight = dr.select(in_halo, value[0], sampled.weight * sampled.density) / dr.maximum(
        dr.lerp(density, halo, _FROM_SURFACE), 1e-30
    )
    weight = dr.select(
        rough, dr.select(smooth, sampled.weight / (1.0 - _FROM_SURFACE), weight), sampled.weight
    )
    left = dr.select(in_halo, value[0] / dr.maximum(density, 1e-30), sampled.left)
    stays = (1.0 - lost) / (1.0 - chance)
    return NextDirection(
        place=place,
        direction=direction,
        density=dr.select(turned, 0.0, density),
        weight=dr.select(turned, turned_weight / chance, weight * stays),
        left=dr.select(turned, fog.albedo * lost / chance, left * stays),
        smooth=smooth & ~turned,
        turned=turned,
    )


def _share_from_fog(scene: DeviceScene, state: PathState) -> Float:
    """Return the share of directions from fog that go into halos, by whether the path serves the sun."""
    if scene.lights.sun < 0:
        return mi.Float(_FROM_FOG)
    if state.tier is None:
        return mi.Float(_FROM_FOG_TO_SUN)
    of_sun = dr.gather(mi.UInt32, scene.lights.tier, mi.UInt32(scene.lights.sun))
    return dr.select(state.tier == of_sun, _FROM_FOG_TO_SUN, _FROM_FOG)
