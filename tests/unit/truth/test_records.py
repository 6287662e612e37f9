"""The records of truth: what a line may leave out, and what is said of one that is wrong."""

import json
import math
from typing import Any

import pytest

from nir_render.truth.lamps import LampTruth, parse_lamp
from nir_render.truth.sources import parse_truth

LEAST: dict[str, Any] = {
    "format": 1, "camera": "r1.front", "index": 0, "time_s": 0.0, "source": "top", "robot": "r2",
    "u_px": 100.0, "v_px": 200.0, "range_m": 3.0, "bearing_body": [1.0, 0.0, 0.0],
}  # fmt: skip


def test_what_another_program_cannot_know_may_be_left_out() -> None:
    """Then a source counts as seen in full, lit and bright, and has no limit."""
    truth = parse_truth(LEAST)
    assert (truth.visible_fraction, truth.on_fraction, truth.direct_e, truth.ghost_of) == (
        1.0,
        1.0,
        0.0,
        None,
    )
    assert truth.peak_snr == math.inf


def test_a_record_reads_as_it_was_written() -> None:
    truth = parse_truth({**LEAST, "saturated_px": 3, "ghost_of": "r2.top", "gain": 2.0, "peak_snr": 7.5})
    assert parse_truth(json.loads(json.dumps(truth.record()))) == truth
    lamp = LampTruth("r1.front", 3, "lamps.ceiling", ((1.0, 2.0), (3.0, 4.5), (0.0, 9.0)))
    assert parse_lamp(json.loads(json.dumps(lamp.record()))) == lamp


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"u_px": None}, "u_px is None; wanted a finite number"),
        ({"index": 1.5}, "index is 1.5; wanted a whole number"),
        ({"bearing_body": [1.0, 0.0]}, "bearing_body is .* wanted a list of three finite numbers"),
        ({"robot": 2}, "robot is 2; wanted a text"),
        ({"range_m": float("nan")}, "range_m is nan; wanted a finite number"),
        ({"range_m": -3.0}, "range_m is -3.0; wanted a number from 0 to 1e\\+09"),
        ({"visible_fraction": 5}, "visible_fraction is 5; wanted a number from 0 to 1"),
        ({"bearing_body": [0.0, 0.0, 0.0]}, "wanted a vector of length 1"),
        ({"format": 7}, "format is 7; this program reads format 1"),
        ({"rang_m": 2.0}, "there is no field 'rang_m'; known: camera, index"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_truth({**LEAST, **change})


def test_a_missing_field_is_named() -> None:
    with pytest.raises(ValueError, match="the field 'range_m' is missing"):
        parse_truth({name: value for name, value in LEAST.items() if name != "range_m"})


@pytest.mark.parametrize("corners", [[[0, 0], [1, 1]], [[0, 0], [1, 1], [2]], "box"])
def test_an_outline_is_a_polygon(corners: Any) -> None:
    with pytest.raises(ValueError, match="outline_px"):
        parse_lamp({"camera": "c", "index": 0, "lamp": "sun", "outline_px": corners})
