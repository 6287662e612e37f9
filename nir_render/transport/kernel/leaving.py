"""How a path leaves a vertex, on a surface or in fog, on the device."""

from dataclasses import dataclass
from typing import Any

from nir_render.transport.backend import backend
from nir_render.transport.kernel import draws as use
from nir_render.transport.kernel import fog as foggy
from nir_render.transport.kernel.halos import Halos
from nir_render.transport.kernel.scatter import Scattered
from nir_render.transport.kernel.tables import World

# Shares of directions that go into the halo of a light, from surfaces in fog and from fog itself.
_FROM_SURFACE, _FROM_FOG = 0.25, 0.5
# So many times more often than light do paths turn in fog: what comes of it varies more than what comes from
# surfaces.
_TURNS = 3.0


@dataclass(frozen=True, eq=False)
class Leaving:
    """How a path goes on.

    From a place in a unit direction, which the surface draws with a density per sr (0 in fog); the weight of
    it; the share of light that goes on at such a vertex, however it was drawn; whether by a smooth part of
    the surface; whether by turning in fog.
    """

    place: Any
    direction: Any
    density: Any
    weight: Any
    left: Any
    smooth: Any
    turned: Any


def off_surface(si: Any, sample: Any, weight: Any) -> Leaving:
    """Return how a path leaves a surface, from a sample of Mitsuba's."""
    mi = backend().mi
    smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    direction = si.to_world(sample.wo)
    return Leaving(mi.Point3f(si.p), direction, mi.Float(sample.pdf), weight, weight, smooth, mi.Bool(False))


def in_fog(
    world: World,
    state: Any,
    si: Any,
    bsdf: Any,
    mine: Leaving,
    surface: Any,
    scattered: Scattered,
    number: Any,
) -> Leaving:
    """Return how a path goes on after a stretch of fog: turned in it, or from the surface behind it.

    It turns where light was scattered into it: near lights; and always where the surface lets nothing go on.
    Some of the directions go into the halo of a light; all weigh by the density of the mixture.

    Parameters
    ----------
    mine
        How it would leave the surface.
    surface
        Whether it could.
    scattered
        What fog has scattered on the stretch; where that is nothing, paths do not turn.
    """
    mi, dr = backend().mi, backend().dr
    fog = world.fog
    assert fog is not None  # noqa: S101 (only called in fog)
    lost = scattered.lost
    often = dr.select(surface, _TURNS * lost / (1.0 + (_TURNS - 1.0) * lost), 1.0)
    often = dr.select(scattered.turns, often, 0.0)
    turned = number(use.FLIGHT) < often

    rough = surface & ~turned & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    share = dr.select(turned, _FROM_FOG, dr.select(rough, _FROM_SURFACE, 0.0))
    into = number(use.HALO) < share
    place = dr.select(turned, scattered.place, mine.place)
    halos = Halos(world, place, state.direction, turned, number(use.HALO_LIGHT), turned | rough)
    u, v = number(use.HALO_U), number(use.HALO_V)
    plain = dr.select(turned, foggy.turned(fog, state.direction, u, v), mine.direction)
    direction = dr.select(into, halos.direction(u, v), plain)
    halo = halos.density(direction)

    phase = foggy.phase(fog, 0.5 * dr.squared_norm(direction - state.direction))
    turned_weight = scattered.weight * phase / dr.lerp(phase, halo, _FROM_FOG)

    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(direction), into & rough)
    density = dr.select(into, density, mine.density)
    smooth = mine.smooth & ~into
    weight = dr.select(into, value[0], mine.weight * mine.density) / dr.maximum(
        dr.lerp(density, halo, _FROM_SURFACE), 1e-30
    )
    weight = dr.select(rough, dr.select(smooth, mine.weight / (1.0 - _FROM_SURFACE), weight), mine.weight)
    left = dr.select(into, value[0] / dr.maximum(density, 1e-30), mine.left)
    stays = (1.0 - lost) / (1.0 - often)
    return Leaving(
        place=place,
        direction=direction,
        density=dr.select(turned, 0.0, density),
        weight=dr.select(turned, turned_weight / often, weight * stays),
        left=dr.select(turned, fog.albedo * lost / often, left * stays),
        smooth=smooth & ~turned,
        turned=turned,
    )
