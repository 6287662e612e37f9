"""Which LLVM library Dr.Jit should load: found, tried in a process of its own, and remembered.

Several LLVM versions end the whole process in the middle of a render, which nothing inside that process
can catch. So each candidate renders one tiny scene in a subprocess, and only that answer counts. Nothing
here imports Mitsuba except the subprocess, and everything but it runs with the standard library alone.
"""

import contextlib
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import signal
import site
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

PREFERRED_VERSION = 19
"""The major version that is tried first: the one this project is tested with."""

PROBE_VERSION = 1
"""Part of the cache key: to be raised when the probe asks for something else than before."""

TIME_LIMIT_S = 120.0
"""A probe takes about a second; one that takes this long is stuck."""

DEVIATION_LIMIT = 0.005
"""Largest relative error of a probe's pixel; its Monte Carlo noise is 0.0006 (the seed is fixed)."""

VARIABLE = "DRJIT_LIBLLVM_PATH"
_SEARCH_VARIABLES = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH")
_PACKAGE = f"libllvm{PREFERRED_VERSION}"


@dataclass(frozen=True)
class Answer:
    """What the probe of one library said.

    Attributes
    ----------
    library : str
        The library that was asked for; empty for Dr.Jit's own choice.
    usable : bool
        Whether it rendered the probe's scene rightly.
    version : str
        LLVM's version, such as "19.1.7"; empty where the probe failed.
    loaded : str
        The file that was in fact loaded; empty where the probe failed or the system does not tell.
    reason : str
        Why it failed, in one line; empty where it did not.
    lasting : bool
        Whether the same question would get the same answer again. False if the probe was killed from
        outside or could not be started.
    """

    library: str
    usable: bool
    version: str = ""
    loaded: str = ""
    reason: str = ""
    lasting: bool = True


@dataclass(frozen=True)
class Choice:
    """The library to use, and how it was found.

    Attributes
    ----------
    library : Path or None
        What ``DRJIT_LIBLLVM_PATH`` should be set to before Mitsuba is imported; None: set nothing.
    usable : bool
        Whether the LLVM variants work. If not, only the scalar variants do.
    version : str
        LLVM's version, such as "19.1.7"; empty if none is usable.
    loaded : str
        The file that Dr.Jit loads; empty if none is usable or the system does not tell.
    how : str
        How it was chosen, as the end of the sentence "LLVM: …".
    tried : tuple of Answer
        The candidates that failed, in the order in which they were tried.
    """

    library: Path | None
    usable: bool
    version: str
    loaded: str
    how: str
    tried: tuple[Answer, ...] = ()


# Where libraries lie


def find_libraries(
    *,
    environ: Mapping[str, str] = os.environ,
    system: str = sys.platform,
    folders: Iterable[str] | None = None,
    loader_cache: Path = Path("/etc/ld.so.cache"),
) -> list[Path]:
    """List the LLVM libraries of this machine: 19 first, then the newest first.

    Parameters
    ----------
    environ : mapping
        The environment, for the loader's own search paths.
    system : str
        As `sys.platform`.
    folders : iterable of str, optional
        Folders to look into, as glob patterns; by default the usual ones of the system.
    loader_cache : Path
        The file from which ``ldconfig -p`` reads. It is read directly: that needs no process, and
        ``/sbin`` is not on everybody's PATH.

    Returns
    -------
    list of Path
        Real paths, each once.
    """
    patterns = usual_folders(environ, system) if folders is None else list(folders)
    inside = [path for pattern in patterns for path in _glob(pattern)]
    paths = [path for folder in inside for path in _listed(folder) if _is_llvm(path)]
    paths += [path for path in _from_loader_cache(loader_cache) if _is_llvm(path)]
    real = {path.resolve() for path in paths if path.is_file()}
    return sorted(real, key=_preference)


def usual_folders(environ: Mapping[str, str], system: str) -> list[str]:
    """Return glob patterns of the folders where LLVM's library may lie on `system` (as `sys.platform`)."""
    separator = ";" if system == "win32" else ":"
    named = [f for v in _SEARCH_VARIABLES for f in environ.get(v, "").split(separator) if f]
    if system == "win32":
        on_path = [f for f in environ.get("PATH", "").split(separator) if f]
        programs = environ.get("PROGRAMFILES", "C:/Program Files")
        return [*named, f"{sys.prefix}/Library/bin", f"{programs}/LLVM/bin", *on_path]
    if system == "darwin":
        kegs = ("/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib", "/opt/local/libexec/llvm-*/lib")
        return [*named, f"{sys.prefix}/lib", *kegs, "/opt/homebrew/lib", "/usr/local/lib"]
    own = ("/usr/lib/llvm*/lib", "/usr/lib64/llvm*/lib", "/opt/llvm*/lib", "/usr/local/llvm*/lib")
    common = ("/usr/lib", "/usr/lib64", "/usr/lib/*-linux-gnu", "/usr/local/lib")
    return [*named, f"{sys.prefix}/lib", *own, *common]


