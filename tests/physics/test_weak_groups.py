"""Weak light beside strong light: each group's array stands alone, whatever else shines, and says how exact it is."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render import Scene
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.guide import group_power
from tests.physics.conftest import Loader
from tests.physics.documents import camera_document, rectangle_document, scene_document, source_document

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

Array = NDArray[np.float64]

SIDES = {"east": (1, 0, 0), "west": (-1, 0, 0), "north": (0, 1, 0), "south": (0, -1, 0), "up": (0, 0, 1), "down": (0, 0, -1)}  # fmt: skip


def _power(scene: Scene) -> Array:
    """Return what each group counts when lights are chosen."""
    snapshot = scene.at(0.0)
    return group_power(snapshot, snapshot.camera("eye.c").camera)


def _arrays(scene: Scene, seed: int, power: Array | None = None) -> tuple[Array, Array]:
    """Return radiance per unit of each group and its variance, shape (groups, rows, columns)."""
    snapshot = scene.at(0.0)
    placed = snapshot.camera("eye.c")
    power = _power(scene) if power is None else power
    light = groups.indirect(snapshot, groups.rays_of(placed.camera, placed.pose), seed, power)
    assert light is not None
    return light.radiance_per_w[:, 0].astype(np.float64), light.variance[:, 0].astype(np.float64)


def _tiles(images: Array, size_px: int) -> Array:
    """Return sums over square tiles of images, shape (…, tiles)."""
    *front, rows, columns = images.shape
    parts = images.reshape(*front, rows // size_px, size_px, columns // size_px, size_px)
    return np.asarray(parts.sum(axis=(-3, -1)).reshape(*front, -1))


def _yard(samples: int, sun: str | None, posts: bool = False) -> dict[str, Any]:
    """A source of 1 W, 4 m ahead in fog of 3 m over a floor, and the sun."""
    shapes: dict[str, Any] = {"floor": rectangle_document((5, 0, -1), (40, 40), (0, 0, 1), "grey")}
    if posts:
        for index, x in enumerate((2.5, 4.5)):
            shapes[f"post{index}"] = {
                "type": "cylinder", "start": f"[{x}, 1.2, -1] m", "end": f"[{x}, 1.2, 1.5] m", "radius": "0.1 m",
                "material": "grey",
            }  # fmt: skip
    more = {} if sun is None else {"sun": {"azimuth": "60 deg", "elevation": "40 deg", "irradiance": sun}}
    return scene_document(
        {"c": camera_document(48, 32, 24.0)}, {"r": source_document((4.0, 0.5, 0.0), 0.02)}, samples=samples,
        max_depth=12, materials={"grey": {"type": "diffuse", "reflectance": 0.3}}, shapes=shapes,
        fog={"extinction": "0.12 /m", "top": "2 m", "phase": {"type": "henyey_greenstein", "g": 0.8}}, **more,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("samples", "seeds", "posts"),
    [(64, 3, False), pytest.param(128, 10, True, marks=pytest.mark.verify)],
)
def test_a_source_beside_the_sun_in_fog_is_as_bright_as_alone(
    make: Loader, samples: int, seeds: int, posts: bool
) -> None:
    """The array of a source of 1 W beside the sun's thousandfold, and beside a faint one, against its own render.

    In 24 tiles of 8 × 8 pixels. Expected: errors over the standard error that renders say of themselves have a
    mean square of 1.3² at most (the tails of samples, and of variances from 8 batches, are in it; it was 20²
    where the source's paths were drawn by what the sun needs), and the mean over seeds is within 4 standard
    errors.
    """
    own = np.stack(
        [_tiles(_arrays(make(_yard(samples, None, posts)), 100 + seed)[0][0], 8) for seed in range(4 * seeds)]
    )
    expected, expected_e2 = own.mean(axis=0), own.var(axis=0, ddof=1) / len(own)
    for sun in ("0.287 W/m^2/nm", "3e-5 W/m^2/nm"):
        scene = make(_yard(samples, sun, posts))
        assert scene.at(0.0).groups[0] == "r.s"
        drawn = [_arrays(scene, seed) for seed in range(seeds)]
        means, variances = (np.stack([_tiles(one[which][0], 8) for one in drawn]) for which in (0, 1))
        z = (means - expected) / np.sqrt(variances + expected_e2)
        assert math.sqrt(np.mean(z**2)) < 1.3
        whole = means.sum(axis=1)
        error = math.hypot(
            math.sqrt(variances.sum()) / seeds, math.sqrt(own.sum(axis=1).var(ddof=1) / len(own))
        )
        assert abs(whole.mean() - expected.sum()) < 4.0 * error
        assert error < 0.05 * expected.sum()


@pytest.mark.verify
def test_a_white_furnace_of_lamps_of_all_powers(make: Loader) -> None:
    """Lamps that fill the walls of a cube, from 1 lm to 10⁴ lm: per watt all of them together still shine evenly.

    As `test_groups_forms.test_a_white_furnace`, with fog that turns light evenly, where lamps of such powers are
    served by paths of their own. Expected: the sum of the groups is 1/(π A), within 4 standard errors of 16
    renders, which are 0.25 % at most.
    """
    flux_lm = dict(zip(SIDES, (10000.0, 300.0, 10000.0, 1.0, 300.0, 1.0), strict=True))
    lamps = {
        side: {
            "center": f"{list(normal)!r} m", "size": "[2.1, 2.1] m", "normal": [-n for n in normal],
            "luminous_flux": f"{flux_lm[side]} lm", "temperature": "2856 K",
        }
        for side, normal in SIDES.items()
    }  # fmt: skip
    document = scene_document(
        {"c": camera_document(32, 24, 16.0)}, {}, samples=128, max_depth=64, lamps=lamps,
        shapes={"ball": {"type": "sphere", "center": "[0.5, 0.3, 0.2] m", "radius": "15 cm", "material": "white"}},
        materials={"white": {"type": "diffuse", "reflectance": 1.0}},
        fog={"extinction": "1 /m", "albedo": 1.0, "phase": {"type": "henyey_greenstein", "g": 0.0}},
    )  # fmt: skip
    document["robots"]["eye"]["position"] = "[-0.6, 0, 0] m"
    scene = make(document)
    built = groups.world_on_device(scene.at(0.0), _power(scene))
    assert built.lights.tiers == 3
    wholes = np.array([_arrays(scene, seed)[0].sum(axis=0).mean() for seed in range(16)])
    error = wholes.std(ddof=1) / math.sqrt(16)
    even = 1.0 / (math.pi * 2.1**2)
    assert error < 0.0025 * even
    assert abs(wholes.mean() - even) < 4.0 * error


def _court(sun: str | None, samples: int) -> dict[str, Any]:
    """A source and a large faint lamp in clear air between two walls, one of them glossy, and the sun."""
    shapes = {
        "floor": rectangle_document((3, 0, -1), (12, 12), (0, 0, 1), "grey"),
        "wall": rectangle_document((5, 0, 0), (6, 4), (-1, 0, 0), "grey"),
        "side": rectangle_document((3, 2, 0), (6, 4), (0, -1, 0), "gloss"),
    }
    lamp = {
        "center": "[3, -1.5, 0.5] m", "size": "[1.5, 1.5] m", "normal": [0, 1, 0], "luminous_flux": "1 lm",
        "temperature": "2856 K",
    }  # fmt: skip
    materials = {
        "grey": {"type": "diffuse", "reflectance": 0.5},
        "gloss": {"type": "rough_conductor", "index": 1.5, "extinction_index": 3.0, "roughness": 0.15},
    }
    more = {} if sun is None else {"sun": {"azimuth": "200 deg", "elevation": "40 deg", "irradiance": sun}}
    return scene_document(
        {"c": camera_document(48, 32, 24.0)}, {"r": source_document((3.0, 0.5, 0.0), 0.02)}, samples=samples,
        max_depth=6, materials=materials, shapes=shapes, lamps={"panel": lamp}, **more,
    )  # fmt: skip


@pytest.mark.parametrize("seeds", [4, pytest.param(32, marks=pytest.mark.verify)])
def test_weak_light_beside_the_sun_in_clear_air_is_as_bright_and_as_quiet_as_alone(
    make: Loader, seeds: int
) -> None:
    """A source and a lamp that paths meet by themselves, beside a sun a thousandfold and more, and without it.

    Each surface asks for the sun and for one of the weak. Expected: in 24 tiles errors over the standard error
    that renders say have a mean square of 1.2² at most (it was 1.9² to 3.4² in a greenhouse where the weak
    had a share of what the sun is asked), the mean over seeds is within 4 standard errors, and noise is at most
    1.1 times that of as many samples without the sun.
    """
    both, alone = make(_court("0.287 W/m^2/nm", 64)), make(_court(None, 64))
    assert both.at(0.0).groups[:2] == alone.at(0.0).groups
    power = _power(both)
    built = groups.world_on_device(both.at(0.0), power)
    assert np.array(built.lights.tier).tolist() == [1, 1, 0]
    beside = [_arrays(both, seed) for seed in range(seeds)]
    own = [_arrays(alone, 1000 + seed, power[:2]) for seed in range(2 * seeds)]
    for group in range(2):
        means, variances = (np.stack([_tiles(one[which][group], 8) for one in beside]) for which in (0, 1))
        others, others_e2 = (np.stack([_tiles(one[which][group], 8) for one in own]) for which in (0, 1))
        expected, expected_e2 = others.mean(axis=0), others_e2.mean(axis=0) / len(own)
        lit = expected > 1e-3 * expected.max()  # not those of the open sky
        assert lit.sum() >= 16
        z = (means - expected)[:, lit] / np.sqrt(variances + expected_e2)[:, lit]
        assert math.sqrt(np.mean(z**2)) < 1.2
        error = math.sqrt(variances.sum() / seeds**2 + expected_e2.sum())
        assert abs(means.mean(axis=0).sum() - expected.sum()) < 4.0 * error
        assert error < 0.0025 * expected.sum()
        assert variances.mean(axis=0).sum() < 1.05**2 * others_e2.mean(axis=0).sum()
