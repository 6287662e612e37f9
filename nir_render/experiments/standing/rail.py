"""The paper's range experiment: a source 1 to 10 m before a camera, at 300 to 800 lx."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.camera.mean_frame import electron_rates
from nir_render.experiments.loop.journal import Told
from nir_render.experiments.standing.sightings import Sighting, set_exposure_s, sight
from nir_render.randomness import generator
from nir_render.scene.pose import Pose
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from perception import Calibration

RAIL = Path(__file__).parents[2] / "data" / "experiments" / "rail.yaml"
CAMERA = "observer.front"

_NEAREST_M, _FARTHEST_M = 1.0, 10.0
_ASIDE_RAD = math.radians(15.0)


@dataclass(frozen=True)
class Rail:
    """What a run of the experiment is.

    Attributes
    ----------
    places
        At how many places the source stands: one anywhere in each of as many equal parts of 1 to 10 m,
        up to 15° aside.
    frames
        How many frames are taken at each place and level.
    levels_lx
        How bright the hall is.
    """

    places: int = 24
    frames: int = 4
    levels_lx: tuple[float, ...] = (300.0, 500.0, 800.0)

    def loop(self, scene: Scene, seed: int) -> "RailLoop":
        """Return the beginning of a run."""
        return RailLoop(scene, self, seed)


class RailLoop:
    """A run in the making; a step is a place, whose light is rendered once, and exposed many times."""

    def __init__(self, scene: Scene, plan: Rail, seed: int) -> None:
        self.plan, self.seed = plan, seed
        self._scenes = {
            lux: scene.with_({"illuminance.level": f"{lux} lx", "seed": seed}) for lux in plan.levels_lx
        }
        self._known = calibration(scene, CAMERA)
        self.taken: list[list[dict[str, Any]]] = []

    @property
    def steps(self) -> int:
        """How many places there are."""
        return self.plan.places

    @property
    def done(self) -> int:
        """How many of them are done."""
        return len(self.taken)

    def calibrations(self) -> list[Calibration]:
        """Return none: no frames are kept."""
        return []

    def step(self) -> Told:
        """Render the light of the next place, and take the frames of every level."""
        from nir_render.transport.render import render

        plan, place = self.plan, self.done
        random = generator(self.seed, "places", "rail", place)
        share = (place + random.random()) / plan.places
        range_m, aside_rad = (
            _NEAREST_M + (_FARTHEST_M - _NEAREST_M) * share,
            random.uniform(-_ASIDE_RAD, _ASIDE_RAD),
        )
        worlds = {lux: self._moved(scene, range_m, aside_rad) for lux, scene in self._scenes.items()}
        # Where it is brightest render noise weighs most beside the sensor's: samples are planned there.
        light = render(worlds[max(worlds)], CAMERA, self.seed)
        rows: list[dict[str, Any]] = []
        for number, (lux, world) in enumerate(worlds.items()):
            rates = electron_rates(light, world)
            exposure_s = set_exposure_s(rates, self._known)
            for frame in range(plan.frames):
                index = (place * len(worlds) + number) * plan.frames + frame
                one: Sighting = sight(rates, self._known, exposure_s, index, self.seed)
                rows.append({"place": place, "lux": lux, **one.record()})
        self.taken.append(rows)
        return Told({})

    def record(self) -> dict[str, Any]:
        """Return a run that is done as plain data: every sighting."""
        return {"format": 1, "seed": self.seed, "sightings": [row for rows in self.taken for row in rows]}

    def _moved(self, scene: Scene, range_m: float, aside_rad: float) -> Any:
        world = scene.at(0.0)
        eye_m = world.camera(CAMERA).pose.position_m
        x_m, y_m = eye_m[:2] + range_m * np.array([math.cos(aside_rad), math.sin(aside_rad)])
        return world.moved({"source": Pose.of((float(x_m), float(y_m), 0.0))})
