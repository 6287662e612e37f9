"""The light-group integrator against closed forms and quadrature: walls, fog, white furnaces, the dark."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import Scene, render
from nir_render.transport.backend.variant import backend
from tests.physics.documents import (
    FOCAL_PX,
    camera_document,
    group_radiance,
    pixel_rays,
    rectangle_document,
    scene_document,
    source_document,
    tile_means,
)
from tests.physics.fog_forms import PhaseFunction, henyey_greenstein, single_scatter_per_w, tabulated
from tests.physics.stock import stock_radiance

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

Array = NDArray[np.float64]


WALL_M, REFLECTANCE = 3.0, 0.6
WALL = {"wall": rectangle_document((WALL_M, 0, 0), (40, 40), (-1, 0, 0), "paint")}
PAINT = {"paint": {"type": "diffuse", "reflectance": REFLECTANCE}}


def _lit_wall(source_m: Array, rays: Array) -> tuple[Array, Array]:
    """Return L = (ρ/π) cos θ / (4π d²) per watt where rays from the origin meet the wall, and these points."""
    points_m = rays * (WALL_M / rays[..., :1])
    offset_m = source_m - points_m
    distance_m = np.linalg.norm(offset_m, axis=-1)
    irradiance = -offset_m[..., 0] / distance_m**3 / (4.0 * math.pi)
    return REFLECTANCE / math.pi * irradiance, points_m


def test_a_source_lights_a_wall_by_the_inverse_square_law(make: Any) -> None:
    """A sphere wholly in view of a wall gives cos θ / (4π d²) per watt, however large it looks.

    A source of 10 mm, 0.2 to 10 m before the wall and 0.3 m aside. Expected: the frame's mean to 0.1 %, every
    pixel to 0.5 %, and the slope of log L against log d, cos θ taken out, −2.000 ± 0.001.
    """
    rays = pixel_rays(32, 24)
    logs = []
    for away_m in np.geomspace(0.2, 10.0, 6):
        source_m = np.array([WALL_M - away_m, 0.3, 0.0])
        scene = make(
            scene_document(
                {"c": camera_document(32, 24)}, {"r": source_document(tuple(source_m.tolist()), 0.01)},
                samples=512, max_depth=2, materials=PAINT, shapes=WALL,
            )
        )  # fmt: skip
        radiance = group_radiance(scene)[0]
        expected, points_m = _lit_wall(source_m, rays)
        # Where the source stands in the way its body is seen, black.
        beside = np.linalg.norm(np.cross(rays, source_m), axis=-1) > 0.02 + 1.5 / FOCAL_PX * np.linalg.norm(
            source_m
        )
        beside |= rays @ source_m < 0.0
        assert radiance[beside].mean() == pytest.approx(expected[beside].mean(), rel=0.001), away_m
        curvature = 0.005 + 0.5 * (WALL_M / FOCAL_PX / away_m) ** 2  # of the irradiance within a pixel
        np.testing.assert_allclose(radiance[beside], expected[beside], rtol=curvature)
        distance_m = np.linalg.norm(source_m - points_m, axis=-1)[beside]
        logs.append((np.log(distance_m), np.log(radiance[beside] / (away_m / distance_m))))
    distances, radiances = (np.concatenate(column) for column in zip(*logs, strict=True))
    slope, _ = np.polyfit(distances, radiances, 1)
    assert slope == pytest.approx(-2.0, abs=0.001)


def test_flux_falls_as_the_square_of_the_range_in_stock_path() -> None:
    """The same law by Mitsuba's own `path`: seven sources of 3 cm side by side, 1 to 10 m away.

    E = ∫ L cos ψ dΩ over each image, ψ from the source's centre, is 1/(4π d²) per watt: the slope of log E
    against log d is −2.000 ± 0.005, and E itself holds to 0.5 %.
    """
    columns, rows, focal_px = 160, 48, 533.0
    ranges_m = np.geomspace(1.0, 10.0, 7)
    widths_px = 2.0 * focal_px * 0.03 / ranges_m
    gap_px = (columns - widths_px.sum()) / 8.0
    left_px = np.cumsum(np.concatenate([[0.5 * gap_px], widths_px + gap_px]))  # borders between images
    centres_px = left_px[:-1] + 0.5 * (gap_px + widths_px)
    sources = {}
    directions = []
    for number, (range_m, centre_px) in enumerate(zip(ranges_m, centres_px, strict=True)):
        direction = np.array([1.0, -(centre_px - 0.5 * columns) / focal_px, 0.0])
        directions.append(direction / np.linalg.norm(direction))
        sources[f"r{number}"] = source_document(tuple((range_m * directions[-1]).tolist()), 0.03)
    document = scene_document(
        {"c": camera_document(columns, rows, focal_px)}, sources, samples=16, max_depth=2
    )
    image = stock_radiance(
        document, [[f"{name}.s" for name in sources]], samples=1024, batches=16, variant=backend().variant, max_depth=1
    )[0].mean(axis=0)  # fmt: skip
    rays = pixel_rays(columns, rows, focal_px)
    solid_angle_sr = rays[..., 0] ** 3 / focal_px**2
    borders = np.round(left_px).astype(int)
    irradiance = np.array([
        (image * solid_angle_sr * (rays @ direction))[:, first:last].sum()
        for direction, first, last in zip(directions, borders[:-1], borders[1:], strict=True)
    ])  # fmt: skip
    np.testing.assert_allclose(irradiance, 1.0 / (4.0 * math.pi * ranges_m**2), rtol=0.005)
    slope, _ = np.polyfit(np.log(ranges_m), np.log(irradiance), 1)
    assert slope == pytest.approx(-2.0, abs=0.005)


SIDES: dict[str, tuple[float, ...]] = {
    "ahead": (1, 0, 0), "behind": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0), "above": (0, 0, 1), "below": (0, 0, -1),
}  # fmt: skip


@pytest.mark.parametrize("reflectance", [0.5, pytest.param(0.8, marks=pytest.mark.verify)])
def test_a_closed_room_keeps_its_energy(make: Any, reflectance: float) -> None:
    """What the walls of a closed room absorb is what the source sends: Φ = (1 − ρ) ∫ E dA.

    A cube of 2 m with matt walls, one small source off its middle, and six cameras of exactly 90° × 90° in the
    middle, each of which sees one wall, every pixel the same area of it. So the mean of all pixels is
    ρ Φ / (π A (1 − ρ)), whatever the light's distribution. Expected to 0.2 %.
    """
    turns: dict[str, dict[str, Any]] = {
        "ahead": {}, "behind": {"yaw": "180 deg"}, "left": {"yaw": "90 deg"}, "right": {"yaw": "-90 deg"},
        "above": {"pitch": "-90 deg"}, "below": {"pitch": "90 deg"},
    }  # fmt: skip
    walls = {
        side: rectangle_document(normal, (2.0, 2.0), tuple(-n for n in normal), "paint")
        for side, normal in SIDES.items()
    }
    scene = make(
        scene_document(
            {side: camera_document(32, 32, 16.0, orientation=turn) for side, turn in turns.items()},
            {"r": source_document((0.35, 0.25, -0.15), 0.005)},
            samples=512, max_depth=64,
            materials={"paint": {"type": "diffuse", "reflectance": reflectance}}, shapes=walls,
        )
    )  # fmt: skip
    radiance = [group_radiance(scene, camera=f"eye.{side}")[0].mean() for side in turns]
    expected = reflectance / (math.pi * 24.0 * (1.0 - reflectance))
    assert np.mean(radiance) == pytest.approx(expected, rel=0.002)


# Of 16 renders with so many samples per pixel the frame's mean has a standard error of 0.075 % in fog that scatters
# forward, 0.05 % or less in the others.
FURNACES: dict[str, tuple[int, dict[str, Any]]] = {
    "clear": (128, {}),
    "fog": (
        128, {"fog": {"extinction": "0.2 /m", "albedo": 1.0, "phase": {"type": "henyey_greenstein", "g": 0.85}}},
    ),
    "even fog": (
        32, {"fog": {"extinction": "1 /m", "albedo": 1.0, "phase": {"type": "henyey_greenstein", "g": 0.0}}},
    ),
    "fog by height": (
        32,
        {
            "fog": {
                "extinction": "2 /m", "albedo": 1.0, "phase": {"type": "henyey_greenstein", "g": 0.5},
                "profile": [["-0.8 m", 0.0], ["-0.2 m", 1.0], ["0.3 m", 0.1], ["0.6 m", 0.8]],
            }
        },
    ),
    "bank of fog": (
        32,
        {
            "fog": {
                "extinction": "2 /m", "albedo": 1.0, "phase": {"type": "henyey_greenstein", "g": 0.5},
                "center": "[0.5, 0.1, 0] m", "size": "[0.7, 0.9, 1.1] m",
            }
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "clear" else pytest.mark.verify) for name in FURNACES],
)
def test_a_white_furnace(make: Any, name: str) -> None:
    """In a room whose walls all shine alike nothing can be seen but even light, if nothing absorbs.

    A cube of 2 m lined with six lamps of one watt each, of radiance 1/(π A); in it a white ball, a white crate,
    a perfect mirror, fog that only scatters. Expected: the sum of the groups is that radiance, the frame to
    0.2 % and within 5 standard errors of 16 renders, tiles within 8.
    """
    lamps = {
        side: {
            "center": f"{list(normal)!r} m", "size": "[2.1, 2.1] m", "normal": [-n for n in normal],
            "luminous_flux": "1000 lm", "temperature": "2856 K",
        }
        for side, normal in SIDES.items()
    }  # fmt: skip
    shapes = {
        "ball": {"type": "sphere", "center": "[0.5, 0.3, 0.2] m", "radius": "15 cm", "material": "white"},
        "crate": {
            "type": "box", "center": "[0.4, -0.3, -0.2] m", "size": "[0.3, 0.3, 0.3] m", "orientation": {"yaw": "30 deg"},
            "material": "white",
        },
        "mirror": rectangle_document((0.7, 0.05, 0.3), (0.3, 0.5), (-1, 0.2, -0.3), "silver"),
    }  # fmt: skip
    samples, fog = FURNACES[name]
    document = scene_document(
        {"c": camera_document(64, 48, 32.0)}, {}, samples=samples, max_depth=64, lamps=lamps, shapes=shapes,
        materials={"white": {"type": "diffuse", "reflectance": 1.0}, "silver": {"type": "mirror", "reflectance": 1.0}},
        **fog,
    )  # fmt: skip
    document["robots"]["eye"]["position"] = "[-0.6, 0, 0] m"
    scene = make(document)
    even = 1.0 / (math.pi * 2.1**2)
    sums = np.stack([group_radiance(scene, seed).sum(axis=0) for seed in range(16)])
    assert sums.mean() == pytest.approx(even, rel=0.002)
    tiles = np.stack([tile_means(image, 8) for image in sums])
    # Student's t of 15 degrees of freedom: 5 standard errors are passed once in 6000, 8 in 48 tiles once in 20 000.
    for estimates, width in ((tiles.mean(axis=(1, 2)), 5.0), (tiles, 8.0)):
        error = estimates.std(axis=0, ddof=1) / math.sqrt(len(estimates))
        assert (np.abs(estimates.mean(axis=0) - even) < width * error + 1e-5 * even).all()


TABLE = [(0.0, 400.0), (0.5, 250.0), (2.0, 60.0), (5.0, 14.0), (12.0, 4.0), (30.0, 0.9), (75.0, 0.12), (120.0, 0.05), (142.0, 0.2), (180.0, 0.08)]  # fmt: skip
PHASES: dict[str, tuple[dict[str, Any], PhaseFunction]] = {
    "even": ({"type": "henyey_greenstein", "g": 0.0}, henyey_greenstein(0.0)),
    "forward": ({"type": "henyey_greenstein", "g": 0.85}, henyey_greenstein(0.85)),
    "backward": ({"type": "henyey_greenstein", "g": -0.5}, henyey_greenstein(-0.5)),
    "table": (
        {"type": "table", "points": [[f"{angle} deg", value] for angle, value in TABLE]},
        tabulated(*np.array(TABLE).T * np.array([[math.pi / 180.0], [1.0]])),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PHASES)
def test_single_scattering_is_the_integral_along_the_ray(make: Any, name: str) -> None:
    """A source alone in fog, all scattering but the first cut off by the depth: L = ∫ σ_s p E exp(−σ s) ds.

    Seen from 2.6 m, 20 mm large, so that the cone it fills matters little but is integrated all the same. Expected:
    16 × 16 tiles that do not touch the source to 1 %, the frame to 0.3 %.
    """
    phase_document, phase = PHASES[name]
    source_m, radius_m = np.array([2.5, 0.5, 0.3]), 0.02
    scene = make(
        scene_document(
            {"c": camera_document(160, 112)}, {"r": source_document(tuple(source_m.tolist()), radius_m)}, samples=256, max_depth=2,
            fog={"extinction": "0.3 /m", "albedo": 0.9, "phase": phase_document},
        )
    )  # fmt: skip
    radiance = group_radiance(scene)[0]
    rays = pixel_rays(160, 112)
    # 2 px beyond the source's rim the radiance, which goes with 1/h there, is even enough within a pixel.
    clear = np.linalg.norm(np.cross(rays, source_m), axis=-1) > radius_m + 3.0 / FOCAL_PX * 2.6
    expected = np.zeros(radiance.shape)
    # 128 nodes are right to 1e-11, across the corners of a table to 1e-4.
    expected[clear] = single_scatter_per_w(rays[clear], source_m, radius_m, 0.3, 0.9, phase, steps=128)
    radiance = np.where(clear, radiance, 0.0)
    assert radiance.mean() == pytest.approx(expected.mean(), rel=0.003)
    np.testing.assert_allclose(tile_means(radiance), tile_means(expected), rtol=0.01)


@pytest.mark.parametrize("asymmetry", [0.0, 0.85])
def test_the_halo_reaches_up_to_the_source(make: Any, asymmetry: float) -> None:
    """The fog right before a source and around its rim, where it outshines all other fog.

    A source of 8 cm, 1 m straight ahead; its own light is not in the arrays, what fog before it scatters is.
    Expected: each ring about it, two inside its rim, to 1 %.
    """
    radius_m, parts = 0.08, 4
    phase_document = {"type": "henyey_greenstein", "g": asymmetry}
    scene = make(
        scene_document(
            {"c": camera_document(48, 48)}, {"r": source_document((1.0, 0.0, 0.0), radius_m)}, samples=4096, max_depth=2,
            fog={"extinction": "0.4 /m", "albedo": 0.9, "phase": phase_document},
        )
    )  # fmt: skip
    radiance = group_radiance(scene)[0]
    tangent = np.linspace(1e-3, 0.45, 300)
    rays = np.stack([np.ones_like(tangent), tangent, np.zeros_like(tangent)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    profile = single_scatter_per_w(
        rays, np.array([1.0, 0.0, 0.0]), radius_m, 0.4, 0.9, henyey_greenstein(asymmetry), steps=256, rings=24
    )
    fine = pixel_rays(48, 48, parts=parts)
    off = np.linalg.norm(fine[..., 1:], axis=-1) / fine[..., 0]
    expected = tile_means(np.interp(off, tangent, profile), parts)
    centre = tile_means(off, parts)
    for low, high in ((0.0, 0.035), (0.035, 0.065), (0.095, 0.12), (0.12, 0.16), (0.16, 0.3)):
        ring = (centre >= low) & (centre < high)
        assert radiance[ring].mean() == pytest.approx(expected[ring].mean(), rel=0.01), (low, high)


REGIONS: dict[str, tuple[dict[str, Any], list[float], list[float]]] = {
    "everywhere": ({}, [-math.inf] * 3, [math.inf] * 3),
    "below a top": ({"top": "0.2 m"}, [-math.inf] * 3, [math.inf, math.inf, 0.2]),
    "around the camera": ({"center": "[0, 0, 0] m", "size": "[2, 2, 2] m"}, [-1.0] * 3, [1.0] * 3),
    "around the source": (
        {"center": "[2, 0.5, 1] m", "size": "[1, 0.8, 1.2] m"},
        [1.5, 0.1, 0.4],
        [2.5, 0.9, 1.6],
    ),
}


def _length_inside_m(start_m: Array, end_m: Array, low_m: Array, high_m: Array) -> Array:
    """Return how much of the way between points, shape (..., 3), lies in a box."""
    way_m = end_m - start_m
    with np.errstate(divide="ignore", invalid="ignore"):
        at_low, at_high = (low_m - start_m) / way_m, (high_m - start_m) / way_m
    enter = np.clip(np.nanmax(np.minimum(at_low, at_high), axis=-1), 0.0, 1.0)
    leave = np.clip(np.nanmin(np.maximum(at_low, at_high), axis=-1), 0.0, 1.0)
    return np.asarray(np.maximum(leave - enter, 0.0) * np.linalg.norm(way_m, axis=-1))


@pytest.mark.parametrize("name", REGIONS)
def test_fog_takes_what_beer_and_lambert_say(make: Any, name: str) -> None:
    """Fog that scatters nothing weakens the lit wall by exp(−σ × the way in fog), source to wall to lens.

    The camera stands in it, before it, or the source does: what Mitsuba leaves out silently where a sensor does
    not name its medium. The light's way begins on the sphere, on average 2r/3 before its centre. Expected: the
    mean to 0.1 %, pixels to 0.5 %, those that the edge of the fog's shadow crosses to 3 %.
    """
    region, low_m, high_m = REGIONS[name]
    source_m, radius_m, extinction_per_m = np.array([2.0, 0.5, 1.0]), 0.01, 0.7
    scene = make(
        scene_document(
            {"c": camera_document(64, 48)}, {"r": source_document(tuple(source_m.tolist()), radius_m)}, samples=256, max_depth=2,
            materials=PAINT, shapes=WALL,
            fog={"extinction": f"{extinction_per_m} /m", "albedo": 0.0, **region},
        )
    )  # fmt: skip
    parts = 8
    clear, points_m = _lit_wall(source_m, pixel_rays(64, 48, parts=parts))
    inside_m = np.zeros(clear.shape)
    for start_m in (np.zeros(3), source_m):
        starts_m = np.broadcast_to(start_m, points_m.shape)
        inside_m += _length_inside_m(starts_m, points_m, np.array(low_m), np.array(high_m))
    if (source_m > low_m).all() and (source_m < high_m).all():
        inside_m -= 2.0 / 3.0 * radius_m
    weakened = np.exp(-extinction_per_m * inside_m)
    expected = tile_means(clear * weakened, parts)
    even = tile_means(weakened**2, parts) / tile_means(weakened, parts) ** 2 < 1.0 + 1e-5
    radiance = group_radiance(scene)[0]
    assert radiance.mean() == pytest.approx(expected.mean(), rel=0.001)
    np.testing.assert_allclose(radiance[even], expected[even], rtol=0.005)
    np.testing.assert_allclose(radiance, expected, rtol=0.03)


def test_a_source_half_sunk_in_a_wall_shines_with_its_free_half(make: Any) -> None:
    """A ball of 5 cm whose centre lies in a black wall lights a side wall with the half that stands out.

    The sphere's free surface is summed up piece by piece: E = ∫ L cos α cos β / d² dA, for one watt of the whole
    sphere. Expected to 1 % per column, 0.3 % on average: light must not pass through the wall.
    """
    radius_m = 0.05
    shapes = {
        "black": rectangle_document((2, 0, 0), (10, 10), (-1, 0, 0), "black"),
        "side": rectangle_document((0, 1, 0), (10, 10), (0, -1, 0), "paint"),
    }
    materials = {**PAINT, "black": {"type": "diffuse", "reflectance": 0.0}}
    scene = make(
        scene_document(
            {"c": camera_document(64, 24, 32.0)}, {"r": source_document((2.0, 0.0, 0.0), radius_m)}, samples=4096, max_depth=2,
            materials=materials, shapes=shapes,
        )
    )  # fmt: skip
    rays = pixel_rays(64, 24, 32.0)[:, :15]  # these meet the side wall, 0.15 m and more before the black one
    points_m = (rays / rays[..., 1:2]).reshape(-1, 3)
    height, turn = np.meshgrid((np.arange(64) + 0.5) / 64, 2.0 * math.pi * (np.arange(128) + 0.5) / 128)
    flat = np.sqrt(1.0 - height**2)
    normals = np.stack([-height, flat * np.cos(turn), flat * np.sin(turn)], axis=-1).reshape(-1, 3)
    piece_m2 = 2.0 * math.pi * radius_m**2 / len(normals)
    way_m = points_m[:, None] - (np.array([2.0, 0.0, 0.0]) + radius_m * normals)
    distance_m = np.linalg.norm(way_m, axis=-1)
    leaving = np.maximum((way_m * normals).sum(axis=-1), 0.0) / distance_m
    falling = way_m[..., 1] / distance_m
    irradiance = (leaving * falling / distance_m**2).sum(axis=1) * piece_m2 / (4.0 * math.pi**2 * radius_m**2)
    expected = (REFLECTANCE / math.pi * irradiance).reshape(rays.shape[:2])
    radiance = group_radiance(scene)[0][:, : rays.shape[1]]
    assert radiance.mean() == pytest.approx(expected.mean(), rel=0.003)
    np.testing.assert_allclose(radiance.mean(axis=0), expected.mean(axis=0), rtol=0.01)


def _dark(scene: Scene) -> bool:
    return bool((group_radiance(scene) == 0.0).all())


def test_a_black_wall_gives_nothing_back(make: Any) -> None:
    """One black wall that fills the view, and a white one behind the camera which it must not show."""
    shapes = {**WALL, "behind": rectangle_document((-1, 0, 0), (4, 4), (1, 0, 0), "white")}
    materials = {
        "paint": {"type": "diffuse", "reflectance": 0.0},
        "white": {"type": "diffuse", "reflectance": 0.9},
    }
    document = scene_document(
        {"c": camera_document(16, 12)}, {"r": source_document((1.0, 0.2, 0.9), 0.01)}, samples=64, max_depth=8, materials=materials,
        shapes=shapes,
    )  # fmt: skip
    assert _dark(make(document))


def test_a_source_in_a_closed_box_lights_nothing_outside(make: Any) -> None:
    """And opening one side lets light out, so that the darkness is the box's doing."""
    sides = {
        side: rectangle_document(
            tuple(2.0 * (axis == 0) + 0.25 * n for axis, n in enumerate(normal)), (0.5, 0.5), tuple(-n for n in normal), "paint"
        )
        for side, normal in SIDES.items()
    }  # fmt: skip
    document = scene_document(
        {"c": camera_document(32, 24)}, {"r": source_document((2.0, 0.0, 0.0), 0.01)}, samples=256, max_depth=8, materials=PAINT,
        shapes={**WALL, **sides},
    )  # fmt: skip
    assert _dark(make(document))
    del document["shapes"]["left"]
    assert group_radiance(make(document))[0].mean() > 1e-4


