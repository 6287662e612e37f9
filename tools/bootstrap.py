"""Set up this checkout: a virtual environment, the pinned packages, and an LLVM that Dr.Jit can use.

``make setup`` runs it with whatever ``python3`` is. Each step does only what is missing, so that a set-up
that was interrupted goes on where it stopped, and one that is complete costs a few hundredths of a second.

The syntax is that of Python 3.6: an old interpreter has to get as far as saying that it is too old.
"""

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nir_render.transport.backend.llvm import Choice

ROOT = Path(__file__).resolve().parent.parent
OLDEST = (3, 11)
NEWER = ("python3.14", "python3.13", "python3.12", "python3.11")
IS_GOOD = "import sys, {}; sys.exit(sys.version_info < (3, 11))"


class SetupError(Exception):
    """What stops the set-up, in one line that says how to mend it."""


def main(arguments: "list[str]", root: Path = ROOT) -> int:
    """Do what is missing; return the exit status."""
    try:
        if arguments == ["--llvm"]:  # called by `set_up`, with the interpreter of .venv
            compile_loops()
            finish_with_llvm(root)
        elif not is_complete(root):
            interpreter = find_interpreter()
            if interpreter != sys.executable:
                return subprocess.call([interpreter, str(Path(__file__).resolve())])
            require_venv_module()
            set_up(root)
    except SetupError as error:
        say(f"error: {error}")
        return 1
    except KeyboardInterrupt:
        say("interrupted; the same command goes on from here")
        return 130
    return 0


def set_up(root: Path) -> None:
    """Make the environment, install the packages, see to LLVM: each only where it is missing."""
    start_s = time.monotonic()
    if not has_packages(root):
        make_environment(root)
        install_packages(root)
        write_stamp(root, None)
    # The interpreter of .venv does the rest: only it has Mitsuba to probe with.
    if subprocess.call([str(environment_python(root)), str(Path(__file__).resolve()), "--llvm"]) != 0:
        raise SetupError("the last part of it broke off, see above; the same command goes on from here")
    say(f"complete after {time.monotonic() - start_s:.0f} s")


def say(line: str) -> None:
    """Print one line of progress at once, on standard error: standard output belongs to what runs next."""
    print("setup: " + line, file=sys.stderr, flush=True)


# What is there already


def inputs_hash(root: Path) -> str:
    """Return the hash of what the installed packages depend on."""
    digest = hashlib.sha256()
    for name in ("pyproject.toml", "constraints.txt"):
        digest.update((root / name).read_bytes() + b"\0")
    return digest.hexdigest()


def stamp_file(root: Path) -> Path:
    """Return the file that says what has been set up."""
    return root / ".venv" / ".ready"


