"""Scores of tracks: against TrackEval's figures, and cases that can be reckoned in the head."""

import math
from dataclasses import astuple

import numpy as np
import pytest

from nir_render.evaluate.track_metrics import Instant, gospa_m, track_scores
from tests.track_eval import sequence

# TrackEval 1.0.0 (J. Luiten, MIT licence), as `python tests/track_eval.py` prints them: HOTA, DetA, AssA, IDF1,
# MOTA, switches, fragments, hits, misses, false alarms.
TRACK_EVAL = [
    (0.388729417392, 0.540535272618, 0.279981856366, 0.478873239437, 0.36231884058, 12, 14, 55, 14, 18),
    (0.54720492879, 0.665513166381, 0.450571434696, 0.606334841629, 0.62037037037, 14, 17, 97, 11, 16),
    (0.446210885389, 0.601486387924, 0.331155600818, 0.55938697318, 0.564285714286, 18, 29, 109, 31, 12),
    (0.414086889466, 0.673718389051, 0.255068856301, 0.448179271709, 0.645161290323, 27, 31, 159, 27, 12),
    (0.434247596457, 0.64765742037, 0.291471188745, 0.455205811138, 0.598173515982, 35, 34, 180, 39, 14),
    (0.267306987239, 0.583467420802, 0.12337642376, 0.291666666667, 0.357142857143, 15, 11, 57, 13, 17),
]


def _instants(raw: list[tuple[list[int], list[int], np.ndarray]]) -> list[Instant]:
    return [
        Instant(np.array(truth, dtype=np.int64), np.array(tracks, dtype=np.int64), similarity)
        for truth, tracks, similarity in raw
    ]


@pytest.mark.parametrize("seed", range(len(TRACK_EVAL)))
def test_scores_are_those_of_track_eval(seed: int) -> None:
    assert astuple(track_scores(_instants(sequence(seed)))) == pytest.approx(TRACK_EVAL[seed], abs=1e-10)


def _of(pairs: list[tuple[int, int]]) -> list[Instant]:
    """Return instants of one source and one track each, at one place."""
    return [Instant(np.array([a]), np.array([b]), np.ones((1, 1))) for a, b in pairs]


def test_one_switch_half_way_halves_the_association() -> None:
    scores = track_scores(_of([(0, 0)] * 10 + [(0, 1)] * 10))
    assert (scores.switches, scores.fragments, scores.mota) == (1, 0, 1.0 - 1.0 / 20)
    assert scores.detection_accuracy == 1.0
    assert scores.association_accuracy == pytest.approx(0.5)
    assert scores.hota == pytest.approx(math.sqrt(0.5))
    assert scores.idf1 == pytest.approx(0.5)


def test_a_gap_is_a_fragment() -> None:
    gap = [Instant(np.array([0]), np.array([9]), np.zeros((1, 1)))] * 5
    scores = track_scores([*_of([(0, 0)] * 10), *gap, *_of([(0, 0)] * 5)])
    assert (scores.switches, scores.fragments, scores.misses, scores.false_alarms) == (0, 1, 5, 5)
    assert scores.idf1 == pytest.approx(2 * 15 / (20 + 20))


def test_nothing_to_score_has_no_scores() -> None:
    nothing = Instant(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 0)))
    scores = track_scores([nothing])
    assert math.isnan(scores.hota)
    assert math.isnan(scores.mota)
    assert track_scores([]).hits == 0


def test_an_identity_that_stands_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="twice"):
        track_scores([Instant(np.array([0, 0]), np.array([1]), np.ones((2, 1)))])


def test_gospa_by_hand() -> None:
    # 0.3 m and 0.4 m apart, and one alone: √(0.09 + 0.16 + 1/2).
    apart_m = np.array([[0.3, 5.0], [5.0, 0.4], [5.0, 5.0]])
    assert gospa_m(apart_m) == pytest.approx(math.sqrt(0.75))
    # What is beyond the cut-off is two alone.
    assert gospa_m(np.array([[2.0]])) == pytest.approx(1.0)
    assert gospa_m(np.empty((0, 0))) == 0.0
