"""Where a lamp stands in a frame, worked out by hand."""

from pathlib import Path

import numpy as np
import pytest

from nir_render import Scene, load_scene
from nir_render.evaluate.lamps import lamp_outlines_px


@pytest.fixture
def scene() -> Scene:
    """A lamp of 0.4 × 0.2 m, 4 m ahead of the front camera of r1 and level with it, that faces it."""
    base = load_scene(Path(__file__).parents[3] / "scenes" / "one_source.yaml")
    lamp = {
        "center": "[4.06, 0, 0.2] m", "size": "[0.4, 0.2] m", "normal": [-1, 0, 0], "luminous_flux": "1000 lm",
        "temperature": "2856 K",
    }  # fmt: skip
    return base.with_({"lamps.one": lamp})


def test_a_lamp_ahead(scene: Scene) -> None:
    """480 px · 0.4 m / 4 m = 48 px wide and 24 px high, about the principal point."""
    (outline,) = lamp_outlines_px(scene, "r1.front", 0.0)
    np.testing.assert_allclose(outline.min(axis=0), [639.5 - 24.0, 479.5 - 12.0], atol=1e-3)
    np.testing.assert_allclose(outline.max(axis=0), [639.5 + 24.0, 479.5 + 12.0], atol=1e-3)


def test_a_lamp_that_faces_away_or_stands_behind_is_not_seen(scene: Scene) -> None:
    assert lamp_outlines_px(scene.with_({"lamps.one.normal": [1, 0, 0]}), "r1.front", 0.0) == []
    assert lamp_outlines_px(scene, "r1.back", 0.0) == []
