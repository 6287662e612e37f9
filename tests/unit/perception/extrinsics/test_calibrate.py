"""Poses of cameras from shared flares: drawn detections whose truth is known."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from perception.extrinsics.calibrate import FrameSet, calibrate_extrinsics
from perception.files.fields import RecordingError
from perception.model.bearing import bearing_body
from perception.types import Calibration, Detection
from tests.unit.perception.rig.world import detection, frame_without_pixels, rig
from tests.unit.perception.simulation import random

Array = NDArray[np.float64]

PX, RELATIVE = 0.02, 0.003


def _said(true: Mapping[str, Calibration], seed: int, turn_deg: float = 1.0) -> dict[str, Calibration]:
    """All but the first camera turned by a degree and shifted by 3 mm per axis."""
    draw = random(seed, 151)
    said = {}
    for number, (name, camera) in enumerate(true.items()):
        turn = Rotation.from_rotvec(draw.normal(0.0, np.radians(turn_deg), 3)).as_matrix()
        shift_m = draw.normal(0.0, 0.003, 3)
        said[name] = camera if number == 0 else replace(
            camera,
            rotation_body_camera=turn @ camera.rotation_body_camera,
            position_body_m=camera.position_body_m + shift_m,
        )  # fmt: skip
    return said


def _hits(
    places: Array, camera: Calibration, said: Calibration, index: int, draw: np.random.Generator
) -> list[Detection]:
    """What a camera that stands as `camera` says of sources, taken for one that stands as `said`."""
    hits = [detection(camera, place, draw, px=PX, relative=RELATIVE) for place in places]
    return [
        replace(hit, index=index, bearing_body=tuple(bearing_body([[hit.u_px, hit.v_px]], said)[0].tolist()))
        for hit in hits
        if hit is not None
    ]


def _sets(
    true: Mapping[str, Calibration],
    said: Mapping[str, Calibration],
    seed: int,
    count: int = 60,
    robots: int = 6,
    ranges_m: tuple[float, float] = (0.6, 6.0),
) -> list[FrameSet]:
    draw = random(seed, 152)
    sets: list[FrameSet] = []
    near, far = math.log(ranges_m[0]), math.log(ranges_m[1])
    for index in range(count):
        turn = draw.uniform(0.0, 2.0 * np.pi, robots)
        range_m = np.exp(draw.uniform(near, far, robots))
        places = np.stack(
            [range_m * np.cos(turn), range_m * np.sin(turn), draw.uniform(0.0, 0.5, robots)], axis=1
        )
        frames = [replace(frame_without_pixels(camera), index=index) for camera in true.values()]
        sets.append((frames, [_hits(places, true[n], said[n], index, draw) for n in true]))
    return sets


def _errors(found: Mapping[str, Calibration], true: Mapping[str, Calibration]) -> Array:
    """How far poses are from the true ones: turn and shift, shape (cameras − 1, 6)."""
    rows = []
    for name in list(true)[1:]:
        turn = found[name].rotation_body_camera @ true[name].rotation_body_camera.T
        shift_m = found[name].position_body_m - true[name].position_body_m
        rows.append(np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift_m]))
    return np.array(rows)


def test_a_ring_of_four_is_learned_with_a_true_covariance() -> None:
    """NEES of the six numbers of each camera over twelve rigs: mean 6, its σ for 36 about 0.6."""
    true, nees, turns = rig(), [], []
    for seed in range(12):
        said = _said(true, seed)
        found = calibrate_extrinsics(_sets(true, said, seed), said)
        errors = _errors(found.calibrations, true)
        assert found.reference == "r1.front"
        assert found.refused == 0
        assert [pose.has_rotation and pose.has_position for pose in found.poses] == [True] * 3
        nees += [
            error @ np.linalg.solve(pose.covariance, error)
            for error, pose in zip(errors, found.poses, strict=True)
        ]
        turns.append(np.abs(errors[:, :3]).max())
        for pose in found.poses:
            variance = np.diagonal(pose.covariance)
            known = found.calibrations[pose.camera].sigma
            assert known["rotation_body_camera"] ** 2 == pytest.approx(variance[:3].mean())
            assert known["position_body_m"] ** 2 == pytest.approx(variance[3:].mean())
    assert np.mean(nees) == pytest.approx(6.0, abs=2.4)
    assert max(turns) < 6e-4  # of 0.03 rad and more before


def test_what_contradicts_the_rest_is_refused() -> None:
    """In a tenth of the sets the left camera has other sources at the places of its flares: 0.5° off."""
    true = rig()
    said = _said(true, 5)
    sets = _sets(true, said, 5, count=120)
    plain = calibrate_extrinsics(sets, said)
    spoilt = []
    for number, (frames, found) in enumerate(sets):
        if number % 10 == 0:
            hits = [[replace(hit, u_px=hit.u_px + 4.0) for hit in own] for own in found[1:2]]
            moved = [
                replace(h, bearing_body=tuple(bearing_body([[h.u_px, h.v_px]], said["r1.left"])[0].tolist()))
                for h in hits[0]
            ]
            found = [found[0], moved, *found[2:]]
        spoilt.append((frames, found))
    told = calibrate_extrinsics(spoilt, said)
    assert plain.refused == 0
    assert told.refused + told.flares <= plain.flares
    assert told.flares < plain.flares
    errors = _errors(told.calibrations, true)
    for error, pose in zip(errors, told.poses, strict=True):
        assert error @ np.linalg.solve(pose.covariance, error) < 22.5  # of six, but for 1 in 1000


def test_far_flares_tell_no_position_which_then_stays() -> None:
    true = rig()
    known = {"position_body_m": 0.001}  # measured by a rule
    said = {name: replace(one, sigma={**one.sigma, **known}) for name, one in _said(true, 3).items()}
    said = {n: replace(one, position_body_m=true[n].position_body_m) for n, one in said.items()}
    found = calibrate_extrinsics(_sets(true, said, 3, ranges_m=(8.0, 10.0)), said)
    for pose in found.poses:
        one = found.calibrations[pose.camera]
        assert pose.has_rotation
        assert not pose.has_position
        assert np.array_equal(one.position_body_m, said[pose.camera].position_body_m)
        assert one.sigma["position_body_m"] == 0.001
    errors = _errors(found.calibrations, true)[:, :3]
    assert np.abs(errors / [np.sqrt(np.diagonal(p.covariance)[:3]) for p in found.poses]).max() < 4.0


def test_one_that_rests_counts_little_more_than_once() -> None:
    """With 10 % of PRNU some 0.4 of a point's variance is fixed: four frames leave √((1 + 3 · 0.4) / 4) of its σ."""
    true = rig(prnu=0.1, source_radius_m=0.001)
    said = _said(true, 4)
    frames, found = zip(*_sets(true, said, 4), strict=True)
    draw = random(4, 153)
    again: list[FrameSet] = []
    for number, one in enumerate(frames):
        again += [(one, found[number])]
        for turn in range(1, 4):
            index = 1000 * turn + number
            hits = [
                [replace(hit, index=index, u_px=hit.u_px + 1e-4 * draw.normal()) for hit in own]
                for own in found[number]
            ]
            again.append(([replace(frame, index=index) for frame in one], hits))
    once = calibrate_extrinsics(list(zip(frames, found, strict=True)), said)
    often = calibrate_extrinsics(again, said)
    sigma = [np.sqrt(np.diagonal(each.poses[0].covariance)) for each in (once, often)]
    assert sigma[1] / sigma[0] == pytest.approx(
        np.full(6, 0.74), abs=0.1
    )  # 0.5 if they were four of their own


def test_too_few_flares_say_what_is_missing() -> None:
    true = rig()
    with pytest.raises(
        RecordingError, match=r"r1: \d+ flares are in the view of two cameras, wanted 12 or more"
    ):
        calibrate_extrinsics(_sets(true, true, 1, count=4), true)
    front = {"r1.front": true["r1.front"]}
    with pytest.raises(RecordingError, match=r"r1\.front: it takes two cameras"):
        calibrate_extrinsics(_sets(front, front, 1, count=4), front)