def _glob(pattern: str) -> list[Path]:
    start = Path(pattern)
    if "*" not in pattern:
        return [start]
    return sorted(Path(start.anchor).glob(str(start.relative_to(start.anchor))))


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _from_loader_cache(loader_cache: Path) -> list[Path]:
    try:
        content = loader_cache.read_bytes()
    except OSError:
        return []
    return [Path(os.fsdecode(name)) for name in re.findall(rb"/[^\0]*libLLVM[^\0/]*", content)]


_LIBRARY_NAME = re.compile(
    r"libLLVM(-\d[\d.]*)?\.so(\.\d+)*|libLLVM(-\d[\d.]*)?\.dylib|libLLVM-\d[\d.]*\.dll|LLVM-C\.dll"
)
_VERSION_IN_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+(?:\.\d+)*)")
_VERSION_IN_FOLDER = re.compile(r"llvm[-@/]?(\d+(?:\.\d+)*)/")


def _is_llvm(path: Path) -> bool:
    return _LIBRARY_NAME.fullmatch(path.name) is not None


def _preference(library: Path) -> tuple[bool, tuple[int, ...], str]:
    """Sort key: the preferred version, then the newest, then those whose version no name tells."""
    posix = library.as_posix()
    match = _VERSION_IN_NAME.search(library.name) or _VERSION_IN_FOLDER.search(posix)
    version = tuple(int(part) for part in match[1].split(".")) if match else ()
    is_other = version[:1] != (PREFERRED_VERSION,)
    # Padded, for a tuple that is shorter sorts before, not after, the longer one it begins.
    newest_first = tuple(-part for part in (*version, 0, 0, 0, 0)[:4])
    return is_other, newest_first, posix


# The probe


def probe(
    library: Path | None,
    *,
    environ: Mapping[str, str] = os.environ,
    time_limit_s: float = TIME_LIMIT_S,
    command: Sequence[str] | None = None,
) -> Answer:
    """Render a tiny scene with `library` in a subprocess and compare it with the closed form.

    Parameters
    ----------
    library : Path or None
        The library to load; None for Dr.Jit's own choice.
    environ : mapping
        The environment that the subprocess gets, apart from ``DRJIT_LIBLLVM_PATH``.
    time_limit_s : float
        Seconds after which the subprocess is ended and counts as failed.
    command : sequence of str, optional
        What to run; by default this file as a program.

    Returns
    -------
    Answer
        An abort, a wrong number, or a time-out is an answer with ``usable`` False, not an exception.
    """
    name = "" if library is None else str(library)
    # -P: the folder of this file must not stand in front of the packages that the probe imports.
    command = [sys.executable, "-P", str(Path(__file__).resolve())] if command is None else command
    try:
        with tempfile.TemporaryDirectory(prefix="nir_render-llvm-", ignore_cleanup_errors=True) as folder:
            done = subprocess.run(  # noqa: S603 (our own interpreter and file)
                command,
                env=_probe_environment(library, environ, folder),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=time_limit_s,
                check=False,
            )
    except subprocess.TimeoutExpired:
        return Answer(name, False, reason=f"no answer within {time_limit_s:g} s")
    except OSError as error:
        return Answer(name, False, reason=f"the probe could not be started: {error}", lasting=False)
    return _read_probe(name, done.returncode, done.stdout, done.stderr)


def _probe_environment(library: Path | None, environ: Mapping[str, str], folder: str) -> dict[str, str]:
    # Dr.Jit keeps compiled kernels in the home folder; one from another LLVM must not hide a failure.
    # The user's own packages also lie there, so their place is named.
    clean = {k: v for k, v in environ.items() if k != VARIABLE}
    clean |= {"HOME": folder, "PYTHONUSERBASE": site.getuserbase()}
    if library is not None:
        clean[VARIABLE] = str(library)
    return clean


