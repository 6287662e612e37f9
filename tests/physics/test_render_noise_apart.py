"""Render noise stays apart from the sensor's: what a photon transfer measures of frames of one light, and of many."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

import nir_render as nr
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.render_noise import render_noise
from nir_render.run.manifest import noise_facts, noise_warning
from tests.physics.documents import rectangle_document, scene_document, source_document

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.verify,
    pytest.mark.vectorised,
]

RENDERS = 16
DRAWS = 400
EXPOSURE_S = 2e-3


def wall_scene(folder: Path, **settings: object) -> nr.Scene:
    """Return a camera before a bright wall, a lamp behind it out of sight, and a second wall that shines on it."""
    camera = {
        "lens": {"focal_length": "1.8 mm", "f_number": 2.0, "transmission": 0.9},
        "sensor": {
            "preset": "mt9m031", "columns": 96, "rows": 72, "pixel_pitch": "45 um", "read_noise": "1 e",
        },
        "point_spread": {"sigma": "0.4 px"}, "exposure": f"{EXPOSURE_S} s",
    }  # fmt: skip
    document = scene_document(
        {"c": camera},
        {"lit": source_document((-0.5, 0.6, 0.0), 0.01)},
        samples=256,
        max_depth=3,
        materials={"paint": {"type": "diffuse", "reflectance": 0.7}},
        shapes={
            "ahead": rectangle_document((2.0, 0.0, 0.0), (20.0, 20.0), (-1.0, 0.0, 0.0), "paint"),
            "below": rectangle_document((0.0, 0.0, -1.0), (20.0, 20.0), (0.0, 0.0, 1.0), "paint"),
        },
    )
    path = folder / "walls.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return nr.load_scene(path, settings)


def measured_gain(first: NDArray[np.float64], second: NDArray[np.float64], scene: nr.Scene) -> float:
    """Return the system gain by photon transfer: K = (σ_y² − σ_dark²) / (μ_y − μ_dark), over all pixels."""
    sensor = scene.camera("eye.c")[1].sensor
    variance = 0.5 * ((first - second) ** 2).mean()
    dark = (sensor.system_gain_dn_per_e * sensor.read_noise_e) ** 2 + 1.0 / 12.0
    return float((variance - dark) / (0.5 * (first + second).mean() - sensor.black_level_dn))


def test_the_gain_of_one_light_and_of_independent_renders(tmp_path: Path) -> None:
    """16 renders, 400 frames of each. Pairs of frames of one light give the sensor's own gain within 0.1 %: what
    rendering added is the same in both. Pairs from two renders give a gain that is higher by the share of
    render noise which the manifest states (`share_behind_lens`), within 0.2 points.

    Of 44 million pairs of pixels the first has a standard error of 0.02 %, the second, by the pixels of 16
    renders, 1 % of the share: 0.05 points.
    """
    scene = wall_scene(tmp_path)
    sensor = scene.camera("eye.c")[1].sensor
    lights = [nr.render(scene, "eye.c", seed=seed) for seed in range(RENDERS)]
    frames = [
        np.stack(
            [nr.expose(light, scene, seed=7, index=DRAWS * number + draw).data_dn for draw in range(DRAWS)]
        )
        for number, light in enumerate(lights)
    ]
    assert np.mean([frame.mean() for frame in frames]) - sensor.black_level_dn > 300
    assert max(frame.max() for frame in frames) < 3500
    same = [measured_gain(frame[::2].astype(float), frame[1::2].astype(float), scene) for frame in frames]
    apart = [
        measured_gain(frames[number].astype(float), frames[number + 1].astype(float), scene)
        for number in range(0, RENDERS, 2)
    ]
    assert np.mean(same) == pytest.approx(sensor.system_gain_dn_per_e, rel=1e-3)
    noises = {
        f"eye.c {n}": render_noise(mean_frame(light, scene.at(0.0), EXPOSURE_S))
        for n, light in enumerate(lights)
    }
    stated = noise_facts(None, noises)["share_behind_lens"]
    assert 0.01 < stated < 0.5
    assert np.mean(apart) / sensor.system_gain_dn_per_e - 1.0 == pytest.approx(stated, abs=0.002)


def test_frames_above_the_stated_share_are_flagged(tmp_path: Path) -> None:
    """One light, planned for 2 ms: at 40 times the exposure the same render noise stands above shot noise, which
    grows slower; the manifest names that frame and the run warns.
    """
    scene = wall_scene(tmp_path, **{"render.noise": "5 % of temporal variance"})
    light = nr.render(scene, "eye.c", seed=1)
    noises = {
        f"eye.c {number}": render_noise(mean_frame(light, scene.at(0.0), times * EXPOSURE_S))
        for number, times in enumerate((1.0, 40.0))
    }
    facts = noise_facts(0.05, noises)
    assert facts["frames_above_target"] == ["eye.c 1"]
    assert noise_warning(facts, 2) is not None
