"""A hall full of robots that stand and say who they are."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.swarm.identity import words_of
from nir_render.randomness import generator
from nir_render.scene.scene import Scene
from perception.messages.uart import FRAME_BITS, RATE_HZ, REPEATS

Array = NDArray[np.float64]

HALL = Path(__file__).parents[2] / "data" / "experiments" / "hall.yaml"
OBSERVER = "r0000"
BODIES = ("masts", "columns")

PACKET_S = FRAME_BITS * REPEATS / RATE_HZ
PAUSE_S = 1.15  # lit, between the two packets of a robot: eleven bits, so that the second is in phase too

_NEAREST_M = 0.3  # robots are 0.2 m wide
_MOST_MISSES = 100_000  # for one robot: where that many places are taken, less than 5e-5 of the hall is free
_MINUTE_S = 60.0
_IDLE_S = 1.5  # before anyone sends: who has just begun to look must see eleven lit bits first
_DRIFT_MOST = 0.01  # of a sender's clock: assumed
_PANEL_EACH_M = 6.0
_HEIGHT_M = 3.0

_HULLS: dict[str, dict[str, Any]] = {
    # Below all lines of sight: cameras look from 0.2 m, sources shine from 0.28 m.
    "masts": {"type": "cylinder", "start": "[0, 0, 0.005] m", "end": "[0, 0, 0.15] m", "radius": "0.1 m"},
    # As high as leaves its own source free for who is 0.3 m away, and thinner than the ring of cameras.
    "columns": {"type": "cylinder", "start": "[0, 0, 0.005] m", "end": "[0, 0, 0.255] m", "radius": "0.05 m"},
}


def side_m(robots: int, density_per_m2: float) -> float:
    """Return how long the walls of a square hall are that holds so many robots so densely."""
    return math.sqrt(robots / density_per_m2)


def names_of(robots: int) -> list[str]:
    """Return what robots are called: the first one is who looks."""
    return [f"r{number:04d}" for number in range(robots)]


def places_m(robots: int, density_per_m2: float, seed: int) -> Array:
    """Return where robots stand, shape (robots, 2): the observer in the middle, all others anywhere.

    No two are nearer than 0.3 m, and none is nearer to a wall than half of that.

    Raises
    ------
    ValueError
        They do not fit.
    """
    random = generator(seed, "places", "swarm", 0)
    half_m = 0.5 * side_m(robots, density_per_m2) - 0.5 * _NEAREST_M
    places = np.zeros((1, 2))
    misses = 0
    while len(places) < robots:
        place = random.uniform(-half_m, half_m, 2)
        if ((places - place) ** 2).sum(axis=1).min() >= _NEAREST_M**2:
            places = np.vstack([places, place])
            misses = 0
        elif (misses := misses + 1) == _MOST_MISSES:
            raise ValueError(
                f"{robots} robots at {density_per_m2:g} per m², {_NEAREST_M} m apart, seed {seed}: "
                f"there is room for {len(places)} in {2.0 * half_m + _NEAREST_M:.2f} m squared; "
                "take fewer per m²"
            )
    return places


def hall_scene(
    scene: Scene, robots: int, density_per_m2: float, bodies: str, lasts_s: float, seed: int
) -> Scene:
    """Return the hall with so many robots in it.

    Each begins to say who it is at a time of its own within a minute; who would not have ended when the run
    does stays lit, so that a short run has as many who speak at a time as a long one.

    Parameters
    ----------
    bodies
        `masts`: hulls below all lines of sight. `columns`: hulls up to the sources, which hide others.
    lasts_s
        How long the run is.
    """
    names, places = names_of(robots), places_m(robots, density_per_m2, seed)
    random = generator(seed, "words", "swarm", 0)
    said: dict[str, Any] = {}
    for number, (name, place) in enumerate(zip(names, places, strict=True)):
        drift = random.uniform(-_DRIFT_MOST, _DRIFT_MOST)
        begin_s = _IDLE_S + random.uniform(0.0, _MINUTE_S)
        yaw_deg = random.uniform(-180.0, 180.0)
        words = words_of(number, robots)
        span_s = (len(words) * (PACKET_S + PAUSE_S) - PAUSE_S) * (1.0 + drift)
        rig: dict[str, Any] = {
            "preset": "infra_swarm",
            "body": {"hull": {**_HULLS[bodies], "material": "hull"}},
        }
        if number > 0 and begin_s + span_s <= lasts_s:
            sends = [
                {"at": f"{(PACKET_S + PAUSE_S) * order} s", "word": word} for order, word in enumerate(words)
            ]
            packets = {"sends": sends, "drift": drift, "offset": f"{begin_s} s"}
            rig["sources"] = {"top": {"drive": {"packets": packets}}}
        said[name] = {
            "position": f"[{place[0]:.4f}, {place[1]:.4f}, 0] m",
            "orientation": {"yaw": f"{yaw_deg:.3f} deg"},
            "rig": rig,
        }
    return scene.with_(
        {
            "seed": seed,
            "robots": said,
            "shapes": _walls(side_m(robots, density_per_m2)),
            "lamps": _panels(side_m(robots, density_per_m2)),
        }
    )


def _walls(side: float) -> dict[str, Any]:
    half, middle = 0.5 * side, 0.5 * _HEIGHT_M
    flat = {"type": "rectangle", "size": f"[{side:.4f}, {_HEIGHT_M}] m", "material": "wall"}
    return {
        "floor": {
            "type": "rectangle", "center": "[0, 0, 0] m", "size": f"[{side:.4f}, {side:.4f}] m",
            "normal": [0, 0, 1], "material": "floor",
        },
        "east": {**flat, "center": f"[{half:.4f}, 0, {middle}] m", "normal": [-1, 0, 0]},
        "west": {**flat, "center": f"[{-half:.4f}, 0, {middle}] m", "normal": [1, 0, 0]},
        "north": {**flat, "center": f"[0, {half:.4f}, {middle}] m", "normal": [0, -1, 0]},
        "south": {**flat, "center": f"[0, {-half:.4f}, {middle}] m", "normal": [0, 1, 0]},
    }  # fmt: skip


def _panels(side: float) -> dict[str, Any]:
    """Return panels on a grid of some 6 m, four at least."""
    count = max(2, round(side / _PANEL_EACH_M))
    along_m = side * ((np.arange(count) + 0.5) / count - 0.5)
    return {
        f"p{row * count + column}": {
            "preset": "white_led",
            "center": f"[{x:.4f}, {y:.4f}, {_HEIGHT_M - 0.02:.2f}] m",
        }
        for row, x in enumerate(along_m)
        for column, y in enumerate(along_m)
    }
