"""Whether a source's light stands alone beside much stronger light, and what that costs: one JSON object.

    python benchmarks/weak_groups.py [--seeds 10] [--only fog,yard,workshop,…] [--keep FILE]

Each scene is rendered with all its light, and again by the sources alone, sun and sky taken away and lamps
dimmed to nothing; the light of each source's own array is compared, as it is when frames are exposed with the
others off, in 16 × 12 tiles.

`median_tile`, `darkest_tile` and `whole` are relative errors of one render against the sources alone (twice
the seeds), the median over seeds; `whole_said` is the standard error that the render says itself, and
`whole_z_rms`, `tile_z_rms` are errors over what is said of both; `noise_to_own` is σ over that of as many
samples of the sources alone. `cost` is the variance of the strongest group, between seeds, summed over the
film, × CPU seconds; `cost_as_said` the same by what renders say.

`holm` has the p-value of each source's `mean_of_seeds` (Student's t, of the seeds less one), the smallest
times their number, and which differ by Holm's procedure at 5 %. `--keep` writes figures scene by scene.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.special import stdtr

import nir_render as nr
from nir_render.light.light import Indirect
from nir_render.scene.scene import Scene
from nir_render.transport.backend.variant import backend
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.guide import group_power

Array = NDArray[np.float64]

_TILES = 12, 16
_SCENES = Path(__file__).parents[1] / "scenes"
_SPECTRUM = {"gaussian": {"centroid": "940 nm", "fwhm": "42 nm"}}
_REFERENCE_SEEDS = 2
_HOLM_LEVEL = 0.05


def source_beside_sun(samples: int = 256, columns: int = 64) -> Scene:
    """Return a source of 1 W in fog over a floor, and the sun."""
    source = {"flux": "1 W", "radius": "0.02 m", "spectrum": _SPECTRUM}
    document: dict[str, Any] = {
        "format": 1,
        "observe": ["eye.c"],
        "render": {"indirect": {"scale": 1, "samples": samples, "max_depth": 8}},
        "fog": {"extinction": "0.12 /m", "top": "3 m", "albedo": 0.9995,
                "phase": {"type": "henyey_greenstein", "g": 0.8}},
        "sun": {"azimuth": "60 deg", "elevation": "40 deg", "irradiance": "0.287 W/m^2/nm"},
        "materials": {"grey": {"type": "diffuse", "reflectance": 0.3}},
        "shapes": {"floor": {"type": "rectangle", "center": "[5, 0, 0] m", "size": "[40, 40] m",
                             "normal": [0, 0, 1], "material": "grey"}},
        "robots": {
            "eye": {"position": "[0, 0, 1] m", "rig": {"cameras": {"c": {
                "lens": {"focal_length": "1.8 mm", "f_number": 2.0, "transmission": 0.9},
                "sensor": {"columns": columns, "rows": columns * 3 // 4,
                           "pixel_pitch": f"{3840.0 / columns} um", "quantum_efficiency": 0.15,
                           "full_well": "1e+7 e", "read_noise": "1 e",
                           "system_gain": "0.0004 DN/e", "black_level": "10 DN", "bit_depth": "12 bit"},
                "point_spread": {"sigma": "0.7 px"}, "exposure": "1 ms"}}}},
            "r": {"position": "[4, 0.5, 1] m", "rig": {"sources": {"s": source}}},
        },
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.yaml"
        path.write_text(yaml.safe_dump(document))
        return nr.load_scene(path)


def of_library(name: str, samples: int, scale: int) -> Scene:
    """Return a scene of the library, of fixed samples in blocks of a scale."""
    scene = nr.load_scene(_SCENES / f"{name}.yaml")
    return scene.with_({"render.indirect.samples": samples, "render.indirect.scale": scale})


def alone(scene: Scene) -> Scene:
    """Return a scene by its sources alone: without sun and sky, its lamps dimmed to nothing."""
    changes: dict[str, Any] = {
        name: None for name in ("sun", "sky") if getattr(scene.document, name) is not None
    }
    if scene.document.illuminance is not None:
        changes["illuminance"] = None
    changes |= {f"lamps.{name}.luminous_flux": "1e-9 lm" for name in scene.document.lamps}
    return scene.with_(changes)


def rendered(scene: Scene, seed: int) -> Indirect:
    """Return the indirect light of a scene's camera, its groups chosen as `nr.render` would."""
    (name,) = scene.cameras()
    snapshot = scene.at(0.0)
    placed = snapshot.camera(name)
    light = groups.indirect(
        snapshot, groups.rays_of(placed.camera, placed.pose), seed, group_power(snapshot, placed.camera)
    )
    assert light is not None
    return light


