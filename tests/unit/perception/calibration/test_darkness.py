"""Black level and noise from frames that are mostly dark."""

import numpy as np
import pytest

from perception.calibration.dark import darkness


def _frames(level_dn: float, noise_dn: float, count: int, pattern_dn: float = 0.0) -> list[np.ndarray]:
    """Frames with rounding, a pattern that stays, and 2 % of bright pixels that move."""
    rng = np.random.default_rng(5)
    fixed = rng.normal(0.0, pattern_dn, (200, 300))
    frames = []
    for _ in range(count):
        counts = rng.normal(level_dn, noise_dn, (200, 300)) + fixed
        counts[rng.random(counts.shape) < 0.02] += 500.0
        frames.append(counts.round().clip(0).astype(np.uint16))
    return frames


@pytest.mark.parametrize(("level_dn", "noise_dn"), [(64.0, 7.0), (64.25, 0.6), (10.0, 2.0)])
def test_level_and_noise_are_found(level_dn: float, noise_dn: float) -> None:
    """60 000 pixels: the level is known to 0.03 DN; cutting at 3 σ takes 1.4 % of the noise."""
    dark = darkness(_frames(level_dn, noise_dn, 4))
    assert dark.level_dn == pytest.approx(level_dn, abs=0.05)
    assert dark.noise_dn == pytest.approx(noise_dn, rel=0.03)
    assert 0.3 <= dark.level_sigma_dn < 0.35


def test_a_pattern_that_stays_is_no_noise() -> None:
    assert darkness(_frames(64.0, 3.0, 3, pattern_dn=4.0)).noise_dn == pytest.approx(3.0, rel=0.05)
    assert darkness(_frames(64.0, 3.0, 1, pattern_dn=4.0)).noise_dn == pytest.approx(5.0, rel=0.05)


def test_what_is_clipped_at_black_shows_no_noise() -> None:
    assert darkness(_frames(-20.0, 3.0, 3)).noise_dn == 0.0