def _read_probe(name: str, status: int, output: str, errors: str) -> Answer:
    if status != 0:
        killed = status == -getattr(signal, "SIGKILL", 9)
        return Answer(name, False, reason=_failure(status, errors), lasting=not killed)
    try:
        result = json.loads(output.splitlines()[-1])
        deviation, version, loaded = float(result["deviation"]), str(result["version"]), str(result["loaded"])
    except (ValueError, LookupError, TypeError):
        return Answer(name, False, reason=f"the probe printed no result: {output[-80:]!r}")
    if not deviation <= DEVIATION_LIMIT:  # also true for NaN
        return Answer(name, False, reason=f"LLVM {version} rendered a wrong radiance, off by {deviation:.3g}")
    return Answer(name, True, version=version, loaded=loaded)


def _failure(status: int, errors: str) -> str:
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    telling = [line for line in lines if re.search(r"LLVM ERROR|too old|API initialization failed", line)]
    line = (telling or lines[-1:] or ["no message"])[0]
    line = re.sub(r",? ?\b0x[0-9a-f]{6,}:?", "", line)[:160]  # addresses say nothing
    if status >= 0:
        return line
    names = {int(s): s.name for s in signal.Signals}
    return f"the process ended by {names.get(-status, f'signal {-status}')}: {line}"


def _render_probe() -> dict[str, str | float]:
    """Render in this process; the answer is the largest relative error over a lit floor.

    A point light of I = 3 W/sr stands h = 8 m over the middle of a Lambertian floor of reflectance 0.5, so
    that at the distance r from its foot the radiance is 0.5/π · I h / (h² + r²)^(3/2). A rough metal ball
    beside and below the floor is in the picture, lit, and sends nothing to the floor: it is there because
    its BSDF is what some LLVM versions cannot compile.
    """
    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_mono")
    import drjit as dr

    def spectrum(value: float) -> dict[str, object]:
        return {"type": "uniform", "value": value}

    look = mi.ScalarTransform4f().look_at(origin=[0.5, 0, 3], target=[0.5, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 32, "height": 16, "pixel_format": "luminance"}
    box = {"type": "box"}
    metal = {"type": "roughconductor", "alpha": 0.2, "material": "none"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 6},
            "sensor": {
                "type": "orthographic",
                "to_world": look @ mi.ScalarTransform4f().scale([2, 2, 1]),
                "film": film | {"rfilter": box},
                "sampler": {"type": "independent", "sample_count": 64},
            },
            "light": {"type": "point", "position": [0, 0, 8], "intensity": spectrum(3.0)},
            "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": spectrum(0.5)}},
            "ball": {"type": "sphere", "center": [1.7, 0, -0.6], "radius": 0.5, "bsdf": metal},
        }
    )
    image = np.array(mi.render(scene, seed=1), dtype=np.float64)[..., 0]
    x_m = (np.arange(32) + 0.5) / 8 - 1.5
    y_m = (np.arange(16) + 0.5) / 8 - 1.0
    on_floor = np.abs(x_m) < 1
    expected = 0.5 / np.pi * 3.0 * 8 / (x_m[on_floor] ** 2 + y_m[:, np.newaxis] ** 2 + 64) ** 1.5
    deviation = float(np.max(np.abs(image[:, on_floor] / expected - 1)))
    ball = image[:, ~on_floor]
    if not (np.isfinite(ball).all() and ball.max() > 0):
        deviation = float("inf")
    version = ".".join(str(part) for part in dr.detail.llvm_version())
    return {"deviation": deviation, "version": version, "loaded": _loaded_library()}


def _loaded_library(maps: Path = Path("/proc/self/maps")) -> str:
    """Return the LLVM library that this process has loaded, or an empty text where Linux is not asked."""
    try:
        lines = maps.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return os.environ.get(VARIABLE, "")
    # Six columns; the last, the path, may hold spaces.
    paths = [columns[5] for line in lines if len(columns := line.split(maxsplit=5)) == 6]
    return next((path for path in paths if _is_llvm(Path(path))), "")


def _forbid_core_dump() -> None:
    """Let an abort that is expected leave no file behind."""
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


# The memory


