"""The clock: the world over time, light where geometry is new, and light turned into raw frames.

Light is rendered once for a geometry; exposing it is arithmetic.
"""

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.mean_frame import (
    MeanFrame,
    Rates,
    electron_rates,
    exposed_frame,
    kept_rates,
    mean_frame,
)
from nir_render.camera.render_noise import RenderNoise, render_noise
from nir_render.camera.sensor.read_out import read_out
from nir_render.camera.timing.exposure_control import (
    ExposureState,
    Setting,
    first_state,
    next_state,
    own_setting,
)
from nir_render.camera.timing.shutter import mid_exposure_s
from nir_render.errors import InputError
from nir_render.light.light import NO_SOURCES, Light
from nir_render.randomness import RandomKey
from nir_render.scene.documents.camera import MOST_GAIN, AutoExposure, Camera
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.frame_times import frame_times, last_of_first
from nir_render.simulation.lamps import lamp_truth
from nir_render.simulation.refresh import Refreshed, RefreshError, built_at
from nir_render.simulation.truth import truth_of
from nir_render.spectra.nodes import BAND_M
from nir_render.transport.cache import LightCache
from nir_render.truth.lamps import LampTruth
from nir_render.truth.sources import SourceTruth
from perception.files.recording import SCENE_KIND
from perception.types import RawFrame

_SAME_PLACE = 1e-6  # of the distance, or in metres
_SETTLING_STEPS = 8  # of at most 4: enough for a factor of 65 000

SceneOrSnapshot = Scene | Snapshot
"""A scene, which moves by its own motions, or the world at one time."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame, its light, the truth about sources and lamps, its mean without noise.

    `exposure` is what the camera's automatic exposure knows after it; None without one. `refresh` is what was
    measured on the way to it of the error of interpolated light. `kind` is what the frame is for.
    """

    frame: RawFrame
    light: Light
    truth: tuple[SourceTruth, ...]
    lamps: tuple[LampTruth, ...]
    mean: MeanFrame
    exposure: ExposureState | None = None
    refresh: tuple[RefreshError, ...] = ()
    kind: str = SCENE_KIND

    @cached_property
    def noise(self) -> RenderNoise:
        """How much noise rendering adds; reckoned where it is asked for."""
        return render_noise(self.mean)


@dataclass(frozen=True)
class Begun:
    """What is done of a run: so many frames, and what automatic exposures know after them, by camera."""

    frames: int = 0
    exposures: Mapping[str, ExposureState] = field(default_factory=dict)


def render(
    world: SceneOrSnapshot,
    camera: str,
    time_s: float | None = None,
    seed: int | None = None,
    cache: LightCache | None = None,
) -> Light:
    """Return the light that reaches a camera, `robot.camera`.

    >>> from nir_render import load_scene
    >>> light = render(load_scene("scenes/one_source.yaml"), "r1.front")
    >>> light.groups[light.direct.group[0]], round(float(light.direct.distance_m[0]), 3)
    ('r2.top', 1.023)

    Parameters
    ----------
    world
        A scene, or a snapshot of the world.
    time_s
        When a scene's geometry is to be looked at, 0 by default; a snapshot has its own time.
    seed
        Replaces the scene's own.
    cache
        Keeps lights: what it holds is not rendered again.

    Raises
    ------
    InputError
        No such camera, the camera is inside a body, another time than the snapshot's.
    """
    from nir_render.transport import render as transport  # Mitsuba loads only where light is rendered

    if seed is None:
        seed = world.document.seed if isinstance(world, Scene) else world.seed
    return transport.render(_at(world, time_s), camera, seed, cache)


def expected_electrons(
    light: Light, world: SceneOrSnapshot, exposure_s: float | None = None
) -> NDArray[np.float64]:
    """Return the noise-free frame: mean photoelectrons per pixel, shape (rows, columns).

    The light's time is mid-exposure. Without `exposure_s` the camera's own exposure is used.
    """
    snapshot = _of_light(light, world)
    own_s = snapshot.camera(light.camera).camera.exposure_s
    return mean_frame(light, snapshot, own_s if exposure_s is None else exposure_s).electrons


