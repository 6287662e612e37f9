"""Spacing error: by hand."""

import numpy as np
import pytest

from nir_render.experiments.flocking.spacing import spacing

TIMES_S = np.arange(0.0, 100.0, 10.0)  # the last minute: 40 to 90 s


def _constant(value_m: float) -> np.ndarray:
    return np.full(len(TIMES_S), value_m)


def test_only_neighbours_in_the_last_minute_count() -> None:
    swinging = np.asarray(1.1 + 0.02 * (-1.0) ** np.arange(10))  # six of them count, as many up as down
    early = _constant(0.97)
    early[0] = 0.3
    found = spacing(TIMES_S, {("a", "b"): swinging, ("b", "c"): early, ("a", "c"): _constant(1.9)}, 1.0, 0.2)
    assert found.error_m == pytest.approx(0.5 * (0.1 + 0.03))
    assert found.bias_m == pytest.approx(0.5 * (0.1 - 0.03))
    assert found.spread_m == pytest.approx(1.1 - 0.97)
    assert found.worst_m == pytest.approx(0.12)
    assert found.all_pairs_m == pytest.approx((1.1 + 0.97 + 1.9) / 3.0)
    assert found.nearest_m == pytest.approx(0.3)
    assert found.valid


def test_a_flock_in_two_parts_says_nothing() -> None:
    pairs = {
        ("a", "b"): 1.0,
        ("c", "d"): 1.0,
        ("a", "c"): 3.0,
        ("a", "d"): 3.0,
        ("b", "c"): 3.0,
        ("b", "d"): 3.0,
    }
    found = spacing(TIMES_S, {pair: _constant(d_m) for pair, d_m in pairs.items()}, 1.0, 0.2)
    assert not found.joined
    assert not found.valid


def test_bodies_that_touch_at_any_time_spoil_a_run() -> None:
    close = _constant(1.0)
    close[1] = 0.19
    assert spacing(TIMES_S, {("a", "b"): close}, 1.0, 0.2).touched
    assert not spacing(TIMES_S, {("a", "b"): close}, 1.0, 0.18).touched


def test_nobody_near_is_no_number() -> None:
    assert np.isnan(spacing(TIMES_S, {("a", "b"): _constant(2.0)}, 1.0, 0.2).error_m)
