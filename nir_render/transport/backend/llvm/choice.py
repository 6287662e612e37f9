"""Choose the LLVM library by probing, with no subprocess where the answers are already known."""

import contextlib
import hashlib
import importlib.metadata
import json
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from nir_render.transport.backend.llvm.libraries import SEARCH_VARIABLES, find_libraries
from nir_render.transport.backend.llvm.probe import PROBE_VERSION, VARIABLE, Answer, probe
from nir_render.transport.backend.user_cache import cache_file, read_answers, write_answers


@dataclass(frozen=True)
class Choice:
    """The library to use, and how it was found."""

    library: Path | None  # for ``DRJIT_LIBLLVM_PATH``, before Mitsuba is imported; None: set nothing
    usable: bool  # whether the LLVM variants work; if not, only the scalar variants do
    version: str  # LLVM's, such as "19.1.7"; empty if none is usable
    loaded: str  # the file that Dr.Jit loads; empty if none is usable or the system does not tell
    how: str  # how it was chosen, as the end of the sentence "LLVM: …"
    tried: tuple[Answer, ...] = ()  # the candidates that failed, in their order


def choose(
    *,
    find: Callable[[], Sequence[Path]] = find_libraries,
    ask: Callable[[Path | None], Answer] = probe,
    environ: Mapping[str, str] = os.environ,
    cache: Path | None = None,
    cpu: str | None = None,
    packages: str | None = None,
) -> Choice:
    """Return the first usable library; never raise for want of one.

    The candidates are, in this order: the library that the user named in ``DRJIT_LIBLLVM_PATH``, or else
    Dr.Jit's own choice; then every library found.

    `cache` is the file of remembered answers, by default in the user's cache folder; `cpu` and `packages`
    stand in for `cpu_name` and `package_versions`.
    """
    packages = package_versions() if packages is None else packages
    if not packages:
        return Choice(None, False, "", "", "Mitsuba is not installed")
    found = find()
    cache = cache or cache_file("llvm.json", environ)
    known = _known_answers(cache)
    machine = [str(PROBE_VERSION), cpu_name() if cpu is None else cpu, packages]
    failed: list[Answer] = []
    for library, how in _candidates(found, environ):
        identity = json.dumps([*machine, *_identity(library, found, environ)])
        key = hashlib.sha256(identity.encode()).hexdigest()[:32]
        answer = known.get(key) or ask(library)
        if key not in known and answer.lasting:
            known[key] = answer
            write_answers(cache, {key: asdict(answer) for key, answer in known.items()})
        if answer.usable:
            return Choice(library, True, answer.version, answer.loaded, how, tuple(failed))
        failed.append(answer)
    return Choice(None, False, "", "", "none that works was found", tuple(failed))


def _candidates(found: Sequence[Path], environ: Mapping[str, str]) -> list[tuple[Path | None, str]]:
    wish = environ.get(VARIABLE)
    first, how = (Path(wish), f"named by {VARIABLE}") if wish else (None, "Dr.Jit's own choice")
    if first is not None and first.is_file():  # a bare name is left to the loader
        first = first.absolute()  # for the probe runs in another folder
    return [(first, how), *((library, "found on this machine") for library in found if library != first)]


# What an answer depends on


def _identity(library: Path | None, found: Sequence[Path], environ: Mapping[str, str]) -> list[str]:
    if library is not None and library.is_file():
        return [_fingerprint(library)]
    # What Dr.Jit (or the loader, for a bare name) picks depends on everything that there is to be picked.
    return [str(library), *(environ.get(name, "") for name in SEARCH_VARIABLES), *map(_fingerprint, found)]


def _fingerprint(library: Path) -> str:
    status = library.stat()
    return f"{library.resolve()} {status.st_size} {status.st_mtime_ns}"


def cpu_name(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's model and its instruction sets, on which LLVM's code generation depends."""
    words = [platform.machine(), os.environ.get("PROCESSOR_IDENTIFIER", "")]
    with contextlib.suppress(OSError):  # only Linux has the file
        first = cpuinfo.read_text(encoding="utf-8", errors="replace").split("\n\n", 1)[0]
        words += re.findall(r"^(?:model name|CPU part|flags|Features)\s*: (.*)", first, re.MULTILINE)
    return " ".join(filter(None, words))


def package_versions() -> str:
    """Return the versions of Mitsuba and Dr.Jit as one text; empty where they are not installed."""
    try:
        return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("mitsuba", "drjit"))
    except importlib.metadata.PackageNotFoundError:
        return ""


# The memory


def _known_answers(file: Path | None) -> dict[str, Answer]:
    try:
        return {key: Answer(**fields) for key, fields in read_answers(file).items()}
    except TypeError:
        return {}  # of another version
