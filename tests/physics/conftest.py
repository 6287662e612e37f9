"""Scenes for the physics tests: one observer r1, one source r2, changed at dotted paths."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from nir_render import Scene, load_scene
from tests.paths import SCENES

SceneMaker = Callable[[Mapping[str, Any]], Scene]
Loader = Callable[[dict[str, Any]], Scene]


@pytest.fixture
def scene_with() -> SceneMaker:
    """Make the one-source scene, changed."""
    base = load_scene(SCENES / "one_source.yaml")
    still = base.with_({"robots.r2": {"rig": "infra_swarm"}, "clock.frames": 1})

    def make(changes: Mapping[str, Any]) -> Scene:
        return still.with_(changes)

    return make


@pytest.fixture
def make(tmp_path: Path) -> Loader:
    """Write a document down and load it."""

    def load(document: dict[str, Any]) -> Scene:
        path = tmp_path / "scene.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        return load_scene(path)

    return load


def source_at(range_m: float, angle_deg: float = 0.0) -> dict[str, Any]:
    """Place the source of r2 at a range and field angle (to the right, level) before the front camera of r1."""
    angle = np.radians(angle_deg)
    # The front camera sits at (0.06, 0, 0.2) m, the source 0.28 m above its robot's origin.
    x, y, z = 0.06 + float(range_m * np.cos(angle)), -float(range_m * np.sin(angle)), 0.2 - 0.28
    return {"robots.r2.position": f"[{x!r}, {y!r}, {z!r}] m"}
