from typing import Any

import pytest

from nir_render.evaluate.estimator_errors import errors_of
from nir_render.report.verdicts import Verdict, verdicts_of
from tests.unit.report.cases import detection, score


def _verdicts(
    errors_m: list[float | None], false_alarms: float | None = 0.0, sigma_m: float = 0.01, **more: Any
) -> dict[str, Verdict]:
    """Judge an estimator on sources at 2, 3, … m with a limit of 1 cm; None: not found."""
    scores = [
        score(
            2.0 + i,
            {}
            if error is None
            else {"mine": detection(range_m=2.0 + i + error, range_sigma_m=sigma_m, **more)},
        )
        for i, error in enumerate(errors_m)
    ]
    judged = verdicts_of({"false_alarms_per_frame": false_alarms}, errors_of(scores, "mine"))
    return {verdict.about: verdict for verdict in judged}


@pytest.mark.parametrize(
    ("missed", "level", "value"),
    [(0, "good", "100 %"), (5, "fair", "95.0 %"), (6, "bad", "94.0 %")],
)
def test_recall(missed: int, level: str, value: str) -> None:
    found = _verdicts([0.0] * (100 - missed) + [None] * missed)["Recall"]
    assert (found.level, found.value) == (level, value)
    assert missed == 0 or "the nearest at " + f"{102 - missed:.1f} m" in found.sentence


@pytest.mark.parametrize(
    ("per_frame", "level", "said"),
    [
        (0.0, "good", "Reported nothing"),
        (0.01, "good", "One in 100 frames"),
        (0.02, "fair", "One in 50 frames"),
        (0.2, "bad", "One in 5 frames"),
        (2.0, "bad", "Reports things"),
    ],
)
def test_false_alarms(per_frame: float, level: str, said: str) -> None:
    found = _verdicts([0.0], per_frame)["False alarms"]
    assert found.level == level
    assert said in found.sentence


@pytest.mark.parametrize(
    ("error_m", "level", "said"),
    [
        (0.0100, "good", "At the limit: physics allows 1.00 cm (1.00 ×)"),
        (0.0129, "good", "1.29 × the limit"),
        (0.0131, "fair", "1.31 × the limit"),
        (0.0299, "fair", "2.99 × the limit"),
        (0.0301, "bad", "3.01 × the limit"),
    ],
)
def test_range_against_the_limit(error_m: float, level: str, said: str) -> None:
    """A thousand flares: chance allows no more than 1.044."""
    found = _verdicts([error_m, -error_m] * 500)["Range"]
    assert (found.level, said in found.sentence) == (level, True), found


def test_few_flares_may_exceed_the_limit_by_chance() -> None:
    """Two flares of equal limit: √(7.378 / 2) = 1.92."""
    assert _verdicts([0.0191, 0.0191])["Range"].level == "good"
    assert _verdicts([0.0193, 0.0193])["Range"].level == "fair"


@pytest.mark.parametrize(
    ("sigma_m", "level", "said"),
    [
        (0.01, "good", "off by as much"),
        (0.0092, "good", "off by as much"),
        (0.0089, "fair", "1.12 × too small"),
        (0.019, "fair", "1.90 × too large"),
        (0.0049, "bad", "2.04 × too small"),
        (float("nan"), "none", "Says nothing"),
    ],
)
def test_claims(sigma_m: float, level: str, said: str) -> None:
    """A thousand flares, errors of 1 cm."""
    found = _verdicts([0.01, -0.01] * 500, sigma_m=sigma_m)["Claimed σ"]
    assert (found.level, said in found.sentence) == (level, True), found


def test_nothing_there_and_nothing_found_are_no_praise() -> None:
    assert {about: found.level for about, found in _verdicts([], None).items()} == {
        "Recall": "none", "False alarms": "none", "Range": "none", "Bearing": "none", "Claimed σ": "none",
    }  # fmt: skip
    missed = _verdicts([None])
    assert (missed["Recall"].level, missed["Range"].level) == ("bad", "none")
    assert _verdicts([float("nan")])["Range"].sentence == "No source was ranged."
