"""Pictures of reflectance lie where they should: against the same surface in one grey, pixel by pixel."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render.scene.scene import parse_scene
from nir_render.transport.indirect.groups import indirect, rays_of
from tests.physics.documents import camera_document, scene_document, source_document

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

Array = NDArray[np.float64]

# The top row first: darker to the right, and the lower row darker still.
VALUES = np.array([[255, 204, 153], [102, 51, 0]], dtype=np.uint8)
LOW, HIGH = 0.1, 0.9


def _radiance(folder: Path, shape: dict[str, Any], reflectance: Any) -> Array:
    document = scene_document(
        {"c": camera_document(48, 32, 48.0)}, {"r": source_document((0.5, 0.2, 0.3), 0.002)}, samples=64, max_depth=2,
        materials={"paint": {"type": "diffuse", "reflectance": reflectance}}, shapes={"wall": shape},
    )  # fmt: skip
    world = parse_scene(document, folder).at(0.0)
    placed = world.camera("eye.c")
    light = indirect(world, rays_of(placed.camera, placed.pose), 1, np.ones(1))
    assert light is not None
    return np.asarray(light.radiance_per_w[0, 0], dtype=np.float64)


def _bilinear(wrap: str) -> Array:
    """Return the reflectance in each of 48 × 32 pixels that the picture fills: means of 8 × 8 places."""
    values = LOW + (HIGH - LOW) * VALUES / 255.0
    padded = np.pad(values, 1, mode="edge" if wrap == "clamp" else "wrap")
    across, down = (np.arange(8 * 48) + 0.5) / 128.0 + 0.5, (np.arange(8 * 32) + 0.5) / 128.0 + 0.5
    column, row = across.astype(int), down.astype(int)
    x, y = across - column, (down - row)[:, None]
    upper, lower = ((1.0 - x) * padded[k][:, column] + x * padded[k][:, column + 1] for k in (row, row + 1))
    return np.asarray(((1.0 - y) * upper + y * lower).reshape(32, 8, 48, 8).mean(axis=(1, 3)))


@pytest.mark.parametrize(("kind", "wrap"), [("rectangle", "clamp"), ("mesh", "repeat")])
def test_a_picture_is_upright_and_interpolated(tmp_path: Path, kind: str, wrap: str) -> None:
    """A wall of 3 m × 2 m at 3 m fills the frame with a picture of 3 × 2 pixels: against bilinear by hand.

    Each of 48 × 32 pixels over the wall in one grey, to ± 0.004; at the wall's edges a rectangle holds the
    outermost values, and a mesh goes on with those of the other side.
    """
    assert cv2.imwrite(str(tmp_path / "a.png"), VALUES)
    shape: dict[str, Any] = {
        "type": "rectangle", "center": "[3, 0, 0] m", "size": "[3, 2] m", "normal": [-1, 0, 0], "material": "paint",
    }  # fmt: skip
    if kind == "mesh":  # seen along x, y is to the left: u runs against it
        (tmp_path / "wall.obj").write_text(
            "v 3 1.5 -1\nv 3 -1.5 -1\nv 3 -1.5 1\nv 3 1.5 1\n"
            "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"
        )
        shape = {"type": "mesh", "file": "wall.obj", "material": "paint"}
    laid = _radiance(tmp_path, shape, {"texture": "a.png", "of": [LOW, HIGH]})
    grey = _radiance(tmp_path, shape, 0.5)
    np.testing.assert_allclose(0.5 * laid / grey, _bilinear(wrap), atol=0.004)
