"""Many lights in fog, and fog before a mirror, each group apart."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render.transport.indirect.kernel import fog_scatter
from tests.physics.conftest import Loader
from tests.physics.documents import (
    camera_document,
    group_radiance,
    pixel_rays,
    rectangle_document,
    scene_document,
    source_document,
    tile_means,
)
from tests.physics.fog_forms import henyey_greenstein, single_scatter_per_w

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.vectorised,
]

Array = NDArray[np.float64]

RADIUS_M = 0.02


@pytest.mark.verify
@pytest.mark.parametrize("number", [24, 48])
def test_each_of_many_sources_shines_in_fog_as_if_alone(make: Loader, number: int) -> None:
    """With more lights than fog weighs one by one, some are proposed, and one is taken: right for each on average.

    Sources strewn over 12 m × 12 m × 6 m, single scattering, each group against its integral along the rays,
    averaged over 3 × 3 places of a pixel, in 8 × 8 tiles, pixels nearer than 1 m to the source left out.
    Expected: the mean square of all errors, in standard errors of 8 renders, is that of Student's t of 7 degrees
    of freedom, 1.4, and the groups are right on average, both within 5 standard errors from the spread over the
    groups; the latter is 0.1 % or less. Light that goes to the wrong group or place is seen in the former, 1 % of
    all light in the latter.
    """
    columns, rows, focal_px, renders = 32, 24, 16.0, 8
    assert number > fog_scatter._WEIGHED_LIGHTS
    random = np.random.default_rng(5)
    places_m = np.stack(
        [random.uniform(2, 14, number), random.uniform(-6, 6, number), random.uniform(-3, 3, number)], 1
    )
    scene = make(
        scene_document(
            {"c": camera_document(columns, rows, focal_px)},
            {f"r{index}": source_document(tuple(place_m.tolist()), RADIUS_M) for index, place_m in enumerate(places_m)},
            samples=1024, max_depth=2,
            fog={"extinction": "0.1 /m", "albedo": 0.9, "phase": {"type": "henyey_greenstein", "g": 0.3}},
        )
    )  # fmt: skip
    images = np.stack([group_radiance(scene, seed) for seed in range(renders)])
    fine = pixel_rays(columns, rows, focal_px, parts=3).reshape(-1, 3)
    middle = pixel_rays(columns, rows, focal_px)
    ratios, squares = [], []
    for group, place_m in enumerate(places_m):
        profile = single_scatter_per_w(fine, place_m, RADIUS_M, 0.1, 0.9, henyey_greenstein(0.3), steps=64)
        expected = tile_means(profile.reshape(3 * rows, 3 * columns), 3)
        clear = np.linalg.norm(np.cross(middle, place_m), axis=-1) > 1.0
        parts = np.stack([tile_means(np.where(clear, image, 0.0), 8) for image in images[:, group]])
        whole = tile_means(np.where(clear, expected, 0.0), 8)
        mostly = tile_means(clear.astype(float), 8) > 0.6
        error = parts.std(axis=0, ddof=1)[mostly] / math.sqrt(renders)
        squares.append(np.mean(((parts.mean(axis=0) - whole)[mostly] / error) ** 2))
        ratios.append(parts.mean() / whole.mean())
    for values, expected_mean in ((squares, 1.4), (ratios, 1.0)):
        error = np.std(values, ddof=1) / math.sqrt(number)
        assert abs(np.mean(values) - expected_mean) < 5.0 * error
    assert error < 0.001


@pytest.mark.parametrize(
    ("samples", "renders", "asymmetry", "albedo"),
    [
        pytest.param(256, 12, 0.5, 0.9, marks=pytest.mark.verify),
        pytest.param(256, 12, 0.0, 0.9, marks=(pytest.mark.verify, pytest.mark.at_length)),
        pytest.param(256, 12, 0.5, 0.05, marks=pytest.mark.verify),
    ],
)
def test_a_mirror_in_fog_doubles_the_world(
    make: Loader, samples: int, renders: int, asymmetry: float, albedo: float
) -> None:
    """Before a perfect mirror plane fog and lights look as if both went on behind it, mirrored: all orders.

    A source 0.7 m before a mirror of 200 m, which the left half of the frame sees, and the same source and its
    mirror image in endless fog without a mirror, summed up. (On one of 2 km a GPU places hits worse than shadow
    rays are shortened, and loses 0.5 %.) Light that goes to and fro must be found once: by the
    source, by its image, or by a path that turns in fog and then meets the mirror. Expected: both halves within
    4 standard errors of the difference, which are 0.1 % at most.
    """
    fog = {
        "extinction": "0.3 /m",
        "albedo": albedo,
        "phase": {"type": "henyey_greenstein", "g": asymmetry},
    }
    camera = {"c": camera_document(32, 24, 32.0)}
    here, behind = source_document((2.0, 0.3, 0.2), 0.05), source_document((2.0, 1.7, 0.2), 0.05)
    mirrored = scene_document(
        camera, {"r": here}, samples=samples, max_depth=40, fog=fog,
        materials={"silver": {"type": "mirror", "reflectance": 1.0}},
        shapes={"mirror": rectangle_document((0, 1, 0), (200, 200), (0, -1, 0), "silver")},
    )  # fmt: skip
    twice = scene_document(camera, {"r": here, "q": behind}, samples=samples, max_depth=40, fog=fog)
    images = [
        np.stack([group_radiance(scene, seed).sum(axis=0) for seed in range(renders)])
        for scene in (make(mirrored), make(twice))
    ]
    for half in (np.s_[..., :16], np.s_[..., 16:]):
        one, other = (image[half].mean(axis=(1, 2)) for image in images)
        error = math.hypot(*(x.std(ddof=1) / math.sqrt(renders) / x.mean() for x in (one, other)))
        assert error < 0.001
        assert abs(one.mean() / other.mean() - 1.0) < 4.0 * error
