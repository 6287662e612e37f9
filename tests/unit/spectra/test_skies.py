"""The skies of CIE S 011: what they bring to planes, and the standard's own tables."""

import math

import numpy as np
import pytest

from nir_render.spectra.skies import cie_sky


def _directions(heights: int = 700, turns: int = 1400) -> tuple[np.ndarray, float]:
    """Return directions of equal solid angle over the upper half, and that angle."""
    height = (np.arange(heights) + 0.5) / heights
    turn = 2.0 * np.pi * (np.arange(turns) + 0.5) / turns
    flat = np.sqrt(1.0 - height**2)[:, None]
    grid = np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), height[:, None]), axis=-1)
    return grid, 2.0 * np.pi / (heights * turns)


@pytest.mark.parametrize("number", range(1, 16))
@pytest.mark.parametrize("elevation_deg", [3.0, 40.0, 90.0])
def test_each_sky_brings_one_watt_to_a_horizontal_plane(number: int, elevation_deg: float) -> None:
    up = math.radians(elevation_deg)
    sky = cie_sky(number, (math.cos(up) * 0.6, math.cos(up) * -0.8, math.sin(up)))
    grid, solid_angle_sr = _directions()
    radiance = sky.relative(grid) / np.pi
    assert radiance.min() >= 0.0
    assert float((radiance * grid[..., 2]).sum() * solid_angle_sr) == pytest.approx(1.0, rel=1e-4)
    assert sky.relative(np.array([0.6, 0.8, -1e-3])) == 0.0


def test_the_overcast_sky_is_three_times_as_bright_above_as_at_the_horizon() -> None:
    """Type 1 stands for Moon and Spencer's (1 + 2 sin γ)/3, within 0.06; type 5 is even."""
    overcast, even = cie_sky(1, (1.0, 0.0, 0.0)), cie_sky(5, (1.0, 0.0, 0.0))
    for height_deg in (5.0, 30.0, 60.0, 90.0):
        up = math.radians(height_deg)
        direction = np.array([0.0, math.cos(up), math.sin(up)])
        share = overcast.relative(direction) / overcast.relative(np.array([0.0, 0.0, 1.0]))
        assert share == pytest.approx((1.0 + 2.0 * math.sin(up)) / 3.0, abs=0.06)
        assert even.relative(direction) == pytest.approx(1.0, rel=1e-9)


def test_the_clear_sky_is_darkest_opposite_the_sun() -> None:
    """Type 12, sun at 60° from the zenith: L over zenith's by the standard's equations, worked by hand.

    f(χ) = 1 + 10 (e^(−3χ) − e^(−3π/2)) + 0.45 cos²χ; φ(Z) = 1 − e^(−0.32/cos Z). Zenith: χ = π/3, φ = 0.27385,
    f = 1.45481; towards the sun at Z = 60°: χ = 0, φ = 0.47271, f = 11.36017.
    """
    sky = cie_sky(12, (math.sin(math.pi / 3), 0.0, 0.5))
    zenith, sun = (
        sky.relative(np.array(one)) for one in ((0.0, 0.0, 1.0), (math.sin(math.pi / 3), 0.0, 0.5))
    )
    assert sun / zenith == pytest.approx(0.47271 * 11.36017 / (0.27385 * 1.45481), rel=1e-4)
    grid, _ = _directions(60, 120)
    values = sky.relative(grid)
    darkest = grid.reshape(-1, 3)[values.argmin()]
    assert darkest[0] < -0.3
