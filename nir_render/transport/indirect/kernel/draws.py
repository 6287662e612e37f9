"""Random numbers that depend on nothing but their key: pixel, seed, sample, and what they are for.

Two rounds of an integer hash make each of them, so samples may be drawn in any order and on any number of
threads. The numbers of a path's first vertex are stratified over the samples of a batch, each apart (Latin
hypercube): the choice of a light and the place in the pixel then vary less between batches.
"""

from collections.abc import Callable
from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.types import Float, Mask, UInt

# What a number is for. A vertex has STEP of them; those of the camera come first.
PIXEL_U, PIXEL_V, CAMERA_DIMENSIONS = 0, 1, 2
TIER = 2**20  # beyond all vertices
LIGHT, LIGHT_U, LIGHT_V, LOBE, LOBE_U, LOBE_V, SURVIVAL = range(7)
FOG_LIGHT, FOG_PLACE, FOG_U, FOG_V, FLIGHT, HALO, HALO_LIGHT, HALO_U, HALO_V = range(7, 16)
WEAK, WEAK_U, WEAK_V = range(7, 10)  # in clear air, where fog needs none
FOG_CANDIDATES = 16  # two for each
STEP = 24


@dataclass(frozen=True, eq=False)
class Draws:
    """Random numbers of the lanes: two keys each, and how many samples make a batch, a power of two.

    That number is an array, so that another count is no other program.
    """

    key: UInt
    second_key: UInt
    samples: UInt

    def pixel(self, sample: UInt, dimension: int) -> Float:
        """Return a stratified number in [0, 1) for a sample's place in the pixel."""
        bits = self._bits(sample, mi.UInt32(dimension))
        return self._even(sample, mi.UInt32(dimension), _unit(bits))

    def tier(self, sample: UInt) -> Float:
        """Return a stratified number in [0, 1) for a sample's tier, the strata in their order.

        So lanes side by side serve the same tier most of the time, and loop over as many lights.
        """
        plain = _unit(self._bits(sample, mi.UInt32(TIER)))
        return dr.minimum((mi.Float(sample) + plain) / mi.Float(self.samples), _BELOW_ONE)

    def vertex(self, sample: UInt, depth: UInt, purpose: UInt) -> Float:
        """Return a number in [0, 1) for a vertex of a path, stratified for its first; `purpose` < STEP."""
        dimension = CAMERA_DIMENSIONS + depth * STEP + purpose
        bits = self._bits(sample, dimension)
        plain = _unit(bits)
        return dr.select(depth == 0, self._even(sample, dimension, plain), plain)

    def _even(self, sample: UInt, dimension: UInt, plain: Float) -> Float:
        """Return a number in the sample's own stratum; which that is a shuffle of each dimension says."""
        stratum = _shuffled(sample, self.samples, self._bits(mi.UInt32(0xFFFFFFFF), dimension))
        return dr.minimum((mi.Float(stratum) + plain) / mi.Float(self.samples), _BELOW_ONE)

    def _bits(self, sample: UInt, dimension: UInt) -> UInt:
        counter = sample * mi.UInt32(0x9E3779B9) ^ dimension * mi.UInt32(0x85EBCA6B)
        return _hash(_hash(counter ^ self.key) + self.second_key)


def lane_draws(pixel: UInt, batch: UInt, seed: int, samples: UInt) -> Draws:
    """Return the random numbers of lanes, keyed by pixel, batch and a seed of 64 bits."""
    first, second = mi.sample_tea_32(pixel, batch)
    low, high = (dr.opaque(mi.UInt32, (seed >> shift) & 0xFFFFFFFF) for shift in (0, 32))
    key, second_key = mi.sample_tea_32(first ^ low, second ^ high)
    return Draws(key, second_key, samples)


def draw_by_weight(
    count: UInt, weigh: Callable[[UInt], tuple[UInt, Float]], u: Float
) -> tuple[UInt, Float, Float]:
    """Return one of some candidates, drawn by weight, its weight, and the sum of all weights.

    Parameters
    ----------
    count
        How many candidates there are.
    weigh
        Returns the candidate of a number, and its weight, above 0 at least for one.
    u
        One number in [0, 1): it serves all the way, as what is left of it is even again after each choice.
    """

    def more(k: UInt, *_others: Float) -> Mask:
        return k < count

    def step(
        k: UInt, chosen: UInt, chosen_weight: Float, total: Float, u_left: Float
    ) -> tuple[UInt, UInt, Float, Float, Float]:
        candidate, weight = weigh(k)
        total = total + weight
        share = weight / dr.maximum(total, 1e-30)
        taken = u_left < share
        u_left = dr.select(
            taken, u_left / dr.maximum(share, 1e-30), (u_left - share) / dr.maximum(1.0 - share, 1e-9)
        )
        return (
            k + 1, dr.select(taken, candidate, chosen), dr.select(taken, weight, chosen_weight), total,
            dr.clip(u_left, 0.0, 1.0),
        )  # fmt: skip

    zero, nothing = dr.zeros(mi.UInt32, dr.width(u)), dr.zeros(mi.Float, dr.width(u))
    start = (zero, mi.UInt32(zero), nothing, mi.Float(nothing), mi.Float(u))
    _, chosen, chosen_weight, total, _ = dr.while_loop(start, more, step)
    return chosen, chosen_weight, total


def power_heuristic(density: Float, other_density: Float) -> Float:
    """Return the power heuristic's weight of the way whose density is `density`."""
    ratio = other_density / dr.maximum(density, 1e-30)
    return dr.select(density > 0.0, 1.0 / (1.0 + ratio * ratio), 0.0)


_BELOW_ONE = 1.0 - 2.0**-24


def _hash(bits: UInt) -> UInt:
    """Mix 32 bits; one to one, every input bit moves every output bit."""
    bits = (bits ^ (bits >> 16)) * mi.UInt32(0x7FEB352D)
    bits = (bits ^ (bits >> 15)) * mi.UInt32(0x846CA68B)
    return bits ^ (bits >> 16)


def _unit(bits: UInt) -> Float:
    return mi.Float(bits >> 8) * mi.Float(2.0**-24)


def _shuffled(index: UInt, count: UInt, key: UInt) -> UInt:
    """Return where a shuffle of 0 … count − 1, count a power of two, takes an index; one to one."""
    mask = count - 1
    half = dr.maximum((32 - dr.lzcnt(mask)) >> 1, 1)
    for turn in range(3):
        index = (index ^ (key >> (10 * turn))) & mask
        index = (index * ((key >> (10 * turn + 4)) | mi.UInt32(1))) & mask
        index = index ^ (index >> half)
    return index
