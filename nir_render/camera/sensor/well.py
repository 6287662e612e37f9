"""What a pixel's well does to the charge in it: it spills over, clips, and is read along a bent curve."""

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.sensor import Sensor

Floats = NDArray[np.float32]


def bloom_into(charge_e: Floats, full_well_e: float, share: float) -> None:
    """Spill what is beyond the full well into the neighbours in the column, in place.

    Parameters
    ----------
    charge_e
        Electrons, shape (rows, columns).
    share
        Of the charge beyond the full well this share spills, half up and half down, over any further wells
        that are full; the rest, and what leaves the sensor, drains.
    """
    columns = np.flatnonzero(charge_e.max(axis=0) > full_well_e)
    if not len(columns) or share == 0.0:
        return
    before = charge_e[:, columns].astype(np.float64)
    after = before + _sinking(before, before, full_well_e, share)
    after += _sinking(before[::-1], after[::-1], full_well_e, share)[::-1]
    charge_e[:, columns] = after.astype(np.float32)


def _sinking(
    charge_e: NDArray[np.float64], filled_e: NDArray[np.float64], full_well_e: float, share: float
) -> NDArray[np.float64]:
    """Return what each well takes of the charge that moves down its column from those beyond full."""
    taken = np.zeros_like(charge_e)
    moving = np.zeros(charge_e.shape[1])
    for row in range(len(charge_e)):
        taken[row] = np.minimum(moving, np.maximum(full_well_e - filled_e[row], 0.0))
        moving = moving - taken[row] + 0.5 * share * np.maximum(charge_e[row] - full_well_e, 0.0)
    return taken


def read_from_well(charge_e: Floats, sensor: Sensor) -> Floats:
    """Return the electrons that are read of a charge, clipped at the full well, float32, same shape."""
    charge: Floats = np.minimum(charge_e, np.float32(sensor.well_e))
    compression = sensor.compression
    return charge if compression is None else compression(charge, sensor.well_e)
