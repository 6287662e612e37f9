"""Where this machine keeps its LLVM libraries, the best to try first."""

import glob
import os
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

PREFERRED_VERSION = 19  # tried first: the one this project is tested with
SEARCH_VARIABLES = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH")

_LIBRARY_NAME = re.compile(
    r"libLLVM(-\d[\d.]*)?\.so(\.\d+)*|libLLVM(-\d[\d.]*)?\.dylib|libLLVM-\d[\d.]*\.dll|LLVM-C\.dll"
)
_VERSION_IN_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+(?:\.\d+)*)")
_VERSION_IN_FOLDER = re.compile(r"llvm[-@/]?(\d+(?:\.\d+)*)/")


def find_libraries(
    *,
    environ: Mapping[str, str] = os.environ,
    system: str = sys.platform,
    folders: Iterable[str] | None = None,
    loader_cache: Path = Path("/etc/ld.so.cache"),
) -> list[Path]:
    """List the LLVM libraries of this machine, real paths, each once: 19 first, then the newest first.

    `folders` are glob patterns, by default `usual_folders`. `loader_cache` is the file from which
    ``ldconfig -p`` reads; it is read directly, for ``/sbin`` is not on everybody's PATH.
    """
    patterns = usual_folders(environ, system) if folders is None else folders
    # Path.glob takes no absolute pattern.
    names = [name for pattern in patterns for name in glob.glob(f"{pattern}/*LLVM*")]  # noqa: PTH207
    paths = map(Path, [*names, *_in_loader_cache(loader_cache)])
    real = {path.resolve() for path in paths if _LIBRARY_NAME.fullmatch(path.name) and path.is_file()}
    return sorted(real, key=_preference)


def usual_folders(environ: Mapping[str, str], system: str) -> list[str]:
    """Return glob patterns of the folders where LLVM's library may lie on `system` (as `sys.platform`)."""

    def listed(variable: str) -> list[str]:
        folders = environ.get(variable, "").split(";" if system == "win32" else ":")
        return [glob.escape(folder) for folder in folders if folder]

    named = [folder for variable in SEARCH_VARIABLES for folder in listed(variable)]
    prefix = glob.escape(sys.prefix)
    if system == "win32":
        programs = environ.get("PROGRAMFILES", "C:/Program Files")
        return [*named, f"{prefix}/Library/bin", f"{programs}/LLVM/bin", *listed("PATH")]
    if system == "darwin":
        kegs = ("/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib", "/opt/local/libexec/llvm-*/lib")
        return [*named, f"{prefix}/lib", *kegs, "/opt/homebrew/lib", "/usr/local/lib"]
    own = ("/usr/lib/llvm*/lib", "/usr/lib64/llvm*/lib", "/opt/llvm*/lib", "/usr/local/llvm*/lib")
    common = ("/usr/lib", "/usr/lib64", "/usr/lib/*-linux-gnu", "/usr/local/lib")
    return [*named, f"{prefix}/lib", *own, *common]


def _in_loader_cache(loader_cache: Path) -> list[str]:
    try:
        content = loader_cache.read_bytes()
    except OSError:
        return []
    return [os.fsdecode(name) for name in re.findall(rb"/[^\0]*libLLVM[^\0/]*", content)]


def _preference(library: Path) -> tuple[bool, tuple[int, ...], str]:
    """Sort key: the preferred version, then the newest, then those whose version no name tells."""
    posix = library.as_posix()
    match = _VERSION_IN_NAME.search(library.name) or _VERSION_IN_FOLDER.search(posix)
    version = tuple(int(part) for part in match[1].split(".")) if match else ()
    is_other = version[:1] != (PREFERRED_VERSION,)
    # Padded, for a tuple that is shorter sorts before, not after, the longer one it begins.
    newest_first = tuple(-part for part in (*version, 0, 0, 0, 0)[:4])
    return is_other, newest_first, posix
