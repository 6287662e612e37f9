"""How fast and exact light is rendered, side by side with Mitsuba's own integrators: one JSON object.

    python benchmarks/transport.py [--quick] [--only groups,many,scaling,fog,smooth,nodes,memory]

Times are medians of five renders of 640 × 480 pixels, 64 samples, depth 6, one after the other in this
process. Variances are those between seeds (the same number for both sides), median over the pixels; a gain is
variance × time of Mitsuba over variance × time of ours. Light that comes straight is left out but where the
field says otherwise. Mitsuba renders all sources at once, into one image; ours gives one array per source.
`fog_gain_scattered` is of light that fog alone scatters, between black surfaces; `fog_gain_room` of all
indirect light in the room with its walls; `clear_gain` and `fog_gain` of the light in flares' apertures,
straight light included. `nodes_time_ratio_N` is the time of light carried at N wavelengths over that at one,
the same walls by their values at 940 nm.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

import nir_render as nr
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.scene.scene import Scene
from nir_render.transport.backend.variant import backend
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.enlarging_error import upsampling_error
from nir_render.transport.indirect.stock import mitsuba_camera
from nir_render.transport.world import mitsuba_scene as world

Array = NDArray[np.float64]

SAMPLES, DEPTH, RADIUS_M = 64, 6, 0.01
ROOM, HALL = (8.0, 6.0, 3.0), (40.0, 40.0, 4.0)
GREY = {"type": "diffuse", "reflectance": 0.3}
BLACK = {"type": "diffuse", "reflectance": 0.0}
MATERIALS: dict[str, dict[str, Any]] = {
    "white": {"type": "diffuse", "reflectance": 0.8},
    "grey": GREY,
    "metal": {"type": "rough_conductor", "index": 1.4, "extinction_index": 9.2, "roughness": 0.2},
    "carpet": {"type": "plastic", "index": 1.5, "reflectance": 0.25, "roughness": 0.3},
}


def build(
    robots: int,
    extent_m: tuple[float, float, float],
    columns: int,
    extinction_per_m: float = 0.0,
    boxes: int = 3,
    *,
    black: bool = False,
) -> Scene:
    """Return a room without ceiling: four walls, a floor, boxes, robots of one source each, one camera.

    All surfaces are black if so wished: then only fog scatters.
    """
    random = np.random.default_rng(0)
    length_m, width_m, height_m = extent_m

    def wall(center: tuple[float, ...], size: tuple[float, float], normal: list[int], material: str) -> Any:
        return {
            "type": "rectangle", "center": f"{list(center)} m", "size": f"{list(size)} m", "normal": normal,
            "material": material,
        }  # fmt: skip

    shapes = {
        "floor": wall((0.0, 0.0, 0.0), (length_m, width_m), [0, 0, 1], "carpet"),
        "ahead": wall((length_m / 2, 0.0, height_m / 2), (width_m, height_m), [-1, 0, 0], "white"),
        "behind": wall((-length_m / 2, 0.0, height_m / 2), (width_m, height_m), [1, 0, 0], "grey"),
        "left": wall((0.0, width_m / 2, height_m / 2), (length_m, height_m), [0, -1, 0], "metal"),
        "right": wall((0.0, -width_m / 2, height_m / 2), (length_m, height_m), [0, 1, 0], "grey"),
    }
    for box in range(boxes):
        x, y = random.uniform([-0.4 * length_m, -0.4 * width_m], [0.4 * length_m, 0.4 * width_m])
        shapes[f"box{box}"] = {
            "type": "box", "center": f"[{x:.3f}, {y:.3f}, 0.3] m", "size": "[0.6, 0.6, 0.6] m",
            "material": "grey",
        }  # fmt: skip
    places_m = random.uniform(
        [-0.45 * length_m, -0.45 * width_m, 0.3], [0.45 * length_m, 0.45 * width_m, 1.0], (robots, 3)
    )
    near = np.hypot(places_m[:, 0], places_m[:, 1]) < 0.5
    places_m[near, 0] += 1.0
    led = {"preset": "infra_swarm", "radius": f"{RADIUS_M} m", "position": "[0, 0, 0] m"}
    document: dict[str, Any] = {
        "format": 1,
        "observe": ["eye.c"],
        "render": {"indirect": {"scale": 1, "samples": SAMPLES, "max_depth": DEPTH}},
        "materials": {name: BLACK if black else material for name, material in MATERIALS.items()},
        "shapes": shapes,
        "robots": {
            "eye": {
                "position": "[0, 0, 0.5] m",
                "orientation": {"yaw": "17 deg"},
                "rig": {"cameras": {"c": _camera(columns)}},
            },
            **{
                f"r{index}": {
                    "position": f"{np.round(place, 4).tolist()} m",
                    "rig": {"sources": {"led": led}},
                }
                for index, place in enumerate(places_m)
            },
        },
    }
    if extinction_per_m > 0.0:
        document["fog"] = {
            "extinction": f"{extinction_per_m} /m",
            "albedo": 0.9995,
            "phase": {"type": "henyey_greenstein", "g": 0.85},
        }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.yaml"
        path.write_text(yaml.safe_dump(document))
        return nr.load_scene(path)


def fog_room(extinction_per_m: float, black: bool, columns: int) -> Scene:
    """Return the room with four robots in fog; of black surfaces, nothing is seen but what fog scatters."""
    return build(4, ROOM, columns, extinction_per_m, black=black)


def _camera(columns: int) -> dict[str, Any]:
    return {
        "lens": {"focal_length": "1.8 mm", "f_number": 2.0, "transmission": 0.9},
        "sensor": {
            "columns": columns, "rows": columns * 3 // 4, "pixel_pitch": f"{3840.0 / columns} um",
            "quantum_efficiency": 0.15, "full_well": "10500 e", "read_noise": "2.3 e",
            "system_gain": "0.35 DN/e", "black_level": "60 DN", "bit_depth": "12 bit",
        },
        "point_spread": {"sigma": "0.7 px"},
        "exposure": "1 ms",
    }  # fmt: skip


def ours(scene: Scene, seed: int) -> Any:
    """Return our indirect light."""
    camera = scene.camera("eye.c")[1]
    rays = groups.rays_of(camera, scene.at(0.0).camera("eye.c").pose)
    return groups.indirect(scene.at(0.0), rays, seed, np.ones(len(scene.at(0.0).groups)))


class Stock:
    """The same scene with all sources on, for Mitsuba's `path`, or `volpath` where there is fog."""

    def __init__(self, scene: Scene) -> None:
        mi = backend().mi
        _, camera = scene.camera("eye.c")
        fog = scene.document.fog
        medium = None
        if fog is not None:
            medium = mi.load_dict(
                {
                    "type": "homogeneous",
                    "albedo": {"type": "uniform", "value": fog.albedo},
                    "sigma_t": {"type": "uniform", "value": fog.extinction_per_m},
                    "phase": {"type": "hg", "g": 0.85},
                }
            )
        bodies = world.described(scene.at(0.0), emitting=scene.sources())
        if medium is not None:
            for body in bodies.values():
                if isinstance(body, dict):
                    body["exterior"] = medium
            bodies["air"] = {
                "type": "cube",
                "to_world": mi.ScalarTransform4f().scale(100.0),
                "interior": medium,
            }
            bodies["air"]["bsdf"] = {"type": "null"}
        self.bodies = mi.load_dict(bodies, optimize=False)
        self.sensor = mitsuba_camera(camera, scene.at(0.0).camera("eye.c").pose, 1, medium)
        self.kind = "path" if fog is None else "volpath"

    def render(self, seed: int, straight: bool = True) -> Array:
        """Return the image; without `straight`, less what the same seed renders at depth 1."""
        whole = self._render(DEPTH, seed)
        return whole if straight else whole - self._render(1, seed)

    def _render(self, depth: int, seed: int) -> Array:
        mi = backend().mi
        integrator = mi.load_dict({"type": self.kind, "max_depth": depth})
        image = mi.render(self.bodies, sensor=self.sensor, integrator=integrator, spp=SAMPLES, seed=seed)
        return np.array(image, dtype=np.float64)[..., 0]


