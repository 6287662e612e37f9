"""The presets of the paper's source, bare and diffused: its two figures, and the same light in a scene."""

import math

import numpy as np
import pytest
from scipy import stats

from nir_render import load_scene, render
from nir_render.scene.documents.emitters import Source
from nir_render.scene.load import load_built
from nir_render.transport.goniometer.goniogram import variation
from nir_render.transport.goniometer.measure import Settings, measure
from nir_render.transport.world.pattern import pattern_of, relative_intensity
from tests.paths import SCENES
from tests.physics.built_in_mitsuba import intensity_at, mitsuba_scene

pytestmark = pytest.mark.mitsuba

NAMES = ["bare", "diffused"]


def _intensity_w_per_sr(name: str, polar_deg: np.ndarray) -> np.ndarray:
    source = Source.model_validate(name, context={"folder": SCENES})
    pattern = pattern_of(source)
    assert pattern is not None
    polar_rad = np.radians(polar_deg)
    ways = np.stack([np.sin(polar_rad), 0.0 * polar_rad, np.cos(polar_rad)], axis=-1)
    return relative_intensity(pattern, ways) * source.flux_w / (4.0 * math.pi)


def test_the_paper_s_two_figures() -> None:
    """Exp. 2: over ±85° a bare one varies by more than 40 %, one with its shade by ±10 % at most."""
    turned_deg = np.arange(-85.0, 86.0, 1.0)
    bare, diffused = (_intensity_w_per_sr(name, np.abs(turned_deg)) for name in NAMES)
    assert (bare.max() - bare.min()) / bare.max() > 0.4
    assert np.abs(diffused / diffused.mean() - 1.0).max() < 0.1
    assert (diffused.max() - diffused.min()) / (diffused.max() + diffused.min()) < 0.06


@pytest.mark.parametrize("name", NAMES)
def test_what_is_baked_is_what_is_built(name: str) -> None:
    """The preset's values against another measurement, with random numbers of its own."""
    gram = measure(load_built(name), Settings(photons=100_000, seed=77))
    baked = _intensity_w_per_sr(name, np.degrees(gram.polar_rad)) / 0.2
    sigma = gram.sigma_per_sr[2:-2, 0]
    known = sigma > 0.0
    away = (gram.intensity_per_sr[2:-2, 0] - baked[2:-2])[known] / sigma[known]
    assert stats.chi2.sf(float((away**2).sum()), len(away)) > 1e-3
    assert gram.lost == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_lights_as_the_goniometer_measured(name: str) -> None:
    """A robot that turns 1 m before a camera: its irradiance is I(turned) / d², of the preset's own numbers."""
    scene = load_scene(SCENES / "one_source.yaml")
    camera = scene.at(0.0).camera("r1.front").pose.position_m
    gram = measure(load_built(name), Settings(photons=200_000))
    turns_deg = [0.0, 20.0, 40.0, 60.0, 80.0]
    found = []
    for turned in turns_deg:
        top = {
            "preset": name, "position": "[0, 0, 0] m", "orientation": {"pitch": "90 deg"}, "drive": 1,
        }  # fmt: skip
        changed = scene.with_(
            {
                "robots.r2": {
                    "rig": {"sources": {"top": top}},
                    "position": f"{np.add(camera, (1.0, 0.0, 0.0)).tolist()} m",
                    "orientation": {"yaw": f"{180.0 + turned} deg"},
                }
            }
        )
        light = render(changed, "r1.front", seed=1)
        row = int(np.flatnonzero(light.direct.group == light.groups.index("r2.top"))[0])
        found.append(float(light.direct.irradiance_per_w[row, 0]) * changed.sources()["r2.top"][1].flux_w)
    measured = np.interp(np.radians(turns_deg), gram.polar_rad, gram.intensity_per_sr[:, 0]) * 0.2
    noise = np.interp(np.radians(turns_deg), gram.polar_rad, gram.sigma_per_sr[:, 0]) * 0.2
    assert found == pytest.approx(_intensity_w_per_sr(name, np.array(turns_deg)), rel=0.002)
    assert (np.abs(found - measured) < 4.0 * noise + 0.002 * measured).all()


@pytest.mark.verify
@pytest.mark.vectorised
@pytest.mark.parametrize(
    ("polar_deg", "samples", "most_off"),
    [
        (85.0, 192, 0.02),
        pytest.param(85.0, 768, 0.01, marks=pytest.mark.at_length),
        pytest.param(45.0, 768, 0.01, marks=pytest.mark.at_length),
    ],
)
def test_a_path_tracer_sees_the_same_source(polar_deg: float, samples: int, most_off: float) -> None:
    """Mitsuba's volumetric path tracer from a camera at 1 m, on meshes, in float32, against counted photons.

    The die is 4 mm in radius, as paths from a camera seldom find one of 1.2 mm: within 1 % at length, else within
    the 2 % that a quarter of the samples tells.
    """
    preset = load_built("diffused")
    wide = preset.model_copy(update={"dies": (preset.dies[0].model_copy(update={"radius_m": 4e-3}),)})
    gram = measure(wide, Settings())
    row = round(polar_deg / 5.0)
    scene = mitsuba_scene(wide)
    angle_rad = math.radians(polar_deg)
    parts = [intensity_at(scene, wide, angle_rad, samples, seed) for seed in range(8)]
    sigma = float(np.hypot(np.std(parts, ddof=1) / math.sqrt(8), gram.sigma_per_sr[row, 0]))
    expected = float(gram.intensity_per_sr[row, 0])
    assert sigma < 0.6 * most_off * expected
    assert np.mean(parts) == pytest.approx(expected, rel=most_off)


@pytest.mark.verify
def test_the_diffused_figure_with_its_error() -> None:
    """±4.5 % over ±85°, from four million photons: what is quoted, within what noise adds."""
    figures = variation(measure(load_built("diffused"), Settings()))
    assert figures.plus_minus == pytest.approx(0.045, abs=0.004)
    assert figures.about_mean < 0.08
    assert figures.edge == pytest.approx(0.928, abs=0.012)
