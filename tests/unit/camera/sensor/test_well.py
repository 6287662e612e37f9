"""Blooming, clipping, the soft non-linearity: charge by hand."""

import numpy as np
import pytest

from nir_render.camera.sensor.well import bloom_into, read_from_well
from tests.unit.camera.conftest import CameraMaker


def test_charge_beyond_the_full_well_spills_up_and_down_its_column() -> None:
    """A well of 100 e with 500 e, share 1: 200 e up and 200 e down fill two neighbours on each side."""
    charge = np.zeros((9, 3), dtype=np.float32)
    charge[4, 1] = 500.0
    charge[6, 1] = 30.0
    bloom_into(charge, 100.0, 1.0)
    assert charge[:, 1].tolist() == [0.0, 0.0, 100.0, 100.0, 500.0, 100.0, 100.0, 30.0, 0.0]
    assert not charge[:, [0, 2]].any()


def test_what_does_not_spill_drains() -> None:
    """With a share of 25 %, 50 e go up and 50 e down; at the edge what leaves the sensor is lost."""
    charge = np.zeros((3, 1), dtype=np.float32)
    charge[0, 0] = 500.0
    bloom_into(charge, 100.0, 0.25)
    assert charge[:, 0].tolist() == [500.0, 50.0, 0.0]


def test_two_full_wells_side_by_side_share_the_room_beyond() -> None:
    """Two wells of 300 e in a column: the 400 e beyond full lie above and below them, 200 e each."""
    charge = np.zeros((10, 1), dtype=np.float32)
    charge[4:6, 0] = 300.0
    bloom_into(charge, 100.0, 1.0)
    assert charge[:, 0].tolist() == [0.0, 0.0, 100.0, 100.0, 300.0, 300.0, 100.0, 100.0, 0.0, 0.0]


def test_a_well_clips_and_bends(camera_with: CameraMaker) -> None:
    """q (1 − 0.05 (q / 4000)⁴): 2000 e are read as 2000 · (1 − 0.05/16) = 1993.75, a full well as 3800."""
    bent = {"full_well": "4000 e", "nonlinearity": {"loss": "5 %", "exponent": 4}, "system_gain": "1 DN/e"}
    sensor = camera_with(sensor=bent).sensor
    read_e = read_from_well(np.array([0.0, 2000.0, 4000.0, 9000.0], dtype=np.float32), sensor)
    np.testing.assert_allclose(read_e, [0.0, 1993.75, 3800.0, 3800.0], rtol=1e-6)
    assert sensor.read_e(2000.0) == pytest.approx(1993.75, rel=1e-12)