def seconds(*calls: Callable[[], Any], repeats: int) -> list[float]:
    """Return the median time of each call, taken in turns, after one of each that is not counted."""
    for call in calls:
        call()
    taken: list[list[float]] = [[] for _ in calls]
    for _ in range(repeats):
        for call, times in zip(calls, taken, strict=True):
            started = time.perf_counter()
            call()
            times.append(time.perf_counter() - started)
    return [float(np.median(times)) for times in taken]


def _spread(images: list[Array]) -> float:
    """Return the variance between seeds, median over the pixels that any light reaches."""
    variance = np.stack(images).var(axis=0, ddof=1)
    return float(np.median(variance[np.stack(images).mean(axis=0) > 0.0]))


def compare(scene_of: Callable[[int], Scene], repeats: int, seeds: int) -> dict[str, float]:
    """Return time, variance and gain of one scene; `scene_of` gives it for a number of columns."""
    large, small = scene_of(640), scene_of(160)
    stock = Stock(large)
    mine_s, stock_s = seconds(lambda: ours(large, 1), lambda: stock.render(1), repeats=repeats)
    stock = Stock(small)
    mine = [ours(small, seed).radiance_per_w[:, 0].sum(axis=0).astype(float) for seed in range(seeds)]
    whole = [stock.render(seed) for seed in range(seeds)]
    # In fog depth 1 is noisy itself; the straight light is then left out with the few pixels that it fills.
    indirect = (
        whole if stock.kind == "volpath" else [stock.render(seed, straight=False) for seed in range(seeds)]
    )
    variance_ratio = _spread(mine) / _spread(indirect)
    flares = _apertures(small)
    mine_flare = np.median([np.var([image[flare].sum() for image in mine], ddof=1) for flare in flares])
    stock_flare = np.median([np.var([image[flare].sum() for image in whole], ddof=1) for flare in flares])
    return {
        "seconds": mine_s,
        "stock_seconds": stock_s,
        "time_ratio": mine_s / stock_s,
        "variance_ratio": variance_ratio,
        "gain": stock_s / (mine_s * variance_ratio),
        "gain_in_flares": stock_s * float(stock_flare) / (mine_s * float(mine_flare)),
    }


