"""Where LLVM's libraries are looked for on each system, and in which order they come."""

from pathlib import Path

import pytest

from nir_render.transport.backend.llvm.libraries import find_libraries, usual_folders


def test_libraries_19_first_then_newest_each_once(tmp_path: Path) -> None:
    """Names as distributions and Homebrew give them; a link, a static part and other files do not count."""
    inside = {
        "lib": ("libLLVM-14.so.1", "libLLVM.so.18.1", "libLLVM.so.19.1", "libLLVM.so.20.1", "libLLVM-9.so"),
        "llvm@21/lib": ("libLLVM.dylib",),
        "Cellar/llvm/22.1.0/lib": ("libLLVM.dylib",),
        "bin": ("LLVM-C.dll",),
    }
    for folder, names in inside.items():
        (tmp_path / folder).mkdir(parents=True)
        for name in (*names, "libLLVMSupport.a", "libLLVM-C.txt"):
            (tmp_path / folder / name).touch()
    (tmp_path / "lib" / "libLLVM.so").symlink_to("libLLVM.so.20.1")
    in_loader_cache = tmp_path / "elsewhere" / "libLLVM-17.so.1"
    in_loader_cache.parent.mkdir()
    in_loader_cache.touch()
    loader_cache = tmp_path / "ld.so.cache"
    listed = [in_loader_cache, tmp_path / "lib" / "libLLVM.so.18.1", tmp_path / "gone" / "libLLVM-16.so.1"]
    loader_cache.write_bytes(b"head\0" + b"\0".join(str(n).encode() for n in listed) + b"\0libLLVM.so\0")

    patterns = [f"{tmp_path}/{folder}" for folder in ("lib", "llvm*/lib", "Cellar/llvm/*/lib", "bin", "none")]
    found = find_libraries(folders=patterns, loader_cache=loader_cache)

    assert [path.relative_to(tmp_path).as_posix() for path in found] == [
        "lib/libLLVM.so.19.1",
        "Cellar/llvm/22.1.0/lib/libLLVM.dylib",
        "llvm@21/lib/libLLVM.dylib",
        "lib/libLLVM.so.20.1",
        "lib/libLLVM.so.18.1",
        "elsewhere/libLLVM-17.so.1",
        "lib/libLLVM-14.so.1",
        "lib/libLLVM-9.so",
        "bin/LLVM-C.dll",
    ]


def test_the_loaders_search_path_is_searched(tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.19.1").touch()
    environ = {"LD_LIBRARY_PATH": f"/nowhere:{tmp_path}"}
    assert (tmp_path / "libLLVM.so.19.1") in find_libraries(environ=environ, system="linux")


@pytest.mark.parametrize(
    ("system", "part"),
    [("linux", "/usr/lib/llvm*/lib"), ("darwin", "/opt/homebrew/opt/llvm*/lib"), ("win32", "P/LLVM/bin")],
)
def test_usual_folders_of_each_system(system: str, part: str) -> None:
    assert part in usual_folders({"PROGRAMFILES": "P", "PATH": "a;b"}, system)
