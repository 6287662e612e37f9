"""Discs that overlap, told by the outline of what is lit: first guesses of spheres that hide parts of others.

Sources are as bright at any range, so that of several, one before the other, the union of their discs is
seen. Its outline is made of arcs: circles are laid through pieces of it, and the one on which most of it lies
is taken out, then the next, till hardly any outline is left (by consensus: Fischler and Bolles, Comm. ACM 24,
381, 1981; whatever the lens, the directions n to a sphere's limb lie on a cone, m · n = 1).
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.lens import project
from perception.model.ranging import brightness_e
from perception.model.window import Camera
from perception.robust.clusters import LEAST_RANGE_M, Cluster
from perception.robust.problem import Start
from perception.types import Calibration

Array = NDArray[np.float64]

MOST_DISCS = 8

_LEAST_SIGMAS = 5.0  # by which half of a source's brightness must exceed the noise
_ARCS_PX = (5, 8, 13, 21, 34, 55)  # of an outline, through whose ends and middle circles are laid
_BEGINNINGS = 64
_LEAST_VOLUME = 1e-13
_ON_PX, _ON_SHARE = 0.3, 0.015  # so far from a circle, beside a share of its radius, an outline lies on it
_FEWEST, _LEAST_ARC = 5, 0.12  # points of an outline that are left, and share of a circle, for another disc
_LEAST_RADIUS_PX = 1.2
_PROBES, _WITHIN, _LEAST_LIT = 24, 0.9, 0.9  # of a disc, at that part of its radius, so much must be lit
_ROUNDS = 2
_TRIED = 32  # circles, the likeliest, for each disc
_BRIGHTEST = 1.5  # times as bright as sources is what they are not


def discs_by_outline(cluster: Cluster, camera: Camera) -> list[Start]:
    """Return discs, the most conspicuous first, of whose arcs the outline of what is lit in a window is made.

    None where nothing is as bright as sources that are resolved.
    """
    window, calibration = cluster.window, camera.calibration
    if not camera.radius_m > 0.0:
        return []
    excess_e = np.where(window.usable, window.image_e - cluster.background_e, 0.0)
    bright_e = _brightness_e(cluster, camera)
    level_e = 0.5 * bright_e
    if not level_e > _LEAST_SIGMAS * math.sqrt(window.floor_e2 + max(cluster.background_e, 0.0)):
        return []
    lit = excess_e > level_e
    if not lit.any() or np.median(excess_e[lit]) > _BRIGHTEST * bright_e:
        return []
    points = _outline(excess_e, lit, window.usable, level_e)
    if len(points) < _FEWEST:
        return []
    corner = np.array([window.box.left, window.box.top], dtype=np.float64)
    limb = direction_camera(points + corner, calibration)
    cones = _cones(limb)
    tolerance_rad = _ON_PX / min(calibration.fx_px, calibration.fy_px)
    starts: list[Start] = []
    left = np.isfinite(limb).all(axis=1)
    while len(cones) and np.count_nonzero(left) >= _FEWEST and len(starts) < MOST_DISCS:
        near = on_cones(cones, limb, tolerance_rad, _ON_SHARE)
        # Of large circles chance puts more of an outline on each.
        score = np.count_nonzero(near & left, axis=1)
        best = None
        for at in np.argsort(-score, kind="stable")[:_TRIED]:
            if score[at] < _FEWEST:
                break
            cone = refined_cone(cones[at], limb, tolerance_rad, _ON_SHARE, _ROUNDS)
            if cone is None or not _is_lit(cone, lit, window.usable, corner, calibration):
                continue
            on = on_cones(cone[None], limb, tolerance_rad, _ON_SHARE)[0]
            length_px = 2.0 * math.pi * _radius_px(cone, calibration)
            if np.count_nonzero(on & left) >= max(_FEWEST, _LEAST_ARC * length_px):
                best = cone
                break
        if best is None:
            break
        length = float(np.linalg.norm(best))
        ((u_px, v_px),) = project(np.asarray(best[None] / length), calibration).tolist()
        range_m = camera.radius_m / math.sin(math.acos(1.0 / length))
        if range_m > LEAST_RANGE_M and math.isfinite(u_px):
            starts.append((u_px, v_px, math.log(range_m)))
        left &= ~on_cones(best[None], limb, 2.0 * tolerance_rad, 2.0 * _ON_SHARE)[0]
    return starts


def _brightness_e(cluster: Cluster, camera: Camera) -> float:
    """Return how bright pixels of resolved sources are in the middle of a window, or where they clip."""
    window, box = cluster.window, cluster.window.box
    middle = np.array([[box.left + 0.5 * box.width, box.top + 0.5 * box.height]])
    of_source_e = float(brightness_e(middle, camera.exposure_s, camera.gain, camera.calibration)[0])
    return min(of_source_e, window.clip_e - cluster.background_e) if of_source_e > 0.0 else 0.0


def _outline(excess_e: Array, lit: NDArray[np.bool_], usable: NDArray[np.bool_], level_e: float) -> Array:
    """Return where an image falls through a level, (u, v) in the window, along each outline in turn."""
    import cv2

    rows, columns = lit.shape
    chains, _ = cv2.findContours(lit.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points: list[tuple[float, float]] = []
    for chain in chains:
        for column, row in chain[:, 0].tolist():
            for across, down in ((0, -1), (1, 0), (0, 1), (-1, 0)):
                other_row, other = row + down, column + across
                if not (0 <= other_row < rows and 0 <= other < columns):
                    continue
                if lit[other_row, other] or not usable[other_row, other]:
                    continue
                inside_e, outside_e = float(excess_e[row, column]), float(excess_e[other_row, other])
                share = (inside_e - level_e) / (inside_e - outside_e)
                points.append((column + share * across, row + share * down))
    return np.array(points).reshape(-1, 2)


def _cones(limb: Array) -> Array:
    """Return cones through the ends and middles of pieces of an outline, shape (cones, 3)."""
    count = len(limb)
    begin = np.unique(np.linspace(0, count, _BEGINNINGS, endpoint=False).astype(np.int64))
    arcs = [(0, (arc + 1) // 2, arc) for arc in _ARCS_PX if arc < count]
    three = limb[(begin[:, None] + np.array(arcs, dtype=np.int64).reshape(-1, 1, 3)) % count].reshape(
        -1, 3, 3
    )
    three = three[abs(np.linalg.det(three)) > _LEAST_VOLUME]
    if len(three) == 0:
        return np.empty((0, 3))
    cones = np.linalg.solve(three, np.ones((len(three), 3, 1)))[..., 0]
    return np.asarray(cones[np.linalg.norm(cones, axis=1) > 1.0])


def on_cones(
    cones: Array, limb: Array, tolerance_rad: float, share: float, most_angle_rad: float = math.inf
) -> NDArray[np.bool_]:
    """Tell which directions n lie on which cones, m · n = 1, shape (cones, directions).

    Within a tolerance, and a share of the cone's angle more; on none that is no cone, or wider than that.
    """
    lengths = np.linalg.norm(cones, axis=-1, keepdims=True)
    angle_rad = np.arccos(np.minimum(1.0 / lengths, 1.0))
    off_rad = abs(np.arccos(np.clip(cones / lengths @ limb.T, -1.0, 1.0)) - angle_rad)
    is_near = off_rad < tolerance_rad + share * angle_rad
    return np.asarray(is_near & (lengths > 1.0) & (angle_rad < most_angle_rad))


def refined_cone(
    cone: Array,
    limb: Array,
    tolerance_rad: float,
    share: float,
    rounds: int,
    most_angle_rad: float = math.inf,
) -> Array | None:
    """Fit a cone to the directions that lie on it, some times over; None where too few do."""
    for _ in range(rounds):
        kept = on_cones(cone[None], limb, tolerance_rad, share, most_angle_rad)[0]
        if np.count_nonzero(kept) < 3:
            return None
        cone = np.linalg.lstsq(limb[kept], np.ones(np.count_nonzero(kept)), rcond=None)[0]
    return cone if float(np.linalg.norm(cone)) > 1.0 else None


def _radius_px(cone: Array, calibration: Calibration) -> float:
    return min(calibration.fx_px, calibration.fy_px) * math.acos(1.0 / float(np.linalg.norm(cone)))


def _is_lit(
    cone: Array,
    lit: NDArray[np.bool_],
    usable: NDArray[np.bool_],
    corner: Array,
    calibration: Calibration,
) -> bool:
    """Tell whether what lies within a cone is lit all around, as far as it is seen."""
    if _radius_px(cone, calibration) < _LEAST_RADIUS_PX:
        return False
    length = float(np.linalg.norm(cone))
    axis, angle_rad = cone / length, _WITHIN * math.acos(1.0 / length)
    aside = np.cross(axis, (0.0, 1.0, 0.0))
    aside /= np.linalg.norm(aside)
    turn = 2.0 * math.pi * np.arange(_PROBES) / _PROBES
    around = np.outer(np.cos(turn), aside) + np.outer(np.sin(turn), np.cross(axis, aside))
    places = project(math.cos(angle_rad) * axis + math.sin(angle_rad) * around, calibration) - corner
    if not np.isfinite(places).all():
        return False
    columns, rows = np.rint(places).astype(np.int64).T
    inside = (columns >= 0) & (rows >= 0) & (columns < lit.shape[1]) & (rows < lit.shape[0])
    if not inside.all():
        return False
    seen = usable[rows, columns]
    return bool(seen.any() and lit[rows, columns][seen].mean() >= _LEAST_LIT)
