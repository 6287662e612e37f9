"""First guesses of clipped flares: those followed lead to where the best of all leads."""

from collections.abc import Sequence

import pytest

from perception import Detection, detect
from perception.robust import explain
from perception.robust.problem import Problem
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=320, height_px=256, cx_px=159.5, cy_px=127.5, sigma={})


def _told(key: int) -> list[Detection]:
    """Return what is told of six flares, points and discs, clipped up to fifty times, some at the edge."""
    number = random(83, key)
    places = [
        (5.0 + 62.0 * k + number.uniform(0.0, 1.0), row + number.uniform(-0.5, 0.5), 0.8 * 10.0**share)
        for row in (1.0, 128.0)
        for k, share in enumerate(number.random(6).tolist())
    ]
    exposure_s = 10.0 ** number.uniform(-3.3, -2.3)
    return list(
        detect(expose(expected_e(CAMERA, places, exposure_s, 3.0), CAMERA, number, exposure_s), CAMERA)
    )


@pytest.mark.parametrize("key", range(2))
def test_the_likeliest_guesses_lead_where_all_lead(key: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """To a tenth of a σ: images are not laid out anew for sizes that are off by less than 2 %."""
    few, followed = _told(key), 0

    def all_of(problems: Sequence[Sequence[Problem]], _: object) -> list[tuple[int, Problem]]:
        nonlocal followed
        chosen = [(index, each) for index, of_one in enumerate(problems) for each in of_one]
        followed = len(chosen)
        return chosen

    monkeypatch.setattr(explain, "likely_starts", all_of)
    every = _told(key)
    assert followed > 1.5 * len(every)
    assert len(few) == len(every) >= 10
    assert sum(one.saturated for one in few) >= 4
    for one, other in zip(few, every, strict=True):
        assert one.u_px == pytest.approx(other.u_px, abs=0.1 * other.u_sigma_px, nan_ok=True)
        assert one.v_px == pytest.approx(other.v_px, abs=0.1 * other.v_sigma_px, nan_ok=True)
        assert one.range_m == pytest.approx(other.range_m, abs=0.1 * other.range_sigma_m, nan_ok=True)
        assert one.range_sigma_m == pytest.approx(other.range_sigma_m, rel=1e-3, nan_ok=True)
