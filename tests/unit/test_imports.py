"""Who may import whom: the rooms stand in one order, and arrows run downwards."""

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.paths import ROOT

# Top to bottom. A room imports from the rooms below it, never from one above. Where a room has rooms of its
# own, these stand behind it in their order. Files that lie loose in a room are held by having no circle.
FLOORS: dict[str, tuple[str, ...]] = {
    "nir_render.command": ("terminal",),
    "nir_render.experiments": ("limits", "communication", "flocking", "swarm", "standing", "loop"),
    "nir_render.export": (),
    "nir_render.stress": ("page", "workers", "job", "design"),
    "nir_render.regress": ("stages",),
    "nir_render.compare": (),
    "nir_render.budget": (),
    "nir_render.run": ("goniometer", "recording"),
    "nir_render.look": (),
    "nir_render.report": ("calibration", "time"),
    "nir_render.evaluate": (),
    "nir_render.simulation": (),
    "nir_render.transport": ("goniometer", "indirect", "direct", "world", "backend"),
    "nir_render.transport.indirect": ("kernel",),
    "nir_render.transport.backend": ("llvm",),
    "nir_render.camera": ("timing", "sensor", "optics"),
    "nir_render.light": (),
    "nir_render.scene": ("scatter", "documents", "meshes", "text"),
    "nir_render.scene.documents": ("robots", "built", "ambient", "times", "spectral", "matter"),
    "nir_render.truth": (),
    "nir_render.spectra": (),
    "nir_render.scattering": (),
    "nir_render.randomness": (),
    "nir_render.geometry": (),
    "nir_render.errors": (),
    "perception.processes": (),
    "perception.warm_up": (),
    "perception.pipeline": (),
    "perception.pairs": (),
    "perception.photometry": (),
    "perception.track": (),
    "perception.messages": (),
    "perception.extrinsics": (),
    "perception.rig": ("pose", "mirrors"),
    "perception.calibration": (),
    "perception.command_estimator": (),
    "perception.estimators": (),
    "perception.paper": (),
    "perception.robust": ("together", "large", "around", "hiding", "overlap", "starts", "search"),
    "perception.files": (),
    "perception.causes": (),
    "perception.model": ("likelihood", "spread", "discs"),
    "perception.odometry": (),
    "perception.own_code": (),
    "perception.compiled": (),
    "perception.types": (),
}
GROUND = ("errors.py", "geometry.py", "randomness.py")
MOST_FILES = 12
MOST_LINES = 400


def _modules() -> dict[str, Path]:
    """Return the files of both packages, by module name; a package's face by the package's."""
    found = {}
    for top in ("nir_render", "perception"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = _modules()


def _imports(path: Path) -> set[str]:
    """Return the names that a file imports, anywhere in it: modules, and what it takes from them."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _arrows() -> dict[str, set[str]]:
    """Return the modules of ours that each module imports; a room's face only where a name of it is taken."""
    arrows: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        targets: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= inner & set(MODULES)
                targets |= {str(node.module)} if inner - set(MODULES) else set()
        arrows[module] = targets & set(MODULES) - {module}
    return arrows


ARROWS = _arrows()


def _circles(arrows: Mapping[str, set[str]]) -> Iterator[list[str]]:
    """Yield a way along arrows that comes back to where it began, for each place where there is one."""
    done: set[str] = set()

    def walk(node: str, trail: list[str]) -> Iterator[list[str]]:
        if node in trail:
            yield [*trail[trail.index(node) :], node]
        elif node not in done:
            for target in sorted(arrows.get(node, ())):
                yield from walk(target, [*trail, node])
            done.add(node)

    for node in sorted(arrows):
        yield from walk(node, [])


def _room(module: str) -> str:
    """Return the room on the list that a module belongs to."""
    return max((room for room in FLOORS if f"{module}.".startswith(f"{room}.")), key=len, default=module)


def test_every_room_is_on_the_list() -> None:
    faces = {"nir_render", "perception"}
    assert {_room(module) for module in MODULES} - set(FLOORS) == faces
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in MODULES.values()}
    listed = {*FLOORS, *(f"{room}.{part}" for room, parts in FLOORS.items() for part in parts)}
    assert folders - listed == faces


def test_arrows_between_rooms_run_downwards() -> None:
    top = [room for room in FLOORS if room.count(".") == 1]
    order = {room: floor for floor, room in enumerate(top)}
    upwards = [
        f"{module} imports {target}"
        for module, targets in ARROWS.items()
        if module not in ("nir_render", "perception")
        for target in targets
        if target not in ("nir_render", "perception")
        and order[".".join(target.split(".")[:2])] < order[".".join(module.split(".")[:2])]
    ]
    assert upwards == []


