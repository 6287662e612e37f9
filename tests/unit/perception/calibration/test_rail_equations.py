"""The information of a rail's pixels against their whole covariance, written out and inverted."""

import numpy as np
import pytest

import perception.calibration.rail_equations as rail_equations_module
from perception.calibration.rail_equations import RailEquations, RailNoise, rail_equations
from perception.model.flare import PixelBox
from tests.unit.perception.simulation import random

# All overlap in some pixels, two in others; one lies apart.
BOXES = (PixelBox(3, 40, 6, 10), PixelBox(5, 44, 7, 8), PixelBox(7, 38, 6, 9), PixelBox(90, 100, 5, 5))
SHARED = 5


def _noise(scale: tuple[float, float]) -> RailNoise:
    """Noise whose offsets and responses err so many times as much as usual."""
    draw = random(1, 0)
    return RailNoise(
        BOXES,
        tuple(draw.uniform(50.0, 90.0, (box.height, box.width)) for box in BOXES),
        tuple(
            np.array(scale)[:, None, None] * draw.uniform(2.0, 12.0, (2, box.height, box.width))
            for box in BOXES
        ),
    )


def _covariance(noise: RailNoise) -> np.ndarray:
    """Of the pixels of all places, in a row: those of two places err alike where they are one pixel's."""
    places = [np.mgrid[box.slices].reshape(2, -1).T for box in BOXES]
    where, common = np.concatenate(places), np.concatenate([one.reshape(2, -1).T for one in noise.common_e])
    same = (where[:, None] == where[None]).all(axis=-1)
    own_e2 = np.concatenate([one.ravel() for one in noise.own_e2])
    return np.asarray(np.diag(own_e2) + same * (common @ common.T))


@pytest.mark.parametrize("scale", [(1.0, 1.0), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0)])
@pytest.mark.parametrize("tile_px", [4, 48])
def test_what_places_share_counts_once(
    scale: tuple[float, float], tile_px: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boxes that are cut by tiles, too, and pixels that err in nothing alike."""
    monkeypatch.setattr(rail_equations_module, "_TILE_PX", tile_px)
    noise, draw = _noise(scale), random(2, 0)
    jacobians = [draw.normal(size=(9, box.height, box.width)) for box in BOXES]
    left = [10.0 * draw.normal(size=(box.height, box.width)) for box in BOXES]
    below, precision = draw.normal(size=5), draw.uniform(1.0, 2.0, 5)
    pixels = sum(box.height * box.width for box in BOXES)
    design, first = np.zeros((pixels, SHARED + 4 * len(BOXES))), 0
    for place, by in enumerate(jacobians):
        rows = slice(first, first := first + by[0].size)
        design[rows, :SHARED] = by[:SHARED].reshape(SHARED, -1).T
        design[rows, SHARED + 4 * place : SHARED + 4 * place + 4] = by[SHARED:].reshape(4, -1).T
    inverse, all_left = np.linalg.inv(_covariance(noise)), np.concatenate([one.ravel() for one in left])
    known = np.zeros(design.shape[1])
    known[:SHARED] = precision

    found = rail_equations(left, jacobians, noise, (below, precision))

    assert isinstance(found, RailEquations)
    assert np.allclose(found.matrix, design.T @ inverse @ design + np.diag(known), rtol=1e-9, atol=1e-12)
    slope = design.T @ inverse @ all_left
    slope[:SHARED] += precision * below
    assert np.allclose(found.slope, slope, rtol=1e-9, atol=1e-10)
    assert np.isclose(found.chi2, all_left @ inverse @ all_left + below @ (precision * below), rtol=1e-10)
    assert np.isclose(noise.chi2(left), all_left @ inverse @ all_left, rtol=1e-10)
