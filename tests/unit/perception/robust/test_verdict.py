"""What is no source: how much is seen of a flare beside what a window leaves out."""

import math

import numpy as np
import pytest

from perception.model.layout import SEEN, UNUSABLE
from perception.robust.verdict import _seen
from tests.unit.perception.simulation import random


@pytest.mark.parametrize("key", range(6))
def test_what_is_seen_of_a_flare_leaves_out_columns_that_are_spilled_on_whole(key: int) -> None:
    """Share and centroid of a Gaussian over usable pixels, against sums by NumPy; columns and rows differ in all."""
    number = random(24, key)
    state = np.where(number.random((21, 25)) < 0.7, SEEN, UNUSABLE).astype(np.uint8)
    state[:, number.integers(0, 25, 4)] = UNUSABLE
    left, top, shape = 60, 3, (40, 80)  # columns from 80 on lie beyond the frame
    place, width_px = (60.0 + 24.0 * number.random(), 3.0 + 20.0 * number.random()), 1.5
    rows, columns = np.mgrid[top : top + 21, left : left + 25]
    light = np.exp(-0.5 * ((columns - place[0]) ** 2 + (rows - place[1]) ** 2) / width_px**2)
    reach = math.ceil(3.0 * width_px)
    within = (abs(rows - round(place[1])) <= reach) & (abs(columns - round(place[0])) <= reach)
    within &= (columns < shape[1]) & (state != UNUSABLE).any(axis=0)
    whole, seen = within * light, within * light * (state != UNUSABLE)
    # What the window does not reach but the frame holds counts as well.
    beyond_rows, beyond_columns = np.mgrid[: shape[0], : shape[1]]
    beyond = (abs(beyond_rows - round(place[1])) <= reach) & (abs(beyond_columns - round(place[0])) <= reach)
    beyond[top : top + 21, left : left + 25] = False
    rest = beyond * np.exp(
        -0.5 * ((beyond_columns - place[0]) ** 2 + (beyond_rows - place[1]) ** 2) / width_px**2
    )
    total = whole.sum() + rest.sum()
    of_whole = [
        ((whole * here).sum() + (rest * there).sum()) / total
        for here, there in ((columns, beyond_columns), (rows, beyond_rows))
    ]
    of_seen = [(seen * here).sum() / seen.sum() for here in (columns, rows)]
    share, off_px = _seen(state, (left, top), place, width_px, shape)
    assert share == pytest.approx(seen.sum() / total, rel=1e-12)
    assert off_px == pytest.approx(math.dist(of_seen, of_whole), rel=1e-9)
