"""Physically based rendering of raw frames from narrowband near-infrared cameras.

    scene = load_scene("scenes/one_source.yaml")
    light = render(scene, camera="r1.front")
    frame = expose(light, scene, exposure_s=2e-4)

Light is rendered once and exposed as often as one likes; `perception` reads the frames.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nir_render.errors import InputError
    from nir_render.light.light import DirectTable, Indirect, Light
    from nir_render.scene.documents.times.drives import Drive
    from nir_render.scene.load import load_scene
    from nir_render.scene.pose import Pose
    from nir_render.scene.scene import Scene, parse_scene
    from nir_render.scene.snapshot import Snapshot
    from nir_render.simulation.calibration import calibration
    from nir_render.simulation.clock import Shot, expected_electrons, expose, render, simulate, take_frame
    from nir_render.transport.cache import LightCache
    from nir_render.truth.lamps import LampTruth
    from nir_render.truth.sources import SourceTruth

__all__ = [
    "DirectTable",
    "Drive",
    "Indirect",
    "InputError",
    "LampTruth",
    "Light",
    "LightCache",
    "Pose",
    "Scene",
    "Shot",
    "Snapshot",
    "SourceTruth",
    "calibration",
    "expected_electrons",
    "expose",
    "load_scene",
    "parse_scene",
    "render",
    "simulate",
    "take_frame",
]

_HOMES = {
    "DirectTable": "light.light",
    "Drive": "scene.documents.times.drives",
    "Indirect": "light.light",
    "InputError": "errors",
    "LampTruth": "truth.lamps",
    "Light": "light.light",
    "LightCache": "transport.cache",
    "Pose": "scene.pose",
    "Scene": "scene.scene",
    "Shot": "simulation.clock",
    "Snapshot": "scene.snapshot",
    "SourceTruth": "truth.sources",
    "calibration": "simulation.calibration",
    "expected_electrons": "simulation.clock",
    "expose": "simulation.clock",
    "load_scene": "scene.load",
    "parse_scene": "scene.scene",
    "render": "simulation.clock",
    "simulate": "simulation.clock",
    "take_frame": "simulation.clock",
}
"""Where each name lives: its module loads when it is first asked for, so that the command starts at once."""


if not TYPE_CHECKING:  # or mypy would take any name for one of these

    def __getattr__(name: str) -> Any:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