def tiles(images: NDArray[np.float32]) -> Array:
    """Return sums over tiles, shape (groups, tiles), of a film that they divide."""
    values = images[:, 0].astype(np.float64)
    count, rows, columns = values.shape
    down, across = _TILES
    parts = values.reshape(count, down, rows // down, across, columns // across)
    return np.asarray(parts.sum(axis=(2, 4)).reshape(count, -1))


def compare(scene: Scene, seeds: int) -> dict[str, Any]:
    """Return, by source, how its array beside the others differs from its own; and the strongest's cost."""
    own_scene = alone(scene)
    names = scene.at(0.0).groups
    sources = [index for index, name in enumerate(names) if name in scene.at(0.0).sources]
    own_of = [own_scene.at(0.0).groups.index(names[index]) for index in sources]
    own, own_variance = _mean_of_many(own_scene, seeds * _REFERENCE_SEEDS)
    rendered(scene, 0)
    begun = time.process_time()
    lights = [rendered(scene, seed) for seed in range(1, seeds + 1)]
    taken_s = (time.process_time() - begun) / seeds
    means = np.stack([tiles(light.radiance_per_w) for light in lights])
    variances = np.stack([tiles(light.variance) for light in lights])
    result: dict[str, Any] = {"seconds": taken_s, "groups": len(names)}
    strongest = int(np.argmax(group_power(scene.at(0.0), scene.camera(scene.cameras()[0])[1])))
    spread = np.stack([light.radiance_per_w[strongest, 0] for light in lights]).var(axis=0, ddof=1).sum()
    result["strong"] = {
        "group": names[strongest],
        "cost": float(spread) * taken_s,
        "cost_as_said": float(variances[:, strongest].sum() / seeds) * taken_s,
    }
    for index, own_index in zip(sources, own_of, strict=True):
        mean, said, wanted = means[:, index], variances[:, index], own[own_index]
        lit = wanted > 1e-3 * wanted.max()
        error = (mean - wanted)[:, lit]
        z = error / np.sqrt(said + own_variance[own_index])[:, lit]
        relative = error / wanted[lit]
        whole = mean.sum(axis=1) / wanted.sum() - 1.0
        whole_said = np.sqrt(said.sum(axis=1)) / wanted.sum()
        own_said = np.sqrt(own_variance[own_index].sum()) / wanted.sum()
        result[names[index]] = {
            "median_tile": float(np.median(relative)),
            "darkest_tile": float(np.median(relative.min(axis=1))),
            "whole": float(np.median(whole)),
            "whole_said": float(np.median(whole_said)),
            "mean_of_seeds": float(whole.mean()),
            "mean_of_seeds_error": float(np.hypot(whole.std(ddof=1) / seeds**0.5, own_said)),
            "whole_z_rms": float(np.sqrt(np.mean(whole**2 / (whole_said**2 + own_said**2)))),
            "tile_z_rms": float(np.sqrt(np.mean(z**2))),
            "noise_to_own": float(
                np.sqrt(said.sum() / seeds / (own_variance[own_index].sum() * seeds * _REFERENCE_SEEDS))
            ),
        }
    return result


def _mean_of_many(scene: Scene, seeds: int) -> tuple[Array, Array]:
    """Return tile sums of the mean of renders, and the variance of these, shape (groups, tiles) each."""
    parts = np.stack([tiles(rendered(scene, 1000 + seed).radiance_per_w) for seed in range(seeds)])
    return parts.mean(axis=0), parts.var(axis=0, ddof=1) / seeds


def holm(result: dict[str, Any], seeds: int) -> dict[str, Any]:
    """Return which sources' arrays differ from their own renders, by Holm's procedure over all of them."""
    p_values = {}
    for scene, figures in result.items():
        for name, one in figures.items() if isinstance(figures, dict) else ():
            if isinstance(one, dict) and "mean_of_seeds" in one:
                t = abs(one["mean_of_seeds"]) / one["mean_of_seeds_error"]
                p_values[f"{scene}: {name}"] = float(2.0 * stdtr(seeds - 1, -t))
    ordered = sorted(p_values, key=lambda key: p_values[key])
    differing: list[str] = []
    for rank, key in enumerate(ordered):
        if p_values[key] * (len(ordered) - rank) > _HOLM_LEVEL:
            break
        differing.append(key)
    smallest = p_values[ordered[0]] * len(ordered) if ordered else 1.0
    return {"p_values": p_values, "smallest_times_number": smallest, "differing": differing}


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", default="fog,yard,greenhouse,glass_room,workshop,yard_in_fog,hall")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    scenes: dict[str, Callable[[], Scene]] = {
        "fog": source_beside_sun,
        "yard": lambda: of_library("sunlit_yard", 32, 2),
        "greenhouse": lambda: of_library("greenhouse", 16, 4),
        "glass_room": lambda: of_library("glass_room", 16, 4),
        "workshop": lambda: of_library("workshop", 16, 4),
        "yard_in_fog": lambda: of_library("yard_in_fog", 64, 4),
        "hall": lambda: of_library("foggy_hall", 64, 8),
    }
    result: dict[str, Any] = {"variant": backend().variant, "seeds": options.seeds}
    for name in options.only.split(","):
        result[name] = compare(scenes[name](), options.seeds)
        result["holm"] = holm(result, options.seeds)
        if options.keep is not None:
            options.keep.write_text(json.dumps(result, indent=1))
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
