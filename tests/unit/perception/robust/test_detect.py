import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from perception.model.fisher import flare_limit
from perception.paper import detect_paper
from perception.robust import detect
from perception.robust.detect import detect_robust
from perception.types import Calibration, Detection, RawFrame
from tests.unit.perception.simulation import calibration, expected_e, expose, random

SMALL = calibration(width_px=200, height_px=160, cx_px=99.5, cy_px=79.5)


def frame_of(level_dn: int, camera: Calibration = SMALL) -> RawFrame:
    data = np.full((camera.height_px, camera.width_px), level_dn, dtype=np.uint16)
    return RawFrame(camera.camera, 0, 0.0, 1e-3, data, 64.0)


def take(
    sources: Sequence[tuple[float, float, float]], exposure_s: float, *key: int, camera: Calibration = SMALL
) -> RawFrame:
    return expose(expected_e(camera, sources, exposure_s, 2.0), camera, random(*key), exposure_s)


def nearest(found: list[Detection], u_px: float, v_px: float) -> Detection:
    return min(found, key=lambda d: math.hypot(d.u_px - u_px, d.v_px - v_px))


# --- robust --------------------------------------------------------------------------------------------

ODD = [
    (1.0, 2.4e-4, 40.2, 120.7),
    (3.0, 2.4e-4, 150.6, 30.1),
    (10.0, 1.35e-3, 99.9, 79.3),
]


@pytest.mark.parametrize(("range_m", "exposure_s", "u_px", "v_px"), ODD)
def test_robust_reaches_the_bound(range_m: float, exposure_s: float, u_px: float, v_px: float) -> None:
    """60 frames: mean range within 4 standard errors (a gain off by 1 % is 0.5 % of range: seen at 1 and
    3 m), scatter within 4 of the Cramér–Rao bound, claims true.
    """
    errors, pulls, scatter_u = [], [], []
    mean = expected_e(SMALL, [(u_px, v_px, range_m)], exposure_s, 2.0)
    camera = calibration(width_px=200, height_px=160, cx_px=99.5, cy_px=79.5, sigma={})
    for trial in range(60):
        (hit,) = detect_robust(expose(mean, camera, random(51, trial), exposure_s), camera)
        assert (hit.merged, hit.saturated, hit.ghost) == (False, False, False)
        errors.append(hit.range_m / range_m - 1.0)
        pulls.append((hit.range_m - range_m) / hit.range_sigma_m)
        scatter_u.append((hit.u_px - u_px) / hit.u_sigma_px)
    cos_theta = 1.0 / math.hypot(1.0, (u_px - 99.5) / 480.0, (v_px - 79.5) / 480.0)
    limit = flare_limit(camera, u_px, v_px, range_m, 1.4e9 * exposure_s * cos_theta / range_m**2, 2.0)
    spread = float(np.std(errors, ddof=1))
    assert abs(np.mean(errors)) < 4.0 * spread / math.sqrt(60)
    assert spread * range_m == pytest.approx(limit.range_sigma_m, rel=4.0 / math.sqrt(120))
    for z in (pulls, scatter_u):
        assert np.std(z, ddof=1) == pytest.approx(1.0, abs=4.0 / math.sqrt(120))


@pytest.mark.parametrize(
    ("range_m", "exposure_s", "claimed_m"), [(1.0, 2.4e-4, 1.0), (5.0, 1.1e-3, 5.0 * 1.02**-0.5)]
)
def test_light_two_per_cent_too_strong(range_m: float, exposure_s: float, claimed_m: float) -> None:
    """Far away ranges are 1 % too short; near by the size tells, as K is stated to 0.2 % only: a quarter of that."""
    mean = expected_e(SMALL, [(40.2, 120.7, range_m)], exposure_s, 2.0, gain_fault=1.02)
    frames = [expose(mean, SMALL, random(52, k), exposure_s) for k in range(16)]
    found = [detect_robust(frame, SMALL)[0].range_m for frame in frames]
    assert np.mean(found) == pytest.approx(claimed_m, rel=0.0025)


def test_no_false_alarms_in_pure_noise() -> None:
    camera = calibration()
    for key, level in enumerate((0.0, 0.5, 30.0)):
        mean = np.full((960, 1280), level)
        assert detect_robust(expose(mean, camera, random(53, key)), camera) == []


@pytest.mark.parametrize("range_m", [0.4, 0.8, 1.5, 3.0, 5.0])
def test_clipped_flares_are_recovered_from_their_wings(range_m: float) -> None:
    """1.35 ms is 2 to 6 times too long here: ranges within 4 claimed σ, which stay below 5 %."""
    (hit,) = detect_robust(take([(80.3, 60.8, range_m)], 1.35e-3, 54), SMALL)
    assert hit.saturated
    assert abs(hit.range_m - range_m) < 4.0 * hit.range_sigma_m
    assert hit.range_sigma_m < 0.05 * range_m


