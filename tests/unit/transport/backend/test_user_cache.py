"""Answers kept in the user's cache folder: where the file is, and that it is only a memory."""

import sys
from pathlib import Path

import pytest

from nir_render.transport.backend.user_cache import cache_file, read_answers, write_answers


@pytest.mark.parametrize(
    ("system", "environ", "expected"),
    [
        ("linux", {"XDG_CACHE_HOME": "/x"}, Path("/x/nir_render/llvm.json")),
        ("linux", {"XDG_CACHE_HOME": "relative"}, Path("/home/u/.cache/nir_render/llvm.json")),
        ("linux", {}, Path("/home/u/.cache/nir_render/llvm.json")),
        ("darwin", {"XDG_CACHE_HOME": "/x"}, Path("/home/u/Library/Caches/nir_render/llvm.json")),
        ("win32", {"LOCALAPPDATA": "/local"}, Path("/local/nir_render/llvm.json")),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="the paths are written as POSIX has them")
def test_cache_file(
    system: str, environ: dict[str, str], expected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/u")
    assert cache_file("llvm.json", environ, system) == expected


def test_answers_come_back_and_the_oldest_go(tmp_path: Path) -> None:
    """Floats to the last bit; of 70 answers the first 6 are dropped; nothing half-written is left."""
    file = tmp_path / "deep" / "answers.json"
    answers = {str(number): {"share": 0.1 + number / 3.0} for number in range(70)}
    write_answers(file, answers)
    assert read_answers(file) == dict(list(answers.items())[6:])
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"answers": []}', '{"answers": {"k": 1}}', '{"format": 1}', "\x00\xff"]
)
def test_a_damaged_file_holds_nothing(tmp_path: Path, content: str) -> None:
    (tmp_path / "answers.json").write_text(content, encoding="latin-1")
    assert read_answers(tmp_path / "answers.json") == {}


def test_without_a_file_nothing_is_kept_and_nothing_fails(tmp_path: Path) -> None:
    (tmp_path / "folder").write_text("a file where the folder should be")
    for file in (None, tmp_path / "folder" / "answers.json"):
        write_answers(file, {"k": {"share": 1.0}})
        assert read_answers(file) == {}
