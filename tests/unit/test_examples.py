from pathlib import Path

import pytest

from nir_render import InputError, load_scene
from nir_render.examples import FIRST_SCENE, new_examples

SCENES = Path(__file__).parents[2] / "scenes"


def test_a_new_folder_holds_the_examples_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()  # an empty folder is as good as none
    names = new_examples(tmp_path / "mine")
    assert {FIRST_SCENE, "my_estimator.py", "scene.schema.json"} <= set(names)
    assert set(names) == {path.name for path in SCENES.iterdir() if path.is_file()}
    for name in names:
        assert (tmp_path / "mine" / name).read_bytes() == (SCENES / name).read_bytes()
    assert load_scene(tmp_path / "mine" / FIRST_SCENE).document.name == "one_source"


def test_a_folder_with_anything_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / ".hidden").write_text("")
    with pytest.raises(InputError, match="holds files already"):
        new_examples(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        new_examples(tmp_path / ".hidden")
    assert [path.name for path in tmp_path.iterdir()] == [".hidden"]


def test_a_disk_that_fills_up_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Path] = []

    def fails_at_the_third(path: Path, data: bytes) -> None:
        if len(written) == 2:
            raise InputError(f"{path}: cannot be written")
        path.write_bytes(data)
        written.append(path)

    monkeypatch.setattr("nir_render.examples.write_file", fails_at_the_third)
    with pytest.raises(InputError, match="cannot be written"):
        new_examples(tmp_path / "mine")
    assert list(tmp_path.iterdir()) == []
