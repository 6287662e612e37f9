import numpy as np
import pytest

import perception
from perception.detection import detect_paper, detect_robust
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=120, height_px=100, cx_px=59.5, cy_px=49.5)
FRAME = expose(expected_e(CAMERA, [(60.3, 49.8, 2.0)], 2.4e-4, 1.0), CAMERA, random(71), 2.4e-4)


def test_names_choose_the_estimator() -> None:
    assert perception.detect(FRAME, CAMERA)[0].range_m == detect_robust(FRAME, CAMERA)[0].range_m
    paper = perception.detect(FRAME, CAMERA, "paper")[0]
    assert (paper.u_px, paper.range_m) == (
        detect_paper(FRAME, CAMERA)[0].u_px,
        detect_paper(FRAME, CAMERA)[0].range_m,
    )


def test_an_estimator_of_ones_own() -> None:
    hits = perception.detect(FRAME, CAMERA, lambda frame, camera: iter(detect_robust(frame, camera)))
    assert len(hits) == 1


def test_unknown_name() -> None:
    with pytest.raises(ValueError, match=r"'sound'.*paper, robust"):
        perception.detect(FRAME, CAMERA, "sound")


def test_inputs_are_left_as_they_were() -> None:
    before = FRAME.data_dn.copy()
    perception.detect(FRAME, CAMERA)
    perception.detect(FRAME, CAMERA, "paper")
    assert np.array_equal(before, FRAME.data_dn)


def test_public_face() -> None:
    assert all(hasattr(perception, name) for name in perception.__all__)