def test_a_large_clipped_disc_is_ranged_by_its_limb() -> None:
    """A disc of 32 px, overexposed: its limb, of 200 px, says where it is and how large within thousandths."""
    (hit,) = detect_robust(take([(99.3, 79.8, 0.15)], 1.35e-3, 55), SMALL)
    assert hit.saturated
    assert abs(hit.range_m - 0.15) < 4.0 * hit.range_sigma_m < 0.15e-2
    assert abs(hit.u_px - 99.3) < 4.0 * hit.u_sigma_px < 0.01
    assert abs(hit.v_px - 79.8) < 4.0 * hit.v_sigma_px < 0.01


@pytest.mark.parametrize(
    ("u_px", "v_px", "range_m"), [(0.3, 60.2, 2.0), (120.4, 159.4, 1.0), (-0.4, -0.2, 1.0)]
)
def test_edge_cut_flares(u_px: float, v_px: float, range_m: float) -> None:
    (hit,) = detect_robust(take([(u_px, v_px, range_m)], 2.4e-4, 56), SMALL)
    assert abs(hit.range_m - range_m) < 4.0 * hit.range_sigma_m
    assert abs(hit.u_px - u_px) < 4.0 * hit.u_sigma_px
    assert abs(hit.v_px - v_px) < 4.0 * hit.v_sigma_px


def test_neighbours_do_not_spoil_each_other() -> None:
    """Two flares 9 px apart, one six times brighter: each as if it were alone."""
    found = detect_robust(take([(90.2, 80.4, 4.0), (99.4, 80.1, 10.0)], 6e-4, 57), SMALL)
    assert len(found) == 2
    for u_px, range_m in ((90.2, 4.0), (99.4, 10.0)):
        hit = nearest(found, u_px, 80.2)
        assert not hit.merged
        assert abs(hit.range_m - range_m) < 4.0 * hit.range_sigma_m
        assert abs(hit.u_px - u_px) < 4.0 * hit.u_sigma_px


@pytest.mark.parametrize("apart_px", [3.6, 1.6])
def test_overlapping_flares_are_told_apart(apart_px: float) -> None:
    """Two sources 8 m away, one right beside the other: both are there, each within 4 claimed σ."""
    sources = [(90.2, 80.4, 8.0), (90.2 + apart_px, 80.4, 8.0)]
    found = detect_robust(take(sources, 8e-4, 58), SMALL)
    assert len(found) == 2
    for u_px, v_px, range_m in sources:
        hit = nearest(found, u_px, v_px)
        assert not hit.merged
        assert abs(hit.range_m - range_m) < 4.0 * hit.range_sigma_m
        assert abs(hit.u_px - u_px) < 4.0 * hit.u_sigma_px
        assert abs(hit.v_px - v_px) < 4.0 * hit.v_sigma_px


def test_extended_light_is_no_flare() -> None:
    """A lit rectangle of 30 × 20 px, as bright as a source's disc, is left out; the flare beside it stays."""
    mean = expected_e(SMALL, [(150.3, 120.2, 5.0)], 5e-4, 2.0)
    mean[30:50, 30:60] += 400.0
    (hit,) = detect_robust(expose(mean, SMALL, random(59), 5e-4), SMALL)
    assert hit.range_m == pytest.approx(5.0, abs=0.2)


def test_the_border_of_a_shadow_is_no_flare() -> None:
    """Half the frame is lit, 400 e against 20 e; the coarse background cannot follow, the fit can."""
    mean = expected_e(SMALL, [(40.3, 120.2, 6.0)], 5e-4, 20.0)
    mean[:, 90:] += 380.0
    (hit,) = detect_robust(expose(mean, SMALL, random(62), 5e-4), SMALL)
    assert abs(hit.range_m - 6.0) < 4.0 * hit.range_sigma_m


def test_one_bad_neighbour_does_not_cost_a_flare() -> None:
    """Beside a flare, 6 px off, two pixels in a column at 700 counts: no fit of both explains them, one alone does."""
    frame = take([(90.3, 80.4, 5.0)], 6e-4, 64)
    frame.data_dn[83:85, 96] = 700
    found = detect_robust(frame, SMALL)
    hit = nearest(found, 90.3, 80.4)
    assert abs(hit.range_m - 5.0) < 4.0 * hit.range_sigma_m


def test_a_stuck_pixel_beside_a_flare_does_not_make_it_saturated() -> None:
    frame = take([(90.3, 80.4, 5.0)], 3e-4, 65)
    frame.data_dn[80, 94] = 4095
    (hit,) = detect_robust(frame, SMALL)
    assert not hit.saturated
    assert abs(hit.range_m - 5.0) < 4.0 * hit.range_sigma_m


def test_without_a_range_constant_flares_are_found_unranged() -> None:
    frame = take([(90.3, 80.4, 5.0), (30.2, 40.1, 8.0)], 4e-4, 66)
    found = detect_robust(frame, replace(SMALL, range_constant_dn_m2_per_s=math.nan))
    assert len(found) == 2
    assert all(math.isnan(hit.range_m) and math.isfinite(hit.u_sigma_px) for hit in found)


