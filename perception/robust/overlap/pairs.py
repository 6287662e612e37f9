"""Which flares may be two spheres, one partly behind the other, and whether a robot may carry both."""

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.layout import UNUSABLE
from perception.model.window import Camera
from perception.robust.solve import Solution

Array = NDArray[np.float64]

LEAST_RADIUS_PX = 1.5
"""Smaller images tell hardly anything of which of two hides the other."""

LEAST_OF_A_LAYOUT_PX = 0.8
"""But where a robot's sources are known to stand so close that one may hide the other, what they add up to is
not what is seen of them however small they are; here they are blurred to points."""

SMALLEST_PX = 0.5
"""Of the one behind."""

OTHER_SIGMAS = 3.0


def least_radius_px(camera: Camera) -> float:
    """Return of how small images eclipses are looked for."""
    return LEAST_OF_A_LAYOUT_PX if knows_layouts(camera) else LEAST_RADIUS_PX


def knows_layouts(camera: Camera) -> bool:
    """Tell whether robots are known to carry several sources."""
    return any(len(layout.places_body_m) > 1 for layout in camera.calibration.layouts)


def longer_chi2(one: Solution) -> float:
    """Return by how much an image is longer than wide than its fit, χ² of two degrees of freedom."""
    return one.drawn_out[0]


def is_near(several: Solution, least_px: float) -> bool:
    """Tell whether of flares two are resolved, and one within two radii of the other."""
    radius_px, apart_px = several.radius_at_rest_px, _apart_px(several)
    near_px, far_px = np.maximum.outer(radius_px, radius_px), np.minimum.outer(radius_px, radius_px)
    is_so = (apart_px < 2.0 * near_px + far_px) & (near_px > least_px) & (far_px > SMALLEST_PX)
    return bool(np.triu(is_so, 1).any())


def meeting(several: Solution) -> list[tuple[int, int]]:
    """Return which two flares' images meet, as they are at rest, the larger one first."""
    radius_px, apart_px = several.radius_at_rest_px, _apart_px(several)
    return [
        (one, other) if radius_px[one] >= radius_px[other] else (other, one)
        for one, other in combinations(range(several.count), 2)
        if apart_px[one, other] < radius_px[one] + radius_px[other]
    ]


def groups_of(several: Solution) -> list[list[int]]:
    """Return which flares' images hang together."""
    groups: list[list[int]] = [[k] for k in range(several.count)]
    for one, other in meeting(several):
        first, second = (next(group for group in groups if k in group) for k in (one, other))
        if first is not second:
            groups.remove(second)
            first += second
    return groups


def alone(several: Solution, group: Sequence[int]) -> Solution:
    """Return some of several flares, with what a window shows nearer to them than to the others."""
    if len(group) == several.count:
        return several
    window, kept = several.window, np.array(group)
    rows, columns = np.indices(window.image_e.shape)
    beyond_px = [
        np.hypot(columns + window.box.left - u, rows + window.box.top - v) - radius_px
        for u, v, radius_px in zip(several.u_px, several.v_px, several.radius_at_rest_px, strict=True)
    ]
    is_own = np.isin(np.argmin(beyond_px, axis=0), kept)
    state = np.where(is_own, window.state, UNUSABLE).astype(np.uint8)
    of_each = {
        field.name: value[kept]
        for field in fields(several)
        if isinstance(value := getattr(several, field.name), np.ndarray)
        if value.shape != window.image_e.shape
    }
    return replace(several, window=replace(window, state=state), **of_each)


def pair_of(several: Solution) -> tuple[int, int]:
    """Return which two flares are nearest to each other."""
    return nearest_two(np.column_stack([several.u_px, several.v_px]))


def nearest_two(places_px: Array) -> tuple[int, int]:
    """Return which two of several places, shape (n, 2), are nearest to each other."""
    rows, columns = np.triu_indices(len(places_px), 1)
    nearest = int(np.argmin(((places_px[rows] - places_px[columns]) ** 2).sum(axis=1)))
    return int(rows[nearest]), int(columns[nearest])


def _apart_px(several: Solution) -> Array:
    """Return how far flares stand apart in the image, shape (flares, flares)."""
    u_px, v_px = several.u_px, several.v_px
    return np.asarray(np.hypot(u_px[:, None] - u_px, v_px[:, None] - v_px))


def are_apart(several: Solution, camera: Camera) -> bool:
    """Tell whether spheres may stand where they are said to: middles two radii apart, or more."""
    apart = (_apart_m(several, two, camera) for two in combinations(range(several.count), 2))
    return all(apart_m + OTHER_SIGMAS * sigma_m >= 2.0 * camera.radius_m for apart_m, sigma_m in apart)


def is_of_a_layout(pair: Solution, camera: Camera) -> bool:
    """Tell whether two spheres may be sources of one robot, as far apart as a layout has them."""
    apart_m, sigma_m = _apart_m(pair, pair_of(pair), camera)
    arms_m = (
        math.dist(one, other)
        for layout in camera.calibration.layouts
        for one, other in combinations(layout.places_body_m, 2)
    )
    return any(abs(apart_m - arm_m) <= OTHER_SIGMAS * sigma_m + camera.radius_m for arm_m in arms_m)


def _apart_m(several: Solution, two: tuple[int, int], camera: Camera) -> tuple[float, float]:
    """Return how far apart two of several spheres stand, and its standard deviation by their ranges."""
    both = list(two)
    place = direction_camera(np.column_stack([several.u_px, several.v_px])[both], camera.calibration)
    place *= np.exp(several.log_range[both])[:, None]
    between = place[0] - place[1]
    apart_m = float(np.linalg.norm(between))
    along = place @ between / max(apart_m, 1e-12)
    return apart_m, float(np.hypot(*(along * several.log_range_sigma[both])))
