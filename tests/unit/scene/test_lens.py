"""Lenses in a scene file: what is read, what is refused, and that it loads again to the same bits."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from nir_render import InputError, Scene, load_scene
from nir_render.scene.documents.lens import Lens
from nir_render.scene.schema import scene_schema
from tests.paths import SCENES

AT = "robots.r1.rig.cameras.front.lens."
FULL = {
    "model": "fisheye", "distortion": [0.01, -0.02, 0.003, -1 / 3000], "principal_point": "[640.2, 478.9] px",
    "vignetting": [["0 deg", 1], ["50 deg", 1.25], ["90 deg", 0.7]], "focus_distance": "2.5 m",
    "thermal_focus_shift": "-3 um/K",
}  # fmt: skip


@pytest.fixture
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


def _with(scene: Scene, lens: dict[str, Any]) -> Scene:
    return scene.with_({AT + key: value for key, value in lens.items()})


def _lens(scene: Scene) -> Lens:
    return scene.camera("r1.front")[1].lens


def test_a_lens_is_read_in_si_units(scene: Scene) -> None:
    lens = _lens(_with(scene, FULL))
    assert lens.distortion == (0.01, -0.02, 0.003, -1 / 3000)
    assert lens.principal_point_px == (640.2, 478.9)
    assert lens.vignetting is not None
    np.testing.assert_allclose(lens.vignetting, [(0.0, 1.0), (np.radians(50.0), 1.25), (np.pi / 2, 0.7)])
    assert lens.focus_distance_m == 2.5
    assert lens.thermal_focus_shift_m_per_k == pytest.approx(-3e-6, rel=1e-12)


def test_the_resolved_document_loads_to_the_same_lens(scene: Scene, tmp_path: Path) -> None:
    changed = _with(scene, FULL)
    path = tmp_path / "scene.yaml"
    path.write_text(changed.resolved_yaml(), encoding="utf-8")
    assert _lens(load_scene(path)) == _lens(changed)


def test_the_schema_takes_a_lens() -> None:
    validator = Draft202012Validator(scene_schema())

    def holds(lens: dict[str, Any]) -> bool:
        camera = {"preset": "infra_swarm", "lens": {"preset": "wide_1p8mm", **lens}}
        rig = {"cameras": {"c": camera}}
        return bool(validator.is_valid({"format": 1, "observe": ["a"], "robots": {"a": {"rig": rig}}}))

    assert holds(FULL)
    assert not holds({"model": "pinhole"})
    assert not holds({"vignetting": [[0, 1], [60, 1]]})
    assert not holds({"distortion": "0.1"})
    assert not holds({"thermal_focus_shift": 3})


@pytest.mark.parametrize(
    ("lens", "reason"),
    [
        ({"distortion": [0.1]}, "a rectilinear lens has none"),
        ({"model": "brown_conrady"}, "distortion: 0 numbers; a brown_conrady lens takes 4 or 5 or 8"),
        ({"model": "brown_conrady", "distortion": [0.1] * 6}, "6 numbers"),
        ({"model": "brown_conrady", "distortion": [0.0] * 12}, "12 numbers.*thin prism and tilt terms are not built"),
        ({"model": "brown_conrady", "distortion": [0.0] * 14}, "14 numbers.*fit the lens anew without them"),
        ({"model": "fisheye", "distortion": [0.0] * 5}, "5 numbers; a fisheye lens takes 4"),
        ({"model": "fisheye", "distortion": [0.0, 0.0, 0.0, float("inf")]}, "finite"),
        ({"model": "pinhole"}, "rectilinear"),
        ({"principal_point": "640 px"}, "not a vector with a unit"),
        ({"focus_distance": "1 mm"}, "not beyond the focal length"),
        # f²/(N (d_f − f)) = 3.24 mm²/(2 · 0.2 mm) is 2160 px of 3.75 µm; 100 px are at 1.8 + 4.32 mm.
        ({"focus_distance": "2 mm"}, r"lens\.focus_distance: .*a disc of 2160 px; .*100 px.* at 0\.00612 m"),
        ({"model": "fisheye", "distortion": "[0.1, 0, 0, 0]"}, r"in brackets and without quotes, such as distortion: \["),
        ({"thermal_focus_shift": "3 um/K"}, "without 'focus_distance' all is in focus"),
        ({"focus_distance": "1 m", "thermal_focus_shift": "3 um"}, "is a length; wanted a focus shift"),
        (
            {"model": "brown_conrady", "distortion": [-0.3, 0, 0, 0]},
            r"cameras\.front: lens\.distortion: the image folds at a field angle of 46\.5 deg, 337 px from the principal.* 800 px",
        ),
    ],
)  # fmt: skip
def test_what_makes_no_lens_is_refused(scene: Scene, lens: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        _with(scene, lens)


def test_a_focus_as_near_as_the_blur_allows_is_read(scene: Scene) -> None:
    assert _lens(_with(scene, {"focus_distance": "6.13 mm"})).focus_distance_m == pytest.approx(0.00613)
