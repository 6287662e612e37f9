"""Physically based rendering of raw frames from narrowband near-infrared cameras.

scene = load_scene("scenes/one_source.yaml")
light = render(scene, camera="r1.front")
frame = expose(light, scene, exposure_s=2e-4)
"""

from nir_render.errors import InputError
from nir_render.expected import expected_electrons
from nir_render.scene.load import Scene, load_scene
from nir_render.simulate import Shot, expose, render, simulate
from nir_render.transport.cache import LightCache
from nir_render.transport.light import DirectTable, Indirect, Light

__all__ = [
    "DirectTable",
    "Indirect",
    "InputError",
    "Light",
    "LightCache",
    "Scene",
    "Shot",
    "expected_electrons",
    "expose",
    "load_scene",
    "render",
    "simulate",
]
