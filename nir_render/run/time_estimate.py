"""How long a scene will take to render, from small trials on this machine."""

import time
from dataclasses import dataclass

from nir_render.scene.scene import Scene
from nir_render.simulation.clock import expected_electrons, expose, render


@dataclass(frozen=True)
class TimeEstimate:
    """What a render will take.

    `lights` counts camera and geometry pairs whose light is rendered, `frames` the exposures made of them.
    """

    lights: int
    frames: int
    seconds_per_light: float
    seconds_per_frame: float

    @property
    def seconds(self) -> float:
        """Total time."""
        return self.lights * self.seconds_per_light + self.frames * self.seconds_per_frame


def time_estimate(scene: Scene) -> TimeEstimate:
    """Return how long `render` will take, by trials with the first camera: its light, and one frame.

    The time of a light is a fixed part and one that grows with the samples: two trials tell both. Where the
    noise has a target, a pilot tells the samples. Other cameras are taken to be like the first; writing files
    is not counted, nor what a light cache would save.
    """
    from nir_render.transport.indirect.stock import samples_of
    from nir_render.transport.render import geometry_of, mean_samples

    cameras = scene.cameras()
    start_s, seed = scene.document.clock.start_s, scene.document.seed
    few, more = scene.with_({"render.indirect.samples": 4}), scene.with_({"render.indirect.samples": 8})
    render(few, cameras[0], start_s)  # compiles
    spent_few, spent_more = _spent(few, cameras[0], start_s), _spent(more, cameras[0], start_s)
    more_samples = samples_of(more.document.render.indirect) - samples_of(few.document.render.indirect)
    per_sample = max(spent_more - spent_few, 0.0) / more_samples if more_samples else 0.0
    started = time.perf_counter()
    wanted = mean_samples(scene.at(start_s), cameras[0], seed)
    spent_pilot = time.perf_counter() - started if scene.document.render.noise is not None else 0.0
    light = render(few, cameras[0], start_s)
    expose(light, few)  # fills the tables
    started = time.perf_counter()
    expected_electrons(light, few)
    expose(light, few)
    seconds_per_frame = time.perf_counter() - started
    lights = {
        (name, geometry_of(scene.at(time_s), name))
        for time_s in scene.document.frame_times_s()
        for name in cameras
    }
    return TimeEstimate(
        lights=len(lights),
        frames=scene.document.clock.frames * len(cameras),
        seconds_per_light=max(spent_few + spent_pilot + per_sample * (wanted - 4), 0.0),
        seconds_per_frame=seconds_per_frame,
    )


def _spent(scene: Scene, camera: str, time_s: float) -> float:
    started = time.perf_counter()
    render(scene, camera, time_s)
    return time.perf_counter() - started
