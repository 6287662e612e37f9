"""The comparison of renders: its rate of false alarms, and what it sees."""

import numpy as np
import pytest

from nir_render.compare import compare_batches
from nir_render.randomness import generator


def _render(seed: int, gain: float = 1.0, batches: int = 16) -> np.ndarray:
    """Sixteen noisy estimates of a bowl of light, 64 × 48, 10 % noise per pixel and batch."""
    rows, columns = np.mgrid[:48, :64]
    image = gain * (1.0 + ((rows - 24) / 24.0) ** 2 + ((columns - 32) / 32.0) ** 2)
    noise = generator(seed, "test", "compare", 0).standard_normal((batches, 48, 64))
    return np.asarray(image * (1.0 + 0.1 * noise))


def test_equal_renders_are_rarely_called_different() -> None:
    """400 pairs at a significance of 5 %: Holm keeps false alarms at or below 5 %, here at most 35 (3 σ)."""
    verdicts = [
        compare_batches(_render(2 * i), _render(2 * i + 1), significance=0.05).same for i in range(400)
    ]
    alarms = len(verdicts) - sum(verdicts)
    assert alarms <= 35
    assert alarms >= 4  # and it is no test that never fires: an uncorrected frame alone would give about 20


def test_one_percent_of_gain_is_seen_every_time() -> None:
    results = [compare_batches(_render(2 * i, gain=1.01), _render(2 * i + 1)) for i in range(50)]
    assert not any(result.same for result in results)
    assert np.mean([result.frame_ratio for result in results]) == pytest.approx(1.01, abs=0.0005)


def test_a_fault_in_one_tile_is_seen() -> None:
    """Ten per cent more light in one tile of twelve: 0.8 % of the frame, plain in its tile."""
    faulty = _render(1)
    faulty[:, 16:32, 16:32] *= 1.10
    assert not compare_batches(faulty, _render(2)).same


def test_the_drift_that_could_have_been_seen() -> None:
    """Frame: 3 · √2 · 0.1 / √(16 · 48 · 64) ≈ 0.19 %, a little more for the bowl's uneven brightness."""
    result = compare_batches(_render(1), _render(2))
    assert result.frame_drift == pytest.approx(3 * np.sqrt(2) * 0.1 / np.sqrt(16 * 48 * 64), rel=0.3)
    assert result.tile_drift == pytest.approx(3 * np.sqrt(2) * 0.1 / np.sqrt(16 * 256), rel=0.3)


def test_images_without_noise_must_agree() -> None:
    flat = np.ones((4, 32, 32))
    assert compare_batches(flat, flat.copy()).same
    assert not compare_batches(flat, 1.001 * flat).same
