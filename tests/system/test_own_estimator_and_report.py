"""What a person does after the first run: an estimator of their own, a look at the page, scenes of their own."""

import base64
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.paths import ROOT
from tests.system.command import QUICK, SCENE, nir_render, nir_render_process

pytestmark = pytest.mark.mitsuba

EXAMPLE = str(ROOT / "scenes" / "my_estimator.py")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rendered frames; perceiving and reporting add files, and overwrite their own."""
    place = tmp_path_factory.mktemp("recording")
    done = nir_render("render", SCENE, "-o", "run", *QUICK, cwd=place)
    assert done.returncode == 0, done.stderr
    return place


def test_ones_own_estimator_is_scored_and_shown_beside_the_others(recording: Path) -> None:
    own = ("--estimator", f"{EXAMPLE}:brightest_spot")
    built_in = ("--estimator", "paper", "--estimator", "robust")
    done = nir_render("perceive", "run", *own, *built_in, "--json", cwd=recording)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["detections"] == {"brightest_spot": 2, "paper": 2, "robust": 2}
    reported = nir_render("report", "run", "--json", cwd=recording)
    assert reported.returncode == 0, reported.stderr
    assert json.loads(reported.stdout)["report"] == str(Path("run") / "report.html")
    summary = json.loads((recording / "run" / "summary.json").read_text())
    spot = summary["estimators"]["brightest_spot"]
    assert (spot["recall"], spot["false_alarms_per_frame"]) == (1.0, 0.0)
    assert spot["range_rmse_m"] < 10.0 * summary["range_limit_rmse_m"]
    page = (recording / "run" / "report.html").read_text(encoding="utf-8")
    assert [name for name in ("brightest_spot", "paper", "robust") if f"</svg> {name}</h3>" in page] == [
        "brightest_spot", "paper", "robust",
    ]  # fmt: skip
    assert "one_source" in page
    assert "llvm" in page or "scalar" in page  # from the manifest


def test_the_page_needs_neither_network_nor_other_files(recording: Path) -> None:
    """Every address is data within the page, or a file of the folder that is there."""
    assert nir_render("perceive", "run", cwd=recording).returncode == 0
    assert nir_render("report", "run", cwd=recording).returncode == 0
    page = (recording / "run" / "report.html").read_text(encoding="utf-8")
    addresses = re.findall(r'(?:href|src)="([^"]*)"', page)
    files = [address for address in addresses if not address.startswith("data:")]
    assert {"summary.json", "truth.jsonl", "manifest.json"} <= set(files)
    assert all((recording / "run" / name).is_file() for name in files)
    for svg in re.findall(r'src="data:image/svg\+xml;base64,([^"]*)"', page):
        drawn = base64.b64decode(svg).decode()
        assert not re.findall(r'href="(?!#|data:)', drawn)


@pytest.mark.parametrize(
    ("body", "reference", "said"),
    [
        ("", "nowhere.py:mine", "--estimator nowhere.py:mine: there is no file 'nowhere.py'"),
        ("", "own.py:mine", "there is no 'mine' in the file"),
        ("def robust(frame, calibration): ...", "own.py:robust", "'robust' is an estimator that is built in"),
        (
            "def mine(frame, calibration): return 1 / 0",
            "own.py:mine",
            "frame 0 of r1.front: ZeroDivisionError",
        ),
        ("def mine(frame, calibration): return [1]", "own.py:mine", "wanted a Detection"),
        ("", "own.py", "wanted file.py:function"),
    ],
)
def test_an_estimator_that_fails_gets_one_line_and_leaves_nothing(
    recording: Path, body: str, reference: str, said: str
) -> None:
    (recording / "own.py").write_text(body + "\n")
    before = sorted(path.name for path in (recording / "run").iterdir())
    done = nir_render("perceive", "run", "--estimator", reference, cwd=recording)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split())
    assert done.stderr.count("error:") == 1
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in (recording / "run").iterdir()) == before


def test_run_refuses_a_bad_estimator_before_it_renders(tmp_path: Path) -> None:
    done = nir_render("run", SCENE, "-o", "run", "--estimator", "nowhere.py:mine", cwd=tmp_path)
    assert done.returncode == 2
    assert list(tmp_path.iterdir()) == []


def test_run_goes_on_with_the_estimators_that_work(tmp_path: Path) -> None:
    broken = f"broken=cmd: {sys.executable} -c 'import sys; sys.exit(\"no model\")'"
    both = ("--estimator", broken, "--estimator", "paper", "--json")
    done = nir_render("run", SCENE, "-o", "run", *QUICK, *both, cwd=tmp_path)
    assert done.returncode == 2
    assert list(json.loads(done.stdout)["estimators"]) == ["paper"]
    assert done.stderr.count("error:") == 1
    assert "exit status 1; its standard error ended with\n    no model" in done.stderr
    assert (tmp_path / "run" / "report.html").is_file()
    compared = nir_render("compare", "run", "run", "--json", cwd=tmp_path)
    assert compared.returncode == 0, compared.stderr
    assert json.loads(compared.stdout)["estimators"][0]["identical"] is True
    assert "compare.html" in json.loads((tmp_path / "run" / "manifest.json").read_text())["sha256"]


def test_two_estimators_of_one_name_are_refused(recording: Path) -> None:
    for folder in ("a", "b"):
        (recording / folder).mkdir()
        (recording / folder / "own.py").write_text("def mine(frame, calibration): return []\n")
    both = ("--estimator", "a/own.py:mine", "--estimator", "b/own.py:mine")
    done = nir_render("perceive", "run", *both, cwd=recording)
    assert done.returncode == 2
    assert "another estimator is called 'mine' too" in " ".join(done.stderr.split())


def test_new_makes_a_folder_that_can_be_worked_in(tmp_path: Path) -> None:
    made = nir_render("new", "my work", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    assert made.stdout.endswith("next: nir-render run 'my work/one_source.yaml'\n")
    assert nir_render("validate", "my work/one_source.yaml", cwd=tmp_path).returncode == 0
    refused = nir_render("new", "my work", cwd=tmp_path)
    assert refused.returncode == 2
    assert "holds files already" in refused.stderr


@pytest.mark.verify
def test_who_installed_the_package_alone_gets_the_examples(tmp_path: Path) -> None:
    """The wheel, unpacked, and taken before the checkout: it carries its scenes, presets and page."""
    build = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        "dist",
        str(ROOT),
    ]
    built = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        assert not [name for name in packed.namelist() if "__pycache__" in name]
        packed.extractall(tmp_path / "installed")
    alone = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
    where = [sys.executable, "-c", "import nir_render; print(nir_render.__file__)"]
    said = subprocess.run(where, cwd=tmp_path, env=alone, capture_output=True, text=True, check=True).stdout
    assert Path(said.strip()).is_relative_to(tmp_path)
    assert nir_render_process("new", "mine", cwd=tmp_path, env=alone).returncode == 0
    for name in ("one_source.yaml", "my_estimator.py", "scene.schema.json"):
        assert (tmp_path / "mine" / name).read_bytes() == (ROOT / "scenes" / name).read_bytes()
    done = nir_render_process("run", "mine/one_source.yaml", "-o", "run", *QUICK, cwd=tmp_path, env=alone)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "report.html").is_file()
