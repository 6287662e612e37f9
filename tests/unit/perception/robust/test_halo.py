"""What asks for a halo: light around a flare beside what its own fit takes up, against least squares by NumPy."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from perception.model.flare import PixelBox
from perception.model.layout import SEEN, UNUSABLE
from perception.robust.around.halo import _halos, halo_sigmas
from perception.robust.solve import Solution
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


@pytest.mark.parametrize(("radius_px", "motion"), [(0.0, None), (3.0, None), (2.0, (3.0, 1.5))])
def test_halos_are_what_a_lens_shows_of_a_lit_wall(
    radius_px: float, motion: tuple[float, float] | None
) -> None:
    """(1 + ρ²/w²)^(-3/2) but for what a ball hides, seen through point spread and pixels: sums on a fine grid.

    Expected: its height within 1 % of the brightest, what another width changes within 1.5 % of the greatest.
    """
    fine, rim, width_px = 8, 8, 5.0
    most_px = 0.0 if motion is None else float(np.hypot(*motion))
    flare = SimpleNamespace(
        window=SimpleNamespace(box=PixelBox(30, 40, SIDE, SIDE)),
        psf_sigma_px=SIGMA_PX,
        starts=[(40.0 + PLACE[0], 30.0 + PLACE[1], 1.0)],
        flux_e=np.array([1000.0]),
        radius_at_rest_px=np.array([radius_px]),
        most_motion_px=most_px,
        motion_px=None if motion is None else np.array([motion]),
    )
    at = (np.arange((SIDE + 2 * rim) * fine) + 0.5) / fine - 0.5 - rim
    x, y = np.meshgrid(at - PLACE[0], at - PLACE[1])
    shares = [0.0] if motion is None else np.linspace(-0.5, 0.5, 401)[1::2]
    seen = 1.0 - np.mean(
        [np.hypot(x - s * (motion or (0, 0))[0], y - s * (motion or (0, 0))[1]) < radius_px for s in shares],
        axis=0,
    )

    def image(width_px: float) -> Array:
        light = (1.0 + (x**2 + y**2) / width_px**2) ** -1.5 * seen / (2.0 * np.pi * width_px**2)
        blurred = gaussian_filter(light, SIGMA_PX * fine)
        return np.asarray(
            blurred.reshape(SIDE + 2 * rim, fine, -1, fine).mean(axis=(1, 3))[rim:-rim, rim:-rim]
        )

    (halo,) = _halos(cast("Solution", flare), [width_px])
    expected = image(width_px), (image(1.01 * width_px) - image(width_px / 1.01)) / (2.0 * np.log(1.01))
    for column, wanted, share in zip(halo.columns, expected, (0.01, 0.015), strict=True):
        assert column.reshape(SIDE, SIDE) == pytest.approx(wanted, abs=share * np.abs(wanted).max())
