"""A Gaussian at pixels' edges, and points and strips along a row, against the standard library's erf."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.model.discs.nodes import DiscNodes
from perception.model.layout import Sources
from perception.model.spread.edges import LANES, REACH_SIGMAS, blur_of, fall_at, whole_lanes
from perception.model.spread.image import spread_nodes
from perception.model.spread.shares import shares, strip_shares

Array = NDArray[np.float64]


def _below(z: Array) -> Array:
    return np.asarray(0.5 + 0.5 * np.vectorize(math.erf)(z * math.sqrt(0.5)))


def _density(z: Array) -> Array:
    return np.asarray(np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi))


@pytest.mark.parametrize("sigma_px", [0.04, 0.3, 0.7, 1.3, 4.0, 30.0])
def test_a_gaussian_at_edges(sigma_px: float) -> None:
    """Its middle anywhere in a row, or beyond: Φ to 4e-9, σ φ to 3e-8 of its greatest."""
    count = 24
    blur = blur_of(sigma_px, count)
    edges = np.arange(count + 1, dtype=np.float64)
    for middle in np.linspace(-3.0, 27.0, 311).tolist():
        begin = fall_at(middle, blur, 0, count, 1)
        below, slope = (blur.falls[row, begin : begin + count + 1] for row in (2, 3))
        z = (edges - middle) / sigma_px
        np.testing.assert_allclose(below, _below(z), atol=4e-9)
        np.testing.assert_allclose(slope, sigma_px * _density(z), atol=3e-8 * sigma_px)


def test_no_width_takes_much_room() -> None:
    """A fit may try any: what is beyond the widest and the narrowest counts as these."""
    assert blur_of(1e9, 40).sigma_px == blur_of(200.0, 40).sigma_px == 200.0
    assert blur_of(0.0, 40).sigma_px == blur_of(1e-9, 40).sigma_px > 0.0
    assert blur_of(0.0, 40).below.size < 10_000


@pytest.mark.parametrize("at_px", [-4.0, -0.4, 0.0, 7.5, 7.51, 16.2, 22.9, 26.0])
def test_a_point_against_erf(at_px: float) -> None:
    """Anywhere along a row of 23 pixels, and beside it: to what is left out at the reach, 6 φ(6)."""
    sigma_px, count = 0.7, 23
    blur, into = blur_of(sigma_px, 40), np.zeros((3, whole_lanes(count)))
    first, end = shares(at_px, count, blur, into)
    z = (np.arange(count + 1, dtype=np.float64) - 0.5 - at_px) / sigma_px
    expected = [np.diff(_below(z)), -np.diff(_density(z)) / sigma_px, -np.diff(z * _density(z))]
    reached = np.flatnonzero(abs(z[:-1] + 0.5 / sigma_px) < REACH_SIGMAS + 0.5 / sigma_px)
    assert (first, end) == (reached[0], reached[-1] + 1)
    for row, one in zip(into, expected, strict=True):
        np.testing.assert_allclose(row[:count], one, atol=4e-8)
    assert np.isfinite(into).all()


def test_what_lies_beyond_reaches_nothing() -> None:
    """A point, and a strip, beside the row."""
    blur, into = blur_of(0.7, 16), np.ones((4, 16))
    assert shares(-5.0, 16, blur, into) == (0, 0)
    assert strip_shares(30.0, 9.0, (0.0, 0.0), 0.0, 16, blur, into) == (0, 0)
    assert (into == 1.0).all()


@pytest.mark.parametrize("shading", [(0.0, 0.0), (0.4, -0.3)])
@pytest.mark.parametrize(
    ("at_px", "half_px", "count"),
    [(9.37, 2.3, 20), (9.37, 0.4, 20), (1.2, 6.4, 17), (15.9, 7.0, 17), (8.0, 40.0, 17), (-30.0, 31.5, 17)],
)
def test_a_strip_against_a_sum_of_points(
    shading: tuple[float, float], at_px: float, half_px: float, count: int
) -> None:
    """Φ and φ of 20 001 points along it, some of it beyond the row: to 3e-6 of the greatest."""
    sigma_px, off_px = 0.7, -1.7
    into: Array = np.zeros((4, whole_lanes(count)))
    first, end = strip_shares(at_px, half_px, shading, off_px, count, blur_of(sigma_px, count), into)
    reach_px = REACH_SIGMAS * sigma_px + half_px + 0.5
    assert first == max(0, math.ceil(at_px - reach_px))
    assert end == min(count, math.floor(at_px + reach_px) + 1)
    t = (np.arange(20001) + 0.5) / 10000.5 - 1.0
    light = 1.0 + shading[0] * t + shading[1] * (t**2 - 1.0 / 3.0)
    light /= light.sum()
    z = (np.arange(count + 1)[:, None] - 0.5 - at_px - half_px * t) / sigma_px
    density = _density(z)
    sums: list[Array] = [
        np.diff(_below(z) @ light),
        -np.diff(density @ light) / sigma_px,
        -np.diff((z * density) @ light),
        -np.diff((density * (off_px + half_px * t)) @ light) / sigma_px,
    ]
    for row, expected in zip(into, sums, strict=True):
        most = max(float(np.abs(expected).max()), 1e-2 / (half_px + sigma_px))
        np.testing.assert_allclose(row[:count], expected, atol=3e-6 * most)


def test_an_image_fills_its_columns_alone() -> None:
    """A strip and a point in windows of every width: the same pixels, and beyond them nothing that counts."""
    nodes = DiscNodes(
        np.array([0, 2]), np.array([0.3, -1.0]), np.array([0.5, 2.0]), np.array([3.0, 0.0]),
        np.array([0.2, 0.0]), np.array([-0.1, 0.0]), np.array([0.5, -0.5]), np.array([0.7, 0.3]),
    )  # fmt: skip
    source = Sources.of(nodes, np.zeros(1), np.zeros(1))
    images = {}
    for columns in range(12, 12 + 2 * LANES):
        image = np.zeros((7, 15, whole_lanes(columns)))
        spread_nodes(source, 0, (6.2, 7.1), 1.1, (0.8, 0.4), blur_of(0.7, columns), columns, image)
        images[columns] = image[:, :, :columns]
    for columns, image in images.items():
        np.testing.assert_allclose(image, images[27][:, :, :columns], atol=1e-12)
        few = np.zeros((4, 15, whole_lanes(columns)))
        spread_nodes(source, 0, (6.2, 7.1), 1.1, (0.8, 0.4), blur_of(0.7, columns), columns, few)
        assert np.array_equal(few[:, :, :columns], image[:4])
    assert images[27][0].sum() == pytest.approx(1.0, abs=1e-8)
