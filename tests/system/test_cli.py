"""The command as people call it: whole runs, and what careless input leads to."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.paths import ROOT
from tests.system.command import QUICK, SCENE, nir_render, nir_render_process

pytestmark = pytest.mark.mitsuba


def _files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run of the demo scene, in a process of its own."""
    place = tmp_path_factory.mktemp("demo")
    done = nir_render_process("run", SCENE, "-o", "run", "--json", cwd=place)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads((place / "run" / "summary.json").read_text())
    return place / "run"


def test_a_run_leaves_all_that_the_design_names(run_folder: Path) -> None:
    frames = [f"frames/r1.front/{index:06d}.png" for index in range(10)]
    assert _files(run_folder) == sorted(
        ["calibration.json", "detections.paper.jsonl", "detections.robust.jsonl", *frames, "frames.jsonl", "look.png",
         "manifest.json", "measurements.paper.jsonl", "measurements.robust.jsonl", "messages.robust.jsonl",
         "mirrors.paper.jsonl", "mirrors.robust.jsonl", "poses.jsonl", "preview.gif", "preview.png", "report.html",
         "scene.yaml", "signals.robust.jsonl", "summary.json", "tracks.robust.jsonl", "truth.jsonl"]
    )  # fmt: skip
    manifest = json.loads((run_folder / "manifest.json").read_text())
    assert sorted(manifest["sha256"]) == [name for name in _files(run_folder) if name != "manifest.json"]
    assert manifest["format"] == 1
    assert set(manifest["seconds"]) == {"render", "perceive", "evaluate", "report"}


def test_robust_ranging_is_right_and_near_the_limit(run_folder: Path) -> None:
    """Ten frames from 1 to 10 m: bearing within 0.02°, and ranges like the limit allows.

    The mean of ten squared errors in units of their own limit is 1 ± 0.45; 3 would be a fault.
    """
    summary = json.loads((run_folder / "summary.json").read_text())
    robust = summary["estimators"]["robust"]
    assert (summary["frames"], summary["sources_visible"]) == (10, 10)
    assert robust["recall"] == 1.0
    assert robust["false_alarms_per_frame"] == 0.0
    assert robust["bearing_rms_deg"] < 0.02
    assert robust["range_rmse_m"] < 3.0 * summary["range_limit_rmse_m"]
    paper = summary["estimators"]["paper"]
    # The mean grey of a blob does not follow 1/d² (docs/physics.md, Ranging).
    assert paper["range_mae_m"] > 0.5


