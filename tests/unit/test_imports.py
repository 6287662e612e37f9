"""Arrows between rooms: who may import whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def _imports(path: Path) -> set[str]:
    """Return the modules that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _offenders(folder: str, *banned: str, but: str = "") -> list[str]:
    return [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        if not (but and path.is_relative_to(ROOT / but))
        for module in sorted(_imports(path))
        if any(module == name or module.startswith(name + ".") for name in banned)
    ]


def test_the_walk_sees_imports() -> None:
    assert "nir_render.transport.render" in _imports(ROOT / "nir_render" / "simulate.py")
    assert _offenders("nir_render/transport", "mitsuba")


def test_perception_knows_nothing_of_the_renderer() -> None:
    assert _offenders("perception", "nir_render", "mitsuba", "drjit", "pydantic") == []


def test_only_transport_imports_mitsuba() -> None:
    assert _offenders("nir_render", "mitsuba", "drjit", but="nir_render/transport") == []


@pytest.mark.parametrize("room", ["camera", "scene", "spectra"])
def test_the_rooms_before_transport_do_not_look_ahead(room: str) -> None:
    ahead = ("transport", "simulate", "evaluate", "run", "cli", "report")
    assert _offenders(f"nir_render/{room}", *(f"nir_render.{name}" for name in ahead)) == []


def test_spectra_and_camera_do_not_load_scene_files() -> None:
    assert _offenders("nir_render/camera", "nir_render.scene.load") == []
    assert _offenders("nir_render/spectra", "nir_render.scene.load", "nir_render.camera") == []


def _run(code: str) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_import_nir_render_loads_neither_mitsuba_nor_colour() -> None:
    heavy = ("mitsuba", "drjit", "colour", "matplotlib")
    _run(
        f"import sys, nir_render, perception; assert not set(sys.modules) & set({heavy}), set(sys.modules) & set({heavy})"
    )


def test_camera_and_perception_run_without_mitsuba() -> None:
    """With Mitsuba blocked, a camera exposes a beam and perception finds it."""
    _run(
        """
import sys
sys.modules["mitsuba"] = sys.modules["drjit"] = None
import numpy as np, perception
from pathlib import Path
from nir_render import load_scene
from nir_render.camera.exposure import Beam, expected_electrons
from nir_render.camera.response import response
from nir_render.camera.sensor import read_out
from nir_render.randomness import FrameKey
scene = load_scene(Path("scenes/one_source.yaml"))
_, camera = scene.camera("r1.front")
source = scene.sources()["r2.top"][1]
beam = Beam(np.array([0.0, 0.0, 1.0]), 0.002, 0.2 / (4 * np.pi * 25), response(camera, source))
data = read_out(expected_electrons(camera, [beam], 1e-3), camera, 1e-3, FrameKey(1, "read_out", "r1.front", 0))
frame = perception.RawFrame("r1.front", 0, 0.0, 1e-3, data, 64.0)
(found,) = perception.detect(frame, scene.calibration("r1.front"))
assert abs(found.range_m - 5.0) < 0.1, found
""".replace('Path("scenes', f'Path("{ROOT.as_posix()}/scenes')
    )
