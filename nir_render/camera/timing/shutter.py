"""When each row of a frame collects light, and how much of an emitter's drive it meets."""

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.timing.drive import mean_level
from nir_render.scene.documents.camera import Camera, RollingShutter
from nir_render.scene.documents.times.drives import Drive

Array = NDArray[np.float64]


def row_starts_s(camera: Camera, time_s: float) -> Array:
    """Return when each row begins its exposure, row 0 at `time_s`, shape (rows,)."""
    return time_s + camera.shutter.row_delay_s * np.arange(camera.sensor.rows, dtype=np.float64)


def mid_exposure_s(camera: Camera, exposure_s: float) -> float:
    """Return the time from the start of a frame to mid-exposure of its middle row."""
    return 0.5 * exposure_s + 0.5 * camera.shutter.row_delay_s * (camera.sensor.rows - 1)


def on_fractions(camera: Camera, drive: Drive, time_s: float, exposure_s: float) -> Array:
    """Return the mean level of a drive over the exposure of each row, from 0 to 1, shape (rows,)."""
    return mean_level(drive, row_starts_s(camera, time_s), exposure_s)


def row_profile(camera: Camera, drive: Drive, time_s: float, exposure_s: float) -> Array:
    """Return what each row collects, relative to an exposure to the same light at full drive, shape (rows,).

    With a global shutter row r waits for r line times w to be read, from the end of the exposure t on, and
    goes on collecting the share PLS of the light: (∫ drive over t + PLS ∫ drive over w) / t.
    """
    collected = on_fractions(camera, drive, time_s, exposure_s)
    shutter = camera.shutter
    if isinstance(shutter, RollingShutter) or shutter.parasitic_light_sensitivity == 0.0:
        return collected
    wait_s = shutter.line_time_s * np.arange(camera.sensor.rows)
    while_waiting = mean_level(drive, time_s + exposure_s, wait_s)
    return collected + shutter.parasitic_light_sensitivity * while_waiting * (wait_s / exposure_s)
