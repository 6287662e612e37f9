"""Rays against boxes of fog and against facets, by hand."""

import math

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.transport.backend.variant import blocked
from nir_render.transport.direct.rays import crossing, length_in_box_m
from nir_render.transport.world.facets import facets
from nir_render.transport.world.mitsuba_scene import build
from tests.paths import SCENES

INF = math.inf


@pytest.mark.parametrize(
    ("start", "direction", "length_m", "low", "high", "inside_m"),
    [
        ([0, 0, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 2.0),
        ([0, 0, 0], [1, 0, 0], 2.5, [1, -1, -1], [3, 1, 1], 1.5),  # ends within
        ([2, 0, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 1.0),  # starts within
        ([0, 0, 0], [-1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 0.0),  # leads away
        ([0, 2, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 0.0),  # passes beside
        ([0, 1, 0], [1, 0, 0], 5.0, [1, -1, -1], [3, 1, 1], 2.0),  # along its face
        ([0, 0, 0], [0.6, 0.8, 0], 5.0, [-INF, -INF, -INF], [INF, INF, INF], 5.0),
        ([0, 0, 0], [0.6, 0, 0.8], 5.0, [-INF, -INF, -INF], [INF, INF, 2.0], 2.5),
        ([0, 0, 0], [0.6, 0, 0.8], INF, [-INF, -INF, -INF], [INF, INF, 2.0], 2.5),  # to the sun
        ([0, 0, 3], [0.6, 0, 0.8], INF, [-INF, -INF, -INF], [INF, INF, 2.0], 0.0),
        ([0, 0, 3], [1, 0, 0], INF, [-INF, -INF, -INF], [INF, INF, 2.0], 0.0),
        ([0, 0, 0], [0.6, 0.8, 0], 9.0, [1.2, 0, -1], [3, 2, 1], 0.5),  # enters at x = 1.2, leaves at y = 2
    ],
)
def test_how_much_of_a_ray_lies_in_a_box(
    start: list[float],
    direction: list[float],
    length_m: float,
    low: list[float],
    high: list[float],
    inside_m: float,
) -> None:
    found = length_in_box_m(
        np.array([start], dtype=float), np.array([direction], dtype=float), np.array([length_m]), np.array(low, dtype=float),
        np.array(high, dtype=float),
    )  # fmt: skip
    assert found == pytest.approx([inside_m])


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
