"""What the site says of the repository is so: `make docs` builds it, this holds its words against the code."""

import contextlib
import importlib.util
import io
import json
import re
import shutil
from pathlib import Path

import cv2
import pytest
import yaml

import nir_render as nr
import perception
from nir_render.scene.load import load_scene
from nir_render.stress.workers.queue import load_queue
from tests.paths import ROOT
from tests.system.command import nir_render
from tests.unit.test_imports import FLOORS

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
PHYSICS = (DOCS / "physics.md").read_text(encoding="utf-8")


def _code() -> list[tuple[Path, str]]:
    """Every file that may cite a page: what it holds, with white space as single blanks."""
    files = [*(ROOT / "nir_render").rglob("*.py"), *(ROOT / "perception").rglob("*.py")]
    files += [*(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py"), *PAGES]
    return [
        (file, " ".join(file.read_text(encoding="utf-8").split())) for file in files if file != Path(__file__)
    ]


def _blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_every_citation_of_the_physics_page_has_its_section() -> None:
    sections = re.findall(r"^## (.*)$", PHYSICS, re.MULTILINE)
    assert len(sections) >= 10
    cited, wrong = set(), []
    for file, text in _code():
        for match in re.finditer(r"docs/physics\.md(?:, (?:[\"“])?([A-Z][\w ]+))?", text):
            section = next((name for name in sections if (match[1] or "").startswith(name)), None)
            if section is None:
                wrong.append(f"{file.relative_to(ROOT)}: {match[0]}")
            cited.add(section)
        if "PHYSICS " in text or "PHYSICS." in text:
            wrong.append(f"{file.relative_to(ROOT)}: cites a page that is not here")
    assert not wrong
    assert {"From source to pixel", "Narrowband filter", "Comparing renders"} <= cited


def test_every_test_that_is_named_exists() -> None:
    named = {
        match for page in PAGES for match in re.findall(r"`(tests/\S+\.py)::(\w+)`", page.read_text("utf-8"))
    }
    assert len(named) > 50
    missing = [
        f"{file}::{name}"
        for file, name in sorted(named)
        if not (ROOT / file).is_file() or f"def {name}(" not in (ROOT / file).read_text(encoding="utf-8")
    ]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_and_link_leads_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    paths = re.findall(r"`((?:nir_render|perception|tests|scenes|benchmarks|docs)/[\w./-]*)`", text)
    links = [link for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text) if "reference/" not in link]
    new = {"nir_render/export/"}  # said to be where exporters will go
    assert not [path for path in paths if path not in new and not (ROOT / path).exists()]
    assert not [link for link in links if not (DOCS / link).exists()]


def test_the_architecture_names_every_room_in_its_order() -> None:
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `nir_render/(\w+)/` \|", page, re.MULTILINE)
    assert set(named) == {path.name for path in (ROOT / "nir_render").iterdir() if path.is_dir()} - {
        "__pycache__"
    }
    rooms = [room.split(".")[1] for room in FLOORS if room.startswith("nir_render.") and room.count(".") == 1]
    floors = [room for room in rooms if (ROOT / "nir_render" / room).is_dir()]
    assert [name for name in named if name != "data"] == floors
    drawn = re.findall(r'class="floor"[^>]*>(\w+)<', (DOCS / "rooms.svg").read_text(encoding="utf-8"))
    assert [name for name in drawn if name in floors] == floors


def test_the_api_page_has_every_public_name() -> None:
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^\.\. (?:auto\w+|data):: (\w+)$", page, re.MULTILINE))
    assert shown == {*nr.__all__, *perception.__all__}


def test_every_command_that_is_named_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    offered = set(re.findall(r"^│ ([\w-]+) ", nir_render("--help", cwd=ROOT).stdout, re.MULTILINE))
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        named = set(re.findall(r"(?:`|^ *|bin/)nir-render ([a-z]\w+)", text, re.MULTILINE))
        assert named <= offered, page.name


def test_the_scenes_shown_can_be_read(tmp_path: Path) -> None:
    """The first is whole; the others are laid over it."""
    whole, *parts = _blocks("scene_files.md", "yaml")
    assert len(parts) >= 3
    (tmp_path / "whole.yaml").write_text(whole, encoding="utf-8")
    load_scene(tmp_path / "whole.yaml")
    for part in parts:
        document = yaml.safe_load(part)
        if "rig" in document:
            document = {"robots": {"r1": document}}
        document["include"] = ["whole.yaml"]
        (tmp_path / "part.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
        load_scene(tmp_path / "part.yaml")


def test_the_camera_shown_can_be_read(tmp_path: Path) -> None:
    (rig,) = (yaml.safe_load(block) for block in _blocks("camera.md", "yaml"))
    document = yaml.safe_load((ROOT / "scenes" / "one_source.yaml").read_text(encoding="utf-8"))
    document["robots"]["r1"]["rig"] = rig
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    assert load_scene(tmp_path / "scene.yaml").cameras() == ["r1.front"]


def test_the_queue_shown_can_be_read(tmp_path: Path) -> None:
    _, queue = _blocks("stress.md", "yaml")
    (tmp_path / "queue.yaml").write_text(queue)
    assert load_queue(tmp_path / "queue.yaml").walltime_s == 7200.0


def test_the_campaign_shown_can_be_planned(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes", ignore=shutil.ignore_patterns("references"))
    campaign, _ = _blocks("stress.md", "yaml")
    (tmp_path / "scenes" / "campaigns" / "shown.yaml").write_text(campaign, encoding="utf-8")
    done = nir_render("stress", "scenes/campaigns/shown.yaml", "--plan", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["jobs"] == 5 * 4 * 3 * 2 * 2


@pytest.mark.mitsuba
def test_the_first_run_in_python_runs_in_order(tmp_path: Path) -> None:
    """r2 and r5 are seen, 2.13 and 2.40 m away: straight light, which has no samples. So few make false alarms afar."""
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    arena = tmp_path / "scenes" / "arena.yaml"
    arena.write_text(
        arena.read_text(encoding="utf-8").replace("samples: 32,", "samples: 4,"), encoding="utf-8"
    )
    said, names = io.StringIO(), {"__name__": "__main__"}
    with contextlib.chdir(tmp_path), contextlib.redirect_stdout(said):
        exec(compile("\n".join(_blocks("first_run.md", "python")), "<first run>", "exec"), names)
    found = sorted(float(match) for match in re.findall(r"([\d.]+) ± [\d.]+ m", said.getvalue()))
    assert found[:2] == pytest.approx([2.128, 2.398], abs=0.05)


def test_what_a_page_loads_from_elsewhere_is_found(tmp_path: Path) -> None:
    """The check that `make docs` makes: loads are found in pages, styles and pictures, links are let be."""
    spec = importlib.util.spec_from_file_location("offline", DOCS / "_ext" / "offline.py")
    assert spec is not None
    assert spec.loader is not None
    pytest.importorskip("sphinx")
    offline = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(offline)
    clean = '<a href="https://example.org">there</a><img src="_images/a.png"><svg xmlns="http://www.w3.org/2000/svg"/>'
    (tmp_path / "clean.html").write_text(clean, encoding="utf-8")
    (tmp_path / "clean.css").write_text(
        "body { background: url(data:image/png;base64,AA) }", encoding="utf-8"
    )
    assert offline.remote_loads(tmp_path) == []
    faults = {
        "script.html": '<script src="https://cdn.example.org/x.js"></script>',
        "style.html": '<link rel="stylesheet" href="//fonts.example.org/css">',
        "picture.html": '<p style="background: url(http://example.org/x.png)"></p>',
        "sheet.css": "@import 'https://fonts.example.org/css';",
        "face.css": "@font-face { src: url(https://fonts.example.org/f.woff2) }",
        "image.svg": '<svg><image href="https://example.org/x.png"/></svg>',
        "code.js": 'fetch("https://example.org/x.json")',
    }
    for name, text in faults.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert {found.split(":")[0] for found in offline.remote_loads(tmp_path)} == set(faults)


def test_the_gallery_is_what_its_script_makes() -> None:
    """Its text follows from the scene files; pictures are drawn anew by hand, and none is left over."""
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "tools" / "gallery.py")
    assert spec is not None
    assert spec.loader is not None
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    assert gallery.PAGE.read_text(encoding="utf-8") == gallery.page()
    shown = {scene for scenes in gallery.SHOWN.values() for scene in scenes}
    assert {path.stem for path in gallery.PICTURES.glob("*.jpg")} == shown
    for scene in shown:
        assert len(gallery.words(scene)) > 60
        picture = cv2.imread(str(gallery.PICTURES / f"{scene}.jpg"))
        assert picture is not None
        assert picture.shape[1] == gallery.WIDTH_PX
