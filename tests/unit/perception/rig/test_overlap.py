"""Cameras that stand otherwise than the calibration says: told by the flares that two of them should see."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.rig.overlap import LEAST_SHARED, overlap_of, overlap_warning
from perception.types import Calibration, Detection
from tests.unit.perception.rig.world import detection, rig
from tests.unit.perception.simulation import random

Sets = list[dict[str, list[Detection]]]


def _sets(count: int, robots: int, cameras: Mapping[str, Calibration], seed: int = 1) -> Sets:
    """Robots anywhere from 0.8 to 6 m about the rig, and what each camera says of them."""
    draw = random(seed, 11)
    sets = []
    for _ in range(count):
        turn, range_m = draw.uniform(0, 2 * np.pi, robots), draw.uniform(0.8, 6.0, robots)
        places = np.stack([range_m * np.cos(turn), range_m * np.sin(turn), np.full(robots, 0.25)], axis=1)
        sets.append({name: _seen(camera, places, draw) for name, camera in cameras.items()})
    return sets


def _seen(camera: Calibration, places: NDArray[np.float64], draw: np.random.Generator) -> list[Detection]:
    return [hit for place in places if (hit := detection(camera, place, draw)) is not None]


def _exchanged(sets: Sets, one: str, other: str) -> Sets:
    names = {one: other, other: one}
    return [{names.get(camera, camera): hits for camera, hits in each.items()} for each in sets]


def test_cameras_where_they_should_be_agree() -> None:
    cameras = rig()
    found = overlap_of(_sets(200, 5, cameras), cameras)
    assert found.shared > 100
    assert found.agreed == found.shared
    assert not found.contradicts


@pytest.mark.parametrize("robots", [1, 5, 20])
@pytest.mark.parametrize(("one", "other"), [("front", "left"), ("back", "left"), ("front", "right")])
def test_two_cameras_swapped_are_named(robots: int, one: str, other: str) -> None:
    cameras = rig()
    sets = _exchanged(_sets(400 // robots, robots, cameras), f"r1.{one}", f"r1.{other}")
    found = overlap_of(sets, cameras)
    assert found.contradicts
    assert found.exchanged == (tuple(sorted((f"r1.{one}", f"r1.{other}"))),)
    assert found.agreed_exchanged == found.shared_exchanged > LEAST_SHARED
    text = overlap_warning("r1", found)
    assert f"r1.{min(one, other)} and r1.{max(one, other)} exchanged" in text


def test_of_opposite_cameras_either_pair_explains_it() -> None:
    """Front for back is left for right, seen from the other side: nothing that cameras share tells them apart."""
    cameras = rig()
    found = overlap_of(_exchanged(_sets(100, 5, cameras), "r1.front", "r1.back"), cameras)
    assert found.contradicts
    assert set(found.exchanged) == {("r1.back", "r1.front"), ("r1.left", "r1.right")}


def test_a_camera_turned_is_told_but_explained_by_no_exchange() -> None:
    cameras = rig()
    turn = np.radians(8.0)
    about = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    front = cameras["r1.front"]
    said = {**cameras, "r1.front": replace(front, rotation_body_camera=about @ front.rotation_body_camera)}
    found = overlap_of(_sets(200, 5, cameras), said)
    only = {name: said[name] for name in ("r1.front", "r1.left", "r1.right")}
    sets = [{name: each[name] for name in only} for each in _sets(200, 5, cameras)]
    of_three = overlap_of(sets, only)
    assert found.agreed < found.shared
    assert of_three.contradicts
    assert of_three.exchanged == ()
    assert "check the cameras' mounting" in overlap_warning("r1", of_three)


def test_a_few_flares_say_nothing() -> None:
    cameras = rig()
    none = overlap_of([{name: [] for name in cameras}], cameras)
    assert (none.shared, none.contradicts) == (0, False)
    alone = overlap_of([{"r1.front": _sets(1, 5, cameras)[0]["r1.front"]}], cameras)
    assert alone.shared == 0
    assert not overlap_of([], {}).contradicts