def _apertures(scene: Scene) -> list[Any]:
    """Return the pixels within 1.5 px of each source's image that is on the sensor."""
    camera = scene.camera("eye.c")[1]
    pose, lens = scene.at(0.0).camera("eye.c").pose, intrinsics_of(camera)
    rows, columns = np.mgrid[: lens.height_px, : lens.width_px]
    found = []
    for center_m in (placed.pose.position_m for placed in scene.at(0.0).sources.values()):
        u_px, v_px = lens.project(pose.to_local(center_m))
        inside = np.hypot(columns - u_px, rows - v_px) <= 1.5
        if inside.any():
            found.append(inside)
    return found


def scaling(repeats: int, seeds: int) -> dict[str, float]:
    """Return how the time to one relative error of the summed frame grows with the number of robots."""
    cost: dict[str, float] = {}
    counts = (8, 32, 128, 512)
    for robots in counts:
        scene = build(robots, HALL, 160, boxes=20)
        (taken_s,) = seconds(lambda scene=scene: ours(scene, 1), repeats=repeats)
        images = [ours(scene, seed).radiance_per_w[:, 0].sum(axis=0).astype(float) for seed in range(seeds)]
        lit = np.stack(images).mean(axis=0) > 0.0
        relative = np.stack(images).var(axis=0, ddof=1)[lit] / np.stack(images).mean(axis=0)[lit] ** 2
        cost[f"seconds_times_relative_variance_{robots}"] = taken_s * float(np.median(relative))
    exponent = np.polyfit(np.log(counts), np.log(list(cost.values())), 1)[0]
    return {**cost, "scaling_exponent": float(exponent)}


def smooth(repeats: int) -> dict[str, float]:
    """Return what blocks of 4 × 4 pixels for the indirect part gain, at 1280 × 960, and their error.

    Edges, pixels rendered one by one and straight light are part of both times.
    """
    full = build(4, ROOM, 1280)
    coarse = full.with_({"render.indirect.scale": 4})
    full_s, coarse_s = seconds(
        *(lambda scene=scene: nr.render(scene, "eye.c") for scene in (full, coarse)), repeats=repeats
    )
    light = nr.render(coarse, "eye.c")
    exposure_s = coarse.camera("eye.c")[1].exposure_s
    mean = mean_frame(light, coarse.at(0.0), exposure_s)
    error = upsampling_error(mean, pixels=4096, samples=512)
    assert not isinstance(error, str)
    mean_e = float(mean.electrons.mean())
    temporal_e2 = mean_e + coarse.camera("eye.c")[1].sensor.read_noise_e ** 2
    return {
        "smooth_gain": full_s / coarse_s,
        "smooth_error_over_shot_variance": error.share * temporal_e2 / mean_e,
        "smooth_error_standard_error": error.standard_error * temporal_e2 / mean_e,
        "smooth_mean_e": mean_e,
        "smooth_seconds": coarse_s,
    }


