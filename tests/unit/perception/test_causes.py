"""What the σ of a detection's range is made of."""

import math
from dataclasses import replace

import pytest

from perception import detect
from perception.causes import CAUSES, detection_causes
from perception.files.detections import parse_causes
from tests.unit.perception.simulation import BLACK_DN, calibration, expected_e, expose, random

CAMERA = calibration(width_px=160, height_px=120, cx_px=79.5, cy_px=59.5)


def test_causes_add_up_to_what_is_claimed_and_name_the_largest() -> None:
    """At 1 m K, of 4 %, rules: σ = ½ · 4 % · 1 m; at 5 m, K of 0.02 %, the flare's own light and read noise do."""
    for range_m, share, exposure_s in ((1.0, 0.04, 2.5e-4), (5.0, 2e-4, 2.5e-4)):
        constant = CAMERA.range_constant_dn_m2_per_s
        camera = replace(
            CAMERA, sigma={"range_constant_dn_m2_per_s": share * constant, "response_relative": 0.01}
        )
        # A size that says nothing: the flux alone ranges.
        camera = replace(camera, sigma={**camera.sigma, "source_radius_m": 10.0 * camera.source_radius_m})
        frame = expose(
            expected_e(camera, [(80.2, 60.3, range_m)], exposure_s), camera, random(91), exposure_s
        )
        hits = detect(frame, camera)
        (found,) = detection_causes(hits, camera, 1.0, BLACK_DN)
        assert math.hypot(*found.causes_m.values()) == pytest.approx(hits[0].range_sigma_m, rel=1e-9)
        assert tuple(found.causes_m) == CAUSES
        assert found.response_m == pytest.approx(0.5 * hits[0].range_m * 0.01)
        assert found.causes_m["other_m"] < 0.35 * found.range_sigma_m  # the estimator works at its bound
        largest = max(CAUSES, key=found.part_m)
        if range_m == 1.0:
            assert largest == "range_constant_m"
            assert found.part_m(largest) == pytest.approx(0.02 * hits[0].range_m, rel=0.02)
        else:
            assert largest in ("own_light_m", "read_noise_m")
            assert found.part_m("range_constant_m") == pytest.approx(1e-4 * hits[0].range_m, rel=0.1)
        again = parse_causes(found.record())
        assert again.causes_m == found.causes_m
        assert (again.camera, again.index, again.detection) == ("r1.front", 3, 0)


def test_at_another_gain_electrons_are_the_same() -> None:
    """Counts of twice the gain are twice as many of the same electrons: the causes are the same ones."""
    frame = expose(expected_e(CAMERA, [(80.2, 60.3, 5.0)], 2.5e-4), CAMERA, random(92), 2.5e-4)
    (hit,) = detect(frame, CAMERA)
    doubled = replace(
        hit, flux_dn=2.0 * hit.flux_dn, background_dn=BLACK_DN + 2.0 * (hit.background_dn - BLACK_DN)
    )
    (one,) = detection_causes([hit], CAMERA, 1.0, BLACK_DN)
    (two,) = detection_causes([doubled], CAMERA, 2.0, BLACK_DN)
    assert two.causes_m["own_light_m"] == pytest.approx(one.causes_m["own_light_m"], rel=0.01)
    assert two.causes_m["rounding_m"] == pytest.approx(0.5 * one.causes_m["rounding_m"], rel=0.01)


def test_what_fog_adds_is_its_own_and_no_claim_has_no_causes() -> None:
    frame = expose(expected_e(CAMERA, [(80.2, 60.3, 5.0)], 2.5e-4), CAMERA, random(93), 2.5e-4)
    foggy = replace(CAMERA, sigma={**CAMERA.sigma, "extinction_per_m": 0.05})
    (hit,) = detect(frame, foggy)
    (found,) = detection_causes([hit], foggy, 1.0, BLACK_DN)
    assert found.causes_m["fog_m"] > 0.9 * hit.range_sigma_m
    assert found.causes_m["other_m"] == 0.0
    assert detection_causes([replace(hit, range_sigma_m=math.nan)], foggy, 1.0, BLACK_DN) == []
