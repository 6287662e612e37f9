"""Fog of droplets by Mie theory, from a name in a scene to the kernel: forward peak, extinction at two wavelengths."""

import math

import numpy as np
import pytest

from nir_render import parse_scene
from nir_render.scattering.mie import cloud_of
from nir_render.scattering.optics import ANGLE_RAD
from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.transport.world.medium import Medium, medium
from tests.physics.conftest import Loader
from tests.physics.documents import (
    camera_document,
    group_radiance,
    pixel_rays,
    scene_document,
    source_document,
    tile_means,
)
from tests.physics.fog_forms import single_scatter_per_w, tabulated

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]


def _fog(make: Loader, droplets: str) -> Medium:
    document = scene_document(
        {"c": camera_document(4, 4)}, {"r": source_document((2.0, 0.0, 0.0), 0.02)}, samples=4, max_depth=2,
        fog={"visibility": "50 m", "droplets": droplets},
    )  # fmt: skip
    fog = medium(make(document).at(0.0))
    assert fog is not None
    return fog


@pytest.mark.parametrize(
    "droplets",
    [
        "radiation_moderate",
        pytest.param("radiation_heavy", marks=pytest.mark.verify),
        pytest.param("advection_moderate", marks=pytest.mark.verify),
        "advection_heavy",
    ],
)
def test_turns_are_drawn_as_mie_theory_has_them(make: Loader, droplets: str) -> None:
    """Shares of the turns that the kernel draws within 1, 5 and 30 degrees and backwards, against Mie sums at other angles.

    Gauss and Legendre's, 200 between each two edges, and 3000 sizes; what the preset's table has is 1025 angles of 8000 sizes.
    Heavy advection fog turns a third of its light by less than a degree. The numbers that are drawn by lie evenly, so that
    shares have no noise to speak of. Expected: each to 0.5 %.
    """
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.indirect.kernel.fog import draw_scattering
    from nir_render.transport.indirect.kernel.tables import upload_fog

    mi, count = backend().mi, 2**21
    even = ((np.arange(count) + 0.5) / count).astype(np.float32)
    axis = np.array([0.48, -0.6, 0.64])
    drawn = draw_scattering(
        upload_fog(_fog(make, droplets)), mi.Vector3f(*axis.tolist()), mi.Float(even), mi.Float(0.3)
    )
    turned = np.array(drawn).T.astype(float)
    angle_deg = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(turned - axis, axis=1), 1.0)))
    document = Droplets.model_validate(droplets)
    edges = np.cos(np.radians([0.0, 1.0, 5.0, 30.0, 90.0, 180.0]))
    nodes, weights = np.polynomial.legendre.leggauss(200)
    half = 0.5 * (edges[:-1] - edges[1:])
    angles = np.arccos(edges[1:, None] + half[:, None] * (nodes + 1.0))
    cloud = cloud_of(document.sizes.sizes(), document.index.value, 940e-9, angles.ravel(), nodes=3000)
    shares = 2.0 * math.pi * half * (cloud.phase_per_sr.reshape(angles.shape) @ weights)
    within = np.cumsum(shares)
    for most_deg, expected in ((1.0, within[0]), (5.0, within[1]), (30.0, within[2])):
        assert np.mean(angle_deg < most_deg) == pytest.approx(expected, rel=0.005)
    assert np.mean(angle_deg > 90.0) == pytest.approx(shares[4], rel=0.005)
    if droplets == "advection_heavy":
        assert 0.30 < within[0] < 0.34


@pytest.mark.parametrize(
    "droplets", ["advection_heavy", pytest.param("radiation_moderate", marks=pytest.mark.verify)]
)
def test_single_scattering_is_the_integral_along_the_ray(make: Loader, droplets: str) -> None:
    """A source alone in fog of droplets, seen through a long lens that shows the forward peak: 480 px a radian.

    As `test_groups_forms` does it for smooth phase functions. Expected: the frame to 0.2 % and rings about the source,
    from 0.2 to 4 degrees beyond its rim, to 0.5 %, where the light of heavy fog falls by a factor of 30.
    """
    source_m, radius_m = np.array([2.6, 0.11, 0.06]), 0.01
    scene = make(
        scene_document(
            {"c": camera_document(64, 48, 480.0)}, {"r": source_document(tuple(source_m.tolist()), radius_m)},
            samples=2048, max_depth=2, fog={"visibility": "20 m", "droplets": droplets},
        )
    )  # fmt: skip
    fog = scene.document.fog
    assert fog is not None
    radiance = group_radiance(scene)[0]
    # The fog is endless: radiance goes by the angle off the source alone. It bends within a pixel, of which 4 × 4 parts count.
    distance_m = float(np.linalg.norm(source_m))
    rim = math.asin(radius_m / distance_m)
    angle = rim + np.geomspace(np.radians(0.05), np.radians(6.0), 300)
    rays = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    optics = Droplets.model_validate(droplets).optics
    profile = single_scatter_per_w(
        rays, np.array([distance_m, 0.0, 0.0]), radius_m, fog.extinction_per_m, 1.0 - optics.absorbed_share,
        tabulated(ANGLE_RAD, optics.phase_per_sr), steps=2048, rings=6,
    )  # fmt: skip
    fine = pixel_rays(64, 48, 480.0, parts=4)
    off = np.arcsin(np.linalg.norm(np.cross(fine, source_m), axis=-1) / distance_m)
    expected = tile_means(np.interp(off, angle, profile), 4)
    beyond = tile_means(off, 4) - rim
    clear = beyond > np.radians(0.2)
    assert radiance[clear].mean() == pytest.approx(expected[clear].mean(), rel=0.002)
    for low_deg, high_deg in ((0.2, 0.6), (0.6, 1.2), (1.2, 2.0), (2.0, 4.0)):
        ring = (beyond > np.radians(low_deg)) & (beyond < np.radians(high_deg))
        assert radiance[ring].mean() == pytest.approx(expected[ring].mean(), rel=0.005), low_deg


def test_a_visibility_is_read_at_550_nm_and_light_at_940(make: Loader) -> None:
    """V = 50 m: σ(940) = 3.912/V × 1.012 … 1.044, a fog that names no droplets in between; extinction stands as it is."""
    expected = {"advection_heavy": 1.012, "advection_moderate": 1.014, "radiation_heavy": 1.028, "radiation_moderate": 1.043}  # fmt: skip
    for name, ratio in expected.items():
        assert _fog(make, name).extinction_per_m * 50.0 / 3.912 == pytest.approx(ratio, abs=0.0015)
    document = scene_document({"c": camera_document(4, 4)}, {"r": source_document((2.0, 0.0, 0.0), 0.02)}, samples=4, max_depth=2)  # fmt: skip
    for fog, per_m in (({"visibility": "50 m"}, 1.028 * 3.912 / 50.0), ({"extinction": "0.1 /m"}, 0.1)):
        found = medium(parse_scene({**document, "fog": fog}).at(0.0))
        assert found is not None
        assert found.extinction_per_m == pytest.approx(per_m, rel=0.0015)
