"""How noisy light in fog is for the time that it takes, under lamps in it and in the sun: one JSON object.

    python benchmarks/fog_noise.py [--seeds 6] [--samples 32] [--only hall,hall_of_droplets,yard,…]

`hall` is `scenes/foggy_hall.yaml`, `yard` is `scenes/yard_in_fog.yaml`; `of_droplets`: with heavy advection
fog, whose droplets throw a third of the light within a degree, in place of Henyey and Greenstein's phase
function.

By group, and for the frame in electrons: `cost`, the variance between seeds summed over the film, over the
sum of squares of the light, × CPU seconds of a render; `median_cost`, the same of the median pixel;
`largest`, the share that the 20 largest errors of all have in the squares of all: fireflies bring it near 1.
`whole` is the sum over the film, and `whole_error` its standard error, relatively.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import nir_render as nr
from nir_render.camera.by_spectrum import group_emitters, group_fluxes
from nir_render.camera.optics.response import response
from nir_render.scene.scene import Scene
from nir_render.transport.backend.variant import backend

Array = NDArray[np.float64]

_SCENES = Path(__file__).parents[1] / "scenes"
_DROPLETS = {"fog.droplets": "advection_heavy", "fog.phase": None, "fog.albedo": None}
_LARGEST = 20


def case(name: str, samples: int) -> Scene:
    """Return a scene in blocks of 8 × 8 pixels, of fixed samples."""
    of_scene, _, droplets = name.partition("_of_")
    scene = nr.load_scene(_SCENES / {"hall": "foggy_hall.yaml", "yard": "yard_in_fog.yaml"}[of_scene])
    changes: dict[str, Any] = {"render.indirect.samples": samples, "render.indirect.scale": 8}
    return scene.with_(changes | (_DROPLETS if droplets else {}))


def noise(images: Array, cpu_s: float) -> dict[str, float]:
    """Return the figures that the head of this file names, of renders, shape (seeds, pixels)."""
    mean, square = images.mean(axis=0), images.var(axis=0, ddof=1)
    errors = np.sort(((images - mean) ** 2).ravel())
    whole = images.sum(axis=1)
    lit = mean > 0.0
    return {
        "whole": float(whole.mean()),
        "whole_error": float(whole.std(ddof=1) / len(whole) ** 0.5 / whole.mean()),
        "cost": float(square.sum() / (mean**2).sum() * cpu_s),
        "median_cost": float(np.median(square[lit] / mean[lit] ** 2) * cpu_s),
        "largest": float(errors[-_LARGEST:].sum() / errors.sum()),
    }


def measure(scene: Scene, seeds: int) -> dict[str, Any]:
    """Render a scene by some seeds, and return its noise."""
    (name,) = scene.cameras()
    nr.render(scene, camera=name, seed=0)
    begun = time.process_time()
    lights = [nr.render(scene, camera=name, seed=seed) for seed in range(1, seeds + 1)]
    cpu_s = (time.process_time() - begun) / seeds
    snapshot = scene.at(0.0)
    camera = snapshot.camera(name).camera
    count = len(snapshot.groups)
    films = [
        [light.indirect.in_frames(k, 0).ravel() for k in range(count)] for light in lights if light.indirect
    ]
    images = np.array(films, dtype=np.float64)
    responses = [float(response(camera, one)(0.0)) for one in group_emitters(lights[0], snapshot)]
    frames = np.einsum("g,sgp->sp", group_fluxes(lights[0], snapshot) * responses, images)
    of_groups = {group: noise(images[:, k], cpu_s) for k, group in enumerate(snapshot.groups)}
    return {"cpu_seconds": cpu_s, "frame": noise(frames, cpu_s), "groups": of_groups}


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--only", default="hall,hall_of_droplets,yard,yard_of_droplets")
    options = parser.parse_args()
    result: dict[str, Any] = {"variant": backend().variant, "seeds": options.seeds}
    for name in options.only.split(","):
        result[name] = measure(case(name, options.samples), options.seeds)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
