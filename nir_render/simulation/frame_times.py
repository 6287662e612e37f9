"""When each camera really takes its frames: by the scene's clock, and by how its own departs from it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.randomness import generator
from nir_render.scene.documents.times.clocks import JITTER_SIGMAS, CameraClock
from nir_render.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """When row 0 of a camera's frames begins, in seconds, shape (frames,), and which frames are lost."""

    time_s: NDArray[np.float64]
    dropped: NDArray[np.bool_]


def frame_times(scene: Scene, seed: int) -> Mapping[str, FrameTimes]:
    """Return the frame times of each observing camera, by name; a camera without a clock keeps the scene's.

    Jitter and losses are keyed by seed, camera and frame: more frames leave those before as they are.
    """
    planned_s = np.array(scene.document.frame_times_s())
    return {name: _of_camera(scene.camera(name)[1].clock, name, planned_s, seed) for name in scene.cameras()}


def frame_span_s(clock: CameraClock | None, planned_s: NDArray[np.float64]) -> tuple[float, float]:
    """Return when a camera's first frame may begin at the earliest, and its last one at the latest."""
    if clock is None:
        return float(planned_s[0]), float(planned_s[-1])
    own_s = _steady_s(clock, planned_s)
    reach_s = JITTER_SIGMAS * clock.jitter_s
    return float(own_s[0] - reach_s), float(own_s[-1] + reach_s)


def last_of_first(
    turns: Sequence[tuple[int, str]], own_times: Mapping[str, FrameTimes], frames: int
) -> dict[str, int]:
    """Return the last frame of each camera among the first so many that were not dropped."""
    kept = [(index, name) for index, name in turns if not own_times[name].dropped[index]]
    return {name: index for index, name in kept[:frames]}


def _of_camera(clock: CameraClock | None, name: str, planned_s: NDArray[np.float64], seed: int) -> FrameTimes:
    if clock is None:
        return FrameTimes(planned_s, np.zeros(len(planned_s), dtype=bool))
    time_s = _steady_s(clock, planned_s)
    dropped = np.zeros(len(planned_s), dtype=bool)
    for index in range(len(planned_s)) if clock.jitter_s or clock.dropped else ():
        random = generator(seed, "clock", name, index)
        dropped[index] = random.random() < clock.dropped
        time_s[index] += clock.jitter_s * np.clip(random.standard_normal(), -JITTER_SIGMAS, JITTER_SIGMAS)
    return FrameTimes(time_s, dropped)


def _steady_s(clock: CameraClock, planned_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the times of a camera's frames without jitter."""
    return np.asarray(planned_s[0] + clock.offset_s + (1.0 + clock.drift) * (planned_s - planned_s[0]))
