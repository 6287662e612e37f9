"""Get an LLVM that works, with apt or by advice. Only tools/bootstrap.py calls this, never a render."""

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from nir_render.transport.backend.llvm.libraries import PREFERRED_VERSION
from nir_render.transport.backend.llvm.probe import VARIABLE

_PACKAGE = f"libllvm{PREFERRED_VERSION}"
Which = Callable[[str], str | None]
Run = Callable[[Sequence[str]], tuple[int, str]]  # runs a command; returns its exit status and output


@dataclass(frozen=True)
class Apt:
    """How LLVM could be installed with apt."""

    command: str  # what to type; empty where there is no apt
    prefix: tuple[str, ...] | None  # goes before ``apt-get`` so that it asks nothing; None: it would ask


NO_APT = Apt("", None)


def _run(command: Sequence[str]) -> tuple[int, str]:
    done = subprocess.run(  # noqa: S603 (fixed words, see the callers)
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False
    )
    return done.returncode, done.stdout + done.stderr


def apt_command(*, which: Which = shutil.which, is_root: bool | None = None, run: Run = _run) -> Apt:
    """Find out whether this user may install with apt: as root, by sudo without a password, or not."""
    if which("apt-get") is None:
        return NO_APT
    steps = ("apt-get update", f"apt-get install -y {_PACKAGE}")
    if os.geteuid() == 0 if is_root is None else is_root:
        return Apt(" && ".join(steps), ())
    may_sudo = which("sudo") is not None and run(["sudo", "-n", "true"])[0] == 0
    return Apt(" && ".join(f"sudo {step}" for step in steps), ("sudo", "-n") if may_sudo else None)


def install(apt: Apt, *, run: Run = _run) -> str:
    """Install LLVM with apt; return an empty text, or else in one line why it failed.

    Raises
    ------
    ValueError
        If `apt` says that this user may not install.
    """
    if apt.prefix is None:
        raise ValueError(f"this user cannot install with apt; by hand: {advice(apt)}")
    quiet = (*apt.prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-o", "DPkg::Lock::Timeout=60")
    # One unreachable source makes the update fail as a whole; the package may be there all the same.
    run([*quiet, "update"])
    status, output = run([*quiet, "install", "-y", "--no-install-recommends", _PACKAGE])
    lines = [line for line in output.splitlines() if line.strip()]
    return "" if status == 0 else (lines or [f"apt-get ended with status {status}"])[-1]


def advice(apt: Apt, *, which: Which = shutil.which) -> str:
    """Return the command that would get a usable LLVM here, or a sentence where none is known."""
    if apt.command:
        return apt.command
    if which("dnf"):
        return f"sudo dnf install llvm{PREFERRED_VERSION}-libs"
    if which("brew"):
        return f"brew install llvm@{PREFERRED_VERSION}"
    return f"install LLVM {PREFERRED_VERSION} or newer and set {VARIABLE} to the path of its library"
