"""A render that is killed: what is there, what the same command makes of it, and that no bit tells."""

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import nir_render as nr
from nir_render.errors import InputError
from nir_render.run.folder import MANIFEST, resumed_run_folder
from nir_render.run.journal import JOURNAL
from nir_render.run.render import render_run
from nir_render.scene.scene import parse_scene

CAMERA = {
    "lens": {"focal_length": "0.3 mm", "f_number": 2.0, "transmission": 0.9},
    "filter": "bp940_10nm_behind",
    "sensor": {"preset": "mt9m031", "rows": 48, "columns": 64},
    "point_spread": {"sigma": "0.6 px"},
    "exposure": "0.2 ms",
    "auto_exposure": {"target": 0.7, "shortest": "20 us", "longest": "2 ms", "latency": 2},
}
DOCUMENT = {
    "format": 1,
    "seed": 5,
    "clock": {"frames": 6, "frame_rate": "30 Hz"},
    "observe": ["r1"],
    "robots": {
        "r1": {"rig": {"cameras": {"front": CAMERA, "back": CAMERA | {"orientation": {"yaw": "180 deg"}}}}},
        "r2": {
            "rig": "infra_swarm",
            "motion": [
                {"time": "0 s", "position": "[0.6, 0, 0] m"},
                {"time": "0.2 s", "position": "[3, 0.5, 0] m"},
            ],
        },
    },
}
KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from tests.unit.run.test_resume import DOCUMENT
from nir_render.run.render import render_run
from nir_render.scene.scene import parse_scene

def progress(done, of):
    if done == 7:
        os.kill(os.getpid(), signal.SIGKILL)

render_run(parse_scene(DOCUMENT), Path(sys.argv[1]), overwrite=False, progress=progress)
"""


def _files(folder: Path) -> dict[str, str]:
    """Return the hashes of all files but the manifest, which says when and how fast."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.name != MANIFEST
    }


def _render(scene: nr.Scene, folder: Path) -> tuple[list[str], list[int]]:
    made: list[int] = []
    told = render_run(scene, folder, overwrite=True, progress=lambda done, _: made.append(done))
    return told, made


@pytest.mark.skipif(os.name != "posix", reason="there is no SIGKILL")
def test_a_killed_render_goes_on_and_no_bit_tells(tmp_path: Path) -> None:
    root = Path(nr.__file__).parents[1]
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path / "killed"), str(root)], cwd=root, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    assert not (tmp_path / "killed").exists()
    aside = tmp_path / ".killed.unfinished"
    whole = (aside / JOURNAL).read_bytes().count(b"\n")
    assert 4 <= whole <= 7  # of 7 handed over, up to three may not have been written yet
    with (aside / JOURNAL).open("ab") as file:
        file.write(b'{"camera": "r1.fro')  # a line that a kill has cut off
    (aside / "frames" / ".half.png.partial-x").touch()

    scene = parse_scene(DOCUMENT)
    told, made = _render(scene, tmp_path / "killed")
    assert made == list(range(whole + 1, 13))
    assert [f"of which {whole} frames were there" in text for text in told] == [True]
    _, made = _render(scene, tmp_path / "straight")
    assert made == list(range(1, 13))
    assert _files(tmp_path / "killed") == _files(tmp_path / "straight")
    assert {path.name for path in tmp_path.iterdir()} == {"killed", "straight"}


def test_another_scene_begins_anew_and_says_so(tmp_path: Path) -> None:
    scene = parse_scene(DOCUMENT)
    _interrupted(scene.with_({"seed": 6}), tmp_path / "run")
    told, made = _render(scene, tmp_path / "run")
    assert made == list(range(1, 13))
    assert ["began anew" in text for text in told] == [True]
    _render(scene, tmp_path / "straight")
    assert _files(tmp_path / "run") == _files(tmp_path / "straight")


def test_an_interrupted_render_is_kept_and_a_failed_one_is_not(tmp_path: Path) -> None:
    scene = parse_scene(DOCUMENT)
    _interrupted(scene, tmp_path / "run")
    assert (tmp_path / ".run.unfinished" / JOURNAL).is_file()
    with pytest.raises(RuntimeError), resumed_run_folder(tmp_path / "other", False, "x"):
        raise RuntimeError
    assert not list(tmp_path.glob(".other.unfinished*/*"))


def test_two_processes_do_not_write_one_run(tmp_path: Path) -> None:
    with (
        resumed_run_folder(tmp_path / "run", False, "x"),
        pytest.raises(InputError, match="another process is rendering"),
        resumed_run_folder(tmp_path / "run", False, "x"),
    ):
        pass


def _interrupted(scene: nr.Scene, folder: Path) -> None:
    def progress(done: int, _: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_run(scene, folder, overwrite=False, progress=progress)
