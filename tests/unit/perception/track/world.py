"""Robots that move and blink, as measurements of a rig would have them: for tests and benchmarks, NumPy alone."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from perception.track import Tracker, TrackerSettings
from perception.types import Measurement, Odometry, Track, bearing_axes
from tests.unit.perception.simulation import random

Array = NDArray[np.float64]
Path = Callable[[float], Array]

PX_RAD = 1.0 / 480.0
BIT_S = 0.1
COMMON = 0.03
EXPOSURE_S = 2e-3
RESOLUTION_RAD = 2.5 * PX_RAD


@dataclass(frozen=True)
class Robot:
    """Where it is in the world, how lit (0 to 1), and whether it can be seen."""

    path: Path
    lit: Callable[[float], float] = lambda _: 1.0
    seen: Callable[[float], bool] = lambda _: True
    flux: float = 1.0


@dataclass(frozen=True)
class Observer:
    """Its pose in the world, what it thinks of it, and where in its body the camera is."""

    path: Path = lambda _: np.zeros(3)
    yaw: Callable[[float], float] = lambda _: 0.0
    position_sigma_m: float = 0.0
    rotation_sigma_rad: float = 0.0
    position_walk: float = 0.0
    rotation_walk: float = 0.0
    camera_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def turn(yaw: float) -> Array:
    """Rotation about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def talking(
    rng: np.random.Generator, packets_per_s: float = 0.12, seconds: float = 20.0
) -> Callable[[float], float]:
    """Blink words (docs/physics.md, Optical language) at 10 Hz: five frames of 11 bits and a stretch of idle light, again and again."""
    bits: list[int] = []
    while len(bits) * BIT_S < seconds:
        bits += [1] * int(rng.integers(5, max(int(10.0 / packets_per_s / 5), 6)))
        word = [int(bit) for bit in rng.integers(0, 2, 7)]
        bits += 5 * [0, *word, sum(word) % 2, 1, 1]
    phase_s = float(rng.uniform(0.0, BIT_S))
    return blinking(bits, phase_s)


def blinking(bits: Sequence[int], phase_s: float = 0.0) -> Callable[[float], float]:
    """Return the mean of a signal over an exposure that begins at a time."""
    level = np.array(bits, dtype=float)

    def mean(time_s: float) -> float:
        begin, end = time_s + phase_s, time_s + phase_s + EXPOSURE_S
        one, other = int(begin / BIT_S), int(end / BIT_S)
        if one == other:
            return float(level[one % len(level)])
        share = (other * BIT_S - begin) / EXPOSURE_S
        return float(share * level[one % len(level)] + (1.0 - share) * level[other % len(level)])

    return mean


def relative_noise(range_m: float) -> float:
    """σ_w / r: shot noise near, 2.5 % at 8 m."""
    return math.hypot(2e-3, 0.025 * (range_m / 8.0) ** 2)


def measurement(
    place_body_m: Array,
    time_s: float,
    rng: np.random.Generator,
    index: int = 0,
    flux: float = 1.0,
    bearing_sigma_rad: float = 0.05 * PX_RAD,
    common: float = COMMON,
    claimed_common: float = COMMON,
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    merged: bool = False,
    ghost_probability: float = 0.0,
) -> Measurement:
    """Return what is measured of a source; its flux has Gaussian noise, its range is K's over the root of that."""
    apart = place_body_m - np.array(origin_m)
    far = float(np.linalg.norm(apart))
    axes = bearing_axes(apart / far)
    off = rng.normal(0.0, bearing_sigma_rad, 2)
    bearing = axes[2] + off @ axes[:2]
    bearing /= np.linalg.norm(bearing)
    seems = far / math.sqrt(flux)
    relative = relative_noise(seems)
    range_m = seems * (1.0 + common) / math.sqrt(max(1.0 + 2.0 * relative * rng.normal(), 0.1))
    claimed = relative_noise(range_m) * range_m
    shared = claimed_common * range_m
    covariance = np.diag([bearing_sigma_rad**2, bearing_sigma_rad**2, claimed**2 + shared**2])
    return Measurement(
        "a", time_s, ("a.c",), (("a.c", round(time_s * 1e4), index),), origin_m,
        (float(bearing[0]), float(bearing[1]), float(bearing[2])), range_m, covariance, shared, False, merged,
        "yes" if ghost_probability > 0.9 else "no", ghost_probability,
    )  # fmt: skip


def clutter(count: int, time_s: float, rng: np.random.Generator) -> list[Measurement]:
    """Return false detections, all around and at every scale of range."""
    found = []
    for k in range(count):
        azimuth, height = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5)
        range_m = math.exp(rng.uniform(math.log(0.4), math.log(12.0)))
        place = range_m * np.array(
            [math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)]
        )
        found.append(measurement(place, time_s, rng, 1000 + k))
    return found


