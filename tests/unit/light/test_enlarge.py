"""Light in blocks enlarged to pixels, on images made by hand: a slanted edge, a ramp, a small bright body."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from nir_render.light.averages import BlockVariance
from nir_render.light.enlarge import (
    Enlargement,
    enlarge,
    enlarge_variance,
    part_of,
    weights_of,
)
from nir_render.transport.indirect.enlargement import Labels, fit_enlargement

ROWS, COLUMNS, FINE = 96, 128, 16


def _fine_labels(edge: str) -> np.ndarray:
    """Labels of 16 × 16 places in each pixel, shape (rows · 16, columns · 16)."""
    y, x = np.mgrid[0 : ROWS * FINE, 0 : COLUMNS * FINE].astype(np.float64)
    x, y = (x + 0.5) / FINE, (y + 0.5) / FINE
    if edge == "slanted":
        return np.where(0.3 * x + y < 61.3, 1, 2)
    if edge == "level":
        return np.where(y < 42.3, 1, 2)
    if edge == "body":  # 3 × 3 pixels, less than a block of 4 × 4 and across four of them
        return np.where((abs(x - 52.0) < 1.5) & (abs(y - 48.0) < 1.5), 2, 1)
    return np.ones(x.shape, dtype=np.int64)


def _labels(fine: np.ndarray, shining: tuple[bool, ...] = (False, False, False)) -> Labels:
    places = fine.reshape(ROWS, FINE, COLUMNS, FINE).transpose(0, 2, 1, 3).reshape(ROWS * COLUMNS, -1)
    middle = fine[FINE // 2 :: FINE, FINE // 2 :: FINE].astype(np.int32)
    edge = np.flatnonzero((places != middle.ravel()[:, None]).any(axis=1))
    nearness = np.full(middle.shape, 0.5, dtype=np.float32)
    even = np.ones(len(shining), dtype=bool)
    return Labels(middle, edge, places[edge].astype(np.int32), nearness, np.array(shining), even)


def _pixels(fine: np.ndarray) -> np.ndarray:
    return np.asarray(fine.reshape(ROWS, FINE, COLUMNS, FINE).mean(axis=(1, 3)))


def _blocks(image: np.ndarray, scale: int) -> np.ndarray:
    return np.asarray(image.reshape(ROWS // scale, scale, COLUMNS // scale, scale).mean(axis=(1, 3)))


def _both(
    edge: str, radiance: np.ndarray, scale: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Enlargement]:
    """Return the true image, the enlarged one with and without labels, and how."""
    truth = _pixels(radiance)
    values = _blocks(truth, scale)
    how = fit_enlargement(_labels(_fine_labels(edge)), scale)
    patch = truth.ravel()[how.patch]
    return truth, enlarge(values, ROWS, COLUMNS, how, patch), enlarge(values, ROWS, COLUMNS), how


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("edge", ["slanted", "level"])
def test_two_even_surfaces_come_back_exactly(edge: str, scale: int) -> None:
    """10 against 1000: exact to the last bit of the weights, where plain interpolation is off by hundreds."""
    radiance = np.array([0.0, 10.0, 1000.0])[_fine_labels(edge)]
    truth, sharp, plain, _ = _both(edge, radiance, scale)
    np.testing.assert_allclose(sharp, truth, rtol=2e-6)
    assert abs(plain - truth).max() > 200.0


@pytest.mark.parametrize("scale", [4, 8])
def test_a_ramp_goes_on_to_the_edge(scale: int) -> None:
    """Two ramps, one along and one across the edge, that differ by 100 at it.

    The ridge takes λ / (v + λ) of a slope, v the variance of the blocks' places along it. Fewest are two rows,
    1.5 and 2.5 blocks from the pixel: with Gaussian weights, σ 1.4, their mean is 1.76 off and v = 0.195, so
    0.03 / 0.225 of 1.76 blocks' rise is lost: 0.235. (Without slopes it would be 1.76.)
    """
    fine = _fine_labels("slanted")
    y, x = np.mgrid[0 : ROWS * FINE, 0 : COLUMNS * FINE] / FINE
    radiance = np.where(fine == 1, 2.0 * y, 300.0 + 2.0 * x)
    truth, sharp, plain, _ = _both("slanted", radiance, scale)
    inner = (slice(scale, -scale), slice(scale, -scale))  # at the frame's border the centres of blocks end
    assert abs(sharp - truth)[inner].max() < 0.235 * 2.0 * scale
    assert abs(plain - truth)[inner].max() > 50.0


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_inside_a_surface_nothing_changes(scale: int) -> None:
    values = np.random.default_rng(1).random((ROWS // scale, COLUMNS // scale))
    how = fit_enlargement(_labels(_fine_labels("none")), scale)
    assert how.pixels.size == how.patch.size == 0
    expected = cv2.resize(values, (COLUMNS, ROWS), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_array_equal(enlarge(values, ROWS, COLUMNS, how), expected)


def test_a_body_without_a_block_of_its_own_is_rendered_one_by_one() -> None:
    """Centre (52, 48), half 1.5: pixels 50 to 53 and 46 to 49 touch it, and no others."""
    how = fit_enlargement(_labels(_fine_labels("body")), 4)
    row, column = np.divmod(how.patch, COLUMNS)
    assert {*row.tolist()} == {46, 47, 48, 49}
    assert {*column.tolist()} == {50, 51, 52, 53}
    assert how.patch.size == 16


def test_the_edge_of_a_lamp_is_rendered_one_by_one() -> None:
    """The level edge at 42.3 cuts row 42: these pixels, and no others but in the frame's corners."""
    labels = _labels(_fine_labels("level"), shining=(False, False, True))
    how = fit_enlargement(labels, 4)
    row, column = np.divmod(how.patch, COLUMNS)
    np.testing.assert_array_equal(column[row == 42], np.arange(COLUMNS))
    assert np.isin(column[row != 42], (0, COLUMNS - 1)).all()


