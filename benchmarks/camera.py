"""How long a raw frame takes once its light is rendered: one JSON object, medians in milliseconds.

    python benchmarks/camera.py

Frames of 1280 × 960 pixels of the arena's front camera, with its own exposure, on all processors: seven light
groups. `expose_ms` is one frame of a light whose rates are known (indirect light enlarged, weighted with the
response and blurred: `rates_ms`, once per light); in `expose_driven_ms` every source blinks on its own.
`mean_ms` is the frame without noise, `read_out_ms` all noise and the converter; `poisson_ms` is the shot
noise alone, `numpy_poisson_ms` the same by numpy's own generator, both on one processor.
"""

import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import nir_render as nr
from nir_render.camera.mean_frame import electron_rates, exposed_frame
from nir_render.camera.sensor.read_out import read_out
from nir_render.camera.sensor.shot_noise import EXPANSION_MEAN, poisson
from nir_render.randomness import RandomKey, generator

RUNS = 15
CAMERA = "r1.front"
BLOCK = 131072


def main() -> None:
    """Time each part in turn, over and over, and print the medians."""
    scene = nr.load_scene(Path(__file__).parents[1] / "scenes" / "arena.yaml")
    scene = scene.with_({"render.indirect.samples": 8})
    light = nr.render(scene, CAMERA)
    bits = {"bits": {"pattern": "0101101111", "rate": "10 Hz"}}
    blinking = scene.with_(
        {f"robots.r{number}.rig.sources.top": {"preset": "infra_swarm", "position": "[0, 0, 0.28] m",
         "drive": bits | {"bits": bits["bits"] | {"start": f"{number} ms"}}} for number in range(2, 6)}
        | {"robots.r1.rig.sources.top.drive": bits}
    )  # fmt: skip
    device = scene.camera(CAMERA)[1]
    of_light, of_blinking = electron_rates(light, scene.at(0.0)), electron_rates(light, blinking.at(0.0))
    exposure_s = 2.5e-4
    mean = exposed_frame(of_light, exposure_s)
    flat = mean.electrons.astype(np.float32).ravel()
    key = RandomKey(1, "read_out", CAMERA, 0)

    def shot(part: slice, block: int) -> None:
        few = flat[part]
        large = key.words("shot", block, few.size + few.size % 2)
        poisson(few, large, key.words("few", block, few.size) if few.min() < EXPANSION_MEAN else None)

    blocks = [slice(first, first + BLOCK) for first in range(0, flat.size, BLOCK)]

    def frame_of(taken: nr.Scene, number: int) -> None:
        nr.expose(light, taken, exposure_s=exposure_s, index=number)

    parts: dict[str, Callable[[], object]] = {
        "expose_ms": lambda: frame_of(scene, 1),
        "mean_ms": lambda: exposed_frame(of_light, exposure_s),
        "mean_driven_ms": lambda: exposed_frame(of_blinking, exposure_s, 0.01),
        "read_out_ms": lambda: read_out(mean.electrons, device, exposure_s, key),
        "read_out_one_ms": lambda: read_out(mean.electrons, device, exposure_s, key, threads=1),
        "poisson_ms": lambda: [shot(part, number) for number, part in enumerate(blocks)],
        "numpy_poisson_ms": lambda: generator(1, "read_out", CAMERA, 0).poisson(mean.electrons),
        "rates_ms": lambda: electron_rates(light, scene.at(0.0)),
    }
    spent_ms: dict[str, list[float]] = {name: [] for name in parts}
    frame_of(scene, 0)
    for _ in range(RUNS):
        for name, work in parts.items():
            started = time.perf_counter()
            work()
            spent_ms[name].append(1e3 * (time.perf_counter() - started))
    driven_ms = []
    frame_of(blinking, 0)
    for number in range(RUNS):
        started = time.perf_counter()
        frame_of(blinking, number)
        driven_ms.append(1e3 * (time.perf_counter() - started))
    medians = {name: round(statistics.median(times), 2) for name, times in spent_ms.items()}
    print(
        json.dumps(
            {
                "benchmark": "camera",
                "pixels": list(mean.electrons.shape),
                "groups": len(light.groups),
                "mean_electrons": round(float(mean.electrons.mean()), 2),
                "processors": os.cpu_count(),
                "runs": RUNS,
                "expose_driven_ms": round(statistics.median(driven_ms), 2),
                **medians,
                "poisson_gain": round(medians["numpy_poisson_ms"] / medians["poisson_ms"], 2),
            }
        )
    )


if __name__ == "__main__":
    main()
