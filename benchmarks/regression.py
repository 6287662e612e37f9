"""What the regression suite sees, and how often it cries wolf: one JSON object.

    python -P benchmarks/regression.py [--clean 200] [--trials 40] [--scene NAME …] [--suite DIR]

`clean`: the suite's light rendered so often anew with seeds of its own, and how many of these whole suites
would fail; all else of a check follows from no seed, and is held once (`holds`, with the seconds it takes).
`sensor`: defects behind the light, on the reference's own light: that needs no render, and no repetition.
`light`: defects of the light alone, each `trials` times with seeds of its own, judged in the family of the
whole suite, the direct table left out: what is caught is caught by the indirect light. A wall's albedo is 5 %
lower; where several walls share a material, one of them gets its own. `code`: the same as faults of the
code, whose random numbers are those of the clean scene; of each trial's seed both are rendered, and compared
path by path, too. `harmless`: what is no fault, so compared: a camera turned by 2e-6 px, another share of the
picks for dim groups. `-P` keeps this folder off Python's path.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[1]))

from nir_render.light.light import Light
from nir_render.regress import FALSE_ALARM_RATE, check
from nir_render.regress.checking import check_scenes
from nir_render.regress.reference import Reference
from nir_render.regress.scenes_of import references_folder, scenes_of
from nir_render.regress.stages.light import compare_indirect
from nir_render.regress.stages.view import compare_view
from nir_render.regress.statistics import PartTests, judge
from nir_render.regress.store import read_reference
from nir_render.scene.scene import Scene
from nir_render.simulation.clock import render
from nir_render.transport.cache import LightCache
from nir_render.transport.indirect import guide
from tests.planted_faults import random_numbers_of

SUITE = Path(__file__).parents[1] / "scenes" / "regression"
SHIFT_PX = 0.1
Changes = dict[str, Any]


def part_tests(
    scene: Scene, reference: Reference, seed: int, own_samples: int = 0
) -> tuple[list[PartTests], bool]:
    """Return the tests of a scene's lights, rendered with a seed; and whether one fails without any test.

    `own_samples` are those of `compare_indirect`.
    """
    tests, certain = [], False
    for known in reference.lights:
        if known.light.indirect is None:
            continue
        light = render(scene, known.light.camera, known.light.time_s, seed)
        findings, pending = compare_indirect(known, light, "", alike=True, own_samples=own_samples)
        calibration = reference.calibrations[light.camera]
        findings.append(compare_view(scene, light.time_s, calibration, ""))
        certain |= any(finding.verdict == "fail" for finding in findings)
        tests += [group.parts for group in pending]
    return tests, certain


def part_tests_in_code(
    scene: Scene, faulty: Scene, reference: Reference, seed: int
) -> tuple[list[PartTests], bool]:
    """As `part_tests`, the fault in the code: faulty light has the paths of the reference's own."""
    known = own_lights(scene, reference, seed)
    with random_numbers_of(scene):
        return part_tests(faulty, *known)


def own_lights(scene: Scene, reference: Reference, seed: int) -> tuple[Reference, int, int]:
    """Return a reference with the light of a seed as its own, the seed, and its samples in a pixel."""
    lights, samples = [], 0
    for known in reference.lights:
        clean = render(scene, known.light.camera, known.light.time_s, seed).indirect
        if clean is not None:
            known, samples = replace(known, own_radiance_per_w=clean.radiance_per_w), clean.samples
        lights.append(known)
    return replace(reference, lights=tuple(lights)), seed, samples


def alarm(tests: list[PartTests]) -> bool:
    """Tell whether any of a family differs."""
    return not all(verdict.same for verdict in judge(tests, FALSE_ALARM_RATE))


def seen_behind_the_light(name: str, scene: Scene, changes: Changes, reference: Reference) -> str | None:
    """Return the stage that finds changes of a sensor, the light being the reference's; None where none."""

    def kept(_scene: Scene, camera: str, time_s: float, _seed: int, _cache: LightCache) -> Light:
        near = [known.light for known in reference.lights if known.light.camera == camera]
        return min(near, key=lambda light: abs(light.time_s - time_s))

    result = check_scenes("suite", {name: scene.with_(changes)}, {name: reference}, rendered=kept)
    stages = [one.stage for found in result.scenes for one in found.findings if one.verdict == "fail"]
    return stages[0] if stages else None


def sensor_defects(scene: Scene) -> Iterator[tuple[str, Changes]]:
    """Yield defects of the first camera that takes frames: of its gain, exposure, filter, lens."""
    name = scene.cameras()[0]
    robot, own = name.split(".")
    _, camera = scene.camera(name)
    place = f"robots.{robot}.rig.cameras.{own}"
    sensor = camera.sensor
    yield "gain 1 %", {f"{place}.sensor.system_gain": f"{1.01 * sensor.system_gain_dn_per_e!r} DN/e"}
    if camera.auto_exposure is None:
        yield "exposure 1 %", {f"{place}.exposure": f"{1.01e3 * camera.exposure_s!r} ms"}
    else:
        yield "exposure control 1 %", {f"{place}.auto_exposure.target": 1.01 * camera.auto_exposure.target}
    yield "1 nm", {f"{place}.filter.centre": "941 nm"}
    centre_px = (0.5 * (sensor.columns - 1) + SHIFT_PX, 0.5 * (sensor.rows - 1))
    yield "0.1 px", {f"{place}.lens.principal_point": f"[{centre_px[0]}, {centre_px[1]}] px"}


