"""The page of a calibration: figures with their σ, in places that the σ is worth, and what speaks against it."""

from dataclasses import replace

import numpy as np
import pytest

from nir_render.report.calibration.page import LearnedCamera, _with_sigma, calibration_html
from perception.calibration.camera import CalibratedCamera
from perception.extrinsics.calibrate import CameraPose, Extrinsics
from tests.unit.report.cases import calibration


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (64.00734, 0.00161, ("64.0073", "0.0016")),
        (9.7, 1.94, ("9.7", "1.9")),
        (412.3, 31.0, ("412", "31")),
        (9.0033212e8, 7.6e5, ("9.00332e+08", "7.6e+05")),
        (2.16364, 0.0, ("2.16364", "–")),
        (float("nan"), 1.0, ("–", "–")),
    ],
)
def test_a_value_has_two_places_of_its_sigma(value: float, sigma: float, shown: tuple[str, str]) -> None:
    assert _with_sigma(value, sigma) == shown


def test_the_page_names_what_was_learned_what_stayed_and_what_failed() -> None:
    """Black level of 64 ± 0.3 learned as 65 ± 0.4 has moved by 2 σ; a robot's name is no mark-up."""
    before = replace(calibration(), sigma={"black_level_dn": 0.3})
    camera = LearnedCamera(
        "r<b>.front", before, CalibratedCamera(before, None, None, None, None), ["K stays as it was"]
    )
    covariance = np.diag([1e-4, 2e-4, 3e-4, 1e-3, 2e-3, 3e-3]) ** 2
    pose = CameraPose("r1.left", 13, np.array([5e-3, 0.0, -1e-3]), np.zeros(3), covariance, True, False)
    page = calibration_html(
        cameras={camera: [("black_level_dn", 65.0, 0.4, 64.0)]},
        rigs={"r1": Extrinsics("r1.front", {}, (pose,), 26, 2, 0.8)},
        faults=["the line bends"],
        folder_name="dark & flat",
        files=["a b.json"],
    )
    for text in (
        "<td>65.00</td><td>0.40</td><td>64</td><td>+2.0</td>", "black level, DN", "K stays as it was.",
        "r&lt;b&gt;.front", "dark &amp; flat", "the line bends", "5.00 ± 0.10, 0.00 ± 0.20, -1.00 ± 0.30",
        "not told: as it was", "2 more do not agree", "a%20b.json",
    ):  # fmt: skip
        assert text in page