def test_patches_stay_few_and_are_everywhere() -> None:
    """Stripes of 3 pixels leave no pure block of 4 × 4: of all pixels 5 % are rendered, in each quarter as many.

    614 of 12 288; the others are counted.
    """
    middle = (np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) % COLUMNS // 3 % 2).astype(np.int32)
    edge = np.arange(ROWS * COLUMNS)
    nearness = np.ones(middle.shape, dtype=np.float32)
    within = np.repeat(middle.reshape(-1, 1), 4, axis=1)
    how = fit_enlargement(
        Labels(middle, edge, within, nearness, np.zeros(2, dtype=bool), np.ones(2, dtype=bool)), 4
    )
    assert how.patch.size == int(0.05 * ROWS * COLUMNS)
    assert how.left_out == ROWS * COLUMNS - how.patch.size
    row, column = np.divmod(how.patch, COLUMNS)
    for at, count in ((row, ROWS), (column, COLUMNS)):
        quarters = np.bincount(at * 4 // count, minlength=4)
        assert abs(quarters - 614 / 4).max() < 10
    values = np.arange(ROWS * COLUMNS / 16.0).reshape(ROWS // 4, -1)
    assert np.isfinite(enlarge(values, ROWS, COLUMNS, how, np.zeros(how.patch.size))).all()


def test_a_surface_seen_at_a_grazing_angle_is_not_continued_far() -> None:
    """A floor below row 42.3 whose nearness doubles within the block that its end cuts."""
    labels = _labels(_fine_labels("level"))
    nearness = np.maximum(np.arange(ROWS) + 0.5 - 40.0, 0.5)[:, None] * np.ones(COLUMNS)
    far = replace(labels, nearness_per_m=nearness.astype(np.float32))
    rows = {*(fit_enlargement(far, 4).patch // COLUMNS).tolist()}
    assert {42, 43} <= rows
    assert max(rows) < 52  # where 4 rows on nearness changes by a third or less, it is interpolated


def test_enlarging_is_linear_and_its_weights_are_what_it_applies() -> None:
    rng = np.random.default_rng(2)
    how = fit_enlargement(_labels(_fine_labels("slanted")), 4)
    one, other = rng.random((2, ROWS // 4, COLUMNS // 4))
    image = enlarge(one, ROWS, COLUMNS, how) + 3.0 * enlarge(other, ROWS, COLUMNS, how)
    np.testing.assert_allclose(enlarge(one + 3.0 * other, ROWS, COLUMNS, how), image, rtol=1e-5)
    every = np.arange(ROWS * COLUMNS)
    chosen = every[~np.isin(every, how.patch)]
    by_weights = weights_of(chosen, 4, how) @ one.ravel()
    np.testing.assert_allclose(by_weights, enlarge(one, ROWS, COLUMNS, how).ravel()[chosen], atol=2e-6)
    assert abs(weights_of(chosen, 4, how).sum(axis=1) - 1.0).max() < 1e-6


def test_the_variance_is_that_of_independent_blocks() -> None:
    """Σ w² v with the weights by which values are enlarged; beside edges at most twice that of a block."""
    rng = np.random.default_rng(3)
    how = fit_enlargement(_labels(_fine_labels("slanted")), 4)
    variance = rng.uniform(0.5, 2.0, (ROWS // 4, COLUMNS // 4))
    patch = rng.uniform(3.0, 4.0, how.patch.size)
    told = enlarge_variance(BlockVariance(variance), ROWS, COLUMNS, how, patch).ravel()
    every = np.setdiff1d(np.arange(ROWS * COLUMNS), how.patch)
    weights = weights_of(every, 4, how).toarray()
    np.testing.assert_allclose(told[every], weights**2 @ variance.ravel(), rtol=1e-6)
    np.testing.assert_array_equal(told[how.patch], patch)
    assert told[how.pixels].max() < 2.0 * 2.0
    for rows in (slice(1, None, 3), slice(3, None, 7), slice(5, 9)):  # of some rows alone: the same
        some = enlarge_variance(BlockVariance(variance), ROWS, COLUMNS, how, patch, rows)
        np.testing.assert_array_equal(some, told.reshape(ROWS, COLUMNS)[rows])
    # Between blocks, weights ⅞ and ⅛, or ⅝ and ⅜, along each axis.
    plain = enlarge_variance(BlockVariance(np.ones((8, 8))), 32, 32)
    assert plain[2, 2] == pytest.approx(((7 / 8) ** 2 + (1 / 8) ** 2) ** 2)
    assert plain[3, 4] == pytest.approx(((5 / 8) ** 2 + (3 / 8) ** 2) ** 2)
    np.testing.assert_array_equal(enlarge_variance(BlockVariance(variance), *variance.shape), variance)


def test_a_part_of_an_enlargement_says_the_same_of_its_pixels() -> None:
    how = fit_enlargement(_labels(_fine_labels("body")), 4)
    slanted = fit_enlargement(_labels(_fine_labels("slanted")), 4)
    some = np.arange(40 * COLUMNS, 50 * COLUMNS)
    np.testing.assert_array_equal(part_of(how, some).patch, how.patch)  # rows 46 to 49
    part = part_of(slanted, some)
    assert 0 < part.pixels.size < slanted.pixels.size
    difference = weights_of(some, 4, part) - weights_of(some, 4, slanted)
    assert abs(difference).max() == 0.0
