"""Fog whose density varies over height: by closed forms, by quadrature, and by Mitsuba's own grid of densities.

Set up: a profile of straight parts, thin above and below, in which light that takes the density of another
height, or that of the middle of its way, is off by tens of per cent.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import render
from nir_render.transport.backend.variant import mi
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
from tests.physics.fog_forms import henyey_greenstein
from tests.physics.stock import _Builder
from tests.statistics import compare_batches

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

Array = NDArray[np.float64]

HEIGHTS_M = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
DENSITY = np.array([0.0, 1.0, 0.3, 0.6, 0.0])
PROFILE = [[f"{height_m} m", float(density)] for height_m, density in zip(HEIGHTS_M, DENSITY, strict=True)]
G, ALBEDO = 0.6, 0.95
RADIUS_M = 0.02


def fog(extinction_per_m: float) -> dict[str, Any]:
    phase = {"type": "henyey_greenstein", "g": G}
    return {"extinction": f"{extinction_per_m} /m", "albedo": ALBEDO, "phase": phase, "profile": PROFILE}


def left(extinction_per_m: float, start_m: Array, end_m: Array) -> Array:
    """Return what fog leaves on straight ways, shape (..., 3) each, by sums over steps of height of 0.02 mm."""
    fine_m = np.linspace(-1.0, 1.0, 100_001)
    density = np.interp(fine_m, HEIGHTS_M, DENSITY)
    column_m = np.cumsum(density) * (fine_m[1] - fine_m[0])
    way_m = np.broadcast_to(end_m - start_m, np.broadcast_shapes(start_m.shape, end_m.shape))
    rise_m = np.where(np.abs(way_m[..., 2]) < 1e-3, 1e-3, way_m[..., 2])
    ends = (np.interp(height_m, fine_m, column_m) for height_m in (start_m[..., 2], start_m[..., 2] + rise_m))
    low, high = ends
    return np.asarray(np.exp(-extinction_per_m * (high - low) / rise_m * np.linalg.norm(way_m, axis=-1)))


@pytest.mark.parametrize("height_m", [-0.6, 0.0, 0.02, 0.9])
def test_straight_light_passes_the_fog_on_its_way(make: Loader, height_m: float) -> None:
    """One source 3 m ahead and higher, in fog of 0.8/m and in clear air: the ratio is what fog leaves, to 0.1 %.

    The source's disc shines evenly; rays to 4 000 places of it end on its surface.
    """
    place = (3.0, 0.4, height_m)
    document = scene_document(
        {"c": camera_document(64, 48)}, {"r": source_document(place, RADIUS_M)}, samples=4, max_depth=2
    )
    totals = [
        render(make({**document, **more}), "eye.c", seed=1).direct.irradiance_per_w.sum()
        for more in ({"fog": fog(0.8)}, {})
    ]
    source_m = np.array(place)
    axis = source_m / np.linalg.norm(source_m)
    aside = np.cross(axis, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(axis, [0.0, 0.0, 1.0]))
    number = np.arange(4000) + 0.5
    beside_m, turn = RADIUS_M * np.sqrt(number / 4000), number * 2.399963
    offset_m = beside_m * np.stack([np.cos(turn), np.sin(turn)])
    disc_m = source_m + offset_m.T @ np.stack([aside, np.cross(axis, aside)])
    surface_m = disc_m - np.sqrt(RADIUS_M**2 - beside_m**2)[:, None] * axis
    expected = left(0.8, np.zeros(3), surface_m).mean()
    assert totals[0] / totals[1] == pytest.approx(expected, rel=1e-3)


def test_light_that_is_scattered_once(make: Loader) -> None:
    """Single scattering of a source against the integral along each pixel's ray, in tiles, to 1 % and on average 0.2 %.

    Pixels nearer to the source than 0.3 m are left out: its size does not matter beside them.
    """
    place_m, extinction_per_m = np.array([2.5, 0.3, 0.15]), 0.6
    document = scene_document(
        {"c": camera_document(64, 48)}, {"r": source_document(tuple(place_m.tolist()), RADIUS_M)}, samples=256,
        max_depth=2, fog=fog(extinction_per_m),
    )  # fmt: skip
    scene = make(document)
    found = np.mean([group_radiance(scene, seed)[0] for seed in range(8)], axis=0)
    rays = pixel_rays(64, 48).reshape(-1, 3)
    along_m = np.geomspace(1e-3, 40.0, 2000)
    middle_m, step_m = np.sqrt(along_m[1:] * along_m[:-1]), np.diff(along_m)
    point_m = rays[:, None] * middle_m[:, None]
    to_m = place_m - point_m
    distance_m = np.linalg.norm(to_m, axis=-1)
    # Light leaves the source along −to, and goes on to the camera along −ray.
    cosine = (to_m * rays[:, None]).sum(axis=-1) / distance_m
    density = np.interp(point_m[..., 2], HEIGHTS_M, DENSITY, left=0.0, right=0.0)
    depth = np.cumsum(extinction_per_m * density * step_m, axis=1) - 0.5 * extinction_per_m * density * step_m
    surface_m = place_m - RADIUS_M * to_m / distance_m[..., None]
    to_source = left(extinction_per_m, point_m, surface_m)
    integrand = (
        ALBEDO * extinction_per_m * density * henyey_greenstein(G)(cosine) / (4.0 * np.pi * distance_m**2)
    )
    expected = (integrand * np.exp(-depth) * to_source * step_m).sum(axis=1)
    clear = np.linalg.norm(np.cross(rays, place_m), axis=-1).reshape(48, 64) > 0.3
    ours, theirs = (tile_means(np.where(clear, image, 0.0), 8) for image in (found, expected.reshape(48, 64)))
    mostly = (tile_means(clear.astype(float), 8) > 0.6) & (theirs > 0.02 * theirs.max())
    assert mostly.sum() > 30
    np.testing.assert_allclose(ours[mostly], theirs[mostly], rtol=0.01)
    assert ours[mostly].sum() / theirs[mostly].sum() == pytest.approx(1.0, abs=0.002)


class _ByHeight(_Builder):
    """Mitsuba's scene with the same profile as a grid: its densities stand in the middles of its cells."""

    def _medium(self, fog: Any) -> Any:
        step_m = float(HEIGHTS_M[1] - HEIGHTS_M[0])
        density = np.zeros((len(DENSITY), 2, 2), dtype=np.float32)
        density[:] = DENSITY[:, None, None]
        low_m = [-30.0, -30.0, float(HEIGHTS_M[0]) - 0.5 * step_m]
        size_m = [60.0, 60.0, step_m * len(DENSITY)]
        transform = self.mi.ScalarTransform4f().translate(low_m).scale(size_m)
        grid = {"type": "gridvolume", "grid": self.mi.VolumeGrid(density), "to_world": transform}
        return self.mi.load_dict({
            "type": "heterogeneous", "sigma_t": grid, "scale": float(fog["extinction"].split()[0]),
            "albedo": float(fog["albedo"]), "phase": {"type": "hg", "g": float(fog["phase"]["g"])},
        })  # fmt: skip


