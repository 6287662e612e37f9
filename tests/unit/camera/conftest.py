"""A camera and a source of the paper's rig, to be changed."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.files import merge

CameraMaker = Callable[..., Camera]


@pytest.fixture
def camera_with() -> CameraMaker:
    """Make the camera of the preset `infra_swarm`, with parts changed as a scene file would."""

    def make(**changes: Any) -> Camera:
        document: Mapping[str, Any] = merge({"preset": "infra_swarm"}, changes)
        return Camera.model_validate(document, context={"folder": Path()})

    return make


@pytest.fixture
def source() -> Source:
    """Return the source of the preset `infra_swarm`."""
    return Source.model_validate("infra_swarm", context={"folder": Path()})
