"""Bodies that all but touch a light: what they hide, and what they do not."""

import math

import numpy as np
import pytest

from tests.physics.conftest import Loader
from tests.physics.documents import (
    camera_document,
    group_radiance,
    pixel_rays,
    rectangle_document,
    scene_document,
    source_document,
)

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.vectorised,
]

REFLECTANCE = 0.6
WALL_M = 3.0
RADIUS_M = 0.01


@pytest.mark.parametrize("gap_mm", [2.0, 5.0])
@pytest.mark.parametrize("distance_m", [5.0, 20.0])
def test_a_black_cover_right_before_a_source_lets_nothing_by(
    make: Loader, distance_m: float, gap_mm: float
) -> None:
    """Shadow rays to a small far source must not end so early that they miss what covers it.

    A source of 10 mm, a black plate of 4 m × 4 m just before it, a wall far away of which 0.5 m are seen: all
    in the shadow, exactly 0. The same plate moved aside until its edge is 2 mm clear of the source: all light,
    L = (ρ/π) cos θ / (4π d²), every pixel to 0.2 % and the frame to 0.1 %.
    """
    place_m = np.array([WALL_M - distance_m, 0.0, 0.0])
    rays = pixel_rays(16, 16, 64.0)
    points_m = np.array([1.0, 0.0, 0.0]) + rays * ((WALL_M - 1.0) / rays[..., :1])
    away2 = ((points_m - place_m) ** 2).sum(axis=-1)
    lit = REFLECTANCE / math.pi * distance_m / away2**1.5 / (4.0 * math.pi)
    for aside_m, expected in ((0.0, 0.0 * lit), (2.0 + RADIUS_M + 0.002, lit)):
        before_m = (WALL_M - distance_m + RADIUS_M + 1e-3 * gap_mm, aside_m, 0.0)
        data = scene_document(
            {"c": camera_document(16, 16, 64.0)}, {"r": source_document(tuple(place_m.tolist()), RADIUS_M)},
            samples=256, max_depth=2,
            materials={"paint": {"type": "diffuse", "reflectance": REFLECTANCE}, "black": {"type": "diffuse", "reflectance": 0.0}},
            shapes={
                "wall": rectangle_document((WALL_M, 0, 0), (40, 40), (-1, 0, 0), "paint"),
                "plate": rectangle_document(before_m, (4, 4), (1, 0, 0), "black"),
            },
        )  # fmt: skip
        data["robots"]["eye"]["position"] = "[1, 0, 0] m"
        radiance = group_radiance(make(data))[0]
        np.testing.assert_allclose(radiance, expected, rtol=0.002, atol=0.0)
        assert radiance.mean() == pytest.approx(expected.mean(), rel=0.001)