@pytest.mark.parametrize("room", [room for room, parts in FLOORS.items() if parts])
def test_arrows_between_the_rooms_of_a_room_run_downwards(room: str) -> None:
    order = {f"{room}.{part}": floor for floor, part in enumerate(FLOORS[room])}

    def inner(module: str) -> str | None:
        return next((part for part in order if f"{module}.".startswith(f"{part}.")), None)

    upwards = [
        f"{module} imports {target}"
        for module, targets in ARROWS.items()
        for target in targets
        if (above := inner(module)) and (below := inner(target)) and order[below] < order[above]
    ]
    assert upwards == []


def test_no_circle_of_files() -> None:
    assert list(_circles(ARROWS)) == []


@pytest.mark.parametrize("room", ["nir_render", "perception", *FLOORS])
def test_no_circle_of_what_lies_in_a_room(room: str) -> None:
    """A room within counts as one, a loose file for itself."""
    inside: dict[str, set[str]] = {}

    def part(module: str) -> str | None:
        rest = module.removeprefix(f"{room}.")
        return None if rest == module else f"{room}.{rest.split('.')[0]}"

    for module, targets in ARROWS.items():
        own = part(module)
        if own is not None:
            parts = {part(target) for target in targets} - {None, own}
            inside.setdefault(own, set()).update(str(one) for one in parts)
    assert list(_circles(inside)) == []


def test_nothing_lies_loose_beside_the_rooms() -> None:
    loose = {path.name for path in (ROOT / "nir_render").glob("*.py")}
    assert loose == {"__init__.py", *GROUND}


def test_rooms_and_files_stay_small_enough_to_survey() -> None:
    folders = {path.parent for path in MODULES.values()}
    full = {
        str(folder.relative_to(ROOT)): count
        for folder in folders
        if (count := len([*folder.glob("*.py")]) - 1) > MOST_FILES
    }
    assert full == {}
    long = {
        str(path.relative_to(ROOT)): lines
        for path in MODULES.values()
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert long == {}


def _offenders(folder: str, *banned: str, but: str = "") -> list[str]:
    return [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        if not (but and path.is_relative_to(ROOT / but))
        for module in sorted(_imports(path))
        if any(module == name or module.startswith(name + ".") for name in banned)
    ]


def test_the_walk_sees_imports() -> None:
    assert "nir_render.transport.render" in ARROWS["nir_render.simulation.clock"]
    assert "nir_render.run.folder" in ARROWS["nir_render.run.render"]
    assert "nir_render.run" not in ARROWS["nir_render.run.render"]
    assert _offenders("nir_render/transport", "mitsuba")
    assert list(_circles({"a": {"b"}, "b": {"c"}, "c": {"b"}})) == [["b", "c", "b"]]


def test_perception_knows_nothing_of_the_renderer() -> None:
    assert _offenders("perception", "nir_render", "mitsuba", "drjit", "pydantic") == []


def test_only_transport_imports_mitsuba() -> None:
    assert _offenders("nir_render", "mitsuba", "drjit", but="nir_render/transport") == []


def test_evaluation_needs_files_and_perception_alone() -> None:
    rooms = {
        _room(target)
        for module, targets in ARROWS.items()
        if _room(module) == "nir_render.evaluate"
        for target in targets
    }
    assert {room for room in rooms if room.startswith("nir_render.")} <= {
        "nir_render.evaluate", "nir_render.truth", "nir_render.errors",
    }  # fmt: skip


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
from nir_render import calibration, load_scene
from nir_render.camera.beams import Beam, beam_electrons
from nir_render.camera.optics.response import response
from nir_render.camera.sensor.read_out import read_out
from nir_render.randomness import RandomKey
scene = load_scene(Path("scenes/one_source.yaml"))
_, camera = scene.camera("r1.front")
source = scene.sources()["r2.top"][1]
beam = Beam(np.array([0.0, 0.0, 1.0]), 0.002, 0.2 / (4 * np.pi * 25), response(camera, source))
data = read_out(beam_electrons(camera, [beam], 1e-3), camera, 1e-3, RandomKey(1, "read_out", "r1.front", 0))
frame = perception.RawFrame("r1.front", 0, 0.0, 1e-3, data, 64.0)
(found,) = perception.detect(frame, calibration(scene, "r1.front"))
assert abs(found.range_m - 5.0) < 0.1, found
""".replace('Path("scenes', f'Path("{ROOT.as_posix()}/scenes')
    )