def cache_file(environ: Mapping[str, str] = os.environ, system: str = sys.platform) -> Path | None:
    """Return the file of remembered answers in the user's cache folder, or None for a user without a home."""
    try:
        home = Path.home()
    except RuntimeError:
        return None
    if system == "win32":
        base = Path(environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif system == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(environ.get("XDG_CACHE_HOME") or home / ".cache")
        # The XDG specification has relative paths ignored.
        base = base if base.is_absolute() else home / ".cache"
    return base / "nir_render" / "llvm.json"


def cpu_name(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's model and its instruction sets, on which LLVM's code generation depends."""
    name = f"{platform.machine()} {os.environ.get('PROCESSOR_IDENTIFIER', '')}".strip()
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").split("\n\n", 1)[0].splitlines()
    except OSError:
        return name
    fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    parts = [fields.get(key, "") for key in ("model name", "CPU part", "flags", "Features")]
    return " ".join([name, *filter(None, parts)])


def package_versions() -> str:
    """Return the versions of Mitsuba and Dr.Jit as one text; empty where they are not installed."""
    try:
        return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("mitsuba", "drjit"))
    except importlib.metadata.PackageNotFoundError:
        return ""


def _identity(library: Path | None, found: Iterable[Path], environ: Mapping[str, str]) -> list[str]:
    """Describe what a probe's answer depends on as regards the library.

    What Dr.Jit (or the loader, for a bare name) picks depends on everything that there is to be picked.
    """
    if library is not None and library.is_file():
        return _fingerprint(library)
    searched = [environ.get(variable, "") for variable in _SEARCH_VARIABLES]
    return [str(library), *searched, *(part for path in found for part in _fingerprint(path))]


def _fingerprint(library: Path) -> list[str]:
    try:
        status = library.stat()
    except OSError:
        return [str(library), "gone"]
    return [str(library.resolve()), str(status.st_size), str(status.st_mtime_ns)]


def _key(machine: Iterable[str], identity: Iterable[str]) -> str:
    return hashlib.sha256(json.dumps([*machine, *identity]).encode()).hexdigest()[:32]


def _read_answers(cache: Path | None) -> dict[str, Answer]:
    if cache is None:
        return {}
    try:
        answers = json.loads(cache.read_text(encoding="utf-8"))["answers"]
        return {str(key): Answer(**fields) for key, fields in answers.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}  # absent, broken or of another version: it is only a memory


def _write_answers(cache: Path | None, answers: Mapping[str, Answer]) -> None:
    if cache is None:
        return
    newest = list(answers.items())[-64:]
    document = {"format": 1, "answers": {key: asdict(answer) for key, answer in newest}}
    aside = cache.with_name(f".{cache.name}.{os.getpid()}")
    try:
        cache.parent.mkdir(parents=True, exist_ok=True)
        aside.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        aside.replace(cache)
    except OSError:
        # An unwritable cache costs a probe per run, nothing else.
        with contextlib.suppress(OSError):
            aside.unlink()


# The choice


def choose(
    *,
    find: Callable[[], Sequence[Path]] = find_libraries,
    ask: Callable[[Path | None], Answer] = probe,
    environ: Mapping[str, str] = os.environ,
    cache: Path | None = None,
    cpu: str | None = None,
    packages: str | None = None,
) -> Choice:
    """Choose the LLVM library by probing, with no subprocess where the answers are already known.

    The candidates are, in this order: the library that the user named in ``DRJIT_LIBLLVM_PATH``, or else
    Dr.Jit's own choice; then every library found. The first that is usable is chosen.

    Parameters
    ----------
    find, ask : callable
        `find_libraries` and `probe`, or what stands in for them.
    environ : mapping
        The environment: the user's wish, and where the cache lies.
    cache : Path, optional
        The file of remembered answers; by default `cache_file`.
    cpu, packages : str, optional
        Stand in for `cpu_name` and `package_versions`.

    Returns
    -------
    Choice
        Never raises for want of a library: ``usable`` says it.
    """
    packages = package_versions() if packages is None else packages
    if not packages:
        return Choice(None, False, "", "", "Mitsuba is not installed")
    found = tuple(find())
    cache = cache_file(environ) if cache is None else cache
    known = _read_answers(cache)
    machine = (str(PROBE_VERSION), cpu_name() if cpu is None else cpu, packages)

    def recall(library: Path | None) -> Answer:
        key = _key(machine, _identity(library, found, environ))
        if key not in known:
            answer = ask(library)
            if not answer.lasting:
                return answer
            known[key] = answer
            _write_answers(cache, known)
        return known[key]

    return _first_usable(_candidates(found, environ), recall)


def cached_choice(
    *,
    find: Callable[[], Sequence[Path]] = find_libraries,
    environ: Mapping[str, str] = os.environ,
    cache: Path | None = None,
    cpu: str | None = None,
    packages: str | None = None,
) -> Choice | None:
    """Return what `choose` would answer, or None where it would have to probe. Never starts a process.

    The parameters are those of `choose`.
    """

    def refuse(library: Path | None) -> Answer:
        raise LookupError(library)

    try:
        return choose(find=find, ask=refuse, environ=environ, cache=cache, cpu=cpu, packages=packages)
    except LookupError:
        return None


def _candidates(found: Iterable[Path], environ: Mapping[str, str]) -> list[tuple[Path | None, str]]:
    wish = environ.get(VARIABLE, "")
    if not wish:
        first, how = None, "Dr.Jit's own choice"
    else:
        # Made absolute, for the probe runs in another folder; a bare name is left to the loader.
        first = Path(wish).absolute() if Path(wish).is_file() else Path(wish)
        how = f"named by {VARIABLE}"
    return [(first, how), *((library, "found on this machine") for library in found if library != first)]


def _first_usable(
    candidates: Iterable[tuple[Path | None, str]], ask: Callable[[Path | None], Answer]
) -> Choice:
    failed: list[Answer] = []
    for library, how in candidates:
        answer = ask(library)
        if answer.usable:
            return Choice(library, True, answer.version, answer.loaded, how, tuple(failed))
        failed.append(answer)
    return Choice(None, False, "", "", "none that works was found", tuple(failed))


# Installation, for the set-up alone


@dataclass(frozen=True)
class Apt:
    """How LLVM could be installed with apt.

    Attributes
    ----------
    command : str
        What to type to install it; empty where there is no apt.
    prefix : tuple of str or None
        What to put in front of ``apt-get`` to run it without a question; None where that is not possible.
    """

    command: str
    prefix: tuple[str, ...] | None


NO_APT = Apt("", None)


def apt_command(
    *,
    which: Callable[[str], str | None] = shutil.which,
    is_root: bool | None = None,
    run: Callable[[Sequence[str]], tuple[int, str]] | None = None,
) -> Apt:
    """Find out whether this user may install with apt: as root, by sudo without a password, or not.

    Parameters
    ----------
    which, run : callable, optional
        Stand in for `shutil.which` and for running a command (exit status and output).
    is_root : bool, optional
        Whether the user is root; by default asked of the system.
    """
    if which("apt-get") is None:
        return NO_APT
    steps = ("apt-get update", f"apt-get install -y {_PACKAGE}")
    if _is_root() if is_root is None else is_root:
        return Apt(" && ".join(steps), ())
    command = " && ".join(f"sudo {step}" for step in steps)
    if which("sudo") is not None and (run or _run)(["sudo", "-n", "true"])[0] == 0:
        return Apt(command, ("sudo", "-n"))
    return Apt(command, None)


def install(apt: Apt, *, run: Callable[[Sequence[str]], tuple[int, str]] | None = None) -> str:
    """Install LLVM with apt. Only the set-up calls this, never a render.

    Parameters
    ----------
    apt : Apt
        The way, from `apt_command`.
    run : callable, optional
        Stands in for running a command (exit status and output).

    Returns
    -------
    str
        Empty if the package is installed, else why not, in one line.

    Raises
    ------
    ValueError
        If `apt` says that this user may not install.
    """
    if apt.prefix is None:
        raise ValueError(f"this user cannot install with apt; by hand: {apt.command or advice(apt)}")
    run = run or _run
    quiet = (*apt.prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-o", "DPkg::Lock::Timeout=60")
    # One unreachable source makes the update fail as a whole; the package may be there all the same.
    run([*quiet, "update"])
    status, output = run([*quiet, "install", "-y", "--no-install-recommends", _PACKAGE])
    lines = [line for line in output.splitlines() if line.strip()]
    return "" if status == 0 else (lines or [f"apt-get ended with status {status}"])[-1]


def advice(apt: Apt, which: Callable[[str], str | None] = shutil.which) -> str:
    """Return the command that would get a usable LLVM here, or a sentence where none is known."""
    others = {
        "dnf": f"sudo dnf install llvm{PREFERRED_VERSION}-libs",
        "brew": f"brew install llvm@{PREFERRED_VERSION}",
    }
    known = [apt.command, *(command for tool, command in others.items() if which(tool))]
    sentence = f"install LLVM {PREFERRED_VERSION} or newer and set {VARIABLE} to the path of its library"
    return next(filter(None, known), sentence)


def _is_root() -> bool:
    return bool(getattr(os, "geteuid", lambda: 1)() == 0)


def _run(command: Sequence[str]) -> tuple[int, str]:
    try:
        done = subprocess.run(  # noqa: S603 (fixed words, see the callers)
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
        )
    except OSError as error:
        return 127, str(error)
    return done.returncode, done.stdout


if __name__ == "__main__":
    _forbid_core_dump()
    sys.stdout.write(json.dumps(_render_probe()) + "\n")
