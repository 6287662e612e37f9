import re
from pathlib import Path

import pytest
import yaml

from nir_render import InputError, load_scene
from nir_render.run.examples import FIRST_SCENE, new_examples
from nir_render.scene.documents.document import SceneDocument
from tests.paths import SCENES


def test_a_new_folder_holds_the_examples_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()  # an empty folder is as good as none
    names = new_examples(tmp_path / "mine")
    assert {FIRST_SCENE, "my_estimator.py", "scene.schema.json", "campaigns/saturation.yaml"} <= set(names)
    shown = [path for folder in ("", "campaigns", "regression") for path in (SCENES / folder).glob("[a-z]*")]
    assert set(names) == {path.relative_to(SCENES).as_posix() for path in shown if path.is_file()}
    for name in names:
        assert (tmp_path / "mine" / name).read_bytes() == (SCENES / name).read_bytes()
    assert load_scene(tmp_path / "mine" / FIRST_SCENE).document.name == "one_source"


def test_the_examples_show_all_that_a_scene_may_hold() -> None:
    """Fog, sun, panes, mirrors, emission patterns and a target for the noise, each in one example at least."""
    documents = [load_scene(path).document for path in sorted(SCENES.glob("*.yaml"))]
    assert [document.name for document in documents] == sorted(path.stem for path in SCENES.glob("*.yaml"))
    assert any(document.fog for document in documents)
    assert any(document.sun for document in documents)
    assert any(document.render.noise == 0.2 for document in documents)
    materials = {material.type for document in documents for material in document.materials.values()}
    assert {"diffuse", "rough_conductor", "mirror", "plastic", "pane"} <= materials
    robots = [robot for document in documents for robot in document.robots.values()]
    assert any(source.pattern for robot in robots for source in robot.rig.sources.values())
    assert any(robot.motion for robot in robots)


def test_the_empty_scene_tells_of_every_key_and_is_valid_with_all_that_it_switches_off(
    tmp_path: Path,
) -> None:
    """What it switches off begins with "#" and no space, or two of them where it is indented."""
    written = (SCENES / "empty.yaml").read_text(encoding="utf-8")
    (tmp_path / "full.yaml").write_text(
        re.sub(r"^#(?=\S|  +\S)", "", written, flags=re.MULTILINE), encoding="utf-8"
    )
    full = yaml.safe_load((tmp_path / "full.yaml").read_text(encoding="utf-8"))
    assert set(full) == {*SceneDocument.model_fields, "include"}
    assert set(full["robots"]) == {"r1", "r2"}
    document = load_scene(tmp_path / "full.yaml").document
    assert document.fog is not None
    assert document.sun is not None
    assert set(document.shapes) == {"floor", "ball"}


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

    monkeypatch.setattr("nir_render.run.examples.write_file", fails_at_the_third)
    with pytest.raises(InputError, match="cannot be written"):
        new_examples(tmp_path / "mine")
    assert list(tmp_path.iterdir()) == []
