"""The clock: poses and exposures over time, and light turned into raw frames.

Light is rendered once for a geometry; exposing it is arithmetic.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nir_render.camera.exposure_control import next_exposure_s
from nir_render.camera.sensor import read_out
from nir_render.errors import InputError
from nir_render.evaluate.truth import SourceTruth, truth_of
from nir_render.expected import Expected, expected
from nir_render.randomness import generator
from nir_render.render_noise import RenderNoise, render_noise
from nir_render.scene.devices import Camera
from nir_render.scene.exposure import AutoExposure
from nir_render.scene.load import Scene
from nir_render.transport.cache import LightCache
from nir_render.transport.light import Light
from perception.types import RawFrame

_SETTLING_FRAMES = 8  # steps of at most 4: enough for a factor of 65 000


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame, its light, the truth about its sources, its mean without noise, the render's noise in it."""

    frame: RawFrame
    light: Light
    truth: tuple[SourceTruth, ...]
    mean: Expected
    noise: RenderNoise


def render(
    scene: Scene,
    camera: str,
    time_s: float = 0.0,
    seed: int | None = None,
    cache: LightCache | None = None,
) -> Light:
    """Return the light that reaches a camera, `robot.camera`, with the scene's geometry at `time_s`.

    `seed` replaces the scene's own. `cache` keeps lights: what it holds is not rendered again.

    Raises
    ------
    InputError
        No such camera, or the camera is inside a body.
    """
    from nir_render.transport import render as transport  # Mitsuba loads only where light is rendered

    return transport.render(scene, camera, time_s, scene.document.seed if seed is None else seed, cache)


def expose(
    light: Light, scene: Scene, exposure_s: float | None = None, seed: int | None = None, index: int = 0
) -> RawFrame:
    """Return the raw frame that a camera takes of a light, its noise keyed by (seed, camera, index).

    The light's time is mid-exposure; the frame's `time_s` the start of the exposure. `exposure_s` replaces
    the camera's own exposure, `seed` the one that the light was rendered with.
    """
    _, camera = scene.camera(light.camera)
    seed = light.seed if seed is None else seed
    exposure_s = camera.exposure_s if exposure_s is None else exposure_s
    return _frame(expected(light, scene, exposure_s), scene, seed, index)


def simulate(scene: Scene, seed: int | None = None, cache: LightCache | None = None) -> Iterator[Shot]:
    """Yield frames with their truth: for each time of the clock, each observing camera.

    `seed` replaces the scene's own. A camera with automatic exposure has settled before its first frame.
    Light is rendered only where geometry is new; `cache` keeps it beyond this run.
    """
    run_seed = scene.document.seed if seed is None else seed
    cache = LightCache() if cache is None else cache
    exposures_s: dict[str, float] = {}
    for index, time_s in enumerate(scene.document.frame_times_s()):
        for name in scene.cameras():
            _, camera = scene.camera(name)
            control = camera.auto_exposure
            if name not in exposures_s and control is not None:
                light = render(scene, name, time_s, run_seed, cache)
                exposures_s[name] = _settled_exposure(scene, light, camera, control, run_seed)
            exposure_s = exposures_s.setdefault(name, camera.exposure_s)
            light = render(scene, name, time_s + 0.5 * exposure_s, run_seed, cache)
            mean = expected(light, scene, exposure_s)
            frame = _frame(mean, scene, run_seed, index)
            truth = tuple(truth_of(scene, mean, frame))
            yield Shot(frame, light, truth, mean, render_noise(mean, scene))
            if control is not None:
                exposures_s[name] = next_exposure_s(control, camera.sensor, frame.data_dn, exposure_s)


def _settled_exposure(scene: Scene, light: Light, camera: Camera, control: AutoExposure, seed: int) -> float:
    """Return the exposure that a camera has found before its first frame, by frames that are not kept."""
    exposure_s = camera.exposure_s
    mean = expected(light, scene, exposure_s)
    for frame in range(_SETTLING_FRAMES):
        electrons = mean.electrons * (exposure_s / mean.exposure_s)  # light is linear in the exposure
        random = generator(seed, "settling", light.camera, frame)
        exposure_s = next_exposure_s(
            control, camera.sensor, read_out(electrons, camera.sensor, random), exposure_s
        )
    return exposure_s


def _frame(mean: Expected, scene: Scene, seed: int, index: int) -> RawFrame:
    name = mean.light.camera
    _, camera = scene.camera(name)
    if not np.isfinite(mean.electrons).all():
        raise InputError(f"{scene.path}: the light of {name} is not finite; a body or source is degenerate")
    return RawFrame(
        camera=name,
        index=index,
        time_s=mean.light.time_s - 0.5 * mean.exposure_s,
        exposure_s=mean.exposure_s,
        data_dn=read_out(mean.electrons, camera.sensor, generator(seed, "read_out", name, index)),
        black_level_dn=camera.sensor.black_level_dn,
    )
