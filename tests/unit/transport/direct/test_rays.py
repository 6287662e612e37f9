"""Rays against facets and bodies, by hand."""

import math

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.transport.backend.variant import blocked
from nir_render.transport.direct.rays import crossing
from nir_render.transport.world.facets import facets
from nir_render.transport.world.mitsuba_scene import build
from tests.paths import SCENES


def test_where_rays_cross_a_facet() -> None:
    """A mirror of 2 × 1 m that stands upright at x = 3, its middle at z = 1."""
    sheet = {
        "type": "rectangle", "center": "[3, 0, 1] m", "size": "[2, 1] m", "normal": [-1, 0, 0], "material": "m",
    }  # fmt: skip
    scene = load_scene(SCENES / "one_source.yaml").with_(
        {"materials.m": {"type": "mirror", "reflectance": 1}, "shapes.s": sheet}
    )
    starts = np.array([[0, 0.99, 1.0], [0, 1.01, 1], [0, 0, 1.49], [0, 0, 1.51], [6, 0, 1], [0, 0, 1]])
    directions = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0]])
    along_m, within = crossing(facets(scene.at(0.0)), 0, starts, directions)
    assert along_m.tolist() == [3.0, 3.0, 3.0, 3.0, -3.0, math.inf]
    assert within.tolist() == [True, False, True, False, True, False]


@pytest.mark.mitsuba
def test_no_rays_hit_nothing() -> None:
    """As of a mirror in which no ray finds its source."""
    bodies = build(load_scene(SCENES / "one_source.yaml").at(0.0), panes=False)
    none = np.zeros((0, 3))
    assert blocked(bodies, none, none, np.zeros(0)).shape == (0,)
