"""Nothing half-written is left behind, and nothing that is no run is ever replaced."""

import json
import os
from pathlib import Path

import pytest

from nir_render import InputError
from nir_render.run.folder import (
    new_run_folder,
    read_json,
    read_lines,
    refresh_manifest,
    write_file,
    write_json,
    write_manifest,
)


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def _make_run(folder: Path, content: bytes = b"old", overwrite: bool = False) -> None:
    with new_run_folder(folder, overwrite) as aside:
        write_file(aside / "data", content)
        write_manifest(aside, {})


def test_a_run_appears_whole(tmp_path: Path) -> None:
    with new_run_folder(tmp_path / "run", overwrite=False) as aside:
        write_file(aside / "sub" / "data", b"x")
        assert not (tmp_path / "run").exists()
    assert _names(tmp_path) == ["run"]
    assert (tmp_path / "run" / "sub" / "data").read_bytes() == b"x"


def test_a_run_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with new_run_folder(tmp_path / "run", overwrite=False) as aside:
            write_file(aside / "data", b"x")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert _names(tmp_path) == []


def test_another_run_is_replaced_only_on_request(tmp_path: Path) -> None:
    _make_run(tmp_path / "run")
    with pytest.raises(InputError, match="holds another run; give a new folder, or --overwrite"):
        _make_run(tmp_path / "run", b"new")
    assert (tmp_path / "run" / "data").read_bytes() == b"old"
    _make_run(tmp_path / "run", b"new", overwrite=True)
    assert (tmp_path / "run" / "data").read_bytes() == b"new"
    assert _names(tmp_path) == ["run"]


def test_a_failed_replacement_leaves_the_old_run(tmp_path: Path) -> None:
    _make_run(tmp_path / "run")
    with pytest.raises(RuntimeError), new_run_folder(tmp_path / "run", overwrite=True):
        raise RuntimeError("stop")
    assert (tmp_path / "run" / "data").read_bytes() == b"old"
    assert _names(tmp_path) == ["run"]


def test_files_that_are_no_run_are_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds files that are no run"):
        _make_run(tmp_path / "home", overwrite=True)
    with pytest.raises(InputError, match="is a file"):
        _make_run(tmp_path / "home" / "thesis.tex", overwrite=True)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"


def test_a_full_disk_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_file(tmp_path / "data", b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="cannot be written \\(No space left on device\\)"):
        write_file(tmp_path / "data", b"new")
    assert _names(tmp_path) == ["data"]
    assert (tmp_path / "data").read_bytes() == b"old"


def test_the_manifest_hashes_every_file_and_follows_changes(tmp_path: Path) -> None:
    _make_run(tmp_path / "run")
    # SHA-256 of the three bytes "old".
    before = read_json(tmp_path / "run" / "manifest.json")["sha256"]
    assert before == {"data": "cba06b5736faf67e54b07b561eae94395e774c517a7d910a54369e1263ccfbd4"}
    write_json(tmp_path / "run" / "more.json", {"a": 1})
    refresh_manifest(tmp_path / "run", {"stage": "done"})
    manifest = read_json(tmp_path / "run" / "manifest.json")
    assert sorted(manifest["sha256"]) == ["data", "more.json"]
    assert (manifest["stage"], manifest["sha256"]["data"]) == ("done", before["data"])


def test_not_a_number_is_never_written_as_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert _names(tmp_path) == []


def test_broken_lines_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.jsonl").write_text(json.dumps({"a": 1}) + "\n\n{broken\n")
    with pytest.raises(InputError, match=r"a\.jsonl, line 3: broken JSON"):
        read_lines(tmp_path / "a.jsonl")
    with pytest.raises(InputError, match="there is no such file"):
        read_json(tmp_path / "b.json")
