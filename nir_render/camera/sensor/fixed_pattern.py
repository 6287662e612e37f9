"""What is fixed about the pixels of one camera: offsets, responses, bad pixels; all by its serial number."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.randomness import generator
from nir_render.scene.documents.sensor import Sensor

Floats = NDArray[np.float32]

_CAMERAS_KEPT = 16


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """The pixels of one camera, maps of shape (rows, columns); None where all pixels are alike.

    Attributes
    ----------
    response
        Photo response relative to the mean (PRNU), 0 of dead pixels.
    offset_e
        Dark signal beside the mean (DSNU), in electrons.
    hot_e_per_s
        Dark current beside the mean, in electrons per second at the sensor's temperature.
    stuck
        Numbers of the pixels, row by row, that always read full scale, shape (n,).
    """

    response: Floats | None
    offset_e: Floats | None
    hot_e_per_s: Floats | None
    stuck: NDArray[np.int64]


def fixed_pattern(sensor: Sensor, serial: str) -> FixedPattern:
    """Return the fixed pattern of the camera of a serial number.

    A sensor of other noise, but of the same serial number and size, has the same pattern, scaled.
    """
    defects = sensor.defects
    return _fixed_pattern(
        serial,
        (sensor.rows, sensor.columns),
        (sensor.prnu.pixel, sensor.prnu.row, sensor.prnu.column),
        (sensor.dsnu.pixel_e, sensor.dsnu.row_e, sensor.dsnu.column_e),
        (defects.dead, defects.hot, defects.stuck),
        # What makes a pixel hot doubles with the temperature as the dark current does.
        sensor.at_temperature_e_per_s(defects.hot_dark_current_e_per_s),
    )


@lru_cache(maxsize=_CAMERAS_KEPT)
def _fixed_pattern(
    serial: str,
    shape: tuple[int, int],
    prnu: tuple[float, float, float],
    dsnu_e: tuple[float, float, float],
    bad: tuple[float, float, float],
    hot_rate_e_per_s: float,
) -> FixedPattern:
    response = _map("prnu", serial, shape, prnu)
    if response is not None:
        response += np.float32(1.0)
        np.maximum(response, np.float32(0.0), out=response)
    dead, hot, stuck = _bad_pixels(serial, shape, bad)
    if len(dead):
        response = np.ones(shape, dtype=np.float32) if response is None else response
        response.ravel()[dead] = 0.0
    hot_e_per_s = None
    if len(hot):
        hot_e_per_s = np.zeros(shape, dtype=np.float32)
        hot_e_per_s.ravel()[hot] = hot_rate_e_per_s
    return FixedPattern(response, _map("dsnu", serial, shape, dsnu_e), hot_e_per_s, stuck)


def _map(
    kind: str, serial: str, shape: tuple[int, int], deviations: tuple[float, float, float]
) -> Floats | None:
    """Return the sum of Gaussian parts of pixels, rows and columns (EMVA 1288, section 8.2); None where 0."""
    if not any(deviations):
        return None
    total = np.zeros(shape, dtype=np.float32)
    parts = (("pixel", shape), ("row", (shape[0], 1)), ("column", (1, shape[1])))
    for (part, of_part), deviation in zip(parts, deviations, strict=True):
        if deviation:
            random = generator(0, f"{kind}/{part}", serial, 0)
            total += np.float32(deviation) * random.standard_normal(of_part, dtype=np.float32)
    return total


def _bad_pixels(
    serial: str, shape: tuple[int, int], shares: tuple[float, float, float]
) -> tuple[NDArray[np.int64], ...]:
    """Return the numbers of dead, hot and stuck pixels; their counts are the shares of all, rounded."""
    count = shape[0] * shape[1]
    kinds = zip(("dead", "hot", "stuck"), shares, strict=True)
    return tuple(
        np.sort(generator(0, kind, serial, 0).choice(count, round(share * count), replace=False))
        for kind, share in kinds
    )
