"""Globes so near that they are fitted as whole discs: cut by the frame's edge, hidden in part, two in one blob."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from perception import Detection, detect
from perception.robust import measure
from perception.robust.large import discs
from perception.robust.large.outline import Outline, outline_of
from perception.types import Calibration
from tests.unit.perception.robust.test_eclipse import _pulls
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, calibration, expected_e, expose, random

Array = NDArray[np.float64]
Place = tuple[float, float, float]

CAMERA = calibration(sigma={})
RADIUS_M = CAMERA.source_radius_m
FINE, SIDE_PX = 8, 200
SMALL = replace(CAMERA, width_px=SIDE_PX, height_px=SIDE_PX, cx_px=99.5, cy_px=99.5)


def _told(mean_e: Array, camera: Calibration = CAMERA, key: int = 0) -> list[Detection]:
    """Return what is told of a frame, its peak at 60 % of full scale."""
    exposure = 0.6 * 4000.0 / 0.74 / float(mean_e.max())
    return list(detect(expose(mean_e * exposure + 5.0, camera, random(83, key), 1e-3 * exposure), camera))


@pytest.mark.parametrize(
    "place",
    [(600.3, 420.6, 0.16), (23.0, 337.0, 0.24), (0.3, 420.6, 0.2), (-15.3, 420.6, 0.2), (300.0, 12.0, 0.13)],
)
def test_what_the_frame_s_edge_cuts_is_ranged(place: Place) -> None:
    """By the sum of what is seen the second is 15 % too far, by 520 σ, and the fourth 66 %."""
    (told,) = _told(expected_e(CAMERA, [place], 1e-3))
    assert np.abs(_pulls(place, told)).max() < 4.5
    assert told.range_sigma_m < 5e-4 * told.range_m
    assert not told.merged


@pytest.mark.parametrize(
    ("place", "exposure_s"),
    [
        ((500.3, 496.1, 0.0675), 1e-5),
        ((893.2, 280.4, 0.0696), 1e-5),
        ((120.4, 415.2, 0.108), 4e-3),
        ((500.3, 496.1, 0.0675), 4e-3),
        ((1124.2, 98.7, 0.132), 4e-3),
        ((374.1, 1.3, 0.123), 4e-3),
    ],
)
def test_discs_of_36_to_71_px_are_ranged_anywhere(place: Place, exposure_s: float) -> None:
    """Dim, or clipped 18 times: two of three were lost, where the mesh of the background took their middle for
    ground, where ovals lean against the frame's axes; of those clipped the range was bounded at two to three times."""
    mean_e = expected_e(CAMERA, [place], exposure_s) + 20.0
    (told,) = detect(expose(mean_e, CAMERA, random(84), exposure_s), CAMERA)
    assert np.abs(_pulls(place, told)).max() < 4.5
    assert told.range_sigma_m < 2e-3 * told.range_m


def test_a_clipped_disc_that_no_disc_explains_is_bounded() -> None:
    """One of 40 px that moves 2 px while exposed: its clipped flux bounds the range from above."""
    places = [(150.3 + along_px, 120.2, 0.12) for along_px in np.linspace(-1.0, 1.0, 9)]
    camera = calibration(width_px=320, height_px=240, cx_px=159.5, cy_px=119.5)
    mean_e = np.mean([expected_e(camera, [place], 2e-3) for place in places], axis=0) + 20.0
    (told,) = detect(expose(mean_e, camera, random(86), 2e-3), camera)
    assert told.saturated
    assert told.range_m > 0.12
    assert math.isnan(told.range_sigma_m)
    assert math.hypot(told.u_px - 150.3, told.v_px - 120.2) < 0.5


