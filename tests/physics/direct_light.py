"""The direct part of the light alone, and figures of it worked out without this program's optics."""

import math

import numpy as np
from numpy.typing import NDArray

from nir_render import Light, Scene, expected_electrons
from nir_render.transport.direct.table import direct_table
from nir_render.transport.world.facets import facets

FOCAL_PX, CX_PX, CY_PX = 480.0, 639.5, 479.5
APERTURE_M2 = math.pi * 0.9e-3**2 / 4.0
# Lens 0.9, quantum efficiency 0.15; the mean wavelength of the LED is its centroid.
ELECTRONS_PER_J = 0.9 * 0.15 * 940e-9 / (6.62607015e-34 * 299_792_458.0)
# The observer without a filter, and its own source all but dark: its ghosts must not stand in the way.
PLAIN = {"robots.r1.rig.cameras.front.filter": None, "robots.r1.rig.sources.top.flux": "1e-30 W"}


def direct_light(scene: Scene, camera: str = "r1.front") -> Light:
    """Return the light of a camera at 0 s without its indirect part: nothing is rendered."""
    world = scene.at(0.0)
    table = direct_table(world, world.camera(camera).pose, specular=True)
    return Light(camera, 0.0, 1, world.groups, (940e-9,), table, None, facets(world).name)


def rows_of(light: Light, group: str, mirror: str | None = None) -> list[int]:
    """Return the rows of a group that is seen straight, or in a surface."""
    table = light.direct
    names = [light.mirrors[facet] if facet >= 0 else None for facet in table.facet]
    return [
        row for row, name in enumerate(names) if light.groups[table.group[row]] == group and name == mirror
    ]


def only(light: Light, group: str, mirror: str | None = None) -> int:
    """Return the one row of a group that is seen straight, or in a surface."""
    (row,) = rows_of(light, group, mirror)
    return row


def pixel_of(offset_m: NDArray[np.float64]) -> tuple[float, float]:
    """Project what lies `offset_m` (world axes) from a camera that looks along world x, upright."""
    ahead, left, up = offset_m
    return CX_PX - FOCAL_PX * left / ahead, CY_PX - FOCAL_PX * up / ahead


def fresnel_by_hand(angle_deg: float, index: float) -> float:
    """Reflectance by sin²(θ − θ')/sin²(θ + θ') and tan²(θ − θ')/tan²(θ + θ'), which nothing else here uses."""
    one = math.radians(angle_deg)
    other = math.asin(math.sin(one) / index)
    if one == 0.0:
        return ((index - 1.0) / (index + 1.0)) ** 2
    across = (math.sin(one - other) / math.sin(one + other)) ** 2
    along = (math.tan(one - other) / math.tan(one + other)) ** 2
    return 0.5 * (across + along)


def flare(
    scene: Scene, light: Light, place_px: tuple[float, float], exposure_s: float, half_px: int = 20
) -> tuple[float, float, float]:
    """Return electrons and centroid (u, v) of what lies about a place in the noise-free frame."""
    image_e = expected_electrons(light, scene, exposure_s)
    column, row = round(place_px[0]), round(place_px[1])
    part = image_e[row - half_px : row + half_px + 1, column - half_px : column + half_px + 1]
    v, u = np.indices(part.shape)
    total = float(part.sum())
    return (
        total,
        float((u * part).sum() / total) + column - half_px,
        float((v * part).sum() / total) + row - half_px,
    )
