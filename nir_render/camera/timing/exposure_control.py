"""A camera's exposures and gains, frame by frame: fixed, a bracket's, or chosen by the frames before.

The paper's camera adapts "to prevent pixel saturation from proximal robots or signal loss at long ranges":
the brightest pixel is that of the nearest robot, and all others get as much exposure as that one allows.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.camera.sensor.read_out import dark_variance_e2, saturation_dn
from nir_render.scene.documents.camera import AutoExposure, Camera
from perception.types import RawFrame

_LARGEST_STEP = 4.0
_SAME_LIGHT = 0.5  # a peak moves between a pixel's middle and its corner
_ABOVE_NOISE = 10.0
# A point's brightest pixel has a neighbour of 1/16 of it with any point spread of σ ≥ 0.32 px.
_MOST_OVER_NEIGHBOURS = 16
_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)


@dataclass(frozen=True)
class Setting:
    """What a frame is taken with."""

    exposure_s: float
    gain: float


@dataclass(frozen=True)
class Seen:
    """What a frame, begun at `time_s`, has told of the light: electrons per second in the brightest pixel.

    Where `clipped`, no less than these, and no later frame has told how many.
    """

    time_s: float
    rate_e_per_s: float
    clipped: bool = False


@dataclass(frozen=True)
class ExposureState:
    """What an automatic exposure knows before a frame.

    Attributes
    ----------
    upcoming
        Settings of the frames to come, the next one's first, the newest choice last.
    seen
        What the frames that count still have told.
    """

    upcoming: tuple[Setting, ...]
    seen: tuple[Seen, ...] = ()


def own_setting(camera: Camera, index: int) -> Setting:
    """Return the camera's own exposure and gain for a frame; of a bracket the one whose turn it is."""
    exposures_s = camera.bracket or (camera.exposure_s,)
    return Setting(exposures_s[index % len(exposures_s)], camera.gain)


def first_state(camera: Camera, control: AutoExposure) -> ExposureState:
    """Return the state of a camera that has seen nothing."""
    return ExposureState((Setting(camera.exposure_s, camera.gain),) * control.latency)


def next_state(state: ExposureState, control: AutoExposure, camera: Camera, frame: RawFrame) -> ExposureState:
    """Return the state after a frame that was taken with `state.upcoming[0]`.

    The choice is the setting at which the brightest pixel, of the frames that `control.hold_s` lets count,
    would be at the target. From this frame to the one that it is for, the level changes by at most a factor
    of 4. A clipped pixel tells only that the exposure was too long, and takes that whole step: until a later
    frame shows the same light unclipped, at half of what clipped or more. A darker frame does not: the light
    may be off. From then on the frame that clipped counts as what it has shown, the level of clipping. A
    frame of less than ten times the dark noise is not held: much of its brightest pixel is noise.
    """
    newest = _seen(camera, frame)
    held = [one for one in state.seen if one.time_s >= frame.time_s - control.hold_s]
    if not newest.clipped:
        shown_e_per_s = newest.rate_e_per_s / _SAME_LIGHT
        held = [replace(one, clipped=one.clipped and one.rate_e_per_s > shown_e_per_s) for one in held]
    beyond = max(1.0, _LARGEST_STEP * control.target)
    brightest = max(one.rate_e_per_s * (beyond if one.clipped else 1.0) for one in (*held, newest))
    at_target = control.target * _range_e(camera, frame.gain) / frame.exposure_s
    within_a_step = min(max(brightest, at_target / _LARGEST_STEP), at_target * _LARGEST_STEP)
    chosen = setting_for(camera, control, within_a_step)
    dark_e2 = dark_variance_e2(camera.sensor, frame.exposure_s) + camera.sensor.dsnu.total_e**2
    if newest.clipped or newest.rate_e_per_s * frame.exposure_s >= _ABOVE_NOISE * math.sqrt(dark_e2):
        held.append(newest)
    return ExposureState((*state.upcoming[1:], chosen), tuple(held))


def _seen(camera: Camera, frame: RawFrame) -> Seen:
    """Return what a frame tells of its brightest pixel."""
    range_dn = saturation_dn(camera.sensor, frame.gain) - frame.black_level_dn
    level = max((brightest_dn(frame.data_dn) - frame.black_level_dn) / range_dn, 0.0)
    full_e_per_s = _range_e(camera, frame.gain) / frame.exposure_s
    return Seen(frame.time_s, min(level, 1.0) * full_e_per_s, level >= 1.0)


def setting_for(camera: Camera, control: AutoExposure, brightest_e_per_s: float) -> Setting:
    """Return the setting that brings electrons per second in a pixel to the target, within the limits.

    Gain is raised only at the longest exposure: it adds no light.
    """
    rate_e_per_s = max(brightest_e_per_s, 1e-300)
    wanted_s = control.target * _range_e(camera, camera.gain) / rate_e_per_s
    exposure_s = float(np.clip(wanted_s, control.shortest_s, control.longest_s))
    gain = camera.gain
    if control.most_gain is not None and wanted_s > control.longest_s:
        wanted = control.target * camera.sensor.full_scale_e / (rate_e_per_s * exposure_s)
        gain = float(np.clip(wanted, camera.gain, control.most_gain))
    return Setting(exposure_s, gain)


def brightest_dn(data_dn: NDArray[np.uint16]) -> float:
    """Return the brightest pixel of a frame, as far as its neighbours bear it out.

    Light spreads over neighbours: what stands out alone, a hot or stuck pixel, is none. So a pixel counts at
    most as the local median (5 × 5: more than half of it is free of a far source's 2 × 2 or 3 × 3 pixels)
    plus 16 times what the brightest of its eight neighbours exceeds that by.

    Parameters
    ----------
    data_dn
        Counts, shape (rows, columns).
    """
    # Reflected, so that a flare in a corner is not its own surroundings.
    wider = cv2.copyMakeBorder(data_dn, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)
    local = cv2.medianBlur(wider, 5)[2:-2, 2:-2].astype(np.int32)
    borne_out = np.maximum(cv2.dilate(data_dn, _AROUND), local.astype(np.uint16)).astype(np.int32) - local
    borne_out *= _MOST_OVER_NEIGHBOURS
    borne_out += local
    return float(np.minimum(data_dn, borne_out).max())


def _range_e(camera: Camera, gain: float) -> float:
    """Return the electrons at which a pixel counts as clipped."""
    sensor = camera.sensor
    range_dn = saturation_dn(sensor, gain) - sensor.black_level_dn
    return range_dn / (sensor.system_gain_dn_per_e * gain)