def test_charge_that_spills_over_whole_columns_is_left_out() -> None:
    """Of balls of 3 to 14 px the middle column is clipped from the frame's top to its bottom: bounds of twice the
    range were told of five of twelve."""
    camera = calibration(width_px=640, height_px=480, cx_px=319.5, cy_px=239.5, sigma={})
    ranges_m = np.geomspace(0.35, 1.6, 12).tolist()
    places = [
        (60.3 + 103.13 * (k % 6), 80.2 + 150.21 * (k // 6), range_m) for k, range_m in enumerate(ranges_m)
    ]
    frame = expose(expected_e(camera, places, 4e-3) + 20.0, camera, random(85), 4e-3)
    data_dn = frame.data_dn.copy()
    data_dn[:, [round(u) for u, _, _ in places[:6]]] = camera.saturation_dn
    found = detect(replace(frame, data_dn=data_dn), camera)
    assert len(found) == len(places)
    for u, v, range_m in places:
        told = min(found, key=lambda one: math.hypot(one.u_px - u, one.v_px - v))
        assert np.abs(_pulls((u, v, range_m), told)).max() < 5.0


def _seen_e(places: list[Place], shown: float = 1.0, turn_rad: float = 0.0) -> Array:
    """Return the mean frame of 1 ms near the axis, of the first so much of its diameter left by an edge."""
    at = (np.arange(SIDE_PX * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid((at - SMALL.cx_px) / SMALL.fx_px, (at - SMALL.cy_px) / SMALL.fy_px)
    cosine = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    lit = np.zeros(x.shape)
    for k, (u, v, range_m) in enumerate(places):
        middle = np.array([(u - SMALL.cx_px) / SMALL.fx_px, (v - SMALL.cy_px) / SMALL.fy_px, 1.0])
        off_u, off_v = (x - middle[0]) * SMALL.fx_px, (y - middle[1]) * SMALL.fy_px
        middle /= np.linalg.norm(middle)
        away = np.sqrt(
            (x * cosine - middle[0]) ** 2 + (y * cosine - middle[1]) ** 2 + (cosine - middle[2]) ** 2
        )
        radius_rad = math.asin(RADIUS_M / range_m)
        disc = np.clip(0.5 + (2.0 * math.sin(0.5 * radius_rad) - away) * SMALL.fx_px * FINE, 0.0, 1.0)
        if k == 0:
            edge_px = SMALL.fx_px * math.tan(radius_rad) * (2.0 * shown - 1.0)
            along = off_u * math.cos(turn_rad) + off_v * math.sin(turn_rad)
            disc *= np.clip(0.5 + (edge_px - along) * FINE, 0.0, 1.0)
        lit = np.maximum(lit, disc)
    radiance = 1e-3 * FLUX_PER_S_AT_1_M / (math.pi * RADIUS_M**2)
    light = lit * radiance * cosine**4 / (SMALL.fx_px * FINE) ** 2
    light = gaussian_filter(light, SMALL.psf_sigma_px * FINE)
    return np.asarray(light.reshape(SIDE_PX, FINE, SIDE_PX, FINE).sum(axis=(1, 3)))


@pytest.mark.parametrize("shown", [0.9, 0.97, 0.98])
def test_what_a_body_hides_a_little_of_is_doubted(shown: float) -> None:
    """By the sum 2.7 % and 0.4 % too far, by 110 and 18 σ."""
    place = (90.3, 101.6, 0.14)
    (told,) = _told(_seen_e([place], shown, 0.5), SMALL)
    assert told.merged
    assert np.abs(_pulls(place, told)).max() < 2.0
    assert told.range_sigma_m < 0.1 * told.range_m


@pytest.mark.parametrize("shown", [0.8, 1.0])
def test_what_no_whole_disc_explains_claims_no_range(shown: float) -> None:
    """A fifth of the diameter hidden: by the sum 8 % too far, by 310 σ."""
    place = (90.3, 101.6, 0.14)
    (told,) = _told(_seen_e([place], shown, 0.5), SMALL)
    assert told.merged == (shown < 1.0)
    assert math.isfinite(told.range_sigma_m + told.u_sigma_px) == (shown == 1.0)
    if shown == 1.0:
        assert np.abs(_pulls(place, told)).max() < 4.5


def test_one_before_another_is_ranged() -> None:
    """One at 30 cm stands out by half from behind one at 14 cm: by the sum one, 6 % too near, by 300 σ; as whole
    discs doubted, or bounded."""
    places = [(85.3, 101.6, 0.14), (119.3, 110.0, 0.3)]
    found = sorted(_told(_seen_e(places), SMALL), key=lambda one: one.range_m)
    assert len(found) == 2
    for place, told in zip(places, found, strict=True):
        assert not told.merged
        assert np.abs(_pulls(place, told)).max() < 4.0


@pytest.mark.parametrize("of_full", [0.15, 0.6])
def test_whole_discs_are_told_without_a_look_at_outlines(
    of_full: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four of 30 to 60 px, the same as by their outlines; one that an edge hides a little of is looked at closely."""
    places = [(220.3, 180.2, 0.16), (600.4, 480.7, 0.1), (1050.2, 220.6, 0.24), (900.7, 800.3, 0.2)]
    exposure_s = of_full * 2.8e-4
    frame = expose(expected_e(CAMERA, places, exposure_s) + 20.0, CAMERA, random(87), exposure_s)
    outlined: list[object] = []

    def counted(*arguments: object) -> object:
        outlined.append(arguments)
        return outline_of(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(discs, "outline_of", counted)
    found = sorted(detect(frame, CAMERA), key=lambda one: one.u_px)
    assert not outlined
    monkeypatch.setattr(measure, "as_whole_discs", lambda *_: {})
    others = sorted(detect(frame, CAMERA), key=lambda one: one.u_px)
    assert len(outlined) == len(places)
    for place, one, other in zip(sorted(places), found, others, strict=True):
        assert np.abs(_pulls(place, one)).max() < 4.5
        assert one.u_px == pytest.approx(other.u_px, abs=0.1 * one.u_sigma_px)
        assert one.range_m == pytest.approx(other.range_m, abs=0.1 * one.range_sigma_m)
        assert one.range_sigma_m == pytest.approx(other.range_sigma_m, rel=0.02)
    monkeypatch.undo()
    outlined.clear()
    monkeypatch.setattr(discs, "outline_of", counted)
    _told(_seen_e([(90.3, 101.6, 0.14)], 0.97, 0.5), SMALL)
    assert outlined


@pytest.mark.parametrize("place", [(400.3, 300.2, 0.12), (2.5, 500.3, 0.1)])
def test_what_is_within_the_outline_of_a_disc_is_lit(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it that the frame shows: whole, or half of it beyond the border."""
    outlines: list[Outline | None] = []

    def kept(*arguments: object) -> Outline | None:
        outlines.append(outline_of(*arguments))  # type: ignore[arg-type]
        return outlines[-1]

    monkeypatch.setattr(discs, "outline_of", kept)
    monkeypatch.setattr(measure, "as_whole_discs", lambda *_: {})
    detect(expose(expected_e(CAMERA, [place], 1e-4) + 20.0, CAMERA, random(100), 1e-4), CAMERA)
    (outline,) = outlines
    assert outline is not None
    assert outline.lit > 0.95


@pytest.mark.parametrize("range_m", [0.028, 0.035])
def test_what_would_stand_before_the_lens_is_no_source(range_m: float) -> None:
    """A whole disc, neither clipped nor larger than is fitted, nearer than 3 cm: of balls of 3 mm."""
    camera = replace(CAMERA, source_radius_m=0.003)
    mean_e = expected_e(camera, [(600.4, 480.7, range_m)], 1e-5)
    exposure_s = 1e-5 * 2000.0 / float(mean_e.max())
    frame = expose(mean_e * exposure_s / 1e-5 + 5.0, camera, random(88), exposure_s)
    assert len(detect(frame, camera)) == (range_m > 0.03)
