"""Light averaged over blocks of one surface: what it keeps, and what noise is left, against drawn numbers."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from nir_render.light.averages import Averages, BlockVariance, averages
from nir_render.light.enlarge import enlarge, enlarge_variance

ROWS, COLUMNS = 9, 11


def _surface() -> np.ndarray:
    """Two surfaces that meet along a slant, a hole of blocks that stand alone, and a lone block."""
    y, x = np.mgrid[0:ROWS, 0:COLUMNS]
    surface = np.where(x + 0.4 * y < 7.0, 3, 5).astype(np.int32)
    surface[2:4, 1:3] = -1
    surface[8, 0] = 9
    return surface


def test_planes_are_kept_surface_by_surface_and_what_stands_alone_is_itself() -> None:
    surface = _surface()
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
    values = np.where(surface == 3, 2.0 + 0.3 * x - 0.2 * y, 40.0 - 2.0 * x + y)
    values[surface < 0] = 1e3
    around = averages(surface)
    # A ridge holds slopes towards 0: by less than a thousandth of a step inside, a tenth in a surface's rim.
    off = np.abs(around.of(values) - values)
    assert off[surface != 9].max() < 0.1 * 2.3
    assert np.median(off) < 0.01 * 2.3
    np.testing.assert_array_equal(off[surface < 0], 0.0)
    assert off[8, 0] == 0.0
    np.testing.assert_allclose(around.of(np.ones(values.shape)), 1.0, rtol=1e-6)
    np.testing.assert_allclose(around.matrix @ values.ravel(), around.of(values).ravel(), rtol=1e-12)
    # A Gaussian of 1.4 blocks over 5 × 5 of them: of its noise a nineteenth is left.
    wide = averages(np.zeros((9, 9), dtype=np.int32))
    assert wide.squares[4, 4] == pytest.approx(1.0 / 18.9, rel=0.01)
    assert wide.own[4, 4] == pytest.approx(0.306**2, rel=0.01)


def _variance(rng: np.random.Generator) -> tuple[BlockVariance, np.ndarray, np.ndarray]:
    """Return a variance, and a thousand draws each of the rest and of what is averaged."""
    multiple, rest = rng.uniform(0.5, 2.0, (2, ROWS, COLUMNS))
    correlation = rng.uniform(-0.6, 0.8, multiple.shape)
    covariance = correlation * np.sqrt(multiple * rest)
    around: Averages = averages(_surface())
    one, other = rng.standard_normal((2, 40_000, ROWS, COLUMNS))
    of_multiple = np.sqrt(multiple) * one
    of_rest = np.sqrt(rest) * (correlation * one + np.sqrt(1.0 - correlation**2) * other)
    whole = rest + multiple + 2.0 * covariance
    return BlockVariance(whole, multiple, covariance, around), of_rest, of_multiple


def test_the_variance_is_that_of_drawn_light() -> None:
    """Of 40 000 draws, whose variance is known to 0.7 %: of blocks, of pixels between them, of sums."""
    variance, rest, multiple = _variance(np.random.default_rng(5))
    assert variance.around is not None
    light = rest + multiple.reshape(len(rest), -1).dot(variance.around.matrix.T.toarray()).reshape(rest.shape)
    within = {"rtol": 5.0 * (2.0 / len(rest)) ** 0.5}
    np.testing.assert_allclose(variance.of_blocks(), light.var(axis=0), **within)
    sums = csr_array(np.random.default_rng(6).uniform(0.0, 1.0, (7, ROWS * COLUMNS)))
    drawn = light.reshape(len(rest), -1) @ sums.T.toarray()
    np.testing.assert_allclose(variance.of_sums(sums), drawn.var(axis=0), **within)
    told = enlarge_variance(variance, 4 * ROWS, 4 * COLUMNS)
    moments = np.zeros((2, 4 * ROWS, 4 * COLUMNS))
    for one in light:
        image = enlarge(one, 4 * ROWS, 4 * COLUMNS)
        moments += image, image**2
    mean, square = moments / len(light)
    np.testing.assert_allclose(told, square - mean**2, **within)
    for rows in (slice(1, None, 3), slice(3, 20)):
        some = enlarge_variance(variance, 4 * ROWS, 4 * COLUMNS, chosen=rows)
        np.testing.assert_array_equal(some, told[rows])


def test_noise_that_is_drawn_has_the_variance() -> None:
    variance, _, _ = _variance(np.random.default_rng(7))
    rng = np.random.default_rng(8)
    drawn = np.stack([variance.drawn(rng).ravel() for _ in range(20_000)])
    sums = csr_array(np.random.default_rng(9).uniform(0.0, 1.0, (7, ROWS * COLUMNS)))
    np.testing.assert_allclose(drawn.var(axis=0), variance.of_blocks().ravel(), rtol=0.05)
    np.testing.assert_allclose((drawn @ sums.T.toarray()).var(axis=0), variance.of_sums(sums), rtol=0.05)


def test_where_nothing_is_averaged_blocks_are_independent() -> None:
    whole = np.random.default_rng(1).uniform(0.5, 2.0, (ROWS, COLUMNS))
    plain = BlockVariance(whole)
    alone = averages(np.full((ROWS, COLUMNS), -1, dtype=np.int32))
    same = BlockVariance(whole, 0.4 * whole, 0.1 * whole, alone)
    sums = csr_array(np.random.default_rng(2).uniform(0.0, 1.0, (3, ROWS * COLUMNS)))
    np.testing.assert_allclose(same.of_blocks(), plain.of_blocks(), rtol=1e-12)
    np.testing.assert_allclose(same.of_sums(sums), plain.of_sums(sums), rtol=1e-12)
    pixels = [enlarge_variance(one, 2 * ROWS, 2 * COLUMNS) for one in (same, plain)]
    np.testing.assert_allclose(pixels[0], pixels[1], rtol=1e-12)