@dataclass(frozen=True, eq=False)
class Set:
    """One set: measurements, odometry around it, and where robots are in body axes, NaN where out of sight."""

    time_s: float
    measurements: list[Measurement]
    odometry: list[Odometry]
    truth_m: Array


def sets(
    robots: Sequence[Robot],
    seconds: float,
    fps: float,
    key: int,
    observer: Observer | None = None,
    false: int = 0,
    dropped: float = 0.0,
    jitter_s: float = 0.0,
    range_factors: Array | None = None,
) -> list[Set]:
    """Simulate sets of measurements; flares that are too near to each other merge into one."""
    rng = random(1601, key)
    at = observer or Observer()
    factor = np.full(len(robots), 1.0 + COMMON * rng.normal()) if range_factors is None else range_factors
    drift_m, drift_rad = np.zeros(3), 0.0
    found, records = [], []
    for n in range(round(seconds * fps)):
        time_s = n / fps
        drift_m = drift_m + rng.normal(size=3) * at.position_walk / math.sqrt(fps)
        drift_rad += rng.normal() * at.rotation_walk / math.sqrt(fps)
        records.append(_record(at, time_s, drift_m, drift_rad, rng))
        when = time_s + rng.uniform(-jitter_s, jitter_s)
        place, back = at.path(when), turn(at.yaw(when)).T
        truth = np.array([back @ (robot.path(when) - place) for robot in robots])
        lights = [
            (truth[k] - at.camera_m, robot.lit(when) * robot.flux / factor[k] ** 2)
            for k, robot in enumerate(robots)
            if robot.seen(when) and robot.lit(when) > 0.05
        ]
        hits = [
            measurement(p + at.camera_m, when, rng, k, flux=f, common=0.0, merged=m, origin_m=at.camera_m)
            for k, (p, f, m) in enumerate(_merged(lights))
        ]
        hits += clutter(false, when, rng)
        seen = np.array([[robot.seen(when)] for robot in robots])
        if rng.uniform() >= dropped:
            now = np.where(
                seen,
                np.array([turn(at.yaw(time_s)).T @ (r.path(time_s) - at.path(time_s)) for r in robots]),
                np.nan,
            )
            found.append(Set(time_s, hits, records[-3:], now))
    return found


def _record(
    at: Observer, time_s: float, drift_m: Array, drift_rad: float, rng: np.random.Generator
) -> Odometry:
    tilt = bearing_noise(rng, at.rotation_sigma_rad)
    return Odometry(
        "a", time_s,
        turn(drift_rad) @ at.path(time_s) + drift_m + rng.normal(size=3) * at.position_sigma_m,
        turn(at.yaw(time_s) + drift_rad) @ tilt,
        at.position_sigma_m, at.rotation_sigma_rad, at.position_walk, at.rotation_walk,
    )  # fmt: skip


def bearing_noise(rng: np.random.Generator, sigma_rad: float) -> Array:
    """Return a small random rotation."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(rng.normal(size=3) * sigma_rad).as_matrix())


def _merged(lights: list[tuple[Array, float]]) -> list[tuple[Array, float, bool]]:
    """Join lights that no camera tells apart: fluxes add up; the bearing is their mean by flux."""
    left = [(p / np.linalg.norm(p), f / float(p @ p), p, f) for p, f in lights]
    found = []
    while left:
        group = [left.pop()]
        for other in list(left):
            if any(np.linalg.norm(other[0] - one[0]) < RESOLUTION_RAD for one in group):
                group.append(other)
                left = [one for one in left if one is not other]
        if len(group) == 1:
            found.append((group[0][2], group[0][3], False))
            continue
        total = sum(one[1] for one in group)
        bearing = sum(one[0] * one[1] for one in group) / total
        # A unit flux at its own range seems to be of that range.
        found.append((np.asarray(bearing / np.linalg.norm(bearing)) / math.sqrt(total), 1.0, False))
    return found


def run(simulated: Sequence[Set], settings: TrackerSettings | None = None) -> list[tuple[Track, ...]]:
    """Track all sets."""
    tracker = Tracker(settings)
    return [tracker.update(one.time_s, one.measurements, one.odometry) for one in simulated]


def switches(simulated: Sequence[Set], out: Sequence[tuple[Track, ...]], within_m: float = 0.4) -> int:
    """Count how often a robot's track is another than the last that it had; nearest match anew in every set."""
    last: dict[int, int] = {}
    count = 0
    for one, tracks in zip(simulated, out, strict=True):
        for robot, track in matched(one, tracks, within_m):
            count += last.get(robot, track.track) != track.track
            last[robot] = track.track
    return count