@pytest.mark.verify
def test_all_orders_are_those_of_mitsubas_grid_of_densities(make: Loader) -> None:
    """A wall, a floor, a ball and a lamp in fog of 1.2/m: up to four turns, by `volpath` through its own grid.

    Expected: tiles of 8 × 8 pixels and the frame agree within noise (Welch's t, Holm's correction, 10⁻³), and a
    drift of 1 % of the frame would be seen.
    """
    lamp = {
        "center": "[2, 0, 1.6] m",
        "size": "[0.8, 0.8] m",
        "luminous_flux": "1000 lm",
        "temperature": "2856 K",
    }
    shapes = {
        "floor": rectangle_document((2.5, 0, -1.2), (6, 6), (0, 0, 1), "white"),
        "wall": rectangle_document((4, 0, 0), (6, 4), (-1, 0, 0), "white"),
        "ball": {"type": "sphere", "center": "[2.4, -0.5, -0.3] m", "radius": "0.3 m", "material": "white"},
    }
    document = scene_document(
        {"c": camera_document(64, 48, 40.0)}, {}, samples=64, max_depth=6, fog=fog(1.2), shapes=shapes,
        lamps={"one": lamp}, materials={"white": {"type": "diffuse", "reflectance": 0.7}},
    )  # fmt: skip
    scene = make(document)
    ours = np.stack([group_radiance(scene, seed)[0] for seed in range(12)])
    builder = _ByHeight(mi, document)
    bodies, sensor = builder.scene(["lamps.one"]), builder.sensor()
    integrator = mi.load_dict({"type": "volpath", "max_depth": 6, "rr_depth": 64})
    theirs = np.stack([
        np.array(mi.render(bodies, sensor=sensor, integrator=integrator, spp=512, seed=seed), dtype=np.float64)[..., 0]
        for seed in range(12)
    ])  # fmt: skip
    result = compare_batches(ours, theirs, tile_px=8)
    assert result.same, result
    assert result.frame_drift < 0.01, result
