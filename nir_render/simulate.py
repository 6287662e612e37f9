"""The clock: poses and exposures over time, and light turned into raw frames.

Light is rendered once for a geometry; exposing it is arithmetic.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.exposure_control import ExposureState, Setting, first_state, next_state, own_setting
from nir_render.camera.sensor import read_out
from nir_render.camera.shutter import mid_exposure_s, row_delay_s
from nir_render.errors import InputError
from nir_render.evaluate.truth import SourceTruth, truth_of
from nir_render.expected import Expected, Rates, exposed, rates
from nir_render.randomness import FrameKey
from nir_render.render_noise import RenderNoise, render_noise
from nir_render.scene.devices import Camera
from nir_render.scene.exposure import MOST_GAIN, AutoExposure
from nir_render.scene.load import Scene
from nir_render.transport.cache import LightCache
from nir_render.transport.light import Light
from perception.types import RawFrame

_SETTLING_STEPS = 8  # of at most 4: enough for a factor of 65 000
_LIGHTS_KEPT = 8  # of `expose`: of cameras that are exposed by turns


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
    light: Light,
    scene: Scene,
    exposure_s: float | None = None,
    seed: int | None = None,
    index: int = 0,
    gain: float | None = None,
    time_s: float | None = None,
) -> RawFrame:
    """Return the raw frame that a camera takes of a light, its noise keyed by (seed, camera, index).

    One light can be exposed many times while its sources blink; the first time takes longest.

    Parameters
    ----------
    exposure_s, gain
        In place of the camera's own; of a bracket that is the exposure whose turn it is by `index`.
    seed
        In place of the one that the light was rendered with.
    time_s
        When row 0 begins its exposure; without it the light's time is mid-exposure, of the middle row.

    Raises
    ------
    InputError
        An exposure that is not positive, a gain outside 1 to 64.
    """
    _, camera = scene.camera(light.camera)
    own = own_setting(camera, index)
    seed = light.seed if seed is None else seed
    mean = exposed(_last_rates(light, scene), own.exposure_s if exposure_s is None else exposure_s, time_s)
    return _frame(mean, own.gain if gain is None else gain, FrameKey(seed, "read_out", light.camera, index))


def simulate(scene: Scene, seed: int | None = None, cache: LightCache | None = None) -> Iterator[Shot]:
    """Yield frames with their truth: for each time of the clock, each observing camera.

    `seed` replaces the scene's own. A camera with automatic exposure has settled before its first frame.
    Geometry stands still within a frame, as it is at mid-exposure of its middle row. Light is rendered only
    where geometry is new; `cache` keeps it beyond this run.
    """
    run_seed = scene.document.seed if seed is None else seed
    cache = LightCache() if cache is None else cache
    kept: dict[str, Rates] = {}
    states: dict[str, ExposureState] = {}
    for index, time_s in enumerate(scene.document.frame_times_s()):
        for name in scene.cameras():
            _, camera = scene.camera(name)
            control, setting = camera.auto_exposure, own_setting(camera, index)
            if control is not None:
                if name not in states:
                    light = render(scene, name, time_s, run_seed, cache)
                    kept[name] = _rates(light, scene, kept.get(name))
                    states[name] = _settled(kept[name], control, time_s, run_seed)
                setting = states[name].upcoming[0]
            middle_s = time_s + mid_exposure_s(camera, setting.exposure_s)
            light = render(scene, name, middle_s, run_seed, cache)
            kept[name] = _rates(light, scene, kept.get(name))
            mean = exposed(kept[name], setting.exposure_s, time_s)
            frame = _frame(mean, setting.gain, FrameKey(run_seed, "read_out", name, index))
            truth = tuple(truth_of(scene, mean, frame))
            yield Shot(frame, light, truth, mean, render_noise(mean, scene))
            if control is not None:
                states[name] = next_state(states[name], control, camera, frame)


def frame_of(
    electrons: NDArray[np.float64] | NDArray[np.float32],
    camera: Camera,
    setting: Setting,
    time_s: float,
    key: FrameKey,
) -> RawFrame:
    """Return the raw frame of expected electrons, shape (rows, columns); row 0 begins at `time_s`.

    Raises
    ------
    InputError
        A gain outside 1 to 64.
    """
    if not 1.0 <= setting.gain <= MOST_GAIN:
        raise InputError(
            f"gain is {setting.gain!r}; wanted a factor from 1 to {MOST_GAIN:g} on the system gain"
        )
    return RawFrame(
        camera=key.camera,
        index=key.frame,
        time_s=time_s,
        exposure_s=setting.exposure_s,
        data_dn=read_out(electrons, camera, setting.exposure_s, key, setting.gain),
        black_level_dn=camera.sensor.black_level_dn,
        line_time_s=row_delay_s(camera),
        gain=setting.gain,
    )


@lru_cache(maxsize=_LIGHTS_KEPT)
def _last_rates(light: Light, scene: Scene) -> Rates:
    """Return the rates of a light, and keep them for its next exposure."""
    return rates(light, scene)


def _rates(light: Light, scene: Scene, kept: Rates | None) -> Rates:
    """Return the rates of a light: those that are kept where it is the same one."""
    if kept is None or kept.light.indirect is not light.indirect or kept.light.direct is not light.direct:
        return rates(light, scene)
    return kept


def _settled(of_light: Rates, control: AutoExposure, time_s: float, seed: int) -> ExposureState:
    """Return what a camera has found before its first frame, by frames that are not kept.

    They come at the clock's pace right before that frame, with the geometry as it is then.
    """
    camera, name = of_light.camera, of_light.light.camera
    period_s = 1.0 / of_light.scene.document.clock.frame_rate_hz
    state = first_state(camera, control)
    frames = _SETTLING_STEPS * control.latency
    for number in range(frames):
        setting = state.upcoming[0]
        mean = exposed(of_light, setting.exposure_s, time_s + (number - frames) * period_s)
        frame = _frame(mean, setting.gain, FrameKey(seed, "settling", name, number))
        state = next_state(state, control, camera, frame)
    return state


def _frame(mean: Expected, gain: float, key: FrameKey) -> RawFrame:
    return frame_of(mean.electrons, mean.rates.camera, Setting(mean.exposure_s, gain), mean.time_s, key)
