"""Robots with two and three LEDs in a simulator of its own: numpy alone, bounds by numerical derivatives."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from perception.rig.measure_set import measure_set
from perception.types import Calibration, Detection, Layout, PoseHypothesis, RobotPose
from tests.unit.perception.rig.world import detection, frame_without_pixels, rig, seen_by

Array = NDArray[np.float64]

COMMON = 0.001
"""Of each detection's range, by K (whose σ is 0.2 % in this rig)."""


@dataclass(frozen=True)
class Noise:
    """Of each detection: pixels, and its range by itself."""

    px: float = 0.02
    relative: float = 0.005


FINE = Noise()

ALIKE = Layout("pair", ((0.06, 0.0, 0.28), (-0.06, 0.0, 0.28)), (1.0, 1.0))
UNLIKE = replace(ALIKE, relative_flux=(1.0, 0.5))
THREE = Layout("three", ((0.06, 0.0, 0.28), (-0.06, 0.0, 0.28), (0.02, 0.04, 0.28)), (1.0, 1.0, 1.0))


def turned(heading_rad: float) -> Array:
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def between(angle_rad: float, turn: float = 2.0 * math.pi) -> float:
    """Return an angle modulo a turn, around 0."""
    return (angle_rad + 0.5 * turn) % turn - 0.5 * turn


def bound_rad(cameras: dict[str, Calibration], layout: Layout, pose: Array, noise: Noise = FINE) -> float:
    """Return the least σ of a heading: Fisher's information of x, y, z, heading and K's error, by differences."""

    def seen(unknown: Array) -> Array:
        told = []
        for camera in cameras.values():
            for place in layout.places_body_m:
                hit = seen_by(camera, unknown[:3] + turned(unknown[3]) @ np.array(place), -1.0)
                was = seen_by(camera, pose[:3] + turned(pose[3]) @ np.array(place))
                if hit is not None and was is not None:
                    logarithm = (math.log(hit[2]) + COMMON * unknown[4]) / noise.relative
                    told += [hit[0] / noise.px, hit[1] / noise.px, logarithm]
        return np.array(told)

    return heading_sigma_rad(seen, pose)


def heading_sigma_rad(seen: Callable[[Array], Array], pose: Array) -> float:
    """Return the σ of a heading by what is seen, over its σ, of x, y, z, heading and K's error, of σ 1."""
    at, step = np.append(pose, 0.0), 1e-5
    slopes = np.column_stack(
        [(seen(at + step * axis) - seen(at - step * axis)) / (2.0 * step) for axis in np.eye(5)]
    )
    information = slopes.T @ slopes
    information[4, 4] += 1.0
    return math.sqrt(np.linalg.pinv(information)[3, 3])


def sighted(
    cameras: dict[str, Calibration],
    robots: Sequence[tuple[Layout, Array]],
    rng: np.random.Generator,
    hidden: Sequence[tuple[int, int]] = (),
) -> list[list[Detection]]:
    """Return what each camera says of robots at poses x, y, z, heading; without the hidden (robot, source)."""
    return [[hit for hit, _ in each] for each in labelled(cameras, robots, rng, hidden)]


def labelled(
    cameras: dict[str, Calibration],
    robots: Sequence[tuple[Layout, Array]],
    rng: np.random.Generator,
    hidden: Sequence[tuple[int, int]] = (),
    noise: Noise = FINE,
) -> list[list[tuple[Detection, tuple[int, int]]]]:
    """As `sighted`, each detection with the robot and source that it is of."""
    errors = rng.normal(size=len(robots))
    return [
        [
            (hit, (k, n))
            for k, (layout, pose) in enumerate(robots)
            for n, place in enumerate(layout.places_body_m)
            if (k, n) not in hidden
            for hit in (
                detection(
                    camera, pose[:3] + turned(pose[3]) @ np.array(place), rng, px=noise.px, relative=noise.relative,
                    common=COMMON, common_error=errors[k], factor=layout.relative_flux[n] ** -0.5,
                ),
            )
            if hit is not None
        ]
        for camera in cameras.values()
    ]  # fmt: skip


def told(cameras: dict[str, Calibration], detections: Sequence[Sequence[Detection]]) -> tuple[RobotPose, ...]:
    frames = [frame_without_pixels(camera) for camera in cameras.values()]
    return measure_set(frames, detections, cameras).robots


