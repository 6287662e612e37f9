"""Matching and counting, on cases that can be worked out by hand."""

import dataclasses
import math

import numpy as np
import pytest

from nir_render.evaluate.match import countable, match
from nir_render.evaluate.metrics import evaluate
from nir_render.truth.lamps import LampTruth
from nir_render.truth.sources import SourceTruth, parse_truth
from perception.types import Calibration, Detection

CALIBRATION = Calibration(
    camera="r1.front", width_px=640, height_px=480, fx_px=480.0, fy_px=480.0, cx_px=319.5, cy_px=239.5,
    rotation_body_camera=np.eye(3), position_body_m=np.zeros(3), system_gain_dn_per_e=1.0, read_noise_e=10.0,
    black_level_dn=64.0, saturation_dn=4095, bit_depth=12, psf_sigma_px=0.7,
    response_angle_rad=np.array([0.0, 1.5]), response_relative=np.ones(2), range_constant_dn_m2_per_s=1e9,
    range_constant_paper_dn_m2_per_s=1e9, source_radius_m=0.01, wavelength_m=940e-9,
)  # fmt: skip


def _truth(u_px: float, v_px: float = 100.0, **changes: object) -> SourceTruth:
    row = SourceTruth(
        camera="r1.front", index=0, time_s=0.0, source="top", robot="r2", u_px=u_px, v_px=v_px, range_m=2.0,
        depth_z_m=2.0, bearing_camera=(0.0, 0.0, 1.0), bearing_body=(1.0, 0.0, 0.0), position_body_m=(2.0, 0.0, 0.0),
        visible_fraction=1.0, direct_e=1e4, mirrored_e=0.0, scattered_e=0.0, background_e=0.0, peak_snr=20.0, saturated_px=0,
        on_fraction=1.0,
    )  # fmt: skip
    return dataclasses.replace(row, **changes)  # type: ignore[arg-type]


def _detection(u_px: float, v_px: float = 100.0, **changes: object) -> Detection:
    found = Detection(
        camera="r1.front", index=0, time_s=0.0, u_px=u_px, v_px=v_px, u_sigma_px=0.1, v_sigma_px=0.1, flux_dn=1e4,
        mean_dn=500.0, background_dn=64.0, area_px=20, saturated=False, merged=False, ghost=False, range_m=2.0,
        range_sigma_m=0.01, bearing_body=(1.0, 0.0, 0.0),
    )  # fmt: skip
    return dataclasses.replace(found, **changes)  # type: ignore[arg-type]


def test_the_gate_is_three_pixels_or_the_radius_of_the_image() -> None:
    middle = _truth(319.5, 239.5)
    assert match([middle], [_detection(322.49, 239.5)], CALIBRATION).pairs == ((0, 0),)
    assert match([middle], [_detection(322.51, 239.5)], CALIBRATION).pairs == ()
    # At 0.5 m a source of 10 mm has an image of 9.6 px radius on the axis; 45° off, twice that along the radius.
    near = _truth(319.5, 239.5, range_m=0.5)
    assert match([near], [_detection(329.0, 239.5)], CALIBRATION).pairs == ((0, 0),)
    assert match([near], [_detection(329.3, 239.5)], CALIBRATION).pairs == ()
    off = _truth(319.5 + 480.0, 239.5, range_m=0.5)
    assert match([off], [_detection(799.5 + 19.0, 239.5)], CALIBRATION).pairs == ((0, 0),)
    assert match([off], [_detection(799.5 + 19.4, 239.5)], CALIBRATION).pairs == ()


def test_one_detection_serves_one_source() -> None:
    """Two detections on one source: the nearer is the hit, the other a false alarm; and the other way round."""
    both = match([_truth(100.0)], [_detection(101.0), _detection(100.5)], CALIBRATION)
    assert (both.pairs, both.unmatched) == (((0, 1),), (0,))
    one = match([_truth(100.0), _truth(102.0)], [_detection(101.5)], CALIBRATION)
    assert (one.pairs, one.unmatched) == (((1, 0),), ())


def test_as_many_pairs_as_possible_come_before_the_nearest() -> None:
    """Sources at 100 and 104, detections at 102.5 and 98: greedy would give 104–102.5 and 100–98 too; here it must."""
    found = match([_truth(100.0), _truth(104.0)], [_detection(102.5), _detection(98.0)], CALIBRATION)
    assert found.pairs == ((0, 1), (1, 0))
    # The detection at 101.5 is nearest to 100, but only it can serve 104, and 98 serves 100.
    found = match([_truth(100.0), _truth(104.0)], [_detection(101.5), _detection(98.0)], CALIBRATION)
    assert found.pairs == ((0, 1), (1, 0))


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({}, True),
        ({"visible_fraction": 0.5}, True),
        ({"visible_fraction": 0.49}, False),
        ({"peak_snr": 5.0}, True),
        ({"peak_snr": 4.99}, False),
        ({"on_fraction": 0.0}, False),
        ({"u_px": -0.6}, False),
        ({"v_px": 479.6}, False),
        ({"ghost_of": "r2.top"}, False),
    ],
)
def test_what_counts_for_recall(changes: dict[str, object], counts: bool) -> None:
    assert countable(dataclasses.replace(_truth(100.0), **changes), CALIBRATION) is counts  # type: ignore[arg-type]


