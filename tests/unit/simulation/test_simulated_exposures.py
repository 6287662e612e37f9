"""The clock with brackets, gain, rolling shutters and blinking sources: what each frame was taken with, and when."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import Scene, load_scene, render, simulate
from nir_render.run.render import render_run
from perception.files.recording import read_frames
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

CAMERA = "robots.r1.rig.cameras.front"
SOURCE = "robots.r2.rig.sources.top"
SMALL = {"preset": "mt9m031", "columns": 128, "rows": 96, "pixel_pitch": "37.5 um"}


@pytest.fixture(scope="module")
def still() -> Scene:
    """The source stands 3 m ahead; 30 frames per second from 2 s on."""
    scene = load_scene(SCENES / "one_source.yaml")
    return scene.with_(
        {
            "robots.r2": {"rig": "infra_swarm", "position": "[3.06, 0.2, 0] m"},
            "clock": {"frames": 7, "frame_rate": "30 Hz", "start": "2 s"},
            f"{CAMERA}.sensor": SMALL,
            f"{SOURCE}.flux": "0.02 W",
        }
    )


def test_a_bracket_goes_round_and_one_light_serves_all_frames(still: Scene) -> None:
    shots = list(
        simulate(still.with_({f"{CAMERA}.bracket": ["50 us", "200 us", "0.8 ms"], f"{CAMERA}.gain": 3}))
    )
    exposures_s = [shot.frame.exposure_s for shot in shots]
    assert exposures_s == pytest.approx([5e-5, 2e-4, 8e-4, 5e-5, 2e-4, 8e-4, 5e-5])
    assert [shot.frame.gain for shot in shots] == [3.0] * 7
    assert [shot.frame.time_s for shot in shots] == pytest.approx([2.0 + index / 30.0 for index in range(7)])
    first, *others = [shot.mean.rates for shot in shots]
    assert all(one is first for one in others)
    direct_e = [shot.truth[0].direct_e / shot.frame.exposure_s for shot in shots]
    assert direct_e == pytest.approx([direct_e[0]] * 7, rel=1e-12)


def test_each_frame_meets_the_bits_of_its_own_time(still: Scene) -> None:
    """0101101111 at 10 Hz from 2.01 s on, 30 frames per second of 20 ms: what is lit of each, by hand."""
    bits = {"pattern": "0101101111", "rate": "10 Hz", "start": "2.01 s"}
    scene = still.with_(
        {f"{SOURCE}.drive": {"bits": bits}, f"{CAMERA}.exposure": "20 ms", "clock.frames": 30}
        | {f"{SOURCE}.flux": "0.4 mW"}
    )
    shots = list(simulate(scene))
    lit_ms = []
    for index in range(30):
        start_ms = 1000.0 * index / 30.0 - 10.0  # from the first bit's edge on
        fine_ms = start_ms + (np.arange(20000) + 0.5) / 1000.0
        bit = np.floor(fine_ms / 100.0).astype(int)
        levels = [1 if number < 0 or number > 9 else int(bits["pattern"][number]) for number in bit]
        lit_ms.append(sum(levels) / 1000.0)
    on = [shot.truth[0].on_fraction for shot in shots]
    assert on == pytest.approx([time / 20.0 for time in lit_ms], abs=1e-4)
    assert sum(0.1 < one < 0.9 for one in on) >= 5
    full_e = max(shot.truth[0].direct_e for shot in shots)
    assert [shot.truth[0].direct_e for shot in shots] == pytest.approx([full_e * one for one in on], rel=1e-9)
    # In the counts: the flare's sum above black follows the electrons, to the noise of 81 pixels.
    gain = scene.camera("r1.front")[1].sensor.system_gain_dn_per_e
    u_px, v_px = round(shots[0].truth[0].u_px), round(shots[0].truth[0].v_px)
    place = np.s_[v_px - 4 : v_px + 5, u_px - 4 : u_px + 5]
    ground_dn = float(np.median(shots[0].frame.data_dn))
    sums_e = [float((shot.frame.data_dn[place] - ground_dn).sum()) / gain for shot in shots]
    np.testing.assert_allclose(
        sums_e, full_e * np.array(on), atol=5.0 * math.hypot(9 * 11.0, math.sqrt(full_e))
    )
    assert full_e > 5000.0


def test_a_latency_delays_the_choice(still: Scene) -> None:
    """Settled on a dim source; in frames 0 and 1 it is ten times brighter: frame 0 + latency is shorter."""
    exposures_s: dict[int, list[float]] = {}
    bits = {"pattern": "1", "rate": "20 Hz", "start": "2 s", "idle": 0.1}
    for latency in (1, 3):
        auto = {"shortest": "20 us", "longest": "20 ms", "latency": latency}
        scene = still.with_({f"{SOURCE}.drive": {"bits": bits}, f"{CAMERA}.auto_exposure": auto})
        exposures_s[latency] = [shot.frame.exposure_s for shot in simulate(scene)]
    for latency, found_s in exposures_s.items():
        before, after = found_s[:latency], found_s[latency]
        assert np.ptp(before) < 0.1 * before[0]
        assert after < 0.4 * before[0]


def test_geometry_is_that_at_mid_exposure_of_the_middle_row(still: Scene) -> None:
    """A source that moves 3 m/s; 96 rows, 100 µs apart, exposures of 2 ms: 1 ms + 4.75 ms after the start."""
    scene = still.with_(
        {
            "robots.r2": {
                "rig": "infra_swarm",
                "motion": [
                    {"time": "2 s", "position": "[3.06, 0, 0] m"},
                    {"time": "3 s", "position": "[6.06, 0, 0] m"},
                ],
            },
            f"{CAMERA}.exposure": "2 ms",
            f"{CAMERA}.shutter": {"type": "rolling", "line_time": "100 us"},
            "clock": {"frames": 2, "frame_rate": "10 Hz", "start": "2.1 s"},
        }
    )
    shots = list(simulate(scene))
    for index, shot in enumerate(shots):
        ahead_m = 3.0 * (1.0 + 0.1 * (1 + index) + 5.75e-3)
        assert shot.truth[0].depth_z_m == pytest.approx(ahead_m, abs=1e-9)
        assert shot.frame.time_s == pytest.approx(2.1 + 0.1 * index, abs=1e-12)
        assert shot.frame.line_time_s == pytest.approx(1e-4)
    light = render(scene, "r1.front", 2.1)
    assert light.direct.distance_m[0] < shots[0].light.direct.distance_m[0]


def test_a_run_folder_tells_exposure_gain_black_level_and_line_time(still: Scene, tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        f"{CAMERA}.bracket": ["50 us", "0.8 ms"],
        f"{CAMERA}.gain": 2.5,
        f"{CAMERA}.shutter": {"type": "rolling", "line_time": "12 us"},
        "clock.frames": 3,
    }
    out = tmp_path / "run"
    render_run(still.with_(changes), out, overwrite=False, progress=lambda *_: None)
    lines = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert [line["exposure_s"] for line in lines] == pytest.approx([5e-5, 8e-4, 5e-5])
    assert {(line["gain"], line["black_level_dn"]) for line in lines} == {(2.5, 64.0)}
    assert [line["line_time_s"] for line in lines] == pytest.approx([12e-6] * 3)
    assert [frame.gain for frame in read_frames(out)] == [2.5] * 3
