"""Fog of droplets by Mie theory, from a name in a scene to the kernel: forward peak, extinction at two wavelengths."""

import math

import numpy as np
import pytest

from nir_render import parse_scene
from nir_render.scattering.mie import cloud_of
from nir_render.scattering.optics import ANGLE_RAD
from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.transport.indirect import groups
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


def _of_a_ball(off_rad: float, distance_m: float, radius_m: float, extinction_per_m: float) -> float:
    """Return the radiance per watt that heavy advection fog before and about a ball scatters once into a ray.

    Along the ray, and over the turns θ that end on the ball: for each, over the angles φ about the ray that do. The phase
    function's own angles are the nodes, so that its peak is not missed.
    """
    optics = Droplets.model_validate("advection_heavy").optics
    foot_m, beside_m = distance_m * math.cos(off_rad), distance_m * math.sin(off_rad)
    end = 0.5 * math.pi
    if beside_m < radius_m:
        end = -math.atan2(math.sqrt(radius_m**2 - beside_m**2), beside_m)
    nodes, weights = np.polynomial.legendre.leggauss(160)
    begin = -math.atan2(foot_m, beside_m)
    view = begin + 0.5 * (end - begin) * (nodes + 1.0)
    along_m = beside_m * np.tan(view)
    per_step = 0.5 * (end - begin) * weights * beside_m / np.cos(view) ** 2
    away_m = np.hypot(beside_m, along_m)[:, None]
    axis = np.arctan2(beside_m, -along_m)[:, None]
    cap = np.arcsin(np.minimum(radius_m / away_m, 1.0))
    turn = np.concatenate([[1e-9], ANGLE_RAD[1:-1]])[None]
    inside = (np.cos(cap) - np.cos(turn) * np.cos(axis)) / (np.sin(turn) * np.sin(axis))
    most = np.arccos(np.clip(inside, -1.0, 1.0))
    about, share = np.polynomial.legendre.leggauss(8)
    towards = 0.0
    for one, weight in zip(0.5 * (about + 1.0), 0.5 * share, strict=True):
        cosine = np.cos(turn) * np.cos(axis) + np.sin(turn) * np.sin(axis) * np.cos(one * most)
        sine2 = np.clip(1.0 - cosine**2, 0.0, (radius_m / away_m) ** 2)
        reach_m = away_m * cosine - np.sqrt(np.maximum(radius_m**2 - away_m**2 * sine2, 0.0))
        towards = towards + weight * 2.0 * most * np.exp(-extinction_per_m * np.maximum(reach_m, 0.0))
    phase = optics.phase_per_sr[:-1][None]
    lit = np.trapezoid(phase * np.sin(turn) * towards, turn, axis=1)
    per_m = extinction_per_m * (1.0 - optics.absorbed_share) * np.exp(-extinction_per_m * (foot_m + along_m))
    return float(np.sum(per_step * per_m * lit) / (4.0 * math.pi**2 * radius_m**2))


@pytest.mark.verify
def test_a_large_lamp_hanging_in_heavy_fog_is_as_bright_as_its_integral(make: Loader) -> None:
    """A ball of 0.4 m, 2 m away, fills 23 degrees: wider than the forward peak, of which asking for its light meets little.

    Paths that turn meet the ball themselves; the two are weighted. Single scattering, 4 renders, against the integral along
    the rays. Expected: the frame and the light before the ball to 0.3 % (σ 0.09 %; by asking alone it is 2.6 %), and the
    errors of 48 tiles, over what renders say of them, have a mean square below 1.5².
    """
    source_m, radius_m, columns, rows, focal_px = np.array([2.0, 0.1, 0.05]), 0.4, 48, 64, 40.0
    scene = make(
        scene_document(
            {"c": camera_document(columns, rows, focal_px)}, {"r": source_document(tuple(source_m.tolist()), radius_m)},
            samples=256, max_depth=2, fog={"visibility": "20 m", "droplets": "advection_heavy"},
        )
    )  # fmt: skip
    fog = scene.document.fog
    assert fog is not None
    distance_m = float(np.linalg.norm(source_m))
    rim = math.asin(radius_m / distance_m)
    angle = rim * np.concatenate(
        [np.linspace(1e-3, 0.98, 24), np.linspace(0.99, 1.01, 9), np.geomspace(1.02, 5.0, 40)]
    )
    profile = np.array([_of_a_ball(one, distance_m, radius_m, fog.extinction_per_m) for one in angle])
    fine = pixel_rays(columns, rows, focal_px, parts=4)
    off = np.arctan2(np.linalg.norm(np.cross(fine, source_m), axis=-1), fine @ source_m)
    expected = tile_means(np.interp(off, angle, profile), 4)
    snapshot = scene.at(0.0)
    placed = snapshot.camera("eye.c")
    drawn = [
        groups.indirect(snapshot, groups.rays_of(placed.camera, placed.pose), seed, np.ones(1))
        for seed in range(4)
    ]
    means = np.stack([one.radiance_per_w[0, 0].astype(float) for one in drawn if one is not None])
    variances = np.stack([one.variance[0, 0].astype(float) for one in drawn if one is not None])
    radiance = means.mean(axis=0)
    before = tile_means(off, 4) < 0.9 * rim
    assert radiance.mean() == pytest.approx(expected.mean(), rel=0.003)
    assert radiance[before].mean() == pytest.approx(expected[before].mean(), rel=0.003)
    error = np.stack([tile_means(one, 8) for one in means]) - tile_means(expected, 8)
    z = error / np.sqrt(np.stack([tile_means(one, 8) for one in variances]) / 64.0)
    assert np.sqrt(np.mean(z**2)) < 1.5


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
