"""A robot that sees by frames: rendered, exposed, and read by the whole stack."""

import math
from collections.abc import Hashable
from typing import Any

from nir_render.camera.mean_frame import Rates, electron_rates, exposed_frame
from nir_render.camera.timing.exposure_control import own_setting
from nir_render.camera.timing.shutter import mid_exposure_s
from nir_render.experiments.loop.controllers import neighbours_of
from nir_render.experiments.loop.sight import Seen
from nir_render.experiments.loop.world import World
from nir_render.light.light import Light
from nir_render.randomness import RandomKey
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import frame_of
from nir_render.simulation.refresh import interpolation_error, rates_between
from perception import Pipeline, RawFrame, Signal

_AHEAD_S = 1e-9
_OFF, _LONGEST_S = 0.005, 40.0  # of the noise's variance, to be off by; how long light is held at most


class FrameSight:
    """Frames of all cameras of a robot, rendered and exposed, read by the whole stack.

    Light straight from sources is reckoned for every frame. Indirect light is rendered again after
    `refresh_s`, and held in between. How far off that was at the end of each stretch, where it is most, is
    kept in `held_shares`: the mean square over the mean temporal variance of the frame. The next stretch is
    as long as leaves it off by 0.5 %, as its square grows with that of time; at most twice as long, and 40 s.
    """

    def __init__(
        self, scene: Scene, robot: str, seed: int, stack: str, refresh_s: float, keep_signals: bool = False
    ) -> None:
        self._robot, self._seed, self._interval_s = robot, seed, refresh_s
        self._cameras = scene.document.cameras_of(robot)
        known = {name: calibration(scene, name) for name in self._cameras}
        self._pipeline = Pipeline.of(stack, known, keep_signals=keep_signals)
        self._held: dict[str, Rates] = {}
        self._held_in: Snapshot | None = None
        self._index = 0
        self.held_shares: list[float] = []

    def look(self, world: World) -> Seen:
        """Take a set of frames, and read it."""
        snapshot = world.snapshot()
        if not self._held and self._held_in is not None:  # it goes on in another process
            built: dict[Hashable, Any] = {}
            self._held = {name: self._rendered(name, self._held_in, built) for name in self._cameras}
        if self._held_in is None or snapshot.time_s >= self._held_in.time_s + self._interval_s - _AHEAD_S:
            self._refresh(snapshot, world.kept_of_snapshot)
        from nir_render.transport.render import direct_lights

        lights = direct_lights(snapshot, self._cameras, self._seed, world.kept_of_snapshot)
        frames = [self._frame(snapshot, light) for light in lights.values()]
        self._index += 1
        heard = self._pipeline.push(frames, world.odometry(self._robot))
        return Seen(neighbours_of(heard.tracks), heard.messages, heard.tracks, tuple(frames))

    def signals(self) -> tuple[Signal, ...]:
        """Return how bright every track was so far, where that is kept."""
        return self._pipeline.signals()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what can be rendered again to the same bits."""
        return {**self.__dict__, "_held": {}}

    def _refresh(self, snapshot: Snapshot, kept: dict[Hashable, Any]) -> None:
        fresh = {name: self._rendered(name, snapshot, kept) for name in self._cameras}
        if self._held_in is not None:
            before_s = self._held_in.time_s
            times_s = (before_s, snapshot.time_s, snapshot.time_s + self._interval_s)
            # Held light is one that does not change: both ends of the interval are the older one.
            shares = [
                interpolation_error(held, held, fresh[name], times_s).mean_share
                for name, held in self._held.items()
            ]
            self.held_shares += shares
            longer = math.sqrt(_OFF / max(max(shares), 1e-9))
            self._interval_s = min(self._interval_s * min(max(longer, 0.5), 2.0), _LONGEST_S)
        self._held, self._held_in = fresh, snapshot

    def _rendered(self, name: str, snapshot: Snapshot, kept: dict[Hashable, Any]) -> Rates:
        from nir_render.transport.render import render  # Mitsuba loads only where light is rendered

        return electron_rates(render(snapshot, name, self._seed, kept=kept), snapshot)

    def _frame(self, snapshot: Snapshot, light: Light) -> RawFrame:
        name = light.camera
        direct = electron_rates(light, snapshot)
        rates = rates_between(direct, ((1.0, self._held[name]),))
        camera = rates.camera
        setting = own_setting(camera, self._index)
        begin_s = snapshot.time_s - mid_exposure_s(camera, setting.exposure_s)
        mean = exposed_frame(rates, setting.exposure_s, begin_s)
        key = RandomKey(self._seed, "read_out", name, self._index)
        return frame_of(mean.electrons, camera, setting, begin_s, key)
