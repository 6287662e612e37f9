"""How long a scene will take to render, from small trials on this machine."""

import time
from dataclasses import dataclass

from nir_render.expected import expected
from nir_render.scene.load import Scene
from nir_render.simulate import expose, render


@dataclass(frozen=True)
class Estimate:
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


def estimate(scene: Scene) -> Estimate:
    """Return how long `render` will take, by trials with the first camera: its light, and one frame.

    The time of a light is a fixed part and one that grows with the samples: two trials tell both. Where the
    noise has a target, a pilot tells the samples. Other cameras are taken to be like the first; writing files
    is not counted, nor what a light cache would save.
    """
    from nir_render.transport.render import geometry_of, mean_samples
    from nir_render.transport.stock import samples_of

    cameras = scene.cameras()
    start_s, seed = scene.document.clock.start_s, scene.document.seed
    few, more = scene.with_({"render.indirect.samples": 4}), scene.with_({"render.indirect.samples": 8})
    render(few, cameras[0], start_s)  # compiles
    spent_few, spent_more = _spent(few, cameras[0], start_s), _spent(more, cameras[0], start_s)
    more_samples = samples_of(more) - samples_of(few)
    per_sample = max(spent_more - spent_few, 0.0) / more_samples if more_samples else 0.0
    started = time.perf_counter()
    wanted = mean_samples(scene, cameras[0], start_s, seed)
    spent_pilot = time.perf_counter() - started if scene.document.render.noise is not None else 0.0
    light = render(few, cameras[0], start_s)
    expose(light, few)  # fills the tables
    started = time.perf_counter()
    expected(light, few, few.camera(cameras[0])[1].exposure_s)
    expose(light, few)
    seconds_per_frame = time.perf_counter() - started
    lights = {
        (name, geometry_of(scene, name, time_s))
        for time_s in scene.document.frame_times_s()
        for name in cameras
    }
    return Estimate(
        lights=len(lights),
        frames=scene.document.clock.frames * len(cameras),
        seconds_per_light=max(spent_few + spent_pilot + per_sample * (wanted - 4), 0.0),
        seconds_per_frame=seconds_per_frame,
    )


def _spent(scene: Scene, camera: str, time_s: float) -> float:
    started = time.perf_counter()
    render(scene, camera, time_s)
    return time.perf_counter() - started
