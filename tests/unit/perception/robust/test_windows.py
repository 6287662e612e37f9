"""Windows are wide enough: what the rest of a frame could tell of a flare beside its own window."""

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.robust.clusters import candidates, clusters
from perception.robust.search.blobs import blobs_at
from perception.robust.search.prepare import prepare
from tests.unit.perception.simulation import calibration, expected_e, expose, random

SIDE_PX = 161
CAMERA = calibration(
    width_px=SIDE_PX, height_px=SIDE_PX, cx_px=80.0, cy_px=80.0, bit_depth=16, saturation_dn=65535, sigma={}
)
PLACE = (80.3, 80.1)
BACKGROUND_E = 3.0


def _sigmas(range_m: float, exposure_s: float, side_px: int) -> NDArray[np.float64]:
    """Cramér–Rao sigmas of u, v and range, background free, of the middle of a frame; by differences."""
    at = np.array([*PLACE, range_m])
    middle = np.s_[80 - side_px // 2 : 81 + side_px // 2, 80 - side_px // 2 : 81 + side_px // 2]

    def image_e(values: NDArray[np.float64]) -> NDArray[np.float64]:
        u_px, v_px, distance_m = values.tolist()
        return expected_e(CAMERA, [(u_px, v_px, distance_m)], exposure_s)[middle].ravel()

    steps = np.diag([0.01, 0.01, 1e-3 * range_m])
    slopes = [(image_e(at + step) - image_e(at - step)) / (2.0 * step.sum()) for step in steps]
    jacobian = np.stack([*slopes, np.ones(side_px**2)])
    variance_e2 = image_e(at) + BACKGROUND_E + CAMERA.read_noise_e**2 + 1.0 / (12.0 * 0.74**2)
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv((jacobian / variance_e2) @ jacobian.T)))[:3])


@pytest.mark.parametrize(("range_m", "exposure_s"), [(0.5, 3e-5), (10.0, 1e-3)])
def test_a_window_tells_nearly_as_much_as_the_frame(range_m: float, exposure_s: float) -> None:
    """Near and far: to 5 % of the bound of 159 × 159 px, where the background's level is better known."""
    mean_e = expected_e(CAMERA, [(*PLACE, range_m)], exposure_s, BACKGROUND_E)
    prepared = prepare(expose(mean_e, CAMERA, random(81), exposure_s), CAMERA)
    (cluster,) = clusters(candidates(blobs_at(prepared.lit_at, prepared.lit_e, SIDE_PX), prepared), prepared)
    of_window = _sigmas(range_m, exposure_s, cluster.window.box.height)
    assert (of_window / _sigmas(range_m, exposure_s, 159)).max() < 1.05
