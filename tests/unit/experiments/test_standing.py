"""The experiments in which nobody drives: a rail, a turntable."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.experiments.loop.shares import lower_limit
from nir_render.experiments.standing.rail import RAIL, Rail
from nir_render.experiments.standing.rail_outcome import (
    figures,
    held_out,
    ideal_mae_m,
    judged,
    outcome_of,
)
from nir_render.experiments.standing.rail_page import write_outcome
from nir_render.experiments.standing.turntable import TURNTABLE, Turntable
from nir_render.experiments.standing.turntable_page import outcome_of as turned
from nir_render.experiments.standing.turntable_page import spread_of
from nir_render.experiments.standing.turntable_page import write_outcome as write_turned


def _row(place: int, range_m: float, signal: float, said_m: float, lux: float = 500.0) -> dict[str, Any]:
    seen = {
        "paper": {"range_m": 1.0, "signal_dn_per_s": signal, "flux_dn_per_s": 1.0},
        "robust": {"range_m": said_m, "signal_dn_per_s": 1.0, "flux_dn_per_s": 1.0},
    }
    return {
        "place": place, "lux": lux, "range_m": range_m, "limit_m": 0.01 * range_m, "light_e_per_s": 1.0,
        "exposure_s": 1e-3, "seen": seen, "false_alarms": {"paper": 1, "robust": 0},
    }  # fmt: skip


def test_constants_are_fitted_at_every_other_place_and_judged_at_the_rest() -> None:
    """m = 3 / d², robust 2 % short: exact after the fit. Held places 1 % farther than said: 1 % of them off."""
    ranges_m = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    rows = [
        _row(place, range_m, 3.0 / range_m**2, 0.98 * range_m * (1.0 if place % 2 == 0 else 0.99))
        for place, range_m in enumerate(ranges_m)
    ]
    frames, intercept_sigmas = judged(rows, 1)
    assert [one.range_m for one in held_out(frames)] == [2.0, 4.0, 6.0]
    assert figures(frames, "paper")["mae_m"] == pytest.approx(0.0, abs=1e-6)
    assert abs(intercept_sigmas) < 10.0  # of rounding alone
    robust = figures(frames, "robust")
    assert robust["mae_m"] == pytest.approx(0.01 * 4.0)
    assert robust["bias_m"] == pytest.approx(-0.01 * 4.0)
    assert figures(frames, "paper")["false_alarms"] == 6
    assert ideal_mae_m(frames) == pytest.approx(math.sqrt(2.0 / math.pi) * 0.04)


def test_the_paper_s_line_takes_an_offset_for_an_intercept() -> None:
    """m = 3 / d² + 0.1: the slope is right, and ranges come out short, most where they are long."""
    rows = [
        _row(place, range_m, 3.0 / range_m**2 + 0.1 + 1e-6 * (-1) ** (place // 2), range_m)
        for place, range_m in enumerate([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    ]
    frames, intercept_sigmas = judged(rows, 1)
    assert frames[-1].said_m["paper"] == pytest.approx(math.sqrt(3.0 / (3.0 / 36.0 + 0.1)), rel=1e-4)
    assert intercept_sigmas > 100.0


def test_what_is_not_found_counts_and_frames_of_one_place_are_one_trial() -> None:
    """Of four places with three frames each one frame is missed; another has no range."""
    rows = [_row(place, 1.0 + place, 1.0 + 0.1 * k, 1.0 + place) for place in range(4) for k in range(3)]
    rows[9]["seen"]["robust"], rows[3]["seen"]["robust"]["range_m"] = None, math.nan
    frames, _ = judged(rows, 1)
    robust = figures(frames, "robust")
    assert (robust["found"], robust["frames"], robust["without_a_range"]) == (11, 12, 1)
    assert (robust["places_found"], robust["places"]) == (3, 4)
    assert robust["places_lower_95"] == pytest.approx(0.2486, abs=1e-4)  # 4 p³ (1 − p) + p⁴ = 0.05
    assert lower_limit(1499, 1500) > 0.996  # 0.05 = Σ of binomial tails
    assert lower_limit(300, 300) == pytest.approx(0.05 ** (1.0 / 300.0))


def test_how_much_an_intensity_varies() -> None:
    assert spread_of(np.array([0.8, 1.0, np.nan, 0.4])) == pytest.approx((0.6, 0.6 / 1.4))


@pytest.mark.mitsuba
def test_the_turntable_shows_the_pattern(tmp_path: Path) -> None:
    """At 0 and ±85°: what the goniometer measured of both sources, 0.91385 / 0.98438 and 0.087226."""
    outcome = turned(
        load_scene(TURNTABLE), Turntable(step_deg=85.0, frames=1), range(1), tmp_path, 1, lambda *_: None
    )
    light = outcome.intensity["diffused"]["light"]
    assert light[[0, 2]] / light[1] == pytest.approx([0.91385 / 0.98438] * 2, rel=2e-3)  # discs seen from 1 m
    bare = outcome.intensity["bare"]["light"]
    assert bare[[0, 2]] / bare[1] == pytest.approx([0.087226] * 2, rel=2e-3)
    assert outcome.found["diffused"]["robust"] == (3, 3)
    assert "the bare source varies by 91.3 %" in write_turned(outcome, tmp_path).read_text()


@pytest.mark.verify
@pytest.mark.mitsuba
def test_ranges_along_the_rail_are_at_their_limit(tmp_path: Path) -> None:
    """Eight places, two levels: robust finds it in all frames, at the limit's MAE within its scatter, paper far off."""
    plan = Rail(places=8, frames=4, levels_lx=(300.0, 800.0))
    outcome = outcome_of(load_scene(RAIL), plan, range(1), tmp_path, 1, lambda *_: None)
    record = outcome.record()
    assert record["frames_held_out"] == 32
    robust = record["stacks"]["robust"]
    assert (robust["found"], robust["places_found"], robust["without_a_range"]) == (64, 8, 0)
    assert robust["false_alarms"] == 0
    assert record["stacks"]["paper"]["found"] < 64  # by its tests of area and aspect
    # Of 32 errors, and a constant fitted on 16: the MAE of an ideal estimator scatters by 0.75 / √32 + common.
    assert robust["mae_m"] < 1.5 * record["ideal_mae_m"]
    assert record["stacks"]["paper"]["mae_m"] > 0.3
    assert "Mean absolute error" in write_outcome(outcome, tmp_path).read_text()
