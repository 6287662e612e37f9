"""Which flares may be two spheres, one partly behind the other, and whether a robot may carry both."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
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
    """Tell whether flares are two, resolved, and one within two radii of the other.

    Of more, the two that are nearest to each other are meant, and the rest stand apart from them.
    """
    if several.count < 2:
        return False
    one, other = pair_of(several)
    radius_px, apart_px = several.image_radius_px, _apart_px(several)
    near_px, far_px = max(radius_px[one], radius_px[other]), min(radius_px[one], radius_px[other])
    for third in set(range(several.count)) - {one, other}:
        if min(apart_px[third, one], apart_px[third, other]) < near_px + radius_px[third]:
            return False
    within = apart_px[one, other] < 2.0 * near_px + far_px
    return bool(within and near_px > least_px and far_px > SMALLEST_PX)


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


def are_apart(pair: Solution, camera: Camera) -> bool:
    """Tell whether two spheres may stand where they are said to: middles two radii apart, or more."""
    apart_m, sigma_m = _apart_m(pair, camera)
    return apart_m + OTHER_SIGMAS * sigma_m >= 2.0 * camera.radius_m


def is_of_a_layout(pair: Solution, camera: Camera) -> bool:
    """Tell whether two spheres may be sources of one robot, as far apart as a layout has them."""
    apart_m, sigma_m = _apart_m(pair, camera)
    arms_m = (
        math.dist(one, other)
        for layout in camera.calibration.layouts
        for one, other in combinations(layout.places_body_m, 2)
    )
    return any(abs(apart_m - arm_m) <= OTHER_SIGMAS * sigma_m + camera.radius_m for arm_m in arms_m)


def _apart_m(pair: Solution, camera: Camera) -> tuple[float, float]:
    """Return how far apart two spheres stand, and its standard deviation by their ranges."""
    two = list(pair_of(pair))
    place = direction_camera(np.column_stack([pair.u_px, pair.v_px])[two], camera.calibration)
    place *= np.exp(pair.log_range[two])[:, None]
    between = place[0] - place[1]
    apart_m = float(np.linalg.norm(between))
    return apart_m, float(np.hypot(*(place @ between / max(apart_m, 1e-12) * pair.log_range_sigma[two])))