def nodes(repeats: int) -> dict[str, float]:
    """Return what 2, 4 and 8 wavelengths cost over one, of 4 and of 32 light groups, by time.

    One wall varies over the spectrum; direct light, which takes no time to speak of, is left out.
    """
    dip = [["300 nm", 0.9], ["900 nm", 0.9], ["940 nm", 0.05], ["980 nm", 0.9], ["1100 nm", 0.9]]
    result = {}
    for robots in (4, 32):
        world = build(robots, ROOM, 640).with_({"materials.white.reflectance": {"points": dip}}).at(0.0)
        rays = groups.rays_of(world.camera("eye.c").camera, world.camera("eye.c").pose)
        power = np.ones(len(world.groups))
        counts = (1, 2, 4, 8)
        calls = [
            partial(
                groups.indirect, world, rays, 1, power, wavelengths_m=tuple(np.linspace(920e-9, 960e-9, n))
            )
            for n in counts
        ]
        one_s, *several_s = seconds(*calls, repeats=repeats)
        result[f"nodes_seconds_1_groups_{robots}"] = one_s
        for n, taken_s in zip(counts[1:], several_s, strict=True):
            result[f"nodes_time_ratio_{n}_groups_{robots}"] = taken_s / one_s
    return result


def memory() -> dict[str, float]:
    """Return the largest resident memory of a process that renders 512 groups at 1280 × 960."""
    code = (
        "import benchmarks.transport as t\n"
        "scene = t.build(512, t.HALL, 1280, boxes=20).with_({'render.indirect.samples': 8})\n"
        "light = t.ours(scene, 1)\n"
        "print(light.radiance_per_w[:, 0].sum(axis=0).mean())\n"
    )
    started = time.perf_counter()
    subprocess.run(  # noqa: S603 (this program itself)
        [sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1], capture_output=True
    )
    peak_kib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return {
        "resident_gib_512_groups": peak_kib / 2**20,
        "seconds_512_groups_8_samples": time.perf_counter() - started,
    }


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two repeats and six seeds")
    parser.add_argument("--only", default="groups,many,scaling,fog,smooth,nodes,memory")
    options = parser.parse_args()
    repeats, seeds = (2, 6) if options.quick else (5, 16)
    wanted = set(options.only.split(","))
    result: dict[str, Any] = {"variant": backend().variant, "repeats": repeats, "seeds": seeds}
    if "groups" in wanted:
        four = compare(lambda columns: build(4, ROOM, columns), repeats, seeds)
        many = compare(lambda columns: build(32, ROOM, columns), repeats, seeds)
        result |= {
            "groups_time_ratio_4": four["time_ratio"],
            "groups_time_ratio_32": many["time_ratio"],
            "sum_variance_ratio_32": many["variance_ratio"],
            "clear_gain_indirect": four["gain"],
            "clear_gain": four["gain_in_flares"],
            "details_4": four,
            "details_32": many,
        }
    if "many" in wanted:
        hall = compare(lambda columns: build(128, HALL, columns, boxes=20), repeats, seeds)
        result |= {"many_gain_128": hall["gain"], "details_128": hall}
    if "fog" in wanted:
        for extinction_per_m in (0.05, 0.2):
            scattered, room = (
                compare(partial(fog_room, extinction_per_m, black), repeats, seeds) for black in (True, False)
            )
            result |= {
                f"fog_gain_scattered_{extinction_per_m}": scattered["gain"],
                f"fog_gain_room_{extinction_per_m}": room["gain"],
                f"fog_gain_{extinction_per_m}": room["gain_in_flares"],
                f"details_fog_scattered_{extinction_per_m}": scattered,
                f"details_fog_room_{extinction_per_m}": room,
            }
    if "smooth" in wanted:
        result |= smooth(repeats)
    if "nodes" in wanted:
        result |= nodes(repeats)
    if "scaling" in wanted:
        result |= scaling(min(repeats, 3), seeds)
    if "memory" in wanted:
        result |= memory()
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
