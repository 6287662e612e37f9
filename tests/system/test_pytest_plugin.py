"""The fixture `regress` in the tests of someone else's repository: a run of pytest of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from nir_render import regress
from nir_render.command.pytest_plugin import Suites
from tests.paths import ROOT
from tests.unit.regress.cases import suite

pytestmark = pytest.mark.mitsuba

TESTS = """
import sys

def test_nothing_is_loaded_before_it_is_used(regress):
    assert not {"mitsuba", "numba", "nir_render.regress"} & set(sys.modules)

def test_scene(regress):
    assert regress.check("suite").holds

def test_no_suite(regress):
    regress.check("siute")
"""


def run_pytest(folder: Path, *more: str) -> str:
    (folder / "pytest.ini").write_text("[pytest]\ncache_dir = kept\n")
    (folder / "test_frames.py").write_text(TESTS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "nir_render.command.pytest_plugin", "-rA", "--no-header", *more],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    return done.stdout + done.stderr


def test_a_drift_fails_the_test_and_says_what_where_and_how_to_accept_it(tmp_path: Path) -> None:
    folder = suite(tmp_path / "suite")
    regress.create(folder, renders=8)
    said = run_pytest(tmp_path)
    assert "PASSED test_frames.py::test_scene" in said
    assert "PASSED test_frames.py::test_nothing_is_loaded" in said
    assert "FAILED test_frames.py::test_no_suite" in said
    assert f"{tmp_path / 'siute'}: " in said  # which folder is not there
    assert "Traceback" not in said
    assert "During handling" not in said
    scene = folder / "small.yaml"
    scene.write_text(scene.read_text().replace("reflectance: 0.7", "reflectance: 0.35"))
    said = run_pytest(tmp_path)
    assert "FAILED test_frames.py::test_scene" in said
    for line in (
        "small: transport: r2.top: −50 %",
        "small: changed: materials.paint.reflectance",
        'if it is meant: nir-render regress update suite --reason "why"',
    ):
        assert line in said, said
    assert (tmp_path / "kept" / "nir_render" / "suite.html").read_text().startswith("<!doctype html>")
    said = run_pytest(tmp_path, "-p", "no:cacheprovider")
    page = tmp_path / ".pytest_cache" / "nir_render" / "suite.html"
    assert f"open {page}" in said
    assert page.exists()


def test_suites_of_one_name_have_pages_of_their_own(tmp_path: Path) -> None:
    suites = Suites(tmp_path, tmp_path / "pages")
    folders = ("suite", "a/suite", "b/suite", "a-suite", ".", "../suite")
    pages = [suites._page(tmp_path / folder).resolve() for folder in folders]
    assert len(set(pages)) == len(pages)
    assert all(page.is_relative_to(tmp_path / "pages") for page in pages)
    assert pages[1] == tmp_path / "pages" / "a" / "suite.html"


def test_the_action_runs_its_check(tmp_path: Path) -> None:
    """The shell step of `action.yml`, as GitHub would run it: it hands on every input, and its status counts."""
    action = yaml.safe_load((ROOT / "action.yml").read_text())
    (step,) = (one for one in action["runs"]["steps"] if one.get("name", "").startswith("Hold"))
    assert {value.split()[1] for value in step["env"].values()} == {
        "inputs.suite",
        "inputs.refs",
        "inputs.seed",
    }
    assert set(action["inputs"]) == {"suite", "refs", "seed", "python-version"}
    stub = tmp_path / "nir-render"
    stub.write_text('#!/bin/sh\nprintf "%s|" "$@"\nexit 1\n')
    stub.chmod(0o755)
    for refs, seed, words in (
        ("", "", ["my suite", "--page", "nir-regress.html"]),
        ("kept here", "7", ["my suite", "--page", "nir-regress.html", "--refs", "kept here", "--seed", "7"]),
    ):
        done = subprocess.run(
            ["bash", "-e", "-o", "pipefail", "-c", step["run"]], capture_output=True, text=True, check=False,
            env={"PATH": f"{tmp_path}:/usr/bin:/bin", "SUITE": "my suite", "REFS": refs, "SEED": seed},
        )  # fmt: skip
        assert done.stdout.split("|")[:-1] == ["regress", "check", *words], done.stderr
        assert done.returncode == 1
