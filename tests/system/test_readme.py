"""What the README shows runs as it stands there."""

import contextlib
import io
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT
from tests.system.command import nir_render

pytestmark = pytest.mark.mitsuba

README = (ROOT / "README.md").read_text(encoding="utf-8")


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the scenes, so that outputs land elsewhere than in the repository."""
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    return tmp_path


def _python(code: str, folder: Path) -> str:
    """Run a program of its own names in a folder; return what it prints."""
    said = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said):
        exec(compile(code, "<snippet>", "exec"), {"__name__": "__main__"})
    return said.getvalue()


def test_the_python_snippets_run_in_order(checkout: Path) -> None:
    """The front camera sees r2 and r5; their ranges are those of the arena, within five of their σ."""
    said = _python("\n".join(_blocks("python")), checkout)
    found = [(float(m[1]), float(m[2])) for m in re.finditer(r"([\d.]+) ± ([\d.]+) m at", said)]
    true_m = [2.128, 2.398]
    assert len(found) == len(true_m)
    for (range_m, sigma_m), truth_m in zip(sorted(found), true_m, strict=True):
        assert range_m == pytest.approx(truth_m, abs=5 * sigma_m)
        assert sigma_m < 0.02


def test_the_example_of_the_design_runs_as_it_stands(checkout: Path) -> None:
    """With fewer samples; its flares are straight light, which has none."""
    arena = checkout / "scenes" / "arena.yaml"
    text = arena.read_text(encoding="utf-8")
    assert text.count("samples: 32,") == 1
    arena.write_text(text.replace("samples: 32,", "samples: 4,"), encoding="utf-8")
    _python(
        """
import nir_render as nr, perception
scene = nr.load_scene("scenes/arena.yaml")
light = nr.render(scene, camera="r1.front", time_s=0.0, seed=1)
frame = nr.expose(light, scene, exposure_s=2e-3, seed=1)
hits = perception.detect(frame, nr.calibration(scene, "r1.front"), estimator="robust")
assert len(hits) >= 2 and any(hit.saturated for hit in hits)
assert frame._repr_png_().startswith(b"\\x89PNG") and "r2.top" in light._repr_html_()
""",
        checkout,
    )


def test_the_commands_run_in_order(checkout: Path) -> None:
    """A run whose source is dimmed by `--set` is calibrated for the source it has: its ranges are right."""
    commands = [line for block in _blocks("sh") for line in block.splitlines() if line]
    assert len(commands) >= 2
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == ".venv/bin/nir-render"
        done = nir_render(*arguments, cwd=checkout)
        assert done.returncode == 0, done.stderr
    robust = json.loads((checkout / "outputs" / "dim" / "summary.json").read_text())["estimators"]["robust"]
    assert robust["recall"] == 1.0
    assert robust["range_rmse_m"] < 3.0 * robust["range_limit_rmse_m"]


def _fields(document: dict[str, Any]) -> set[str]:
    """Return the keys of a document and of what it holds, but names that a scene or system gives."""
    names = set(document)
    for key, value in document.items():
        if key == "materials":
            names |= set(value) | {one for record in value["known"].values() for one in record}
        elif isinstance(value, dict) and key not in ("versions", "sha256"):
            listed = [each if isinstance(each, list) else [each] for each in value.values()]
            records = [record for each in listed for record in each]
            if key == "groups_by_camera":
                records = [record for groups in records for record in groups.values()]
            by_camera = key != "ambient" and all(isinstance(record, dict) for record in records)
            names |= {one for record in records for one in record} if by_camera else _fields(value)
    return names


def test_every_field_of_a_manifest_is_explained(checkout: Path) -> None:
    """A run in fog with a target for the noise, in blocks of 2 × 2: it has every field but that of a missing error."""
    wall = "{type: rectangle, center: '[3, 0, 0] m', size: '[4, 4] m', normal: [-1, 0, 0], material: white}"
    ambient = {
        "lamps.panel": "{preset: white_led, center: '[1, 0, 2.5] m'}",
        "illuminance": "{level: 100 lx, at: '[1, 0, 0.8] m'}",
        "sun": "{azimuth: 30 deg, elevation: 40 deg, irradiance: 0.01 W/m^2/nm}",
        "sky": "{irradiance: 0.001 W/m^2/nm}",
        "fog": "{visibility: 200 m, top: 3 m, droplets: radiation_heavy}",
    }
    changes = ["clock.frames=1", "materials.white={type: diffuse, reflectance: 0.5}", f"shapes.wall={wall}"]
    sensor = "robots.r1.rig.cameras.front.sensor"
    changes += [f"{sensor}.columns=40", f"{sensor}.rows=30", f"{sensor}.pixel_pitch=120 um"]
    changes += ["render.indirect.samples=16"]
    changes += [f"{path}={value}" for path, value in ambient.items()]
    settings = [word for change in changes for word in ("--set", change)]
    done = nir_render("render", "scenes/one_source.yaml", "-o", "one", *settings, cwd=checkout)
    assert done.returncode == 0, done.stderr
    manifest = json.loads((checkout / "one" / "manifest.json").read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "manifest.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"`(\w+)`", page))
    assert _fields(manifest) - explained == set()
    rows = [row.split("|")[1] for row in page.splitlines() if row.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert named - _fields(manifest) == {"reason"}


def test_every_command_and_target_that_is_named_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^    make (\w+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    shown = set(re.findall(r"^\| `nir-render (\w+)", README, re.MULTILINE))
    monkeypatch.setenv("COLUMNS", "120")
    help_text = nir_render("--help", cwd=ROOT).stdout
    offered = set(re.findall(r"^│ (\w+) ", help_text, re.MULTILINE))
    assert shown == offered


@pytest.mark.parametrize("link", re.findall(r"\]\(([^)#:]+)\)", README))
def test_links_lead_somewhere(link: str) -> None:
    assert (ROOT / link).exists()