def matched(one: Set, tracks: Sequence[Track], within_m: float) -> list[tuple[int, Track]]:
    """Match robots in sight to tracks."""
    if not tracks:
        return []
    apart = np.linalg.norm(one.truth_m[:, None] - np.array([t.position_body_m for t in tracks]), axis=2)
    apart = np.where(apart < within_m, apart, 1e3)
    rows, columns = linear_sum_assignment(apart)
    return [(int(r), tracks[int(c)]) for r, c in zip(rows, columns, strict=True) if apart[r, c] < within_m]


def covered(
    simulated: Sequence[Set], out: Sequence[tuple[Track, ...]], after_s: float, within_m: float = 0.4
) -> float:
    """Return the share of robots in sight that have a track, from a time on."""
    has = could = 0
    for one, tracks in zip(simulated, out, strict=True):
        if one.time_s >= after_s:
            could += int(np.isfinite(one.truth_m[:, 0]).sum())
            has += len(matched(one, tracks, within_m))
    return has / could


def straight(start: Sequence[float], velocity: Sequence[float]) -> Path:
    """Move evenly."""
    begin, step = np.array(start, dtype=float), np.array(velocity, dtype=float)
    return lambda time_s: begin + time_s * step


# --- the scenes of the issue, by their measurements ---

MOVING = Observer(
    path=lambda t: np.array([0.03 * t, 0.2 * math.sin(0.5 * t), 0.0]),
    yaw=lambda t: 0.3 * math.sin(0.7 * t),
    position_sigma_m=2e-3, rotation_sigma_rad=1e-3, position_walk=5e-3, rotation_walk=2e-3,
)  # fmt: skip
TURNING = Observer(yaw=MOVING.yaw, rotation_sigma_rad=1e-3, rotation_walk=2e-3)


def crossing() -> list[Robot]:
    """Two talkers cross with 0.6 m of depth between."""
    return [
        Robot(straight([2.0, -1.5, 0.0], [0.0, 0.25, 0.0]), talking(random(1602, 1))),
        Robot(straight([2.6, 1.5, 0.0], [0.0, -0.25, 0.0]), talking(random(1602, 2))),
    ]


def dark_crossing() -> list[Robot]:
    """Two cross in the middle of 0.9 s in which both are dark, with 0.5 m of depth between."""

    def lit(time_s: float) -> float:
        return float(not 5.55 <= time_s < 6.45)

    return [
        Robot(straight([2.0, -1.5, 0.0], [0.0, 0.25, 0.0]), lit),
        Robot(straight([2.5, 1.875, 0.0], [0.0, -0.3125, 0.0]), lit),
    ]


def bounce(back: bool) -> list[Robot]:
    """Two flares that are one for 0.5 s; then both go on, or back."""

    def path(range_m: float, side: float) -> Path:
        def at(time_s: float) -> Array:
            angle = side * 0.0104 * (time_s - 6.0)
            angle = -abs(angle) * side if back else angle
            return range_m * np.array([math.cos(angle), math.sin(angle), 0.0])

        return at

    return [Robot(path(2.0, 1.0)), Robot(path(2.5, -1.0))]


def occlusion() -> list[Robot]:
    """Two talkers, each hidden for a while."""
    one, other = (straight([2.0, -1.5, 0.0], [0.0, 0.25, 0.0]), straight([3.0, 1.5, 0.0], [0.0, -0.25, 0.0]))
    return [
        Robot(one, talking(random(1603, 1)), lambda t: not 5.0 < t < 5.8),
        Robot(other, talking(random(1603, 2)), lambda t: not 7.0 < t < 7.9),
    ]


def swarm(count: int, key: int, speed_m_per_s: float = 0.1) -> list[Robot]:
    """Talkers that go round in circles of 0.25 m, nowhere nearer to each other than 0.5 m."""
    rng = random(1604, key)
    centres: list[Array] = []
    while len(centres) < count:
        place = np.array([rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0), 0.0])
        if np.linalg.norm(place) > 1.2 and all(np.linalg.norm(place - one) > 1.0 for one in centres):
            centres.append(place)

    def round_about(centre: Array, turn_rad_per_s: float, phase: float) -> Path:
        return lambda t: (
            centre
            + 0.25
            * np.array([math.cos(turn_rad_per_s * t + phase), math.sin(turn_rad_per_s * t + phase), 0.0])
        )

    return [
        Robot(
            round_about(one, speed_m_per_s / 0.25 * rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)),
            talking(rng),
        )
        for one in centres
    ]
