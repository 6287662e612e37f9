"""Automatic exposure is judged by what it makes of the reference's frames."""

from dataclasses import replace
from pathlib import Path

import pytest

from nir_render.regress.make import choices
from nir_render.regress.reference import Reference, ReferenceShot
from nir_render.regress.stages.exposure import compare_choices
from nir_render.scene.scene import Scene
from tests.unit.regress import cases

AUTOMATIC = {
    "robots.r1.rig.cameras.front.auto_exposure": {"target": 0.7, "shortest": "20 us", "longest": "2 ms"}
}


def _made(tmp_path: Path) -> tuple[Scene, tuple[ReferenceShot, ...]]:
    scene = cases.scene(tmp_path).with_(AUTOMATIC)
    reference: Reference = cases.reference(scene)
    (shot,) = reference.shots
    chosen = choices(scene, [shot.frame])
    return scene, (replace(shot, chosen=chosen[shot.frame.camera, shot.frame.index]),)


def test_the_choice_of_a_flat_frame_by_hand(tmp_path: Path) -> None:
    """754 − 64 DN at 0.1 ms; it may clip 4 σ of 10 e below the 5700 e of its well, of 0.69 DN each: at 3905 DN."""
    _, (shot,) = _made(tmp_path)
    assert shot.chosen is not None
    assert shot.chosen.exposure_s == pytest.approx(1e-4 * 0.7 * 3905 / (754 - 64), rel=1e-12)
    assert shot.chosen.gain == 1.0


@pytest.mark.parametrize(
    ("change", "verdict", "said"),
    [
        ({}, "pass", "equal"),
        ({"target": 0.707}, "fail", "after frame 0, exposure in s: 0.000396"),
        ({"longest": "0.39 ms"}, "fail", "exposure in s"),
        ({"shortest": "21 us"}, "pass", "equal"),
    ],
)
def test_what_the_control_does_otherwise_is_found(
    tmp_path: Path, change: dict[str, object], verdict: str, said: str
) -> None:
    scene, shots = _made(tmp_path)
    place = "robots.r1.rig.cameras.front.auto_exposure"
    changed = scene.with_({f"{place}.{key}": value for key, value in change.items()})
    (finding,) = compare_choices(changed, shots, exact=False)
    assert finding.verdict == verdict
    assert said in finding.seen


def test_fixed_exposure_has_none_and_an_older_reference_says_how_to_get_them(tmp_path: Path) -> None:
    scene, shots = _made(tmp_path)
    (older,) = compare_choices(scene, [replace(shot, chosen=None) for shot in shots], exact=False)
    assert older.verdict == "skipped"
    assert "update --all" in older.seen
    fixed = cases.scene(tmp_path)
    assert compare_choices(fixed, cases.reference(fixed).shots, exact=False) == []
    (gone,) = compare_choices(fixed, shots, exact=False)
    assert gone.verdict == "fail"
