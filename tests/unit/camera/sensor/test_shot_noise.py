"""Poisson and normal variates against their distributions: χ² tests that would see a fault of 1 %.

Power: of N draws, χ² has a non-centrality of N · Σ (p − q)²/p for probabilities q in place of p. A mean that is
off by 1 % brings N λ · 1e-4, a variance off by 1 % N/2 · 1e-4: with 2 million draws 100 and more, against
a standard deviation of χ² of √(2k), at most 35 with the k ≤ 600 classes here. The tests fail by chance with a
probability of 1e-4 each, and with fixed keys never.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from nir_render.camera.sensor.shot_noise import (
    EXPANSION_MEAN,
    large_poisson,
    normal,
    poisson,
    small_poisson,
    some_normal,
)
from nir_render.randomness import RandomKey

DRAWS = 2_000_000
BLOCK = 50_000
CHANCE = 1e-4


def drawn(mean_e: float, draws: int = DRAWS, seed: int = 1) -> NDArray[np.float64]:
    """Draw Poisson variates of one mean, in blocks as the sensor does."""
    key = RandomKey(seed, "test", "c", 0)
    mean = np.full(BLOCK, mean_e, dtype=np.float32)
    blocks = [
        poisson(
            mean,
            key.words("a", block, BLOCK),
            key.words("b", block, BLOCK) if mean_e < EXPANSION_MEAN else None,
        )
        for block in range(draws // BLOCK)
    ]
    return np.concatenate(blocks).astype(np.float64)


def chi_square_chance(counts: NDArray[np.int64], probability: NDArray[np.float64]) -> float:
    """Return the chance of counts this unlikely; classes with fewer than 10 expected are put together."""
    expected = probability * counts.sum()
    keep = expected >= 10.0
    observed = np.append(counts[keep], counts[~keep].sum())
    wanted = np.append(expected[keep], max(expected[~keep].sum(), 1e-9))
    if wanted[-1] < 1.0:
        observed, wanted = observed[:-1], wanted[:-1] * observed[:-1].sum() / wanted[:-1].sum()
    statistic = float(((observed - wanted) ** 2 / wanted).sum())
    return float(stats.chi2.sf(statistic, len(wanted) - 1))


@pytest.mark.parametrize("mean_e", [0.0, 0.1, 1.0, 10.0, 15.9, 16.0, 40.0, 5000.0])
def test_poisson_variates_are_poisson(mean_e: float) -> None:
    """Each count as often as it should be; mean and variance within 4 standard errors."""
    counts = drawn(mean_e)
    assert np.array_equal(counts, np.rint(counts))
    assert counts.min() >= 0.0
    if mean_e == 0.0:
        assert not counts.any()
        return
    error = np.sqrt(mean_e / DRAWS)
    assert counts.mean() == pytest.approx(mean_e, abs=4.0 * error)
    assert counts.var() == pytest.approx(mean_e, rel=4.0 * np.sqrt((2.0 + 1.0 / mean_e) / DRAWS))
    bins = np.bincount(counts.astype(np.int64))
    assert chi_square_chance(bins, stats.poisson.pmf(np.arange(len(bins)), mean_e)) > CHANCE


@pytest.mark.parametrize("mean_e", [1.0, 10.0, 40.0])
def test_the_chi_square_test_sees_a_fault_of_one_percent(mean_e: float) -> None:
    """Its power: against a mean that is 1 % off, the chance falls below that of failing."""
    bins = np.bincount(drawn(mean_e).astype(np.int64))
    assert chi_square_chance(bins, stats.poisson.pmf(np.arange(len(bins)), 1.01 * mean_e)) < CHANCE


def test_large_means_keep_mean_and_variance() -> None:
    """At 100 000 e a float32 count has steps of 1/128: mean and variance still hold within 4 standard errors."""
    counts = drawn(1e5)
    assert counts.mean() == pytest.approx(1e5, abs=4.0 * np.sqrt(1e5 / DRAWS))
    assert counts.var() == pytest.approx(1e5, rel=4.0 * np.sqrt(2.0 / DRAWS))


def test_rare_counts_are_as_rare_as_they_should_be() -> None:
    """Of 20 million pixels of 0.1 e, 5 e or more are expected 1.5 times, never dozens: no false bright pixels."""
    counts = drawn(0.1, draws=20_000_000)
    expected = stats.poisson.sf(4, 0.1) * counts.size
    assert (counts >= 5).sum() <= stats.poisson.ppf(1.0 - CHANCE, expected)
    assert (counts >= 3).sum() == pytest.approx(stats.poisson.sf(2, 0.1) * counts.size, rel=0.08)


def test_a_mixed_block_draws_each_pixel_by_its_own_mean() -> None:
    """Dark and bright pixels in turn: the sums of each kind are those of their means."""
    key = RandomKey(3, "test", "c", 0)
    mean = np.tile(np.array([0.5, 3.0, 15.9, 16.1, 2000.0], dtype=np.float32), 20_000)
    counts = poisson(mean, key.words("a", 0, mean.size), key.words("b", 0, mean.size)).reshape(-1, 5)
    np.testing.assert_allclose(counts.mean(axis=0), mean[:5], atol=1e-12, rtol=0.04)
    assert (np.abs(counts.mean(axis=0) - mean[:5]) < 4.0 * np.sqrt(mean[:5] / 20_000)).all()


def test_normal_variates_are_normal() -> None:
    """200 classes of equal probability and the tails beyond 4 σ."""
    key = RandomKey(1, "test", "c", 0)
    z = np.concatenate([normal(key.words("n", block, BLOCK)) for block in range(DRAWS // BLOCK)]).astype(
        float
    )
    classes = np.bincount((stats.norm.cdf(z) * 200).astype(np.int64), minlength=200)
    assert chi_square_chance(classes, np.full(200, 1 / 200)) > CHANCE
    assert (np.abs(z) > 4.0).sum() == pytest.approx(
        2.0 * stats.norm.sf(4.0) * DRAWS, abs=4.0 * np.sqrt(127.0)
    )
    assert np.abs(z).max() < 6.8
    # The two halves of Box and Muller's pairs know nothing of each other.
    first, second = z.reshape(-1, 2, BLOCK // 2).swapaxes(0, 1).reshape(2, -1)
    assert abs(np.corrcoef(first, second)[0, 1]) < 4.0 / np.sqrt(DRAWS / 2)
    assert abs(np.corrcoef(first**2, second**2)[0, 1]) < 4.0 / np.sqrt(DRAWS / 2)


@pytest.mark.parametrize("mean_e", [16.0, 25.0, 300.0, 20_000.0])
def test_the_expansion_is_the_quantile(mean_e: float) -> None:
    """Of 200 000 quantiles as many as float32 and the expansion's error allow differ from the exact ones: at 16 e
    2e-5 of them, at 20 000 e the rounding to 1/512 of a count. A constant of 1/3 that is 1 % off moves 0.3 %.
    """
    probability = (np.arange(200_000) + 0.5) / 200_000
    z = stats.norm.ppf(probability)
    drawn = large_poisson(np.full(z.shape, mean_e, dtype=np.float32), z.astype(np.float32))
    wrong = drawn != stats.poisson.ppf(probability, mean_e)
    assert np.abs(drawn - stats.poisson.ppf(probability, mean_e)).max() <= 1.0
    assert wrong.mean() < 1e-4 + 2.0**-23 * mean_e


def test_small_means_by_adding_up_probabilities() -> None:
    """By hand: at mean 1, the first 36.79 % of the words give 0, up to 73.58 % 1, up to 91.97 % 2."""
    words = np.array([0.3678, 0.3680, 0.7357, 0.7359, 0.9196, 0.9198, 0.999999999]) * 2.0**32
    counts = small_poisson(np.ones(len(words), dtype=np.float32), words.astype(np.uint32))
    assert counts.tolist() == [0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 11.0]


@pytest.mark.parametrize("mean_e", [0.004, 0.1, 0.9, 3.0, 9.0, 15.99])
def test_small_counts_are_the_exact_quantiles(mean_e: float) -> None:
    """Beside scipy's quantiles of 400 000 words: float32 misplaces 1e-6 of the probability at each count, of
    which 2 λ + 3 matter, and none of the first 400, set into the uppermost 2⁻¹². Were the dark pixels' share
    skipped 1e-4 too far, 40 would move.
    """
    words = RandomKey(1, "test", "c", 0).words("few", 0, 400_000)
    words[:400] = np.uint32(2**32 - 1) - np.arange(400, dtype=np.uint32) * np.uint32(2000)
    counts = small_poisson(np.full(len(words), mean_e, dtype=np.float32), words)
    wanted = stats.poisson.ppf((words + 0.5) * 2.0**-32, float(np.float32(mean_e)))
    assert np.abs(counts - wanted).max() <= 1.0
    assert (counts != wanted).sum() <= 1e-6 * len(words) * (2.0 * mean_e + 3.0)
    np.testing.assert_array_equal(counts[:400], wanted[:400])


def test_what_a_block_needs_not_is_not_asked_for() -> None:
    """Dark pixels alone need no words for bright ones, and the other way round: the same counts."""
    key, count = RandomKey(2, "test", "c", 0), 1000
    large, small = key.words("a", 0, count), key.words("b", 0, count)
    for mean_e, needed in ((3.0, (None, small)), (300.0, (large, None))):
        mean = np.full(count, mean_e, dtype=np.float32)
        np.testing.assert_array_equal(poisson(mean, *needed), poisson(mean, large, small))


def test_normal_variates_at_some_places_are_those_of_all() -> None:
    """To the bit, from both halves of the pairs; an odd number of pixels too, whose last word is of no pixel."""
    words = RandomKey(1, "test", "c", 0).words("n", 0, 1000)
    for places in (
        np.arange(0, 999, 7),
        np.array([3, 499]),
        np.array([500, 998]),
        np.array([], dtype=np.int64),
    ):
        np.testing.assert_array_equal(some_normal(words, places), normal(words)[places])


@pytest.mark.parametrize("share", [0.01, 0.6])
def test_few_bright_pixels_are_drawn_as_many_are(share: float) -> None:
    """A pixel's electrons do not depend on how many others of its block are bright."""
    key, count = RandomKey(2, "test", "c", 0), 10_001
    bright = np.random.default_rng(1).random(count) < share
    mean = np.where(bright, 300.0, 2.0).astype(np.float32)
    large, small = key.words("a", 0, count + 1), key.words("b", 0, count)
    drawn = poisson(mean, large, small)
    np.testing.assert_array_equal(drawn[bright], large_poisson(mean, normal(large)[:count])[bright])
    np.testing.assert_array_equal(drawn[~bright], small_poisson(np.full_like(mean, 2.0), small)[~bright])
