"""The flux of a disc from the light within a circle, and what it tells of a first guess."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import ncx2

from perception import detect
from perception.model import ranging
from perception.robust.problem import Problem
from perception.robust.starts import at_rest
from perception.robust.starts.curve_of_growth import whole_fluxes
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=640, height_px=480, cx_px=40.0, cy_px=30.0, sigma={})


def _light(radius: float, brightness: float, clip: float, within: float) -> tuple[float, float]:
    """Return the light of a disc within a circle, and the area that clips, in units of the blur: by quadrature.

    The share of its brightness that a blurred disc has at a place is a noncentral χ² distribution's.
    """

    def bright(at: float) -> float:
        return brightness * float(ncx2.cdf(radius**2, 2, max(at * at, 1e-20)))

    clipped_at = 0.0
    if bright(0.0) > clip:
        low, high = 0.0, radius + 9.0
        for _ in range(60):
            clipped_at = 0.5 * (low + high)
            low, high = (clipped_at, high) if bright(clipped_at) > clip else (low, clipped_at)
    whole = quad(
        lambda at: 2.0 * math.pi * at * min(bright(at), clip), 0.0, within, limit=400,
        points=[at for at in (clipped_at, radius) if 0.0 < at < within], epsrel=1e-8,
    )  # fmt: skip
    return float(whole[0]), math.pi * clipped_at**2


@pytest.mark.parametrize("smooth_px", [0.5, 2.0])
def test_the_light_within_a_circle_tells_the_flux(smooth_px: float) -> None:
    """From points to discs of twenty widths, of which none clips, the middle does, or all: within 2e-4."""
    cases = [
        (radius, times, radius + beyond)
        for radius in (0.02, 0.4, 1.0, 3.0, 4.9, 7.0, 20.0)
        for times in (0.0, 1.02, 1.5, 10.0, 1000.0)
        for beyond in (2.0, 4.0)
    ]
    px2 = smooth_px**2
    brightness = np.array([700.0 / min(radius, 1.0) ** 2 for radius, *_ in cases])
    clip = np.array(
        [math.inf if times == 0.0 else b / times for b, (_, times, _) in zip(brightness, cases, strict=True)]
    )
    told = [
        _light(radius, b, c, within)
        for b, c, (radius, _, within) in zip(brightness, clip, cases, strict=True)
    ]
    light, clipped = np.array(told).T
    within_px2 = np.array([math.pi * within**2 * px2 for *_, within in cases])
    flux_e, clipped_px2 = whole_fluxes(light * px2, within_px2, brightness, clip, smooth_px).T
    for case, b, flux, area, seen in zip(cases, brightness, flux_e, clipped_px2, clipped, strict=True):
        if math.sqrt(seen / math.pi) > case[2]:  # all of what is looked at clips
            continue
        assert flux == pytest.approx(b * math.pi * case[0] ** 2 * px2, rel=2e-4), case
        assert area == pytest.approx(seen * px2, rel=1e-3, abs=1e-9), case


def test_what_no_disc_shows_tells_nothing() -> None:
    """No light, none that a range could be had from, or a background as bright as what clips."""
    light_e, brightness_e = np.array([0.0, 100.0, -3.0, 100.0]), np.array([50.0, math.nan, 50.0, 50.0])
    clip_e = np.array([math.inf, math.inf, math.inf, 0.0])
    told = whole_fluxes(light_e, np.full(4, 30.0), brightness_e, clip_e, 0.7)
    assert np.isnan(told).all()


@pytest.mark.parametrize("times", [0.5, 1.5, 6.0, 40.0])
def test_a_lone_disc_is_guessed_nearly_as_it_is_fitted(times: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Off the axis, up to 55°, so many times as bright as what clips: the only guess is where the disc is.

    The middle of what clips lies up to .1 px off its place, to which the flank alone would add some .03 px.
    """
    number, problems = random(96, round(10.0 * times)), list[Sequence[Problem]]()
    places = [
        (u + float(number.uniform(-0.5, 0.5)), v + float(number.uniform(-0.5, 0.5)), range_m)
        for (u, v), range_m in zip(
            [(u, v) for u in (120.0, 340.0, 560.0) for v in (90.0, 240.0, 400.0)],
            np.geomspace(0.5, 2.0, 9).tolist(),
            strict=True,
        )
    ]

    def kept(sets: Sequence[Sequence[Problem]], _: object) -> list[tuple[int, Problem]]:
        problems.extend(sets)
        return []

    monkeypatch.setattr(at_rest, "likely_starts", kept)
    middle = np.array([place[:2] for place in places])
    clip_e = (4095.0 - 64.0) / 0.74
    for (u, v, range_m), per_s in zip(places, ranging.brightness_e(middle, 1.0, 1.0, CAMERA), strict=True):
        exposure_s = times * clip_e / float(per_s)
        frame = expose(
            expected_e(CAMERA, [(u, v, range_m)], exposure_s, 3.0),
            CAMERA,
            random(97, round(u), round(times)),
            exposure_s,
        )
        problems.clear()
        detect(frame, CAMERA)
        (guessed,) = problems[0]
        ((told_u, told_v, log_range),) = guessed.starts
        assert math.hypot(told_u - u, told_v - v) < 0.05
        assert log_range == pytest.approx(math.log(range_m), abs=0.015)
