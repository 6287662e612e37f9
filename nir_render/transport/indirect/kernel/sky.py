"""The sky on the device: how bright it is in a direction, and directions drawn by that.

Directions are drawn from cells of equal solid angle over the upper half of all directions, a cell by how
bright its middle is, evenly within; every cell has a share, so that none that shines is left out.
"""

from dataclasses import dataclass

import numpy as np

from nir_render.spectra.skies import CieSky
from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.types import Float, UInt, Vector

_HEIGHTS, _TURNS = 32, 128
_CELLS = _HEIGHTS * _TURNS
_EVEN_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class SkyTable:
    """A sky on the device; see `spectra.skies.CieSky`. `chance` of each cell, and the sums up to each."""

    a: Float
    b: Float
    c: Float
    d: Float
    e: Float
    unit: Float
    to_sun: Vector
    cumulative: Float
    chance: Float

    def relative(self, direction: Vector) -> Float:
        """Return the radiance in a direction over that of an even sky that brings as much to the ground."""
        cosine = direction.z
        sun_cosine = dr.clip(dr.dot(direction, self.to_sun), -1.0, 1.0)
        gradation = 1.0 + self.a * dr.exp(self.b / dr.maximum(cosine, 1e-6))
        scattered = 1.0 + self.c * (dr.exp(self.d * dr.acos(sun_cosine)) - dr.exp(0.5 * dr.pi * self.d))
        scattered = scattered + self.e * sun_cosine * sun_cosine
        return dr.select(cosine > 0.0, self.unit * gradation * scattered, 0.0)

    def aim(self, u: Float, v: Float) -> Vector:
        """Return a unit direction, drawn."""
        cell = dr.binary_search(0, _CELLS - 1, lambda k: dr.gather(mi.Float, self.cumulative, k) <= u)
        chance = dr.gather(mi.Float, self.chance, cell)
        before = dr.gather(mi.Float, self.cumulative, cell) - chance
        row = cell // _TURNS
        along = dr.clip((u - before) / chance, 0.0, 1.0)
        cosine = (mi.Float(row) + along) / _HEIGHTS
        sine = dr.safe_sqrt(1.0 - cosine * cosine)
        turn_sine, turn_cosine = dr.sincos(2.0 * dr.pi * (mi.Float(cell - row * _TURNS) + v) / _TURNS)
        return mi.Vector3f(sine * turn_cosine, sine * turn_sine, cosine)

    def density(self, direction: Vector) -> Float:
        """Return the density per sr with which `aim` draws a direction."""
        turn = dr.atan2(direction.y, direction.x)
        turn = dr.select(turn < 0.0, turn + 2.0 * dr.pi, turn) * (_TURNS / (2.0 * dr.pi))
        row = _whole(direction.z * _HEIGHTS, _HEIGHTS)
        chance = dr.gather(mi.Float, self.chance, row * _TURNS + _whole(turn, _TURNS))
        return dr.select(direction.z > 0.0, chance * (_CELLS / (2.0 * dr.pi)), 0.0)


def _whole(place: Float, count: int) -> UInt:
    """Return the number of a cell along an axis; 0 where the place is no number, as in lanes that rest."""
    return dr.minimum(mi.UInt32(dr.select(place > 0.0, dr.minimum(place, count), 0.0)), count - 1)


def upload_sky(sky: CieSky) -> SkyTable:
    """Bring a sky to the device."""
    cosine = (np.arange(_HEIGHTS) + 0.5) / _HEIGHTS
    turn = 2.0 * np.pi * (np.arange(_TURNS) + 0.5) / _TURNS
    sine = np.sqrt(1.0 - cosine**2)[:, None]
    directions = np.stack(
        np.broadcast_arrays(sine * np.cos(turn), sine * np.sin(turn), cosine[:, None]), axis=-1
    )
    bright = sky.relative(directions).ravel()
    share = (1.0 - _EVEN_SHARE) * bright / bright.sum() + _EVEN_SHARE / _CELLS
    cumulative = np.cumsum(share).astype(np.float32)
    cumulative[-1] = 1.0
    chance = np.diff(cumulative, prepend=np.float32(0.0)).astype(np.float32)
    return SkyTable(
        a=dr.opaque(mi.Float, sky.a),
        b=dr.opaque(mi.Float, sky.b),
        c=dr.opaque(mi.Float, sky.c),
        d=dr.opaque(mi.Float, sky.d),
        e=dr.opaque(mi.Float, sky.e),
        unit=dr.opaque(mi.Float, sky.unit),
        to_sun=mi.Vector3f(*(dr.opaque(mi.Float, value) for value in sky.to_sun)),
        cumulative=mi.Float(cumulative),
        chance=mi.Float(chance),
    )
