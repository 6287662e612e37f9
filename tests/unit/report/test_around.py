"""Headings in the picture around a robot: they point where they should, and odds stand where there are several."""

import math
from dataclasses import replace

import numpy as np

from nir_render.evaluate.headings import heading_numbers
from nir_render.evaluate.sets import SetEvaluation, SetScore, Stand
from nir_render.report.around import _page, around_section
from perception.types import PoseHypothesis, RobotPose
from tests.unit.report.cases import truth

NUMBERS = {
    "set_recall": 1.0, "set_split": 0, "set_false_alarms_per_set": 0.0, "set_ghosts_told": 0,
    "set_ghosts_visible": 0, "set_robots_called_ghosts": 0, "set_position_rmse_m": 0.01, "set_range_rmse_m": 0.01,
    "set_nees": 1.0,
}  # fmt: skip


def _around(*odds: float) -> SetEvaluation:
    covariance = np.diag([1e-4, 1e-4, 1e-4, math.radians(2.0) ** 2])
    hypotheses = tuple(
        PoseHypothesis(share, (2.0, 0.0, 0.0), 0.5 + math.pi * k, covariance, (0, 1))
        for k, share in enumerate(odds)
    )
    told = RobotPose("r1", 0.0, "two", (("r1.front", 0, 0), ("r1.front", 0, 1)), 1.0, hypotheses)
    stands = (Stand(0, told, (np.array([2.0, 0.0, 0.0]), 0.5 + math.radians(1.0)), False),)
    score = SetScore(0, (truth(),), np.array([2.0, 0.0, 0.0]), True, {})
    return SetEvaluation(
        [[("r1.front", 0)]], (score,), {"robust": ()}, {"robust": {**NUMBERS, **heading_numbers(stands)}}, {},
        {"robust": stands},
    )  # fmt: skip


def test_ahead_is_up_the_page_and_left_is_left() -> None:
    assert _page((1.0, 0.0)) == (0.0, 1.0)
    assert _page((0.0, 1.0)) == (-1.0, 0.0)


def test_headings_have_a_table_and_odds_where_there_are_several() -> None:
    section = around_section(_around(0.7, 0.3))
    assert section is not None
    assert section.headings is not None
    assert section.headings.rows == [["robust", "1", "0", "1.00°", "0.06", "0", "0"]]
    assert section.picture is not None
    assert "70 %" in section.picture.svg
    assert "30 %" in section.picture.svg
    sure = around_section(_around(1.0))
    assert sure is not None
    assert sure.picture is not None
    assert "100 %" not in sure.picture.svg
    assert "robust: heading" in sure.picture.svg


def test_without_layouts_nothing_is_said_of_headings() -> None:
    plain = replace(_around(1.0), stands={}, summary={"robust": NUMBERS})
    section = around_section(plain)
    assert section is not None
    assert section.headings is None
    assert section.picture is not None
    assert "heading" not in section.picture.svg
