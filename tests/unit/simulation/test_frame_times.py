"""Clocks of cameras: offset, drift, jitter, lost frames."""

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.scene.scene import Scene, parse_scene
from nir_render.simulation.clock import simulate
from nir_render.simulation.frame_times import frame_times


def _scene(clock: dict[str, object], frames: int = 4000) -> Scene:
    cameras = {"front": {"clock": clock}}
    robots = {"r1": {"rig": {"preset": "infra_swarm", "cameras": cameras}}}
    return parse_scene(
        {
            "format": 1,
            "observe": ["r1.front", "r1.left"],
            "clock": {"frames": frames, "frame_rate": "100 Hz", "start": "2 s"},
            "robots": robots,
        }
    )


def test_offset_and_drift_shift_one_camera() -> None:
    times = frame_times(_scene({"offset": "2 ms", "drift": 1e-3}), 1)
    assert times["r1.front"].time_s[[0, 1000]] == pytest.approx([2.002, 12.012])
    assert times["r1.left"].time_s[[0, 1000]] == pytest.approx([2.0, 12.0])


def test_jitter_and_losses_are_as_wide_as_they_say() -> None:
    """4000 draws: their mean square is right to 2.2 % (1 σ), the share that is lost to 0.0034; taken at 4 σ.

    Normal numbers cut off at 3 σ have a mean square of 0.9950.
    """
    times = frame_times(_scene({"jitter": "0.1 ms", "dropped": 0.05}), 1)["r1.front"]
    off = (times.time_s - (2.0 + np.arange(4000) / 100.0)) / 1e-4
    assert np.mean(off**2) == pytest.approx(0.995, abs=4 * 0.022)
    assert np.abs(off).max() <= 3.0 + 1e-6
    assert times.dropped.mean() == pytest.approx(0.05, abs=4 * 0.0034)
    fewer = frame_times(_scene({"jitter": "0.1 ms", "dropped": 0.05}, 10), 1)["r1.front"]
    np.testing.assert_array_equal(fewer.time_s, times.time_s[:10])
    np.testing.assert_array_equal(fewer.dropped, times.dropped[:10])


def test_jitter_that_could_turn_frames_round_is_refused() -> None:
    """Two neighbours, 10 ms apart, are off by up to 3 σ towards each other: from 1.67 ms on they may meet."""
    with pytest.raises(InputError, match=r"clock.jitter: 2 ms could take a frame before the one before it"):
        _scene({"jitter": "2 ms"})


def test_lost_frames_leave_gaps_and_stamps_are_true_times() -> None:
    scene = _scene({"jitter": "0.1 ms", "dropped": 0.5}, 12)
    times = frame_times(scene, scene.document.seed)["r1.front"]
    assert 0 < times.dropped.sum() < 12
    shots = list(simulate(scene))
    front = [shot.frame for shot in shots if shot.frame.camera == "r1.front"]
    assert [frame.index for frame in front] == np.flatnonzero(~times.dropped).tolist()
    assert [frame.time_s for frame in front] == times.time_s[~times.dropped].tolist()
    assert sum(shot.frame.camera == "r1.left" for shot in shots) == 12