@pytest.mark.parametrize(
    "changes",
    [
        {"psf_sigma_px": math.nan},
        {"source_radius_m": -0.01},
        {"dsnu_e": math.inf},
        {"prnu": math.nan},
        {"sigma": {"psf_sigma_px": math.inf}},
    ],
)
def test_a_calibration_that_cannot_be_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="its calibration has"):
        detect_robust(take([(90.3, 80.4, 5.0)], 6e-4, 67), replace(SMALL, **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("side_px", [1, 3, 8, 20])
def test_tiny_frames(side_px: int) -> None:
    """Noise alone: nothing, and no exception."""
    camera = calibration(width_px=side_px, height_px=side_px, cx_px=0.5 * side_px, cy_px=0.5 * side_px)
    for key in range(10):
        assert detect_robust(expose(np.full((side_px, side_px), 3.0), camera, random(68, key)), camera) == []


def test_garbage_takes_bounded_time() -> None:
    data = random(63).integers(0, 4096, (160, 200)).astype(np.uint16)
    detect_robust(RawFrame(SMALL.camera, 0, 0.0, 1e-3, data, 64.0), SMALL)


def _with(level_e: float, rectangle_e: float = 0.0) -> RawFrame:
    mean = np.full((SMALL.height_px, SMALL.width_px), level_e)
    mean[30:50, 30:60] += rectangle_e
    return expose(mean, SMALL, random(70), 5e-4)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (_with(1e6), "100 % of the pixels are clipped (at 4095 counts)"),
        (frame_of(0), "all pixels read 0 counts"),
        (replace(_with(2.0), black_level_dn=200.0), "less than the black level, 200"),
        (_with(2.0), "nothing exceeds the noise"),
        (_with(2.0, 400.0), "in 1 place, nothing looks like a source"),
    ],
)
def test_a_frame_without_flares_says_why(frame: RawFrame, reason: str) -> None:
    found = detect_robust(frame, SMALL)
    assert found == []
    assert reason in found.reason
    assert not found.truncated


def test_limited_time_measures_the_brightest_as_they_are() -> None:
    """Of 40 flares, in clusters of one: with time enough the same to the bit, with none left not one."""
    rows, columns = np.divmod(np.arange(40), 8)
    sources = [
        (14.3 + 24.0 * c, 16.4 + 32.0 * r, 4.0 + 0.1 * (8 * r + c))
        for r, c in zip(rows, columns, strict=True)
    ]
    frame = take(sources, 1e-3, 71)
    whole, ample, none = (detect_robust(frame, SMALL, limit_s) for limit_s in (math.inf, 60.0, 1e-9))
    assert len(whole) == 40
    assert ample == whole or [vars(hit) for hit in ample] == [vars(hit) for hit in whole]
    assert (whole.truncated, ample.truncated, none.truncated) == (False, False, True)
    assert (none, whole.reason) == ([], "")
    assert "time was up" in none.reason


def test_what_time_leaves_is_the_brightest(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that stands at 0 for three looks, before the turn of the camera and the first batch: the nearest of all."""
    sources = [
        (14.3 + 24.0 * k, 16.4 + 32.0 * row, 4.0 + 0.3 * (8 * row + k)) for row in range(4) for k in range(8)
    ]
    frame, looks = take(sources[::-1], 1e-3, 72), iter([0.0, 0.0, 0.0])
    monkeypatch.setattr(detect, "time", SimpleNamespace(perf_counter=lambda: next(looks, 9.0)))
    found = detect_robust(frame, SMALL, 1.0)
    assert found.truncated
    assert sorted(round(hit.u_px) for hit in found) == sorted(round(u) for u, _, _ in sources[:8])
    assert {round(hit.v_px) for hit in found} == {16}


def test_gain_of_the_frame() -> None:
    """At half gain the counts halve and the range does not."""
    camera = calibration(width_px=200, height_px=160, cx_px=99.5, cy_px=79.5, system_gain_dn_per_e=0.37)
    mean = expected_e(SMALL, [(120.3, 40.2, 2.0)], 2.4e-4, 2.0)
    frame = expose(mean, camera, random(60), 2.4e-4)
    frame = RawFrame(frame.camera, 1, 0.0, 2.4e-4, frame.data_dn, 64.0, gain=0.5)
    (hit,) = detect_robust(frame, SMALL)
    assert abs(hit.range_m - 2.0) < 4.0 * hit.range_sigma_m
    assert hit.background_dn == pytest.approx(64.0 + 2.0 * 0.37, abs=1.5)


# --- both ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("detector", [detect_paper, detect_robust])
@pytest.mark.parametrize("level_dn", [0, 64, 4095, 65535])
def test_uniform_frames_hold_nothing(detector: object, level_dn: int) -> None:
    assert callable(detector)
    assert detector(frame_of(level_dn), SMALL) == []
    one = calibration(width_px=1, height_px=1)
    assert detector(frame_of(level_dn, one), one) == []


@pytest.mark.parametrize("detector", [detect_paper, detect_robust])
def test_mismatch(detector: object) -> None:
    assert callable(detector)
    with pytest.raises(ValueError, match="shape"):
        detector(frame_of(64), calibration())
