import numpy as np
import pytest

from perception.background import background_mesh_e, spread_mesh
from tests.unit.perception.simulation import calibration, expose, random


@pytest.mark.parametrize("level_e", [0.0, 0.6, 40.0, 2000.0])
def test_flat_background(level_e: float) -> None:
    """Within 5 standard errors (with 3 σ clipping) of truth over 12 cells, also where Poisson is skewed."""
    camera = calibration(width_px=256, height_px=192, read_noise_e=2.0)
    frame = expose(np.full((192, 256), level_e), camera, random(21))
    mesh = background_mesh_e(frame, camera)
    assert mesh.shape == (3, 4)
    sigma = np.sqrt(level_e + 4.0 + 0.15)
    assert abs(mesh.mean() - level_e) < 5.0 * sigma / np.sqrt(12 * 1024) + 0.02 * sigma


def test_flares_do_not_lift_the_background() -> None:
    """Bright discs on a quarter of a cell move its level by less than 0.3 σ."""
    camera = calibration(width_px=320, height_px=320)
    mean = np.full((320, 320), 20.0)
    mean[140:172, 140:172] += 3000.0
    mesh = background_mesh_e(expose(mean, camera, random(22)), camera)
    assert abs(mesh[2, 2] - 20.0) < 0.3 * np.sqrt(120.0)


def test_a_ramp_stays_where_it_is() -> None:
    """A slope across the frame, 0.25 e per px: half a cell of shift would be 8 e."""
    camera = calibration(width_px=640, height_px=480, read_noise_e=3.0)
    mean = np.broadcast_to(50.0 + 0.25 * np.arange(640.0), (480, 640))
    full = spread_mesh(background_mesh_e(expose(mean, camera, random(23)), camera), camera)
    inner = np.s_[100:-100, 100:-100]
    assert np.abs((full - mean)[inner]).max() < 2.5
    assert abs((full - mean)[inner].mean()) < 0.2


@pytest.mark.parametrize(("width", "height"), [(1, 1), (5, 3), (100, 31), (65, 700)])
def test_any_size(width: int, height: int) -> None:
    camera = calibration(width_px=width, height_px=height)
    frame = expose(np.full((height, width), 10.0), camera, random(24))
    assert spread_mesh(background_mesh_e(frame, camera), camera).shape == (height, width)