def read_stamp(root: Path) -> "dict[str, Any]":
    """Return what has been set up, empty if nothing has or the file is broken."""
    try:
        stamp = json.loads(stamp_file(root).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def write_stamp(root: Path, llvm: "str | None") -> None:
    """Note that the packages are installed and, unless `llvm` is None, that LLVM has been seen to.

    `llvm` is the library file in use, empty if none is or it is unknown.
    """
    stamp = {"inputs": inputs_hash(root), "root": str(root), "llvm": llvm}
    stamp_file(root).write_text(json.dumps(stamp) + "\n", encoding="utf-8")


def has_packages(root: Path) -> bool:
    """Tell whether the packages that are pinned now are installed, here (an environment cannot be moved)."""
    stamp = read_stamp(root)
    here = stamp.get("root") == str(root) and stamp.get("inputs") == inputs_hash(root)
    return here and environment_python(root).exists()


def is_complete(root: Path) -> bool:
    """Tell whether nothing is to be done. A library that has gone since then is to be replaced."""
    llvm = read_stamp(root).get("llvm")
    return has_packages(root) and llvm is not None and (llvm == "" or Path(llvm).exists())


def environment_python(root: Path) -> Path:
    """Return the interpreter of the environment."""
    return root / ".venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def succeeds(command: "list[str]") -> bool:
    """Run a command in silence and tell whether it succeeded."""
    try:
        return subprocess.call(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) == 0
    except OSError:
        return False


# The interpreter


def find_interpreter(version: "tuple[int, ...]" = tuple(sys.version_info[:3])) -> str:
    """Return an interpreter that is new enough: this one, of this `version`, or one on the PATH."""
    if version >= OLDEST:
        return sys.executable
    # Asked, not believed: a version manager leaves launchers on the PATH for versions that are not active.
    for path in filter(None, map(shutil.which, NEWER)):
        if succeeds([path, "-c", IS_GOOD.format("venv, ensurepip")]):
            return path
    spoken = ".".join(str(part) for part in version)
    needed = f"Python 3.11 or newer is needed, and {sys.executable} is {spoken}"
    raise SetupError(f"{needed}: {python_advice('3.11')}")


def require_venv_module() -> None:
    """Raise `SetupError` if Python came without what makes environments, as Debian's does."""
    for module in ("venv", "ensurepip"):
        if importlib.util.find_spec(module) is None:
            version = f"{sys.version_info[0]}.{sys.version_info[1]}"
            raise SetupError(f"{sys.executable} has no module {module}: {python_advice(version)}")


def python_advice(version: str) -> str:
    """Name the package that brings a whole Python, in the words of this machine's package manager."""
    commands = (
        ("apt-get", f"sudo apt-get install python{version}-venv"),
        ("dnf", f"sudo dnf install python{version}"),
        ("brew", f"brew install python@{version}"),
    )
    known = [command for tool, command in commands if shutil.which(tool)]
    return known[0] if known else f"install the package python{version}-venv, or a whole Python {version}"


# The environment and its packages


def make_environment(root: Path) -> None:
    """Make ``.venv``, unless there is one that works and was made here."""
    python = environment_python(root)
    made_here = read_stamp(root).get("root", str(root)) == str(root)
    if made_here and succeeds([str(python), "-c", IS_GOOD.format("pip")]):
        return
    if (root / ".venv").is_symlink():  # making it anew would empty what it points to
        raise SetupError(f"{root / '.venv'} is a link to a folder that was not made here: delete the link")
    say(f"making .venv with Python {'.'.join(map(str, sys.version_info[:3]))}")
    # The base interpreter: this one may itself be the one in .venv, which is cleared.
    base = getattr(sys, "_base_executable", None) or sys.executable
    if subprocess.call([base, "-m", "venv", "--clear", str(root / ".venv")]) != 0:
        raise SetupError(f"{root / '.venv'} could not be made, see above; free that folder and try again")


def install_packages(root: Path) -> None:
    """Install this project, editable, with all that it needs, in the pinned versions."""
    say("installing the pinned packages (a few minutes if they have to be downloaded)")
    command = [str(environment_python(root)), "-m", "pip", "install", "-qq", "--no-input"]
    command += ["--disable-pip-version-check", "-c", "constraints.txt", "-e", ".[dev]"]
    if subprocess.call(command, cwd=str(root), env=pip_environment(dict(os.environ))) != 0:
        raise SetupError("pip could not install the packages, see above; the same command tries again")


def pip_environment(environ: "dict[str, str]") -> "dict[str, str]":
    """Return `environ` with the constraints for what builds the project, too.

    That is installed by a second pip, which older versions tell of constraints by the first variable, newer
    ones by the second. The path is relative because pip splits the variables at spaces.
    """
    for variable in ("PIP_CONSTRAINT", "PIP_BUILD_CONSTRAINT"):
        environ = {**environ, variable: f"{environ.get(variable, '')} constraints.txt".strip()}
    return environ


def compile_loops() -> None:
    """Compile the loops of perception, so that no first frame waits for it: in two processes at once."""
    from perception.warm_up import warm_up_frames

    say("compiling the loops of perception (a minute or two)")
    other = subprocess.Popen(
        [sys.executable, "-c", "from perception.warm_up import warm_up_sets; warm_up_sets()"], cwd=ROOT
    )
    try:
        warm_up_frames()
    finally:
        status = other.wait()
    if status:
        say(f"a loop did not compile (status {status}): the first frames will wait for it")


# LLVM


def finish_with_llvm(root: Path) -> None:
    """See to LLVM, with the interpreter of the environment, and note that the set-up is complete."""
    if importlib.util.find_spec("mitsuba") is None:
        say("Mitsuba has no wheel for this platform: camera and perception work, rendering does not")
        write_stamp(root, "")
        return
    write_stamp(root, ensure_llvm())


def ensure_llvm() -> str:
    """Find an LLVM that works or install one; else go on without, and print what would help.

    Return the library in use, empty if none is or it is unknown.
    """
    from nir_render.transport.backend.llvm import install

    choice = choose_aloud()
    apt = install.apt_command()
    if not choice.usable and apt.prefix is not None:
        say(f"installing LLVM: {apt.command}")
        problem = install.install(apt)
        if problem:
            say(f"apt did not install it: {problem}")
        choice = choose_aloud()
        apt = install.NO_APT  # it has had its turn
    if not choice.usable:
        say("going on with Mitsuba's scalar variant, 4 to 6 times slower")
        say(f"what would help: {install.advice(apt)}")
    return str(choice.loaded or choice.library or "")


def choose_aloud() -> "Choice":
    """Choose an LLVM, and say what is being tried, which was chosen, and why not those before it."""
    from nir_render.transport.backend import llvm
    from nir_render.transport.backend.llvm.probe import Answer, probe

    own = "the library that Dr.Jit takes by itself"

    def ask(library: "Path | None") -> Answer:
        say(f"trying {library or own}: one small test render")
        return probe(library)

    choice = llvm.choose(ask=ask)
    for answer in choice.tried:
        say(f"  {answer.library or own}: {answer.reason}")
    where = f" {choice.version}, {choice.how}: {choice.loaded or choice.library}"
    say("LLVM" + (where if choice.usable else f": {choice.how}"))
    return choice


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