def expose(
    light: Light,
    world: SceneOrSnapshot,
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
    world
        What the light was rendered of: cameras, sources and what they send are taken from it.
    exposure_s, gain
        In place of the camera's own; of a bracket that is the exposure whose turn it is by `index`.
    seed
        In place of the one that the light was rendered with.
    index
        Of the frame: two frames of one index have the same noise.
    time_s
        When row 0 begins its exposure. Without it mid-exposure, of the middle row, is at the light's time; of
        a snapshot, at the snapshot's: sources blink on while the light serves another frame.

    Raises
    ------
    InputError
        An exposure that is not positive, a gain outside 1 to 64, a snapshot in which the camera or a source
        that the light shows stands elsewhere.
    """
    snapshot = _of_light(light, world)
    camera = snapshot.camera(light.camera).camera
    own = own_setting(camera, index)
    exposure_s = own.exposure_s if exposure_s is None else exposure_s
    if time_s is None and isinstance(world, Snapshot):
        time_s = world.time_s - mid_exposure_s(camera, exposure_s)
    mean = exposed_frame(kept_rates(light, snapshot), exposure_s, time_s)
    key = RandomKey(light.seed if seed is None else seed, "read_out", light.camera, index)
    return _frame(mean, own.gain if gain is None else gain, key)


def take_frame(
    snapshot: Snapshot,
    camera: str,
    index: int,
    exposure_s: float | None = None,
    gain: float | None = None,
    seed: int | None = None,
    cache: LightCache | None = None,
) -> Shot:
    """Return the frame that a camera takes of a world, with light, truth, and the mean without noise.

    The snapshot's time is mid-exposure of the middle row. One step of a loop whose robots are moved by hand.

    Parameters
    ----------
    index
        Of the frame: it keys the noise, with the seed and the camera, and is the turn of a bracket.
    exposure_s, gain
        In place of the camera's own; with automatic exposure what it chose is for the caller to say.
    seed
        Replaces the snapshot's own.
    cache
        Keeps lights: a geometry that it has seen is not rendered again.

    Raises
    ------
    InputError
        Those of `render` and `expose`.
    """
    seed = snapshot.seed if seed is None else seed
    device = snapshot.camera(camera).camera
    own = own_setting(device, index)
    exposure_s = own.exposure_s if exposure_s is None else exposure_s
    setting = Setting(exposure_s, own.gain if gain is None else gain)
    light = render(snapshot, camera, seed=seed, cache=cache)
    begin_s = snapshot.time_s - mid_exposure_s(device, setting.exposure_s)
    key = RandomKey(seed, "read_out", camera, index)
    return _shot(light, electron_rates(light, snapshot), setting, begin_s, key)


def _shot(light: Light, rates: Rates, setting: Setting, time_s: float, key: RandomKey) -> Shot:
    """Return the frame of a light, row 0 of which begins at a time, and all that is known of it."""
    mean = exposed_frame(rates, setting.exposure_s, time_s)
    frame = _frame(mean, setting.gain, key)
    return Shot(
        frame=frame,
        light=light,
        truth=tuple(truth_of(mean, frame)),
        lamps=tuple(lamp_truth(rates.snapshot, key.camera, key.frame)),
        mean=mean,
    )


def _at(world: SceneOrSnapshot, time_s: float | None) -> Snapshot:
    if isinstance(world, Scene):
        return world.at(0.0 if time_s is None else time_s)
    if time_s is not None and time_s != world.time_s:
        raise InputError(
            f"time_s is {time_s!r}, but the snapshot is of {world.time_s!r} s; leave time_s out, or take the "
            "world of a scene: scene.at(time_s)"
        )
    return world


def _of_light(light: Light, world: SceneOrSnapshot) -> Snapshot:
    """Return the world that a light is exposed in; raise InputError where it is not the light's."""
    if isinstance(world, Scene):
        return world.at(light.time_s)
    pose, table = world.camera(light.camera).pose, light.direct
    for row in np.flatnonzero((table.facet < 0) & np.isfinite(table.distance_m)):
        name = light.groups[table.group[row]]
        if name not in world.sources:
            continue  # what is missing is told where it is looked for
        seen_m = table.distance_m[row] * table.direction[row]
        off_m = float(np.linalg.norm(pose.to_local(world.sources[name].pose.position_m) - seen_m))
        if off_m > _SAME_PLACE * max(float(table.distance_m[row]), 1.0):
            raise InputError(
                f"{world.origin}: seen from {light.camera}, {name} stands {off_m:.3g} m from where the light "
                "was rendered with it; render this snapshot again, or use take_frame"
            )
    return world


def simulate(
    scene: Scene, seed: int | None = None, cache: LightCache | None = None, begun: Begun | None = None
) -> Iterator[Shot]:
    """Yield frames with their truth: for each time of the clock, each observing camera.

    `seed` replaces the scene's own. A camera with automatic exposure has settled before its first frame.
    Geometry is as at mid-exposure of a frame's middle row; only the flares of what moves are drawn out along
    their way (`camera/motion_blur.py`). Light is rendered only where geometry is new; `cache` keeps it beyond
    this run. Frames that a camera drops are taken, for automatic exposure, and not yielded. Dark frames have
    the cap on, and automatic exposure waits for the next that sees. Those that
    are `begun`, done already, are left out, and the others are as they would be after them.
    """
    run_seed = scene.document.seed if seed is None else seed
    cache = LightCache() if cache is None else cache
    period_s = 1.0 / scene.document.clock.frame_rate_hz
    kept: dict[str, Rates] = {}
    built: dict[float, dict[Hashable, Any]] = {}
    begun = Begun() if begun is None else begun
    states = dict(begun.exposures)
    cameras = scene.cameras()

    refreshed = _refreshed(scene, run_seed, cache)

    def light_at(name: str, time_s: float) -> tuple[Light, Rates]:
        if refreshed is not None:
            rates = refreshed.rates_at(name, time_s)
            return rates.light, rates
        from nir_render.transport import render as transport

        snapshot = scene.at(time_s)
        light = transport.render(snapshot, name, run_seed, cache, built_at(built, time_s))
        kept[name] = _reused_rates(light, snapshot, kept.get(name))
        return light, kept[name]

    own_times = frame_times(scene, run_seed)
    turns = [(index, name) for index in range(scene.document.clock.frames) for name in cameras]
    done = last_of_first(turns, own_times, begun.frames)
    for index, name in turns:
        _, camera = scene.camera(name)
        control, setting = camera.auto_exposure, own_setting(camera, index)
        kind = scene.document.clock.calibration.kind_of(index)
        time_s, dropped = float(own_times[name].time_s[index]), bool(own_times[name].dropped[index])
        if index <= done.get(name, -1) or (dropped and (control is None or kind == "dark")):
            continue
        if kind == "dark":
            if control is not None and name in states:
                setting = states[name].upcoming[0]
            yield _capped(scene, name, index, time_s, setting, run_seed)
            continue
        if control is not None:
            if name not in states:
                _, rates = light_at(name, time_s)
                states[name] = _settled(rates, control, time_s, period_s, run_seed)
            setting = states[name].upcoming[0]
        light, rates = light_at(name, time_s + mid_exposure_s(camera, setting.exposure_s))
        shot = _shot(light, rates, setting, time_s, RandomKey(run_seed, "read_out", name, index))
        if control is not None:
            states[name] = next_state(states[name], control, camera, shot.frame)
            shot = replace(shot, exposure=states[name])
        if refreshed is not None:
            shot = replace(shot, refresh=tuple(refreshed.measured()))
        if not dropped:
            yield replace(shot, kind=kind)


def _capped(scene: Scene, camera: str, index: int, time_s: float, setting: Setting, seed: int) -> Shot:
    """Return a frame with the cap on."""
    light = Light(camera, time_s, seed, (), (BAND_M,), NO_SOURCES, None)
    rates = electron_rates(light, scene.at(time_s))
    shot = _shot(light, rates, setting, time_s, RandomKey(seed, "read_out", camera, index))
    return replace(shot, lamps=(), kind="dark")


def frame_of(
    electrons: NDArray[np.float64] | NDArray[np.float32],
    camera: Camera,
    setting: Setting,
    time_s: float,
    key: RandomKey,
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
        line_time_s=camera.shutter.row_delay_s,
        gain=setting.gain,
    )


def _refreshed(scene: Scene, seed: int, cache: LightCache) -> Refreshed | None:
    """Return what interpolates indirect light; None where each frame's is rendered."""
    settings = scene.document.render.indirect
    if (settings.every_s is None and settings.error is None) or not scene.document.has_indirect_light():
        return None
    return Refreshed(scene, seed, cache)


def _reused_rates(light: Light, snapshot: Snapshot, kept: Rates | None) -> Rates:
    """Return the rates of a light: those that are kept where it is the same light at another time."""
    if kept is None or not kept.snapshot.as_fast_as(snapshot):
        return electron_rates(light, snapshot)
    if kept.light.indirect is not light.indirect or kept.light.direct is not light.direct:
        return electron_rates(light, snapshot)
    return kept


def _settled(rates: Rates, control: AutoExposure, time_s: float, period_s: float, seed: int) -> ExposureState:
    """Return what a camera has found before its first frame, by frames that are not kept.

    They come at the clock's pace right before that frame, with the geometry as it is then.
    """
    camera, name = rates.camera, rates.light.camera
    state = first_state(camera, control)
    frames = _SETTLING_STEPS * control.latency
    for number in range(frames):
        setting = state.upcoming[0]
        mean = exposed_frame(rates, setting.exposure_s, time_s + (number - frames) * period_s)
        frame = _frame(mean, setting.gain, RandomKey(seed, "settling", name, number))
        state = next_state(state, control, camera, frame)
    return state


def _frame(mean: MeanFrame, gain: float, key: RandomKey) -> RawFrame:
    return frame_of(mean.electrons, mean.camera, Setting(mean.exposure_s, gain), mean.time_s, key)
