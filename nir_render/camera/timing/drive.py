"""How much an emitter sends within a stretch of time, exactly: means of its drive, in closed form."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.times.drives import FULL_DRIVE, BitString, Drive, Flicker, Packets, SquareWave
from nir_render.scene.emission import Emitter
from perception.messages.uart import encode

Array = NDArray[np.float64]


def drive_of(emitter: Emitter) -> Drive:
    """Return the drive of an emitter; sun and sky shine evenly."""
    return FULL_DRIVE if isinstance(emitter, Sun | Skylight) else emitter.drive


def mean_level(drive: Drive, start_s: ArrayLike, duration_s: ArrayLike) -> Array:
    """Return the mean level of a drive over stretches of time: from 0 to 1, and to 2 of what flickers.

    Edges lie where the floats say, to their rounding; a stretch without edges has its level to the bit.

    Parameters
    ----------
    start_s
        When the stretches begin, any shape; times before 0 are times too.
    duration_s
        How long they are, not negative; the mean over none at all is the level there.
    """
    start, duration = np.broadcast_arrays(np.asarray(start_s, float), np.asarray(duration_s, float))
    if drive.square is not None:
        return _of_square(drive.square, start, duration)
    if drive.flicker is not None:
        return _of_flicker(drive.flicker, start, duration)
    if drive.bits is not None:
        return np.clip(_of_bits(drive.bits, start, duration), 0.0, 1.0)
    if drive.packets is not None:
        return _of_packets(drive.packets, start, duration)
    assert drive.constant is not None  # the model admits no other form
    return np.full(start.shape, drive.constant)


def _of_square(square: SquareWave, start_s: Array, duration_s: Array) -> Array:
    """Return the mean over whole periods, and over the rest, which may meet two times of light."""
    _, begin = _whole_and_part((start_s - square.phase_s) * square.frequency_hz)
    length = duration_s * square.frequency_hz
    whole, rest = _whole_and_part(length)
    lit = np.clip(square.duty - begin, 0.0, rest) + np.clip(1.0 + square.duty - begin, 0.0, rest)
    lit -= np.clip(1.0 - begin, 0.0, rest)
    level = np.where(begin < square.duty, 1.0, 0.0)
    return np.divide(whole * square.duty + lit, length, out=level, where=length > 0.0)


def _of_flicker(flicker: Flicker, start_s: Array, duration_s: Array) -> Array:
    """Return the mean of a sine about 1: that at mid-stretch, weakened by sinc of the periods within."""
    rate_hz = 2.0 * flicker.mains_hz
    middle_s = start_s + 0.5 * duration_s - flicker.phase_s
    swing = np.sinc(rate_hz * duration_s) * np.sin(2.0 * np.pi * rate_hz * middle_s)
    return np.asarray(1.0 + flicker.modulation * swing)


def _of_bits(bits: BitString, start_s: Array, duration_s: Array) -> Array:
    """Return the mean: a part of the first bit, whole bits, a part of the last."""
    levels = np.array([float(bit) for bit in bits.pattern])
    sums = np.concatenate([[0.0], np.cumsum(levels)])
    count = len(levels)
    end = np.inf if bits.repeat == "forever" else float(count * bits.repeat)

    def level(number: Array) -> Array:
        sent = levels[np.mod(number, count).astype(np.int64)]
        return np.where((number >= 0.0) & (number < end), sent, bits.idle)

    def total(number: Array) -> Array:
        """Return the sum of the levels from bit 0 on up to, and without, the bit of a number."""
        within = np.clip(number, 0.0, end)
        repeats, number_in = np.divmod(within, count)
        return np.asarray(
            repeats * sums[-1] + sums[number_in.astype(np.int64)] + bits.idle * (number - within)
        )

    first, begin = _whole_and_part((start_s - bits.start_s) * bits.rate_hz)
    length = duration_s * bits.rate_hz
    further, rest = _whole_and_part(begin + length)
    summed = level(first) * (1.0 - begin) + total(first + further) - total(first + 1.0)
    summed += level(first + further) * rest
    return np.divide(summed, length, out=level(first), where=further > 0.0)


def _of_packets(packets: Packets, start_s: Array, duration_s: Array) -> Array:
    """Return the mean: what is left of the first bit, whole bits, a part of the last; lit between packets."""
    edges_s, levels = [], [np.array([1.0])]
    for at_s, word in packets.starts_s:
        bits = encode(word)
        edges_s.append(at_s + packets.bit_s * np.arange(len(bits) + 1))
        levels += [bits.astype(float), np.array([1.0])]
    edge_s, level = np.concatenate(edges_s), np.concatenate(levels)
    sums_s = np.concatenate([[0.0], np.cumsum(level[1:-1] * np.diff(edge_s))])  # of light, up to each edge
    end_s = start_s + duration_s
    first = np.searchsorted(edge_s, start_s, side="right")
    last = np.maximum(np.searchsorted(edge_s, end_s, side="left"), first)
    within = first == last
    final = np.maximum(last - 1, 0)
    opened = np.minimum(first, len(edge_s) - 1)
    lit_s = level[first] * (edge_s[opened] - start_s) + (sums_s[final] - sums_s[opened])
    lit_s += level[last] * (end_s - edge_s[final])
    mean = np.divide(lit_s, duration_s, out=np.asarray(level[first]), where=~within)
    return np.asarray(np.clip(mean, 0.0, 1.0))


def _whole_and_part(number: Array) -> tuple[Array, Array]:
    """Return whole numbers, rounded down, and what is left, from 0 to below 1."""
    whole = np.floor(number)
    part = number - whole
    carry = part >= 1.0  # a number just below 0 rounds up to 1
    return whole + carry, np.where(carry, 0.0, part)