def test_a_source_within_a_solid_box_lights_nothing_outside(make: Any) -> None:
    crate = {"type": "box", "center": "[2, 0, 0] m", "size": "[0.5, 0.5, 0.5] m", "material": "paint"}
    document = scene_document(
        {"c": camera_document(32, 24)}, {"r": source_document((2.0, 0.0, 0.0), 0.01)}, samples=256, max_depth=8, materials=PAINT,
        shapes={**WALL, "crate": crate},
    )  # fmt: skip
    assert _dark(make(document))


@pytest.mark.parametrize("fog", [{}, {"fog": {"extinction": "0.2 /m", "albedo": 1.0}}])
def test_nothing_shines_in_an_empty_world_but_fog(make: Any, fog: dict[str, Any]) -> None:
    """A source with nothing around it has no indirect light; in fog it has, at most what it sends."""
    document = scene_document(
        {"c": camera_document(32, 24)},
        {"r": source_document((2.0, 0.1, 0.0), 0.01)},
        samples=256,
        max_depth=64,
        **fog,
    )
    light = render(make(document), "eye.c", seed=1)
    if not fog:
        assert light.indirect is None
        return
    assert light.indirect is not None
    radiance = light.indirect.radiance_per_w[0, 0].astype(float)
    assert np.isfinite(radiance).all()
    assert radiance.min() >= 0.0
    solid_angle_sr = pixel_rays(32, 24)[..., 0] ** 3 / FOCAL_PX**2
    assert 0.0 < (radiance * solid_angle_sr).sum() < 1.0 / (4.0 * math.pi * 4.01)
