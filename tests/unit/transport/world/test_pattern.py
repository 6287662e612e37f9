"""Emission patterns as tables: normalised to the bit that matters, and read at the right angles."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from nir_render import InputError
from nir_render.scene.documents.emitters import Source
from nir_render.transport.world.pattern import Pattern, pattern_of, relative_intensity

PLAIN = {
    "flux": "0.2 W", "radius": "10 mm", "spectrum": {"gaussian": {"centroid": "940 nm", "fwhm": "42 nm"}},
}  # fmt: skip


def _pattern(document: dict[str, Any]) -> Pattern:
    pattern = pattern_of(Source.model_validate({**PLAIN, "pattern": document}))
    assert pattern is not None
    return pattern


def _grid(value: Callable[[float, float], float], polar: list[float], azimuth: list[float]) -> dict[str, Any]:
    rows = [[value(math.radians(theta), math.radians(phi)) for phi in azimuth] for theta in polar]
    return {
        "grid": {"polar": f"{polar} deg", "azimuth": f"{azimuth} deg", "values": [str(row) for row in rows]}
    }


def _direction(polar_rad: float, azimuth_rad: float) -> np.ndarray:
    flat = math.sin(polar_rad)
    return np.array([flat * math.cos(azimuth_rad), flat * math.sin(azimuth_rad), math.cos(polar_rad)])


CASES = {
    "even": {"points": [["0 deg", 3.0], ["180 deg", 3.0]]},
    "slope": {"points": [["0 deg", 1.0], ["180 deg", 0.0]]},
    "narrow": {"points": [["0 deg", 1.0], ["10 deg", 0.9], ["15 deg", 0.1], ["20 deg", 0], ["180 deg", 0]]},
    "irregular": {"points": [["0 deg", 0.0], ["33.3 deg", 1.0], ["91.7 deg", 0.2], ["180 deg", 0.4]]},
    "one peak at the pole": {"points": [["0 deg", 1.0], ["1 deg", 0.0], ["180 deg", 0.0]]},
    "three-lobed": _grid(
        lambda theta, phi: math.sin(theta) ** 2 * (1.2 + math.cos(3 * phi)), list(range(0, 181, 5)), list(range(0, 360, 5))
    ),
    "uneven azimuths": _grid(lambda theta, phi: 1.0 + theta * phi, [0, 60, 180], [10, 50, 300]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_mean_over_the_sphere_is_one(name: str) -> None:
    """∫ of the bilinear interpolant dΩ = 4π to 1e-6, by Gauss–Legendre in each of its cells."""
    pattern = _pattern(CASES[name])
    nodes, weights = np.polynomial.legendre.leggauss(4)
    polar = (np.arange(180)[:, None] + 0.5 * (nodes + 1.0)).ravel() * np.pi / 180.0
    polar_weights = np.tile(0.5 * weights, 180) * np.pi / 180.0
    azimuth = (np.arange(360)[:, None] + 0.5 * (nodes + 1.0)).ravel() * np.pi / 180.0
    azimuth_weights = np.tile(0.5 * weights, 360) * np.pi / 180.0
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    values = relative_intensity(pattern, directions)
    total = polar_weights @ (values * np.sin(theta)) @ azimuth_weights
    assert total == pytest.approx(4.0 * np.pi, rel=1e-6)


def test_points_give_what_they_say() -> None:
    """Between whole degrees too, over its own mean ½ ∫ f sin θ dθ by adaptive quadrature; the same all around."""
    pattern = _pattern(CASES["narrow"])
    assert pattern.values.shape == (181, 1)

    def given(polar_deg: float) -> float:
        return float(np.interp(polar_deg, [0, 10, 15, 20, 180], [1.0, 0.9, 0.1, 0.0, 0.0]))

    mean, _ = quad(
        lambda deg: 0.5 * given(deg) * math.sin(math.radians(deg)) * math.pi / 180,
        0,
        20,
        points=[10, 15],
        epsrel=1e-10,
    )
    for polar_deg in (0.0, 0.01, 7.3, 10.0, 12.5, 19.99, 20.01, 90.0, 180.0):
        for azimuth in (0.0, 2.0, -3.0):
            direction = _direction(math.radians(polar_deg), azimuth)
            assert float(relative_intensity(pattern, direction)) == pytest.approx(
                given(polar_deg) / mean, rel=1e-9, abs=1e-9
            )


@pytest.mark.parametrize("azimuth_deg", [0.0, 0.5, 90.0, 179.0, 181.0, 359.5, -0.5])
def test_a_grid_goes_on_from_its_last_azimuth_to_its_first(azimuth_deg: float) -> None:
    """Azimuths 0, 90, 180, 270 of values 1, 2, 3, 4 at every polar angle but the poles, which hold their mean."""
    grid = {
        "polar": "[0, 1, 179, 180] deg", "azimuth": "[0, 90, 180, 270] deg",
        "values": ["[2.5, 2.5, 2.5, 2.5]", "[1, 2, 3, 4]", "[1, 2, 3, 4]", "[2.5, 2.5, 2.5, 2.5]"],
    }  # fmt: skip
    pattern = _pattern({"grid": grid})
    value = np.interp(azimuth_deg % 360.0, [0, 90, 180, 270, 360], [1, 2, 3, 4, 1])
    found = relative_intensity(pattern, _direction(math.radians(70.0), math.radians(azimuth_deg)))
    assert float(found) == pytest.approx(float(value) / 2.5, rel=1e-9)


def test_at_a_pole_all_azimuths_are_one() -> None:
    """Values 1 and 3 at the pole, measured at azimuths 0 and 180°: in its direction it is their mean."""
    document = {
        "polar": "[0, 90, 180] deg",
        "azimuth": "[0, 180] deg",
        "values": ["[1, 3]", "[2, 2]", "[2, 2]"],
    }
    pattern = _pattern({"grid": document})
    for direction in (_direction(0.0, 0.0), _direction(1e-9, math.pi)):
        assert float(relative_intensity(pattern, direction)) == pytest.approx(1.0, rel=1e-6)


def test_a_source_without_a_pattern_has_none() -> None:
    assert pattern_of(Source.model_validate(PLAIN)) is None


def test_a_pattern_between_the_steps_is_refused() -> None:
    spike = [["0 deg", 0], ["45.4 deg", 0], ["45.5 deg", 1], ["45.6 deg", 0], ["180 deg", 0]]
    with pytest.raises(InputError, match="0 at every whole degree"):
        _pattern({"points": spike})
