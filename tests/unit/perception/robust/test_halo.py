"""What asks for a halo: light around a flare beside what its own fit takes up, against least squares by NumPy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.model.layout import SEEN, UNUSABLE
from perception.robust.goodness import halo_sigmas
from tests.unit.perception.simulation import random

Array = NDArray[np.float64]

SIDE, SIGMA_PX = 25, 0.9
PLACE = (12.3, 11.6)


def _window(halo_e: float, key: int) -> tuple[Array, NDArray[np.uint8], Array, Array]:
    """Return what is seen, what each pixel is, what is expected, and the flare's part of that."""
    rows, columns = np.mgrid[:SIDE, :SIDE].astype(np.float64)
    distance2 = (columns - PLACE[0]) ** 2 + (rows - PLACE[1]) ** 2
    flares_e = 4000.0 * np.exp(-0.5 * distance2 / SIGMA_PX**2)
    expected_e = flares_e + 20.0
    around_e = halo_e * (1.0 + distance2 / 4.0**2) ** -1.5
    image_e = expected_e + around_e + np.sqrt(expected_e + 100.0) * random(401, key).normal(size=(SIDE, SIDE))
    state = np.full((SIDE, SIDE), SEEN, dtype=np.uint8)
    state[3:6, 4:9] = UNUSABLE
    return image_e, state, expected_e, flares_e


@pytest.mark.parametrize("halo_e", [0.0, 8.0, 40.0])
def test_what_shows_beside_ground_flux_and_place(halo_e: float) -> None:
    """The score of each width's light is that of a column of a least-squares fit over its standard error."""
    widths_px = np.array([2.0, 4.0, 8.0])
    for key in range(4):
        image_e, state, expected_e, flares_e = _window(halo_e, key)
        seen, weight = state == SEEN, 1.0 / np.sqrt(expected_e + 100.0)
        padded = np.pad(flares_e, 1, mode="edge")
        columns = [
            np.ones_like(flares_e),
            flares_e,
            padded[1:-1, 2:] - padded[1:-1, :-2],
            padded[2:, 1:-1] - padded[:-2, 1:-1],
        ]
        residual = ((image_e - expected_e) * weight)[seen]
        rows, across = np.mgrid[:SIDE, :SIDE]
        expected = []
        for width_px in widths_px:
            halo = (1.0 + ((across - PLACE[0]) ** 2 + (rows - PLACE[1]) ** 2) / width_px**2) ** -1.5
            design = np.stack([(each * weight)[seen] for each in (*columns, halo)])
            information = design @ design.T
            amplitude = np.linalg.solve(information, design @ residual)[-1]
            expected.append(amplitude / np.sqrt(np.linalg.inv(information)[-1, -1]))
        found = halo_sigmas(image_e, state, expected_e, flares_e, 100.0, 0.0, PLACE, widths_px, -1e9)
        assert found == pytest.approx(max(*expected, 0.0), rel=1e-6, abs=1e-9)


def test_what_hardly_shows_is_not_looked_at() -> None:
    image_e, state, expected_e, flares_e = _window(0.0, 0)
    assert halo_sigmas(image_e, state, expected_e, flares_e, 100.0, 0.0, PLACE, np.array([4.0]), 6.0) == 0.0
