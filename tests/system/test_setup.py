"""The set-up behind `make`: what it says and does where something is missing, and that it does it once.

Nothing is downloaded or installed here: interpreters, pip and apt are stood in for.
"""

import ast
import importlib.util
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from nir_render.transport.backend import llvm
from nir_render.transport.backend.llvm import Choice, install, probe
from nir_render.transport.backend.llvm.install import NO_APT, Apt
from nir_render.transport.backend.llvm.probe import Answer
from tests.paths import ROOT

BOOTSTRAP = ROOT / "tools" / "bootstrap.py"

posix_only = pytest.mark.skipif(os.name == "nt", reason="the stand-ins are shell scripts")


@pytest.fixture
def bootstrap() -> ModuleType:
    """Load tools/bootstrap.py, which is a program and no part of a package."""
    spec = importlib.util.spec_from_file_location("bootstrap", BOOTSTRAP)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Make what the set-up reads of a checkout, with a space in its path."""
    root = tmp_path / "a checkout"
    root.mkdir()
    (root / "pyproject.toml").write_text("[project]\n")
    (root / "constraints.txt").write_text("numpy==2.4.6\n")
    return root


def add_environment(bootstrap: ModuleType, root: Path) -> None:
    python: Path = bootstrap.environment_python(root)
    python.parent.mkdir(parents=True)
    python.touch()


def put_program(folder: Path, name: str, script: str) -> Path:
    folder.mkdir(exist_ok=True)
    program = folder / name
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return program


# The interpreter


def test_an_old_python_can_read_the_program() -> None:
    """Python 3.6 must come as far as the line that says it is too old."""
    ast.parse(BOOTSTRAP.read_text(encoding="utf-8"), feature_version=(3, 6))


@posix_only
def test_an_old_python_looks_for_a_newer_one_that_answers(
    bootstrap: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_program(tmp_path / "bin", "python3.13", "exit 127")  # a version manager's empty launcher
    good = put_program(tmp_path / "bin", "python3.12", "exit 0")
    put_program(tmp_path / "bin", "python3.11", "exit 0")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert bootstrap.find_interpreter((3, 8, 18)) == str(good)


@posix_only
@pytest.mark.parametrize(
    ("tool", "advice"),
    [
        ("apt-get", "sudo apt-get install python3.11-venv"),
        ("dnf", "sudo dnf install python3.11"),
        ("brew", "brew install python@3.11"),
        ("none", "install the package python3.11-venv, or a whole Python 3.11"),
    ],
)
def test_an_old_python_alone_gives_one_line(
    bootstrap: ModuleType,
    checkout: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    tool: str,
    advice: str,
) -> None:
    put_program(checkout / "bin", tool, "exit 0")
    monkeypatch.setenv("PATH", str(checkout / "bin"))
    find = bootstrap.find_interpreter
    monkeypatch.setattr(bootstrap, "find_interpreter", lambda: find((3, 10, 13)))
    assert bootstrap.main([], checkout) == 1
    output = capfd.readouterr()
    line = f"setup: error: Python 3.11 or newer is needed, and {sys.executable} is 3.10.13: {advice}\n"
    assert (output.out, output.err) == ("", line)
    assert not (checkout / ".venv").exists()


@posix_only
@pytest.mark.parametrize("module", ["venv", "ensurepip"])
def test_a_python_without_venv_gives_one_line(
    bootstrap: ModuleType,
    checkout: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    module: str,
) -> None:
    put_program(checkout / "bin", "apt-get", "exit 0")
    monkeypatch.setenv("PATH", str(checkout / "bin"))
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == module else there(name))
    assert bootstrap.main([], checkout) == 1
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    package = f"sudo apt-get install python{version}-venv"
    assert capfd.readouterr().err == f"setup: error: {sys.executable} has no module {module}: {package}\n"


@posix_only
@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_without_a_python_gives_the_package_and_fails() -> None:
    done = subprocess.run(
        ["make", "-C", str(ROOT), "PYTHON=no-such-python", "setup"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "setup: error: there is no no-such-python: install the package python3-venv" in done.stderr


# What has been done is not done again


def test_a_complete_set_up_runs_nothing(
    bootstrap: ModuleType, checkout: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    add_environment(bootstrap, checkout)
    bootstrap.write_stamp(checkout, "")
    for name in ("call", "check_call", "run", "Popen"):
        monkeypatch.setattr(subprocess, name, lambda *_, **__: pytest.fail("a process was started"))
    assert bootstrap.main([], checkout) == 0
    assert capfd.readouterr() == ("", "")


def change_constraints(root: Path) -> None:
    (root / "constraints.txt").write_text("numpy==2.4.7\n")


def remove_interpreter(root: Path) -> None:
    shutil.rmtree(root / ".venv" / ("Scripts" if os.name == "nt" else "bin"))


def break_stamp(root: Path) -> None:
    (root / ".venv" / ".ready").write_text("{")


@pytest.mark.parametrize("change", [change_constraints, remove_interpreter, break_stamp])
def test_packages_are_installed_again_when(bootstrap: ModuleType, checkout: Path, change: Any) -> None:
    add_environment(bootstrap, checkout)
    bootstrap.write_stamp(checkout, "")
    assert bootstrap.is_complete(checkout)
    change(checkout)
    assert not bootstrap.has_packages(checkout)
    assert not bootstrap.is_complete(checkout)


def test_a_checkout_that_was_moved_is_set_up_anew(bootstrap: ModuleType, checkout: Path) -> None:
    add_environment(bootstrap, checkout)
    bootstrap.write_stamp(checkout, "")
    moved = checkout.rename(checkout.with_name("moved"))
    assert not bootstrap.has_packages(moved)


@posix_only
def test_an_environment_of_another_checkout_is_not_emptied(
    bootstrap: ModuleType, checkout: Path, tmp_path: Path
) -> None:
    kept = tmp_path / "another" / ".venv" / "kept"
    kept.parent.mkdir(parents=True)
    kept.touch()
    (checkout / ".venv").symlink_to(kept.parent)
    with pytest.raises(bootstrap.SetupError, match=r"is a link .* delete the link"):
        bootstrap.make_environment(checkout)
    assert kept.exists()


def test_an_interrupted_set_up_goes_on_with_llvm(
    bootstrap: ModuleType, checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_environment(bootstrap, checkout)
    bootstrap.write_stamp(checkout, None)  # the packages are there, LLVM was not reached
    ran: list[list[str]] = []

    def call(command: list[str]) -> int:
        ran.append(command)
        return 0

    monkeypatch.setattr(subprocess, "call", call)
    assert bootstrap.main([], checkout) == 0
    assert [command[1:] for command in ran] == [[str(BOOTSTRAP), "--llvm"]]


def test_a_library_that_has_gone_is_replaced_and_packages_stay(bootstrap: ModuleType, checkout: Path) -> None:
    add_environment(bootstrap, checkout)
    library = checkout / "libLLVM.so.19.1"
    library.touch()
    bootstrap.write_stamp(checkout, str(library))
    assert bootstrap.is_complete(checkout)
    library.unlink()
    assert bootstrap.has_packages(checkout)
    assert not bootstrap.is_complete(checkout)


def test_pip_that_fails_leaves_no_stamp(
    bootstrap: ModuleType, checkout: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    add_environment(bootstrap, checkout)
    monkeypatch.setattr(subprocess, "call", lambda command, **_: int("pip" in command))
    assert bootstrap.main([], checkout) == 1
    assert "pip could not install the packages" in capfd.readouterr().err
    assert bootstrap.read_stamp(checkout) == {}


def test_what_builds_the_project_is_pinned_too(bootstrap: ModuleType) -> None:
    environ = bootstrap.pip_environment({"PIP_CONSTRAINT": "theirs.txt", "A": "a"})
    assert environ == {
        "A": "a",
        "PIP_CONSTRAINT": "theirs.txt constraints.txt",
        "PIP_BUILD_CONSTRAINT": "constraints.txt",
    }


# LLVM, hidden from the set-up or not

WORKS = Choice(Path("/l.so"), True, "19.1.7", "/l.so", "found on this machine")
NONE = Choice(None, False, "", "", "none that works was found", (Answer("", False, reason="aborted"),))


StandIn = Callable[..., list[Apt]]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """Give the function by which a test says what this machine's LLVM and apt are like.

    The choices are made one after the other; the list returned is of what was installed.
    """

    def set_machine(*choices: Choice, apt: Apt = NO_APT, problem: str = "", known: bool = False) -> list[Apt]:
        remaining = list(choices)
        installed: list[Apt] = []

        def choose(ask: Callable[[Path | None], Answer]) -> Choice:
            if not known:
                ask(None)
            return remaining.pop(0)

        def put(apt: Apt) -> str:
            installed.append(apt)
            return problem

        monkeypatch.setattr(llvm, "choose", choose)
        monkeypatch.setattr(probe, "probe", lambda _: Answer("", True))
        monkeypatch.setattr(install, "apt_command", lambda: apt)
        monkeypatch.setattr(install, "install", put)
        monkeypatch.setattr(install, "advice", lambda apt: apt.command or "the general advice")
        return installed

    return set_machine


@pytest.mark.parametrize("known", [False, True])
def test_a_usable_llvm_is_used_and_tried_only_where_it_is_not_known(
    bootstrap: ModuleType, stand_in: StandIn, capfd: pytest.CaptureFixture[str], known: bool
) -> None:
    installed = stand_in(WORKS, apt=Apt("apt-get …", ()), known=known)
    assert bootstrap.ensure_llvm() == "/l.so"
    assert installed == []
    lines = capfd.readouterr().err.splitlines()
    assert lines[-1] == "setup: LLVM 19.1.7, found on this machine: /l.so"
    trying = "setup: trying the library that Dr.Jit takes by itself: one small test render"
    assert lines[:-1] == ([] if known else [trying])


def test_without_llvm_it_is_installed_where_that_is_allowed(bootstrap: ModuleType, stand_in: StandIn) -> None:
    installed = stand_in(NONE, WORKS, apt=Apt("apt-get …", ()))
    assert bootstrap.ensure_llvm() == "/l.so"
    assert installed == [Apt("apt-get …", ())]


@pytest.mark.parametrize(
    ("apt", "problem", "said"),
    [
        (
            Apt("sudo apt-get install -y libllvm19", None),
            "",
            ["what would help: sudo apt-get install -y libllvm19"],
        ),
        (NO_APT, "", ["what would help: the general advice"]),
        (
            Apt("apt-get …", ()),
            "E: Unable to locate package",
            ["apt did not install it: E: Unable to locate package", "what would help: the general advice"],
        ),
        (Apt("apt-get …", ()), "", ["what would help: the general advice"]),
    ],
    ids=[
        "apt asks for a password",
        "no apt",
        "apt lacks the package",
        "the installed one does not work either",
    ],
)
def test_without_llvm_the_set_up_goes_on_with_scalar_and_says_what_would_help(
    bootstrap: ModuleType,
    stand_in: StandIn,
    capfd: pytest.CaptureFixture[str],
    apt: Apt,
    problem: str,
    said: list[str],
) -> None:
    installed = stand_in(NONE, NONE, apt=apt, problem=problem)
    assert bootstrap.ensure_llvm() == ""
    lines = capfd.readouterr().err.splitlines()
    assert "setup:   the library that Dr.Jit takes by itself: aborted" in lines
    assert "setup: going on with Mitsuba's scalar variant, 4 to 6 times slower" in lines
    assert [line.removeprefix("setup: ") for line in lines if "help" in line or "apt did" in line] == said
    assert bool(installed) == (apt.prefix is not None)


def test_the_whole_set_up_without_llvm_succeeds_once(
    bootstrap: ModuleType,
    checkout: Path,
    stand_in: StandIn,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Set-up, its second half in the same process: exit 0, scalar, and nothing left for a second call."""
    stand_in(NONE)
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: there("json" if name == "mitsuba" else name)
    )

    def call(command: list[str], **_: object) -> int:
        if "venv" in command:
            add_environment(bootstrap, checkout)
        return bootstrap.main(["--llvm"], checkout) if "--llvm" in command else int("-c" in command[:2])

    monkeypatch.setattr(subprocess, "call", call)
    assert bootstrap.main([], checkout) == 0
    assert "what would help" in capfd.readouterr().err
    assert bootstrap.is_complete(checkout)
    assert bootstrap.main([], checkout) == 0
    assert capfd.readouterr().err == ""


def test_without_a_wheel_of_mitsuba_llvm_is_not_looked_for(
    bootstrap: ModuleType, checkout: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    add_environment(bootstrap, checkout)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert bootstrap.main(["--llvm"], checkout) == 0
    assert "Mitsuba has no wheel for this platform" in capfd.readouterr().err
    assert bootstrap.is_complete(checkout)
