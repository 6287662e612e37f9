"""The comparison of renders: its rate of false alarms, and what it sees."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats

from nir_render.randomness import generator
from nir_render.regress.statistics import (
    TILE_PX,
    MonteCarloImage,
    PathComparison,
    compare_parts,
    compare_paths,
    judge,
    tile_sums,
)
from tests.statistics import compare_batches

Array = NDArray[np.float64]


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


LIT = 0.05  # of samples of the heavy-tailed renders bring light


def _heavy(seed: int, renders: int, samples: int, lit: float = LIT, tail: float = 1.0) -> MonteCarloImage:
    """Renders of 48 × 64 pixels whose samples are mostly nothing, and log-normal where they are something."""
    mean, variance = _heavy_stack(seed, renders, samples, lit, tail)
    return MonteCarloImage(mean.mean(axis=0), variance.mean(axis=0) / renders, renders * samples)


def _heavy_stack(seed: int, renders: int, samples: int, lit: float, tail: float) -> tuple[Array, Array]:
    draw = generator(seed, "test", "heavy", 0)
    batch = samples // 8
    count = draw.poisson(lit * batch, (renders, 8, 48, 64))
    values = draw.lognormal(-0.5 * tail**2, tail, count.sum())
    place = np.repeat(np.arange(count.size), count.ravel())
    batches = np.bincount(place, values, count.size).reshape(count.shape) / batch
    return batches.mean(axis=1), batches.var(axis=1, ddof=1) / 8


def _third(seed: int, renders: int, samples: int, lit: float, tail: float) -> Array:
    """Third cumulant of one sample, summed over tiles."""
    mean, _ = _heavy_stack(seed, renders, samples, lit, tail)
    return tile_sums(np.asarray(stats.kstat(mean, 3, axis=0)), TILE_PX) * samples**2


@pytest.mark.parametrize(("lit", "tail"), [(0.05, 1.0), (0.01, 1.2), (0.002, 1.0)])
def test_heavy_tails_raise_no_more_false_alarms_than_stated(lit: float, tail: float) -> None:
    """200 renders against 10 references, at 5 %: at most 10 + 3 σ; and the tail at 1e-3 is that of p-values."""
    alarms, p = 0, []
    for i in range(200):
        if i % 20 == 0:
            reference, third = _heavy(-i, 16, 64, lit, tail), _third(-i, 16, 64, lit, tail)
        parts = compare_parts(reference, _heavy(i + 1, 1, 64, lit, tail), third)
        p.append(parts.p[parts.judged])
        alarms += not judge([parts], 0.05)[0].same
    assert alarms <= 10 + 3 * np.sqrt(10 * 0.95)
    every = np.concatenate(p)
    # Tiles of 8, of 16 and the frame overlap: three times Poisson's variance at most.
    expected = 1e-3 * every.size
    assert (every < 1e-3).sum() <= expected + 3 * np.sqrt(3 * expected)


def test_a_normal_tail_would_raise_false_alarms() -> None:
    """So the skewness is needed: without it the upper tail at 1e-4 is three times as heavy as it says, or more."""
    far = count = 0
    for i in range(200):
        if i % 20 == 0:
            reference = _heavy(-i, 16, 64, 0.01, 1.2)
        parts = compare_parts(reference, _heavy(i + 1, 1, 64, 0.01, 1.2))
        z = ((parts.after - parts.before) / parts.error)[parts.judged]
        far, count = far + int((z > stats.norm.isf(1e-4)).sum()), count + z.size
    assert far > 3 * 1e-4 * count


def test_few_samples_of_another_sampler_raise_no_more_false_alarms() -> None:
    """8 samples whose own variance is poorly known, and low where their mean is, against a good reference, at 5 %."""
    alarms = 0
    for i in range(200):
        if i % 20 == 0:
            reference, third = _heavy(-i, 16, 64), _third(-i, 16, 64, LIT, 1.0)
        parts = compare_parts(reference, _heavy(i + 1, 1, 8), third, alike=False)
        alarms += not judge([parts], 0.05)[0].same
    assert alarms <= 10 + 3 * np.sqrt(10 * 0.95)


def test_the_tail_is_that_of_a_shifted_gamma() -> None:
    """Of brighter parts p is twice the chance of a gamma of shape k = 4 / skewness², at k + √k z."""
    parts = compare_parts(_heavy(-1, 16, 64), _heavy(1, 1, 64), _third(-1, 16, 64, LIT, 1.0))
    z = (parts.after - parts.before) / parts.error
    brighter = parts.judged & (z > 0.0)
    assert brighter.sum() > 10
    shape = 4.0 / parts.skewness[brighter] ** 2
    tail = special.gammaincc(shape, shape + np.sqrt(shape) * z[brighter])
    assert parts.p[brighter] == pytest.approx(np.minimum(2.0 * tail, 1.0), rel=1e-9)


def _smooth(seed: int, samples: int, gain: Array | float = 1.0) -> MonteCarloImage:
    """An even image, its samples normal with a standard deviation of 1."""
    draw = generator(seed, "test", "smooth", 0).standard_normal((8, 48, 64)) * np.sqrt(8 / samples)
    batches = gain * (1.0 + draw)
    return MonteCarloImage(batches.mean(axis=0), batches.var(axis=0, ddof=1) / 8, samples)


def test_the_drift_that_would_have_been_seen_is_found_so_often() -> None:
    """Of 400 renders with the stated drift, the frame's test finds 95 %, and so does a tile's."""
    reference = _smooth(-1, 1024)
    clean = judge([compare_parts(reference, _smooth(-2, 64))], 1e-3)[0]
    tile = np.ones((48, 64))
    tile[16:24, 32:40] += clean.tile_drift
    place = 2 * 8 + 4
    found = np.zeros(2)
    for i in range(400):
        if i % 4 == 0:  # its own noise counts too
            reference = _smooth(-10 - i, 1024)
        whole = compare_parts(reference, _smooth(i, 64, 1.0 + clean.frame_drift))
        one = compare_parts(reference, _smooth(i, 64, tile))
        threshold = 1e-3 / whole.judged.sum()
        found += [whole.p[-1] < threshold, one.p[place] < threshold]
    assert found / 400 == pytest.approx(0.95, abs=0.035)
    assert clean.frame_drift == pytest.approx(6.0 / np.sqrt(64 * 48 * 64), rel=0.1)


def test_differences_of_equal_renders_are_of_their_stated_error() -> None:
    """In 400 pairs of 64 and 256 samples 48 tiles differ by 1.00 standard errors: 0.5 % is what chance allows."""
    pairs = [compare_parts(_smooth(-10 - i, 256), _smooth(i, 64)) for i in range(400)]
    z = np.array([((one.after - one.before) / one.error)[: one.tiles] for one in pairs])
    assert z.std() == pytest.approx(1.0, abs=0.012)


def test_the_skewness_is_the_measured_one_and_at_least_that_of_equal_samples() -> None:
    """Log-normal samples of tail t, of which a share is lit: κ₂ is lit · e^t² and κ₃ lit · e^3t², for one sample.

    The frame is a mean of N = 64 · 3072 samples, and differs from a reference of 16 times as many.
    """
    lit, tail, n = 0.3, 0.7, 64
    third = np.mean([_third(-i, 16, n, lit, tail) for i in range(8)], axis=0)
    reference, render = _heavy(-1, 16, n, lit, tail), _heavy(1, 1, n, lit, tail)
    count = n * 48 * 64
    variance = lit * np.exp(tail**2) / count * (1 + 1 / 16)
    cumulant = lit * np.exp(3 * tail**2) / count**2 * (1 - 1 / 256)
    measured = compare_parts(reference, render, third).skewness[-1]
    assert measured == pytest.approx(cumulant / variance**1.5, rel=0.1)
    least = compare_parts(reference, render).skewness[-1]
    assert least == pytest.approx(np.sqrt(variance) / lit, rel=0.02)
    assert measured > 1.4 * least


def test_it_says_where_and_how_much() -> None:
    gain = np.ones((48, 64))
    gain[24:32, 8:16] = 1.3
    verdict = judge([compare_parts(_smooth(-1, 1024), _smooth(1, 64, gain))], 1e-3)[0]
    assert not verdict.same
    assert verdict.part == (24, 32, 8, 16)
    assert verdict.change == pytest.approx(0.3, abs=0.06)
    assert verdict.frame_change == pytest.approx(0.3 * 64 / 3072, abs=0.008)


def test_what_no_tile_tells_is_over_the_frame() -> None:
    """Seven standard errors of the frame are two of a tile of 16."""
    brighter = _smooth(1, 64, 1.0 + 7.0 / np.sqrt(64 * 48 * 64))
    verdict = judge([compare_parts(_smooth(-1, 1024), brighter)], 1e-3)[0]
    assert not verdict.same
    assert verdict.part == (0, 48, 0, 64)


def test_noise_that_only_one_has_found_is_no_alarm_light_is() -> None:
    dark = MonteCarloImage(np.zeros((16, 16)), np.zeros((16, 16)), 1024)
    lone, lone_variance = np.zeros((16, 16)), np.zeros((16, 16))
    lone[3, 4], lone_variance[3, 4] = 1.0, 1.0
    assert judge([compare_parts(dark, MonteCarloImage(lone, lone_variance, 64))], 1e-3)[0].same
    lit = MonteCarloImage(np.ones((16, 16)), np.full((16, 16), 0.01), 64)
    verdict = judge([compare_parts(dark, lit)], 1e-3)[0]
    assert not verdict.same
    assert verdict.change == np.inf


def test_light_without_noise_agrees_to_float32() -> None:
    lamp, none = np.full((16, 16), 3.0), np.zeros((16, 16))
    for change, same in ((1e-6, True), (1e-4, False)):
        parts = compare_parts(
            MonteCarloImage(lamp, none, 1024), MonteCarloImage(lamp * (1 + change), none, 64)
        )
        assert judge([parts], 1e-3)[0].same is same


def test_images_of_a_family_share_the_rate() -> None:
    """Twice as many images, half the threshold: what one image alone calls a drift, many do not."""
    reference, drifted = _smooth(-1, 1024), _smooth(3, 64, 1.0 + 4.6 / np.sqrt(64 * 48 * 64))
    alone = compare_parts(reference, drifted)
    others = [compare_parts(_smooth(-10 - i, 1024), _smooth(10 + i, 64)) for i in range(40)]
    one, many = judge([alone], 1e-3)[0], judge([alone, *others], 1e-3)[0]
    assert many.smallest_p > 20 * one.smallest_p
    assert many.frame_drift > 1.1 * one.frame_drift


def test_what_is_not_judged_takes_no_part_in_the_correction() -> None:
    """A dark image beside it costs a drift nothing."""
    drifted = compare_parts(_smooth(-1, 1024), _smooth(3, 64, 1.0 + 4.6 / np.sqrt(64 * 48 * 64)))
    none = np.zeros((480, 640))
    dark = compare_parts(MonteCarloImage(none, none, 1024), MonteCarloImage(none, none, 64))
    alone, beside = judge([drifted], 1e-3)[0], judge([drifted, dark], 1e-3)[0]
    assert beside.smallest_p == alone.smallest_p
    assert (alone.judged_tiles, alone.tiles) == (48, 48)
    assert judge([dark], 1e-3)[0].judged_tiles == 0


def _same_paths(seed: int, factor: float = 1.0, others: float = 0.02) -> PathComparison:
    """Two skewed renders of 96 × 128 pixels of the same paths, but for a share; the second darker in 40 × 8."""
    draw = generator(seed, "test", "same paths", 0)
    one = draw.lognormal(0.0, 1.0, (96, 128))
    other = np.where(draw.random(one.shape) < others, draw.lognormal(0.0, 1.0, one.shape), one)
    other *= 1.0 + 3e-5 * draw.uniform(0.5, 1.0, one.shape)  # sums in another order, all upwards
    other[40:80, 40:48] *= factor
    return compare_paths(one, other, np.full(one.shape, 2.0 * (np.e - 1.0) * np.e))


def _told(comparison: PathComparison, rate: float) -> bool:
    return comparison.parts is not None and not judge([comparison.parts], rate)[0].same


def test_paths_that_rounding_sends_elsewhere_raise_no_false_alarm() -> None:
    """Skewed light, 2 % of the pixels of other paths: 800 pairs, even at 5 %."""
    found = [_same_paths(seed) for seed in range(800)]
    assert all(100 < one.unlike < 400 and one.pixels == 96 * 128 and not one.others for one in found)
    assert not any(_told(one, 0.05) for one in found)


def test_another_unbiased_sampler_of_the_same_random_numbers_raises_no_false_alarm() -> None:
    """Roulette that lets one path in two go on, and 11 in 20: many pixels darker, few brighter, none on average.

    The signs alone would be told every time.
    """
    alarms = few = 0
    for seed in range(300):
        draw = generator(seed, "test", "roulette", 0)
        value, chance = draw.lognormal(0.0, 1.0, (96, 128, 4)), draw.random((96, 128, 4))
        kept, now = (np.where(chance < keep, value / keep, 0.0) for keep in (0.5, 0.55))
        rest = draw.lognormal(2.0, 1.0, (96, 128))
        one, other = rest + kept[..., :1].sum(axis=-1), rest + now[..., :1].sum(axis=-1)
        unlike = np.abs(other - one) > 1e-4 * one
        few += abs((other > one)[unlike].mean() - 0.5) > 0.2
        alarms += _told(compare_paths(one, other, np.full(one.shape, 2.0 * 255.0)), 1e-3)
    assert few == 300
    assert alarms == 0


def test_a_thousandth_of_light_in_a_dim_corner_is_seen_by_the_same_paths() -> None:
    """320 pixels of 12 288 are 0.1 % darker, where a pixel's noise is 130 %: told, and where, and how much."""
    comparison = _same_paths(1, 0.999, others=0.0)
    assert comparison.parts is not None
    (found,) = judge([comparison.parts], 1e-3)
    assert comparison.unlike == 320
    assert not found.same
    top, bottom, left, right = found.part
    assert 40 <= top + 8 <= bottom <= 88
    assert 32 <= left <= 40 <= right <= 56
    assert found.change == pytest.approx(-0.001, rel=0.05)  # rounding is in it
    assert found.frame_change == pytest.approx(-0.001, rel=0.05)


def test_other_random_numbers_and_what_is_equal_are_not_compared_by_paths() -> None:
    assert _same_paths(1, others=1.0).others
    assert _same_paths(1, others=1.0).parts is None
    same = _same_paths(1, others=0.0)
    assert (same.unlike, same.others, same.parts) == (0, False, None)
    # A tenth of the variance of independent renders is where paths are others.
    for factor, others in ((0.98, False), (1.02, True)):
        one = np.full((16, 16), 1.0)
        apart = np.zeros_like(one)
        apart[:8] = np.sqrt(2.0 * factor * 0.1)
        assert compare_paths(one, one + apart, np.ones_like(one)).others is others
    negative = np.full((8, 8), -1e-6)  # as a difference of renders may be
    assert compare_paths(negative, negative, np.ones((8, 8))).unlike == 0