def test_the_resolved_scene_renders_to_the_same_bits(run_folder: Path, tmp_path: Path) -> None:
    """From another process, with one thread, from the run's own scene.yaml."""
    again_from = str(run_folder / "scene.yaml")
    done = nir_render_process("render", again_from, "-o", "again", "--threads", "1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first = json.loads((run_folder / "manifest.json").read_text())["sha256"]
    again = json.loads((tmp_path / "again" / "manifest.json").read_text())["sha256"]
    compared = [name for name in again if name.startswith(("frames", "truth", "calibration", "scene"))]
    assert len(compared) == 14
    assert {name: again[name] for name in compared} == {name: first[name] for name in compared}


def test_same_seed_same_bits_for_any_number_of_threads(run_folder: Path, tmp_path: Path) -> None:
    """Three; one is what the run's own scene is rendered with, and all of them what the run had."""
    done = nir_render_process("render", SCENE, "-o", "run", "--threads", "3", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for index in range(2):
        name = f"frames/r1.front/{index:06d}.png"
        assert (tmp_path / "run" / name).read_bytes() == (run_folder / name).read_bytes()


def test_another_seed_changes_the_noise_but_not_the_truth(run_folder: Path, tmp_path: Path) -> None:
    assert nir_render("render", SCENE, "-o", "run", "--seed", "2", *QUICK, cwd=tmp_path).returncode == 0
    name = "frames/r1.front/000000.png"
    assert (tmp_path / "run" / name).read_bytes() != (run_folder / name).read_bytes()
    truths = [
        (folder / "truth.jsonl").read_text().splitlines()[:2] for folder in (tmp_path / "run", run_folder)
    ]
    clipped = [[{**json.loads(line), "saturated_px": 0} for line in lines] for lines in truths]
    assert clipped[0] == clipped[1]


def test_stages_one_by_one_give_what_run_gives(run_folder: Path, tmp_path: Path) -> None:
    assert nir_render("render", SCENE, "-o", "run", cwd=tmp_path).returncode == 0
    early = nir_render("evaluate", "run", cwd=tmp_path)
    assert early.returncode == 2
    assert "run 'nir-render perceive run' first" in early.stderr
    counts = nir_render("perceive", "run", "--json", cwd=tmp_path)
    assert json.loads(counts.stdout)["detections"]["robust"] == 10
    assert nir_render("evaluate", "run", "--json", cwd=tmp_path).returncode == 0
    assert (tmp_path / "run" / "summary.json").read_text() == (run_folder / "summary.json").read_text()


def test_a_table_shows_truth_estimators_and_limit(tmp_path: Path) -> None:
    done = nir_render("run", SCENE, "-o", "run", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for word in ("true", "paper", "robust", "limit", "1.023", "preview.png"):
        assert word in done.stdout


def test_doctor_and_validate_and_schema(tmp_path: Path) -> None:
    doctor = nir_render("doctor", "--json", cwd=tmp_path)
    assert doctor.returncode == 0, doctor.stdout + doctor.stderr
    report = json.loads(doctor.stdout)
    assert report["check_holds"] is True
    assert report["mitsuba"] == "3.9.1"
    assert nir_render("validate", SCENE, cwd=tmp_path).returncode == 0
    schema = nir_render("schema", cwd=tmp_path)
    assert json.loads(schema.stdout) == json.loads((ROOT / "scenes" / "scene.schema.json").read_text())


def test_the_version_is_that_of_the_package(tmp_path: Path) -> None:
    done = nir_render("--version", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, f"nir-render {version('nir-render')}\n")


def test_validate_refuses_what_a_plan_refuses(tmp_path: Path) -> None:
    """An estimator that is none: both tell it, with its file and line."""
    (tmp_path / "campaign.yaml").write_text(
        f"{{format: 1, name: c, scene: {SCENE}, axes: {{clock.frames: [1, 2]}}, estimators: [robsut, paper]}}"
    )
    for call in (["validate", "campaign.yaml"], ["stress", "campaign.yaml", "--plan"]):
        done = nir_render(*call, cwd=tmp_path)
        assert done.returncode == 2
        assert "campaign.yaml:1: estimators: robsut: unknown; known: paper, robust" in " ".join(
            done.stderr.split()
        )
    assert [path.name for path in tmp_path.iterdir()] == ["campaign.yaml"]


def test_validate_refuses_curves_that_end_before_what_cameras_see(tmp_path: Path) -> None:
    """A paint known from 400 to 780 nm says nothing of 940: `render` refuses it, and so must this."""
    scene = yaml.safe_load(Path(SCENE).read_text(encoding="utf-8"))
    paint = {"type": "diffuse", "reflectance": {"points": [["400 nm", 0.5], ["780 nm", 0.6]]}}
    wall = {
        "type": "rectangle",
        "center": "[9, 0, 0] m",
        "size": "[2, 2] m",
        "normal": [-1, 0, 0],
        "material": "paint",
    }
    document = {**scene, "materials": {"paint": paint}, "shapes": {"wall": wall}}
    (tmp_path / "cut.yaml").write_text(yaml.safe_dump(document))
    done = nir_render("validate", "cut.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert "materials.paint.reflectance: covers 400 to 780 nm, but 100 %" in " ".join(done.stderr.split())


BAD_SCENES: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": ({"robots.r1.positon": "[0, 0, 0] m"}, "did you mean 'position'?"),
    "bare number": ({"robots.r1.rig.cameras.front.exposure": 0.001}, "is a bare number"),
    "wrong dimension": ({"robots.r2.rig.sources.top.radius": "5 kg"}, "'5 kg' is a mass; wanted a length"),
    "negative power": ({"robots.r2.rig.sources.top.flux": "-0.2 W"}, "greater than 0"),
    "NaN": ({"robots.r2.rig.sources.top.flux": ".nan W"}, "'.nan W'"),
    "camera inside a solid": (
        {"shapes.b": {"type": "sphere", "center": "[0, 0, 0.2] m", "radius": "1 m", "material": "black"}},
        "the camera is inside shapes.b",
    ),
    "missing file": ({"robots.r1.rig": "mine.yaml"}, "there is no file 'mine.yaml'"),
    "RGB": (
        {"materials.m": {"type": "diffuse", "reflectance": [1, 0, 0]}},
        "RGB colours have no meaning at 940 nm",
    ),
    "curve without 940 nm": (
        {"robots.r2.rig.sources.top.spectrum": {"points": [["800 nm", 0], ["850 nm", 1], ["900 nm", 0]]}},
        "covers 800 to 900 nm, not 940 nm",
    ),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scenes_get_one_clear_error_and_leave_nothing(case: str, tmp_path: Path) -> None:
    changes, said = BAD_SCENES[case]
    settings = [
        word
        for path, value in changes.items()
        for word in (
            "--set",
            f"{path}={yaml.safe_dump(value, default_flow_style=True).removesuffix(chr(10)).removesuffix('...').strip()}",
        )
    ]
    done = nir_render("run", SCENE, "-o", "run", *settings, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert said in " ".join(done.stderr.split())
    assert done.stderr.count("error:") >= 1
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "nowhere.yaml"], "nowhere.yaml: there is no such scene file"),
        (["run", SCENE, "--set", "observe"], "wanted PATH=VALUE"),
        (["run", SCENE, "--set", "clok.frames=2"], "'clok' is no part of a scene"),
        (["run", SCENE, "--estimator", "papr"], "--estimator papr: unknown; known: paper, robust"),
        (["run", SCENE, "--seed", "-1"], "seed"),
        (["run", SCENE, "--light-cache-gib", "inf"], "--light-cache-gib inf: wanted a size above 0, in GiB"),
        (["render", SCENE, "--light-cache-gib", "nan"], "--light-cache-gib nan: wanted a size above 0"),
        (["render", SCENE, "--light-cache-gib", "0"], "--light-cache-gib 0: wanted a size above 0"),
        (["render", SCENE, "--light-cache-gib", "-1"], "--light-cache-gib -1: wanted a size above 0"),
        (["render", SCENE, "--estimate", "--light-cache", SCENE], "cannot be a light cache"),
        (["render", SCENE, "--estimate", "-o", SCENE], "is a file; give a folder for the run"),
        (["perceive", "nowhere"], "nowhere"),
        (["evaluate", "nowhere"], "there is no such file"),
        (["rnder", SCENE], "rnder"),
        (["validate", SCENE, "nowhere.yaml"], "nowhere.yaml: there is no such scene file"),
    ],
)
def test_bad_calls_end_with_status_2_and_leave_nothing(
    arguments: list[str], said: str, tmp_path: Path
) -> None:
    done = nir_render(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert said in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_estimate_keeps_to_the_threads(tmp_path: Path) -> None:
    """It is of the render that the same words would start."""
    count = "from nir_render.transport.backend.variant import backend; print(backend().dr.thread_count())"
    code = f"import sys; from nir_render.command.main import app; app(sys.argv[1:], standalone_mode=False); {count}"
    arguments = ["render", SCENE, "--estimate", "--threads", "3", "--json"]
    command = [sys.executable, "-W", "error", "-c", code, *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    estimate, threads = done.stdout.splitlines()
    assert json.loads(estimate)["frames"] == 10
    assert threads == "3"
    assert list(tmp_path.iterdir()) == []


def test_another_run_is_replaced_only_on_request(tmp_path: Path) -> None:
    assert nir_render("render", SCENE, "-o", "run", *QUICK, cwd=tmp_path).returncode == 0
    before = (tmp_path / "run" / "manifest.json").read_bytes()
    refused = nir_render("run", SCENE, "-o", "run", *QUICK, cwd=tmp_path)
    assert refused.returncode == 2
    assert "holds another run" in refused.stderr
    assert (tmp_path / "run" / "manifest.json").read_bytes() == before
    assert nir_render("run", SCENE, "-o", "run", *QUICK, "--overwrite", cwd=tmp_path).returncode == 0
    assert (tmp_path / "run" / "preview.png").is_file()


@pytest.mark.skipif(os.name != "posix", reason="limits on file sizes are a POSIX matter")
def test_a_disk_that_fills_up_gives_one_error_and_leaves_nothing(tmp_path: Path) -> None:
    """The kernel refuses files beyond 100 kB: a frame of 1280×960 is larger. Errors read like a full disk's."""
    import resource
    import signal

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    done = nir_render_process("run", SCENE, "-o", "run", *QUICK, cwd=tmp_path, preexec_fn=limit)
    assert done.returncode == 2, done.stderr
    assert "cannot be written" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
