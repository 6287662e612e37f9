"""The sensor: expected electrons to raw counts (EMVA 1288 release 4.0, linear model, and beyond it).

Photoelectrons and dark current are Poisson, by each pixel's own response; what the well cannot hold spills or
clips; the read-out adds noise, the pixel's offset, gain and black level; the ADC rounds and clips:
μ_y = K μ_e + offset, σ_y² = K² (σ_d² + σ_e²) + 1/12 DN².
"""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.sensor.fixed_pattern import FixedPattern, fixed_pattern
from nir_render.camera.sensor.shot_noise import EXPANSION_MEAN, normal, poisson
from nir_render.camera.sensor.well import bloom_into, read_from_well
from nir_render.randomness import RandomKey
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.sensor import Sensor
from perception.compiled import compiled

Floats = NDArray[np.float32]

_READ_NOISE_MARGIN = 4.0
_BRIGHTEST_E = 1e30  # beyond any well, and far from the end of float32
# Drawn at once: small enough for a core's cache, large enough that workers do not wait for the interpreter.
_BLOCK_PIXELS = 131072


def read_out(
    expected_e: NDArray[np.float64] | Floats,
    camera: Camera,
    exposure_s: float,
    key: RandomKey,
    gain: float = 1.0,
    threads: int | None = None,
) -> NDArray[np.uint16]:
    """Return raw counts, uint16, same shape.

    Parameters
    ----------
    expected_e
        Mean photoelectrons of a pixel of mean response, shape (rows, columns).
    exposure_s
        How long dark current is collected.
    key
        Whose random numbers; its camera is also the serial number of a camera that has none.
    gain
        Factor on the system gain.
    threads
        How many work on it, by default one per processor. The bits do not depend on it.

    Raises
    ------
    ValueError
        The light has not the shape of the sensor.
    """
    sensor = camera.sensor
    rows, columns = expected_e.shape
    if (rows, columns) != (sensor.rows, sensor.columns):
        raise ValueError(
            f"light of {rows} x {columns} pixels for a sensor of {sensor.rows} x {sensor.columns}"
        )
    pattern = fixed_pattern(sensor, camera.serial or key.camera)
    height = max(_BLOCK_PIXELS // columns, 1)
    blocks = [slice(top, min(top + height, rows)) for top in range(0, rows, height)]
    charge_e = np.empty((rows, columns), dtype=np.float32)
    counts_dn = np.empty((rows, columns), dtype=np.uint16)

    def collect(number: int) -> None:
        part = blocks[number]
        charge_e[part] = _charge(expected_e[part], sensor, pattern, part, exposure_s, key, number)

    def digitise(number: int) -> None:
        part = blocks[number]
        counts_dn[part] = _digitised(charge_e[part], sensor, pattern, part, gain, key, number)

    def both(number: int) -> None:
        collect(number)
        digitise(number)

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        if sensor.blooming == 0.0:
            _all(pool, both, len(blocks))
        else:
            _all(pool, collect, len(blocks))
            bloom_into(charge_e, sensor.well_e, sensor.blooming)
            _all(pool, digitise, len(blocks))
    counts_dn.ravel()[pattern.stuck] = sensor.full_scale_dn
    return counts_dn


def _all(pool: ThreadPoolExecutor, work: Callable[[int], None], blocks: int) -> None:
    for _ in pool.map(work, range(blocks)):
        pass


def _charge(
    expected_e: NDArray[np.float64] | Floats,
    sensor: Sensor,
    pattern: FixedPattern,
    part: slice,
    exposure_s: float,
    key: RandomKey,
    block: int,
) -> Floats:
    """Return the electrons that light and heat release in the pixels of a block of rows."""
    mean = _mean_charge(
        expected_e.ravel(),
        _flat(pattern.response, part),
        _flat(pattern.hot_e_per_s, part),
        np.float32(sensor.dark_rate_e_per_s * exposure_s),
        np.float32(exposure_s),
    )
    some_large, some_small = mean.max(initial=0.0) >= EXPANSION_MEAN, mean.min(initial=0.0) < EXPANSION_MEAN
    large = key.words("shot", block, mean.size + mean.size % 2) if some_large else None
    small = key.words("few", block, mean.size) if some_small else None
    return poisson(mean, large, small).reshape(expected_e.shape)


def _flat(pattern: Floats | None, part: slice) -> Floats:
    """Return a part of a pattern in one row; an empty one where all pixels are alike."""
    return np.empty(0, dtype=np.float32) if pattern is None else pattern[part].ravel()


@compiled
def _mean_charge(
    expected_e: NDArray[Any],
    response: Floats,
    hot_e_per_s: Floats,
    dark_e: np.float32,
    exposure_s: np.float32,
) -> Floats:
    """Return the electrons of pixels of a response, their own dark current added, shape (n,)."""
    mean_e = np.empty(len(expected_e), dtype=np.float32)
    for pixel in range(len(expected_e)):
        released_e = np.float32(min(expected_e[pixel], _BRIGHTEST_E))
        if len(response) > 0:
            released_e *= response[pixel]
        released_e += dark_e
        if len(hot_e_per_s) > 0:
            released_e += hot_e_per_s[pixel] * exposure_s
        mean_e[pixel] = released_e
    return mean_e


def _digitised(
    charge_e: Floats,
    sensor: Sensor,
    pattern: FixedPattern,
    part: slice,
    gain: float,
    key: RandomKey,
    block: int,
) -> NDArray[np.uint16]:
    """Return the counts of the charge of a block of rows."""
    signal_e = read_from_well(charge_e, sensor).ravel()
    noisy = sensor.read_noise_e > 0.0
    words = key.words("read", block, signal_e.size + signal_e.size % 2) if noisy else np.empty(0, np.uint32)
    return _converted(
        signal_e,
        normal(words),
        np.float32(sensor.read_noise_e),
        _flat(pattern.offset_e, part),
        np.float32(sensor.system_gain_dn_per_e * gain),
        np.float32(sensor.black_level_dn),
        np.float32(sensor.full_scale_dn),
    ).reshape(charge_e.shape)


@compiled
def _converted(
    signal_e: Floats,
    noise: Floats,
    read_noise_e: np.float32,
    offset_e: Floats,
    gain_dn_per_e: np.float32,
    black_level_dn: np.float32,
    full_scale_dn: np.float32,
) -> NDArray[np.uint16]:
    """Return the counts of what is read of the wells, with noise and offsets if there are any, shape (n,)."""
    counts_dn = np.empty(len(signal_e), dtype=np.uint16)
    for pixel in range(len(signal_e)):
        read_e = signal_e[pixel]
        if len(noise) > 0:
            read_e += noise[pixel] * read_noise_e
        if len(offset_e) > 0:
            read_e += offset_e[pixel]
        read_dn = np.rint(read_e * gain_dn_per_e + black_level_dn)
        counts_dn[pixel] = np.uint16(min(max(read_dn, np.float32(0.0)), full_scale_dn))
    return counts_dn


def quantise(electrons: NDArray[np.float64], sensor: Sensor) -> NDArray[np.uint16]:
    """Return the counts of an ADC that rounds to the nearest count and clips at full scale."""
    counts_dn = np.rint(sensor.system_gain_dn_per_e * electrons + sensor.black_level_dn)
    return np.clip(counts_dn, 0, sensor.full_scale_dn).astype(np.uint16)


def saturation_dn(sensor: Sensor, gain: float = 1.0) -> int:
    """Return the count from which on a pixel may have been clipped, by its well or by the ADC.

    Read noise and offsets are added behind the well, so a clipped pixel can read a few widths below it.
    """
    margin_e = _READ_NOISE_MARGIN * math.hypot(sensor.read_noise_e, sensor.dsnu.total_e)
    clipped_dn = sensor.system_gain_dn_per_e * gain * (sensor.read_e(sensor.well_e) - margin_e)
    return min(sensor.full_scale_dn, math.floor(sensor.black_level_dn + clipped_dn))


def dark_variance_e2(sensor: Sensor, exposure_s: float) -> float:
    """Return the temporal variance of a dark pixel before the ADC: read noise and dark current's own."""
    return sensor.read_noise_e**2 + sensor.dark_rate_e_per_s * exposure_s
