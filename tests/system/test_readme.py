"""What the README shows runs as it stands there."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.mitsuba

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the scenes, so that outputs land elsewhere than in the repository."""
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")
    return tmp_path


def test_the_python_snippets_run_in_order(checkout: Path) -> None:
    code = "\n".join(_blocks("python"))
    assert "nr.render(scene" in code
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = re.match(r"([\d.]+) ± ([\d.]+) m at", done.stdout)
    assert found is not None, done.stdout
    assert float(found[1]) == pytest.approx(1.0229, abs=5 * 0.0012)


def test_the_commands_run_in_order(checkout: Path) -> None:
    commands = [line for block in _blocks("sh") for line in block.splitlines() if line]
    assert len(commands) >= 2
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == ".venv/bin/nir-render"
        run = [sys.executable, "-W", "error", "-c", "from nir_render.cli import main; main()", *arguments]
        done = subprocess.run(run, cwd=checkout, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_every_command_and_target_that_is_named_exists() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^    make (\w+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    shown = set(re.findall(r"^\| `nir-render (\w+)", README, re.MULTILINE))
    run = [sys.executable, "-c", "from nir_render.cli import main; main()", "--help"]
    help_text = subprocess.run(
        run, capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "120"}
    ).stdout
    offered = set(re.findall(r"^│ (\w+) ", help_text, re.MULTILINE))
    assert shown == offered


@pytest.mark.parametrize("link", re.findall(r"\]\(([^)#:]+)\)", README))
def test_links_lead_somewhere(link: str) -> None:
    assert (ROOT / link).exists()
