"""Two sources too near to be told apart are one flare that says so; lone ones are not doubted.

Frames of the independent simulator (`simulation`): two spheres at 4 to 8 m, less than a width of the point
spread apart. Before they were tried, all of these were one flare with a range up to 29 % too near, by 30 to 80
of its σ, and most of them undoubted.
"""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from perception import Detection, detect
from perception.model.window import Camera
from perception.robust.overlap import rivals, unparted
from perception.robust.problem import Problem
from perception.robust.solve import Solution, solve
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=64, height_px=64, cx_px=31.5, cy_px=31.5, bit_depth=16, saturation_dn=65535)
EXPOSURE_S, BACKGROUND_E = 6e-4, 3.0


def _pair(number: int, apart_px: float, ratio: float) -> tuple[float, list[Detection]]:
    """Return the range of the brighter one of two, and what is found of both."""
    rng = random(161, number)
    range_m, turn_rad = 4.0 * 2.0 ** rng.random(), 2.0 * math.pi * rng.random()
    u_px, v_px = 30.0 + 3.0 * rng.random(2)
    other = (
        u_px + apart_px * math.cos(turn_rad),
        v_px + apart_px * math.sin(turn_rad),
        range_m / math.sqrt(ratio),
    )
    mean_e = expected_e(CAMERA, [(u_px, v_px, range_m), other], EXPOSURE_S, BACKGROUND_E)
    return range_m, list(detect(expose(mean_e, CAMERA, random(162, number), EXPOSURE_S), CAMERA))


@pytest.mark.parametrize(("apart_px", "ratio", "most"), [(0.3, 1.0, 1), (0.5, 1.0, 1), (0.5, 0.5, 3)])
def test_two_in_one_flare_cover_both(apart_px: float, ratio: float, most: int) -> None:
    """Of 16 at most so many are confidently wrong; and one flare or two, never none."""
    wrong = 0
    for number in range(16):
        range_m, found = _pair(number, apart_px, ratio)
        assert 1 <= len(found) <= 2
        one = found[0]
        off = abs(one.range_m - range_m) > 5.0 * one.range_sigma_m
        wrong += len(found) == 1 and (off or (one.range_m < 0.9 * range_m and not one.merged))
    assert wrong <= most


@pytest.mark.parametrize(
    ("around", "chi2", "is_tried"), [(0, 12.5, False), (0, 13.3, True), (4, 9.5, False), (4, 10.2, True)]
)
def test_two_are_tried_where_they_could_count(
    around: int, chi2: float, is_tried: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alone from 17 less 4.1 on (ln of one in 50 px, twice), with four others within 50 px from 17 less 7.3."""
    tried, whole = list[int](), solve

    def counted(problems: Sequence[Problem], camera: Camera) -> list[Solution | None]:
        tried.append(len(problems))
        return whole(problems, camera)

    monkeypatch.setattr(unparted, "solve", counted)
    monkeypatch.setattr(unparted, "longer_chi2", lambda _: chi2)
    places = [(31.5, 31.5, 4.0)] + [
        (31.5 + 20.0 * du, 31.5 + 20.0 * dv, 4.0) for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    mean_e = expected_e(CAMERA, places[: 1 + around], EXPOSURE_S, BACKGROUND_E)
    assert len(detect(expose(mean_e, CAMERA, random(165, around), EXPOSURE_S), CAMERA)) == 1 + around
    assert bool(sum(tried)) == is_tried


def test_lone_ones_are_not_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 120 from 1.5 to 9 m none is; some are tried, as noise makes them longer than wide."""
    tried = 0
    whole = rivals.weighed

    def counted(*solutions: object) -> object:
        nonlocal tried
        tried += 1
        return whole(*solutions)  # type: ignore[arg-type]

    monkeypatch.setattr(unparted, "weighed", counted)
    monkeypatch.setattr(unparted, "LONGER_CHI2", 3.0)  # noise does it once in 4.5
    monkeypatch.setattr(unparted, "LEAST_CHI2", 3.0)
    pulls = []
    for number in range(120):
        rng = random(163, number)
        range_m = 1.5 * 6.0 ** rng.random()
        u_px, v_px = 30.0 + 3.0 * rng.random(2)
        mean_e = expected_e(CAMERA, [(u_px, v_px, range_m)], EXPOSURE_S, BACKGROUND_E)
        (one,) = detect(expose(mean_e, CAMERA, random(164, number), EXPOSURE_S), CAMERA)
        assert not one.merged
        pulls.append((one.range_m - range_m) / one.range_sigma_m)
    assert 10 <= tried <= 60
    assert np.mean(np.square(pulls)) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 120))
