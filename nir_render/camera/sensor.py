"""The sensor: expected electrons to raw counts (EMVA 1288 release 4.0, linear model)."""

import math

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.sensor import Sensor

_READ_NOISE_MARGIN = 4.0


def read_out(
    expected_e: NDArray[np.float64], sensor: Sensor, random: np.random.Generator
) -> NDArray[np.uint16]:
    """Return raw counts, uint16, same shape.

    Photoelectrons are Poisson; the full well clips them; the read-out adds Gaussian noise, gain and black
    level; the ADC rounds and clips. EMVA 1288: μ_y = K μ_e + offset, σ_y² = K²(σ_d² + σ_e²) + 1/12 DN².
    """
    # Far beyond the well the draw makes no difference, but numpy's Poisson has a largest mean.
    photoelectrons = random.poisson(np.minimum(expected_e, 1e3 * sensor.full_well_e))
    electrons = np.minimum(photoelectrons, sensor.full_well_e)
    electrons = electrons + sensor.read_noise_e * random.standard_normal(expected_e.shape)
    return quantise(electrons, sensor)


def quantise(electrons: NDArray[np.float64], sensor: Sensor) -> NDArray[np.uint16]:
    """Return the counts of an ADC that rounds to the nearest count and clips at full scale."""
    counts_dn = np.rint(sensor.system_gain_dn_per_e * electrons + sensor.black_level_dn)
    return np.clip(counts_dn, 0, sensor.full_scale_dn).astype(np.uint16)


def saturation_dn(sensor: Sensor) -> int:
    """Return the count from which on a pixel may have been clipped, by its well or by the ADC.

    Read noise is added behind the well, so a clipped pixel can read a few noise widths below it.
    """
    clipped_e = sensor.full_well_e - _READ_NOISE_MARGIN * sensor.read_noise_e
    return min(
        sensor.full_scale_dn, math.floor(sensor.black_level_dn + sensor.system_gain_dn_per_e * clipped_e)
    )