def test_the_summary_of_a_run_worked_out_by_hand() -> None:
    """Three frames; two countable sources at 2 m, one found 10 cm too far and 1° off; a false alarm, and
    one that calls itself a ghost where none is; a detection on a source that does not count is neither hit nor
    false alarm."""
    tilted = (math.cos(math.radians(1.0)), math.sin(math.radians(1.0)), 0.0)
    truth = [_truth(100.0), _truth(200.0, index=1), _truth(300.0, index=1, peak_snr=2.0)]
    detections = {
        "robust": [
            _detection(100.5, range_m=2.1, bearing_body=tilted),
            _detection(400.0, index=1),
            _detection(300.0, index=1),
            _detection(50.0, index=2, ghost=True),
        ],
        "paper": [],
    }
    frames = [("r1.front", 0), ("r1.front", 1), ("r1.front", 2)]
    summary = evaluate(frames, truth, {"r1.front": CALIBRATION}, detections).summary
    assert (summary["frames"], summary["sources_visible"]) == (3, 2)
    assert summary["estimators"]["robust"] == {
        "recall": 0.5,
        "range_mae_m": pytest.approx(0.1),
        "range_rmse_m": pytest.approx(0.1),
        "range_bias_m": pytest.approx(0.1),
        # Of the one that was found, at another place in its pixel than the other.
        "range_limit_rmse_m": pytest.approx(summary["range_limit_rmse_m"], rel=0.02),
        "saturated": 0,
        "ranges_missing": 0,
        "bearing_rms_deg": pytest.approx(1.0),
        "false_alarms_per_frame": pytest.approx(2.0 / 3.0),
        "ghosts_reported": 0,
        "lamps_reported": 0,
    }
    assert summary["estimators"]["paper"]["recall"] == 0.0
    assert summary["estimators"]["paper"]["range_mae_m"] is None


def test_what_calls_itself_a_ghost_is_believed_only_where_one_is() -> None:
    """A mirror image at 200 px: a detection there that says ghost counts apart, one at 400 px is a false alarm."""
    rows = [_truth(100.0), _truth(200.0, ghost_of="r2.top", direct_e=0.0, mirrored_e=1e4, range_m=4.0)]
    found = [_detection(100.0), _detection(200.5, ghost=True), _detection(400.0, ghost=True)]
    summary = evaluate([("r1.front", 0)], rows, {"r1.front": CALIBRATION}, {"robust": found}).summary
    robust = summary["estimators"]["robust"]
    assert (robust["recall"], robust["ghosts_reported"], robust["false_alarms_per_frame"]) == (1.0, 1, 1.0)


def test_detections_of_ghosts_are_counted_apart() -> None:
    """A source and its two ghosts: one ghost is found, and called a robot; so is nothing, twice.

    Recall counts the source alone, false alarms what belongs to neither. A second detection on the ghost is one.
    """
    ghosts = [
        _truth(u_px, ghost_of="r2.top", direct_e=0.0, mirrored_e=1e4, range_m=4.0) for u_px in (200.0, 300.0)
    ]
    found = [_detection(100.2), _detection(200.3, range_m=4.1), _detection(202.0), _detection(400.0)]
    result = evaluate(
        [("r1.front", 0)], [_truth(100.0), *ghosts], {"r1.front": CALIBRATION}, {"robust": found}
    )
    assert result.summary["sources_visible"] == 1
    robust = result.summary["estimators"]["robust"]
    assert (robust["recall"], robust["ghosts_reported"], robust["false_alarms_per_frame"]) == (1.0, 1, 2.0)
    assert robust["range_bias_m"] == pytest.approx(0.0, abs=1e-12)
    assert [score.truth.ghost_of for score in result.scores] == [None]
    assert [score.truth.u_px for score in result.ghosts] == [200.0, 300.0]
    assert [len(score.detections) for score in result.ghosts] == [1, 0]


def test_a_detection_between_a_source_and_a_ghost_belongs_to_the_nearer() -> None:
    """Source at 100, ghost at 104 px: what is found at 102.5 is the ghost, and the source is missed."""
    rows = [_truth(100.0), _truth(104.0, ghost_of="r2.top")]
    summary = evaluate(
        [("r1.front", 0)], rows, {"r1.front": CALIBRATION}, {"robust": [_detection(102.5)]}
    ).summary
    assert summary["estimators"]["robust"]["ghosts_reported"] == 1
    assert summary["estimators"]["robust"]["recall"] == 0.0


def test_truth_reads_back_as_it_was_written() -> None:
    assert parse_truth(_truth(100.0).record()) == _truth(100.0)
    ghost = _truth(100.0, ghost_of="r2.top")
    assert parse_truth(ghost.record()) == ghost
    assert ghost.record()["ghost_of"] == "r2.top"
    amplified = _truth(100.0, gain=16.0, dark_e=45.7, flare_share=0.9)
    assert parse_truth(amplified.record()) == amplified


def test_truth_without_gain_and_dark_current_reads_as_of_a_cold_camera_at_gain_1() -> None:
    record = _truth(100.0, gain=16.0, dark_e=45.7, flare_share=0.9).record()
    del record["gain"], record["dark_e"], record["flare_share"]
    assert parse_truth(record) == _truth(100.0, gain=1.0, dark_e=0.0, flare_share=1.0)


def test_what_is_found_on_a_lamp_is_counted_apart() -> None:
    """A lamp's outline from 390 to 410 px: the detection at 400 is on it, one 7 px beside it is not."""
    lamp = LampTruth("r1.front", 0, "lamps.one", ((390, 90), (410, 90), (410, 110), (390, 110)))
    found = [_detection(100.0), _detection(400.0), _detection(417.0)]
    result = evaluate(
        [("r1.front", 0)],
        [_truth(100.0)],
        {"r1.front": CALIBRATION},
        {"robust": found},
        [lamp],
    )
    robust = result.summary["estimators"]["robust"]
    assert (robust["lamps_reported"], robust["false_alarms_per_frame"], robust["recall"]) == (1, 1.0, 1.0)
