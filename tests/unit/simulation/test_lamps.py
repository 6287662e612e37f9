"""Where a lamp stands in a frame, worked out by hand."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from nir_render import Scene, load_scene
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.evaluate.match import on_a_lamp
from nir_render.simulation.lamps import lamp_truth
from perception.types import Detection
from tests.paths import SCENES


@pytest.fixture
def scene() -> Scene:
    """A lamp of 0.4 × 0.2 m, 4 m ahead of the front camera of r1 and level with it, that faces it."""
    base = load_scene(SCENES / "one_source.yaml")
    lamp = {
        "center": "[4.06, 0, 0.2] m", "size": "[0.4, 0.2] m", "normal": [-1, 0, 0], "luminous_flux": "1000 lm",
        "temperature": "2856 K",
    }  # fmt: skip
    return base.with_({"lamps.one": lamp})


def _outlines_px(scene: Scene, camera: str) -> list[np.ndarray]:
    return [np.array(lamp.outline_px) for lamp in lamp_truth(scene.at(0.0), camera, 0)]


def test_a_lamp_ahead(scene: Scene) -> None:
    """480 px · 0.4 m / 4 m = 48 px wide and 24 px high, about the principal point."""
    (outline,) = _outlines_px(scene, "r1.front")
    np.testing.assert_allclose(outline.min(axis=0), [639.5 - 24.0, 479.5 - 12.0], atol=1e-3)
    np.testing.assert_allclose(outline.max(axis=0), [639.5 + 24.0, 479.5 + 12.0], atol=1e-3)


def test_a_lamp_that_faces_away_or_stands_behind_is_not_seen(scene: Scene) -> None:
    assert _outlines_px(scene.with_({"lamps.one.normal": [1, 0, 0]}), "r1.front") == []
    assert _outlines_px(scene, "r1.back") == []


SUN = {"azimuth": "10 deg", "elevation": "20 deg", "irradiance": "0.305 W/m^2/nm"}
FLOOR = {
    "type": "rectangle", "center": "[3, 0, 0] m", "size": "[8, 8] m", "normal": [0, 0, 1], "material": "gloss",
}  # fmt: skip
GLOSS = {"type": "plastic", "index": 1.5, "reflectance": 0.3, "roughness": 0.0}


def test_the_sun_and_its_image_in_the_floor(scene: Scene) -> None:
    """Seen along x, the sun lies at u = 480 tan 10° to the left and v = 480 tan 20°/cos 10° up; its image in the
    floor as far below, where the ray meets the floor 0.2/tan 20° = 0.55 m ahead: not on one that begins beyond."""
    u, v = (
        639.5 - 480.0 * np.tan(np.radians(10.0)),
        480.0 * np.tan(np.radians(20.0)) / np.cos(np.radians(10.0)),
    )
    sunny = scene.with_({"lamps": {}, "sun": SUN})
    (disc,) = _outlines_px(sunny, "r1.front")
    # The image of a circle is an ellipse whose middle lies a little farther out: r² / f · … = 0.01 px.
    np.testing.assert_allclose(0.5 * (disc.min(axis=0) + disc.max(axis=0)), [u, 479.5 - v], atol=0.02)
    # 480 px · tan 0.2666° = 2.23 px, stretched by 1/cos² of its 22.3° from the axis along the radius alone.
    assert (disc.max(axis=0) - disc.min(axis=0)).max() / 2.0 == pytest.approx(
        2.23 / np.cos(np.radians(22.3)) ** 2, rel=0.02
    )
    near = sunny.with_({"materials": {"gloss": GLOSS}, "shapes": {"floor": FLOOR}})
    _, image = _outlines_px(near, "r1.front")
    np.testing.assert_allclose(0.5 * (image.min(axis=0) + image.max(axis=0)), [u, 479.5 + v], atol=0.02)
    far = near.with_({"shapes.floor.center": "[6, 0, 0] m"})
    assert len(_outlines_px(far, "r1.front")) == 1
    assert _outlines_px(sunny, "r1.back") == []


def _under(scene: Scene, place_m: list[float], outlines: list[Any]) -> bool:
    """Tell whether what the front camera sees of a place in the world would count as on a lamp."""
    device = scene.camera("r1.front")[1]
    local_m = scene.at(0.0).camera("r1.front").pose.to_local(np.array([place_m]))
    u_px, v_px = (float(value) for value in intrinsics_of(device).project(local_m)[0])
    # on_a_lamp looks at the place alone.
    return on_a_lamp(cast(Detection, SimpleNamespace(u_px=u_px, v_px=v_px)), outlines)


@pytest.mark.parametrize(("from_x", "to_x"), [(0.9, 1.1), (-1.5, 0.7)])
def test_a_long_lamp_over_a_fisheye_is_a_bow(scene: Scene, from_x: float, to_x: float) -> None:
    """8 m across the way, 1 m above the camera at x = 0.06 m: what is on the lamp is on it, right up to its edges;
    what is under the bow, above the line between its ends, is not. The second lamp reaches behind the camera."""
    change = {
        "center": f"[{0.5 * (from_x + to_x)}, 0, 1.2] m", "size": f"[{to_x - from_x}, 8] m", "normal": [0, 0, -1],
    }  # fmt: skip
    lens = {"model": "fisheye", "distortion": [0, 0, 0, 0], "focal_length": "1.6 mm"}
    bent = scene.with_(
        {f"lamps.one.{key}": value for key, value in change.items()}
        | {f"robots.r1.rig.cameras.front.lens.{key}": value for key, value in lens.items()}
    )
    outlines = _outlines_px(bent, "r1.front")
    for x in np.linspace(max(from_x, 0.1) + 0.01, to_x - 0.01, 5):
        for y in (-3.9, -2.0, 0.3, 1.0, 3.9):
            assert _under(bent, [x, y, 1.2], outlines), (x, y)
    for y in (-1.5, 0.0, 1.0):
        # Over 0.3 m farther ahead at the same height: 30 px below the lamp's far edge, and above its ends.
        assert not _under(bent, [to_x + 0.3, y, 1.2], outlines)
    far_end_px = min(outlines[0][:, 1].max(), 479.0)
    device = bent.camera("r1.front")[1]
    middle = intrinsics_of(device).project(
        bent.at(0.0).camera("r1.front").pose.to_local(np.array([[to_x + 0.3, 0.0, 1.2]]))
    )[0]
    assert middle[1] < far_end_px