def light_defects(scene: Scene) -> Iterator[tuple[str, Changes]]:
    """Yield defects of light: each wall's albedo, the fog's extinction, where the camera looks."""
    raw = scene.raw
    for name, shape in (raw.get("shapes") or {}).items():
        material = raw["materials"][shape["material"]]
        if isinstance(material, Mapping) and "reflectance" in material:
            darker = {**material, "reflectance": 0.95 * float(material["reflectance"])}
            shapes = {**raw["shapes"], name: {**shape, "material": "its_own"}}
            yield (
                f"albedo of {name} 5 %",
                {"materials": {**raw["materials"], "its_own": darker}, "shapes": shapes},
            )
    if scene.document.fog is not None:
        yield "fog extinction 5 %", {"fog.extinction": f"{1.05 * scene.document.fog.extinction_per_m!r} /m"}
    if not scene.document.has_indirect_light():
        return
    robot, own = scene.cameras()[0].split(".")
    _, camera = scene.camera(f"{robot}.{own}")
    turn_deg = math.degrees(SHIFT_PX * camera.sensor.pixel_pitch_m / camera.lens.focal_length_m)
    yield "0.1 px", {f"robots.{robot}.rig.cameras.{own}.orientation.yaw": f"{turn_deg!r} deg"}


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", type=Path, default=SUITE)
    parser.add_argument("--scene", nargs="*", help="defects of these alone")
    parser.add_argument("--clean", type=int, default=200)
    parser.add_argument("--trials", type=int, default=40)
    asked = parser.parse_args()
    scenes = scenes_of(asked.suite)
    folder = references_folder(asked.suite, None)
    references = {name: read_reference(folder, name, asked.suite) for name in scenes}
    tried = list(scenes) if asked.scene is None else asked.scene

    started = time.perf_counter()
    holds = check(asked.suite).holds
    told: dict[str, Any] = {"benchmark": "regression", "holds": holds}
    told["check_s"] = round(time.perf_counter() - started, 1)

    alarms = 0
    for number in range(asked.clean):
        seen = [part_tests(scenes[name], references[name], 10_000 + number) for name in scenes]
        alarms += alarm([one for tests, _ in seen for one in tests]) or any(certain for _, certain in seen)
        print(f"{alarms} false alarms in {number + 1} suites", file=sys.stderr)
    told["clean"] = {"suites": asked.clean, "alarms": alarms}

    told["sensor"] = {
        f"{name}: {defect}": seen_behind_the_light(name, scenes[name], changes, references[name])
        for name in tried
        for defect, changes in sensor_defects(scenes[name])
    }

    told["light"], told["code"], told["harmless"] = {}, {}, {}
    clean = (
        {name: part_tests(scenes[name], references[name], 1)[0] for name in scenes} if asked.trials else {}
    )
    for name in tried if asked.trials else ():
        others = [one for other in scenes if other != name for one in clean[other]]
        for defect, changes in light_defects(scenes[name]):
            faulty, caught, in_code = scenes[name].with_(changes), 0, 0
            for trial in range(asked.trials):
                own, certain = part_tests(faulty, references[name], 20_000 + trial)
                caught += certain or alarm([*own, *others])
                own, certain = part_tests_in_code(scenes[name], faulty, references[name], 20_000 + trial)
                in_code += certain or alarm([*own, *others])
            told["light"][f"{name}: {defect}"] = f"{caught} of {asked.trials}"
            told["code"][f"{name}: {defect}"] = f"{in_code} of {asked.trials}"
            print(f"{name}: {defect}: {caught}, {in_code} of {asked.trials}", file=sys.stderr)
        if not scenes[name].document.has_indirect_light():
            continue
        robot, own_camera = scenes[name].cameras()[0].split(".")
        rounded = scenes[name].with_(
            {f"robots.{robot}.rig.cameras.{own_camera}.orientation.yaw": "0.00001 deg"}
        )
        harmless = {"rounding": 0, "another sampler": 0}
        for trial in range(asked.trials):
            seed = 30_000 + trial
            harmless["rounding"] += alarm(
                part_tests_in_code(scenes[name], rounded, references[name], seed)[0]
            )
            known = own_lights(scenes[name], references[name], seed)
            with patch.object(guide, "_GROUP_SHARE", guide._GROUP_SHARE + 0.002):
                harmless["another sampler"] += alarm(part_tests(scenes[name], *known)[0])
        told["harmless"] |= {f"{name}: {one}": f"{n} of {asked.trials}" for one, n in harmless.items()}
    print(json.dumps(told))


if __name__ == "__main__":
    main()
