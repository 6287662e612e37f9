"""What the command loads before it has anything to do, and what it says of itself."""

import subprocess
import sys

import pytest

import nir_render as nr
from tests.paths import ROOT, SCENES
from tests.system.command import nir_render


def _loaded(code: str, *arguments: str) -> set[str]:
    """Return the names of all modules that a process of its own has loaded at its end."""
    told = "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); "
    command = [sys.executable, "-W", "error", "-c", told + code, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stderr.split())


COMMAND = "from nir_render.command.main import main; main()"


def test_help_loads_nothing_that_computes() -> None:
    assert _loaded(COMMAND, "--help").isdisjoint({"numpy", "scipy", "yaml", "pydantic", "pint", "perception"})


def test_a_scene_is_validated_without_what_renders_draws_or_gathers() -> None:
    heavy = {"mitsuba", "drjit", "pint", "matplotlib", "pyarrow", "distributed", "jinja2", "rich.progress"}
    assert _loaded(COMMAND, "validate", str(SCENES / "arena.yaml")).isdisjoint(heavy)


def test_the_package_loads_a_name_when_it_is_asked_for() -> None:
    assert _loaded("import nir_render").isdisjoint({"numpy", "scipy", "yaml", "pydantic"})
    loaded = _loaded("import nir_render as nr; assert issubclass(nr.InputError, Exception)")
    assert "nir_render.errors" in loaded
    assert "numpy" not in loaded


def test_every_name_of_the_package_is_there() -> None:
    assert sorted(nr._HOMES) == nr.__all__
    assert set(nr.__all__) <= set(dir(nr))
    for name in nr.__all__:
        assert getattr(nr, name).__name__ == name
    with pytest.raises(AttributeError, match="module 'nir_render' has no attribute 'simulat'"):
        nr.simulat  # type: ignore[attr-defined]  # noqa: B018


def test_the_help_names_every_command_and_what_it_does() -> None:
    done = nir_render("--help", cwd=ROOT)
    assert done.returncode == 0
    lines = [" ".join(line.strip("│ ").split()) for line in done.stdout.splitlines()]
    commands = [line for line in lines if line.partition(" ")[0] in COMMANDS]
    assert [line.partition(" ")[0] for line in commands] == COMMANDS
    assert "run Render, perceive, evaluate and report a scene in one go." in commands
    assert "Usage: nir-render [OPTIONS] COMMAND [ARGS]..." in lines


COMMANDS = [
    "run",
    "render",
    "perceive",
    "evaluate",
    "calibrate",
    "report",
    "stress",
    "new",
    "validate",
    "schema",
    "doctor",
    "new-recording",
    "import",
    "regress",
]
