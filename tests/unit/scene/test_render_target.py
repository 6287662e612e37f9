"""The target for the noise of rendering, and the fixed count that may stand in its place."""

import copy
from pathlib import Path

import pytest

from nir_render import InputError, Scene, load_scene
from tests.paths import SCENES

PERCENT = "% of temporal variance"


@pytest.fixture
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


@pytest.mark.parametrize(
    ("text", "share"),
    [(f"5 {PERCENT}", 0.05), (f"0.1{PERCENT}", 0.001), (f" 100 {PERCENT} ", 1.0), (f".5 {PERCENT}", 0.005)],
)
def test_a_target_is_read_as_its_share(scene: Scene, text: str, share: float) -> None:
    assert scene.with_({"render.noise": text}).document.render.noise == pytest.approx(share, rel=1e-15)


@pytest.mark.parametrize(
    "wrong",
    ["5 %", 0.05, f"-5 {PERCENT}", "5 % of variance", f"5 1 {PERCENT}", f"0.05 {PERCENT}", f"101 {PERCENT}"],
)
def test_what_is_no_target_is_refused_by_name(scene: Scene, wrong: object) -> None:
    with pytest.raises(
        InputError, match=r"render\.noise: .*(such as '5 % of temporal variance'|lies outside 0.1 to 100 %)"
    ):
        scene.with_({"render.noise": wrong})


def test_the_default_is_five_percent_unless_a_count_is_fixed(scene: Scene) -> None:
    assert scene.document.render.noise == 0.05
    fixed = scene.with_({"render.indirect.samples": 64}).document.render
    assert (fixed.noise, fixed.indirect.samples) == (None, 64)


def test_both_in_one_document_are_refused(scene: Scene) -> None:
    both = {"render.noise": f"1 {PERCENT}", "render.indirect.samples": 16}
    with pytest.raises(InputError, match="write one of them, or set the other to null"):
        scene.with_(both)
    assert scene.with_(both | {"render.noise": None}).document.render.indirect.samples == 16


def test_a_change_that_writes_one_takes_the_other_away(scene: Scene) -> None:
    target = scene.with_({"render.indirect.samples": 16}).with_({"render.noise": f"2 {PERCENT}"})
    assert (target.document.render.noise, target.document.render.indirect.samples) == (0.02, None)
    count = target.with_({"render.indirect.samples": 32})
    assert (count.document.render.noise, count.document.render.indirect.samples) == (None, 32)


def test_the_resolved_document_loads_to_the_same_target(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    for changes in ({}, {"render.noise": f"0.3 {PERCENT}"}, {"render.indirect.samples": 8}):
        changed = scene.with_(changes)
        path.write_text(changed.resolved_yaml(), encoding="utf-8")
        assert load_scene(path).document.render == changed.document.render


def test_what_is_changed_is_a_copy(scene: Scene) -> None:
    """Copies share what they leave alone: so nothing is changed where it stands, and a rival that goes goes from the copy."""
    scene = scene.with_({"render.indirect.samples": 64, "render.indirect.scale": 4})
    before = copy.deepcopy(scene.raw)
    changed = scene.with_({"render.noise": f"2 {PERCENT}", "robots.r2.rig.sources.top.flux": "0.1 W"})
    assert scene.raw == before
    assert changed.raw["render"] == {"noise": f"2 {PERCENT}", "indirect": {"scale": 4}}
    scene.with_({"render.indirect.samples": 16})
    assert scene.raw == before
