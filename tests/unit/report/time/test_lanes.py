"""Lanes worked out by hand: errors, claims, switches, and the section on a page."""

import dataclasses

import numpy as np
import pytest

from nir_render.evaluate.metrics import evaluate
from nir_render.evaluate.tracks import TrackEvaluation, evaluate_tracks
from nir_render.report.style import BAD, FAINT, GOOD, TRUTH
from nir_render.report.time.blinks import blink_plot
from nir_render.report.time.film import film_gif, places_px
from nir_render.report.time.lanes import Lane, lanes_of, spans
from nir_render.report.time.section import Said, time_section
from nir_render.truth.sent import SentTruth
from perception.types import Message, Signal, Track
from tests.unit.report.cases import calibration, frame, truth

CAMERA = calibration()
KEYS = [("r1.front", k) for k in range(4)]


def _track(k: int, number: int, place_m: tuple[float, float, float]) -> Track:
    covariance = np.diag([0.04, 0.0009, 0.0016, 1.0, 1.0, 1.0])
    seen = (("r1.front", k, 0),) if k != 2 else ()
    return Track("r1", 0.1 * k, number, np.array(place_m), np.zeros(3), covariance, seen)


def _scored() -> TrackEvaluation:
    """A source stays 2 m ahead; track 7 follows it twice, then track 8 takes over."""
    rows = [truth(index=k, time_s=0.1 * k, on_fraction=0.0 if k == 2 else 1.0) for k in range(4)]
    sets = [("r1", 0.1 * k, [KEYS[k]]) for k in range(4)]
    tracks = [_track(0, 7, (2.1, 0.0, 0.0)), _track(1, 7, (2.0, 0.02, 0.0)),
              _track(2, 8, (1.9, 0.0, 0.0)), _track(3, 8, (2.0, 0.0, 0.0))]  # fmt: skip
    return evaluate_tracks(sets, rows, {"r1.front": CAMERA}, {"robust": tracks})


def _lane() -> Lane:
    (lane,) = lanes_of(_scored().moments, "r1", "robust")
    return lane


def test_errors_and_claims_by_hand() -> None:
    """σ along is √0.04 m; across √(0.0009 + 0.0016) = 0.05 m, at 2.1 m 1.3642°; 0.02 m beside 2 m is 0.5729°."""
    lane = _lane()
    assert lane.range_error_m == pytest.approx([0.1, np.hypot(2.0, 0.02) - 2.0, -0.1, 0.0], abs=1e-12)
    assert lane.bearing_error_deg == pytest.approx([0.0, 0.5729387, 0.0, 0.0], abs=1e-6)
    assert lane.range_sigma_m[0] == pytest.approx(0.2)
    assert lane.bearing_sigma_deg[0] == pytest.approx(np.degrees(0.05 / 2.1))


def test_who_followed_whom() -> None:
    """Dark for one instant it still counts; the take-over is in the third, where the track is a prediction."""
    lane = _lane()
    assert lane.track.tolist() == [7, 7, 8, 8]
    assert lane.switches() == [2]
    assert lane.counts.tolist() == [True] * 4
    assert lane.lit.tolist() == [True, True, False, True]
    assert lane.seen.tolist() == [True, True, False, True]


def test_spans_reach_to_the_next_instant() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.3])
    assert spans(time_s, np.array([True, False, True, True])) == [(0.0, 0.1), (0.2, pytest.approx(0.4))]
    assert spans(time_s, np.zeros(4, dtype=bool)) == []


def test_tracks_stand_where_the_lens_puts_them() -> None:
    """With body axes for camera axes, (0.1, −0.2, 2) is at 480 · 0.05 right and 480 · 0.1 above the centre."""
    (place,) = places_px([_track(0, 1, (0.1, -0.2, 2.0))], CAMERA)
    assert place == pytest.approx([159.5 + 24.0, 119.5 - 48.0])


@pytest.mark.parametrize(("wrong", "colour"), [(None, FAINT), ((), GOOD), ("all", BAD)])
def test_what_was_read_has_the_colour_of_its_verdict(wrong: object, colour: str) -> None:
    """What was sent is drawn also where the packet was not in view from beginning to end."""
    at = np.linspace(0.0, 6.0, 60)
    signal = Signal("r1", 7, at, np.full(60, 1e-3), np.ones(60), np.full(60, 0.05), np.full(60, 0.05))
    message = Message("r1", 7, 0.2, 5.7, 10, "aggregate", 0.9999, 5)
    sent = [SentTruth("r2", "top", 0.2, 5.7, 0, "stop")]
    lanes = lanes_of(_scored().moments, "r1", "robust")
    drawing = blink_plot([signal], [message], lanes, sent, [message] if wrong == "all" else wrong, "robust")  # type: ignore[arg-type]
    assert drawing is not None
    told = {shade for shade in (GOOD, BAD) if f"fill: {shade}" in drawing.svg}
    assert told == {colour} - {FAINT}
    assert f"fill: {TRUTH}" in drawing.svg


def test_the_section_has_all_its_plots_and_the_film_moves() -> None:
    few = _scored()
    scored = dataclasses.replace(few, moments=3 * few.moments)
    result = evaluate(KEYS, [], {"r1.front": CAMERA}, {"robust": []})
    summary = {**result.summary, "estimators": {"robust": {**scored.summary["robust"]}}}
    result = dataclasses.replace(result, summary=summary, over_time=scored)
    at = np.arange(4, dtype=np.float64) * 0.1
    signal = Signal("r1", 7, at, np.full(4, 1e-3), np.array([1.0, 1.0, 0.0, 1.0]), np.full(4, 0.05),
                    np.array([0.05, 0.05, 0.05, np.inf]))  # fmt: skip
    section = time_section(result, Said({"robust": [signal]}, {}))
    assert section is not None
    (view,) = section.views
    assert view.observer == "r1"
    assert view.above is not None
    assert view.lives is not None
    assert list(view.errors) == list(view.blinks) == ["robust"]
    assert section.tracks.rows[0][4] == "1"  # switches
    assert section.messages is None
    film = film_gif(KEYS, scored.moments, "robust", lambda key: frame(*key), {"r1.front": CAMERA})
    assert film is not None
    assert film.startswith(b"GIF")
    assert time_section(dataclasses.replace(result, over_time=None), Said()) is None
    assert (
        time_section(dataclasses.replace(result, over_time=few), Said()) is None
    )  # tracks have hardly begun
