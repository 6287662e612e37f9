"""A closed loop that is killed, anywhere, ends with the same bits."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.experiments.flocking.loop import Flocking
from nir_render.experiments.flocking.outcome import ARENA
from nir_render.experiments.loop import runs

_KILLS = 20


@pytest.mark.verify
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_kill_9_at_20_random_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Children that are killed by SIGKILL within 0 to 0.8 s, until 20 were; the last goes on to the end."""
    scene, plan = load_scene(ARENA), Flocking(lasts_s=6.0)
    monkeypatch.setattr(runs, "_SAVED_STEPS", 2)
    runs.run_seed(scene, plan, 5, tmp_path / "whole")
    random, killed = np.random.default_rng(1), 0
    while killed < _KILLS:
        child = os.fork()
        if child == 0:  # pragma: no cover
            try:
                runs.run_seed(scene, plan, 5, tmp_path / "killed")
            finally:
                os._exit(0)
        time.sleep(random.uniform(0.0, 0.8))
        ended, _ = os.waitpid(child, os.WNOHANG)
        if ended:  # it was done before its time: what it made is thrown away
            (tmp_path / "killed" / "runs" / "0005.json").unlink()
            continue
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        killed += 1
    runs.run_seed(scene, plan, 5, tmp_path / "killed")
    whole, left = (
        {
            path.relative_to(tmp_path / name): path.read_bytes()
            for path in (tmp_path / name).rglob("*.*")
            if path.is_file()
        }
        for name in ("whole", "killed")
    )
    whole = {path: data for path, data in whole.items() if ".partial-" not in path.name}
    left = {path: data for path, data in left.items() if ".partial-" not in path.name}
    assert left == whole
