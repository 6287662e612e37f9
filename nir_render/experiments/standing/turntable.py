"""The paper's Exp. 2: a source turns about its robot's vertical axis, bare and under its shade."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.camera.mean_frame import Rates, electron_rates
from nir_render.experiments.loop.journal import Told
from nir_render.experiments.standing.sightings import set_exposure_s, sight
from nir_render.scene.pose import Pose
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from perception import Calibration

TURNTABLE = Path(__file__).parents[2] / "data" / "experiments" / "turntable.yaml"
CAMERA = "observer.front"
SOURCES = ("bare", "diffused")

_AWAY_M = 1.0


@dataclass(frozen=True)
class Turntable:
    """What a run of the experiment is: how far the source turns, by what, how many frames at each angle."""

    reach_deg: float = 85.0
    step_deg: float = 5.0
    frames: int = 4

    @property
    def angles_deg(self) -> tuple[float, ...]:
        """All angles, from one end to the other."""
        count = round(2.0 * self.reach_deg / self.step_deg) + 1
        return tuple(np.linspace(-self.reach_deg, self.reach_deg, count).tolist())

    def loop(self, scene: Scene, seed: int) -> "TurntableLoop":
        """Return the beginning of a run."""
        return TurntableLoop(scene, self, seed)


class TurntableLoop:
    """A run in the making; a step is an angle of both sources. The exposure of each is fixed at 0°."""

    def __init__(self, scene: Scene, plan: Turntable, seed: int) -> None:
        self.plan, self.seed = plan, seed
        self._scenes = {
            name: scene.with_({"robots.source.rig.sources.top.preset": name, "seed": seed})
            for name in SOURCES
        }
        # As a rail would calibrate it: the source faces the camera.
        self._known, self._exposure_s = {}, {}
        for name, one in self._scenes.items():
            facing = self._rates(name, 0.0)
            known = calibration(one, CAMERA)
            constant = known.system_gain_dn_per_e * facing.windows[0].total * _AWAY_M**2
            self._known[name] = replace(known, range_constant_dn_m2_per_s=constant)
            self._exposure_s[name] = set_exposure_s(facing, known)
        self.taken: list[list[dict[str, Any]]] = []

    @property
    def steps(self) -> int:
        """How many angles there are."""
        return len(self.plan.angles_deg)

    @property
    def done(self) -> int:
        """How many of them are done."""
        return len(self.taken)

    def calibrations(self) -> list[Calibration]:
        """Return none: no frames are kept."""
        return []

    def step(self) -> Told:
        """Take the frames of the next angle."""
        angle_deg, rows = self.plan.angles_deg[self.done], []
        for number, name in enumerate(SOURCES):
            rates = self._rates(name, angle_deg)
            for frame in range(self.plan.frames):
                index = (self.done * len(SOURCES) + number) * self.plan.frames + frame
                one = sight(rates, self._known[name], self._exposure_s[name], index, self.seed)
                rows.append({"source": name, "angle_deg": angle_deg, **one.record()})
        self.taken.append(rows)
        return Told({})

    def record(self) -> dict[str, Any]:
        """Return a run that is done as plain data: every sighting."""
        return {"format": 1, "seed": self.seed, "sightings": [row for rows in self.taken for row in rows]}

    def _rates(self, name: str, angle_deg: float) -> Rates:
        from nir_render.transport.render import direct_light

        facing = Pose.of((_AWAY_M, 0.0, 0.0), yaw_rad=np.pi + np.radians(angle_deg))
        world = self._scenes[name].at(0.0).moved({"source": facing})
        return electron_rates(direct_light(world, CAMERA, self.seed), world)
