"""Adaptive exposure: the next frame's exposure from the brightest pixel of the last one.

The paper's camera adapts "to prevent pixel saturation from proximal robots or signal loss at long ranges".
"""

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.sensor import saturation_dn
from nir_render.scene.exposure import AutoExposure
from nir_render.scene.sensor import Sensor

_LARGEST_STEP = 4.0


def next_exposure_s(
    control: AutoExposure, sensor: Sensor, data_dn: NDArray[np.uint16], exposure_s: float
) -> float:
    """Return the exposure that would bring the brightest pixel of a frame to the target.

    Parameters
    ----------
    control
        Target level and limits.
    sensor
        Where the frame's counts begin and clip.
    data_dn
        The last frame's counts, shape (rows, columns).
    exposure_s
        Its exposure.

    Returns
    -------
    Seconds, within the limits. One step is at most a factor of 4; a clipped pixel tells only that the
    exposure was too long, and takes that whole step.
    """
    range_dn = saturation_dn(sensor) - sensor.black_level_dn
    level = (float(data_dn.max()) - sensor.black_level_dn) / range_dn
    step = control.target / max(level, control.target / _LARGEST_STEP)
    if level >= 1.0:
        step = 1.0 / _LARGEST_STEP
    return float(np.clip(exposure_s * step, control.shortest_s, control.longest_s))