@dataclass
class Figures:
    """Of one robot in many poses: error of the best hypothesis' heading (rad, modulo symmetry), its σ, bound.

    `odds` tells how probable the stack held the best, `alike` all that are like it modulo symmetry, `right`
    those at the true heading, and `named` those of these that also say rightly which source each flare is.
    `astray` tells whether the best is at another heading, modulo symmetry, `swapped` whether it names wrong.
    """

    error: Array
    sigma: Array
    bound: Array
    right: Array
    named: Array
    odds: Array
    alike: Array
    astray: NDArray[np.bool_]
    swapped: NDArray[np.bool_]
    pulls2: Array
    lost: int


class Look(Protocol):
    """What is told of a robot at a pose: robots, which source each flare of the only one is, and the bound."""

    def __call__(
        self, cameras: dict[str, Calibration], layout: Layout, pose: Array, rng: np.random.Generator
    ) -> tuple[tuple[RobotPose, ...], tuple[int, ...], float]: ...


def drawn(
    cameras: dict[str, Calibration],
    layout: Layout,
    pose: Array,
    rng: np.random.Generator,
    noise: Noise = FINE,
) -> tuple[tuple[RobotPose, ...], tuple[int, ...], float]:
    """Look by detections that are drawn from the errors that they claim; who lacks a flare is not told."""
    seen = labelled(cameras, [(layout, pose)], rng, noise=noise)
    robots = told(cameras, [[hit for hit, _ in each] for each in seen])
    if len(robots) != 1 or len(robots[0].flares) != len(layout.places_body_m):
        return (), (), math.nan
    by_camera = dict(zip(cameras, seen, strict=True))
    sources = tuple(by_camera[camera][number][1][1] for camera, _, number in robots[0].flares)
    return robots, sources, bound_rad(cameras, layout, pose, noise)


def pose_of(rng: np.random.Generator) -> Array:
    """Return x, y, z, heading 1 to 5 m away, anywhere around, turned anyhow."""
    range_m, bearing, heading = rng.uniform(1, 5), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
    return np.array([range_m * np.cos(bearing), range_m * np.sin(bearing), rng.uniform(-0.1, 0.1), heading])


def figures(
    layout: Layout,
    poses: int,
    turn: float = 2.0 * math.pi,
    seed: int = 5,
    look: Look = drawn,
    **changes: Any,
) -> Figures:
    """Return the figures of so many poses; `changes` are of the cameras' calibrations."""
    cameras = {name: replace(camera, layouts=(layout,)) for name, camera in rig(**changes).items()}
    rng = np.random.default_rng(seed)
    rows, lost = [], 0
    for _ in range(poses):
        pose = pose_of(rng)
        robots, sources, bound = look(cameras, layout, pose, rng)
        if len(robots) != 1:
            lost += 1
            continue
        hypotheses, heading = robots[0].hypotheses, float(pose[3])
        best = hypotheses[0]
        off = np.array(
            [*(np.array(best.position_body_m) - pose[:3]), between(best.heading_rad - heading, turn)]
        )
        pull2 = float(off @ np.linalg.solve(best.covariance, off))
        right = [each for each in hypotheses if is_at(each, heading)]
        alike = [each for each in hypotheses if is_at(each, best.heading_rad, turn)]
        rows.append((
            off[3], math.sqrt(best.covariance[3, 3]), bound,
            sum(each.odds for each in right), sum(each.odds for each in right if each.sources == sources),
            best.odds, sum(each.odds for each in alike), not is_at(best, heading, turn),
            best.sources != sources, pull2,
        ))  # fmt: skip
    error, sigma, bounds, shares, named, odds, alike_odds, astray, swapped, pulls2 = np.array(rows).T
    return Figures(
        error, sigma, bounds, shares, named, odds, alike_odds, astray.astype(bool), swapped.astype(bool),
        pulls2, lost,
    )  # fmt: skip


def is_at(hypothesis: PoseHypothesis, heading_rad: float, turn: float = 2.0 * math.pi) -> bool:
    """Return whether a hypothesis is that of a heading, modulo a turn: within 5 σ of it."""
    off = between(hypothesis.heading_rad - heading_rad, turn)
    return abs(off) < 5.0 * math.sqrt(hypothesis.covariance[3, 3])


def against_bound(found: Figures) -> tuple[float, float, float]:
    """Return RMSE over the bound where that is at most 10°, coverage of 95 % elsewhere, mean NEES per dimension."""
    close = found.bound <= math.radians(10.0)
    ratio = math.sqrt(float(np.mean((found.error[close] / found.bound[close]) ** 2)))
    within = np.abs(found.error[~close]) < 1.96 * found.sigma[~close]
    return ratio, float(within.mean()) if within.size else math.nan, float(found.pulls2.mean()) / 4.0
