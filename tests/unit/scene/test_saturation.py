"""The saturation capacity of EMVA 1288 against the clip of the full well."""

import numpy as np
import pytest

from nir_render.scene.documents.sensor import (
    Compression,
    _variance_grows,
    full_well_e,
    saturation_capacity_e,
    temporal_variance_e2,
)


@pytest.mark.parametrize("prnu", [0.0, 0.01])
@pytest.mark.parametrize("compression", [None, Compression(0.03, 4.0)])
def test_the_variance_is_that_of_clipped_shot_noise(prnu: float, compression: Compression | None) -> None:
    """Against 4 million drawn electrons below, at and above the peak: within 4 standard errors (0.3 %)."""
    random = np.random.default_rng(1)
    well_e = 5000.0
    for mean_e in (2000.0, 4750.0, 4900.0):
        response = 1.0 + prnu * random.standard_normal(200_000)
        drawn = np.minimum(random.poisson(mean_e * response, (20, response.size)), well_e).astype(float)
        if compression is not None:
            drawn = compression(drawn, well_e)
        variance = float(drawn.var(axis=0, ddof=1).mean())
        expected = temporal_variance_e2(mean_e, well_e, prnu, compression)
        assert variance == pytest.approx(expected, rel=0.004)


def test_capacity_lies_where_the_variance_is_largest() -> None:
    """On a grid of 0.02 %: no place has more variance than the capacity."""
    capacity_e = saturation_capacity_e(10_000.0, 0.005)
    grid = np.linspace(9000.0, 10_000.0, 501)
    variances = [temporal_variance_e2(float(place), 10_000.0, 0.005) for place in grid]
    assert capacity_e == pytest.approx(grid[int(np.argmax(variances))], abs=2.1)


@pytest.mark.parametrize("capacity_e", [1000.0, 5500.0, 32_000.0])
@pytest.mark.parametrize("prnu", [0.0, 0.01])
def test_well_and_capacity_are_each_others_inverse(capacity_e: float, prnu: float) -> None:
    """docs/physics.md, Sensor: the capacity lies 2 to 4 % below the clip for usual sensors, more for small wells."""
    well_e = full_well_e(capacity_e, prnu)
    assert saturation_capacity_e(well_e, prnu) == pytest.approx(capacity_e, rel=1e-4)
    assert 1.015 < well_e / capacity_e < 1.09


@pytest.mark.parametrize("prnu", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("capacity_e", [1000.0, 5500.0, 32000.0, 1e6])
def test_whether_full_scale_is_beyond_the_full_well_is_told_without_solving_for_it(
    capacity_e: float, prnu: float
) -> None:
    """The variance at a capacity still grows where the charge that clips is above its full well, and not below.

    The full well is one whose variance peaks at the capacity, so the two must agree; to 0.2 % and a little.
    """
    well_e = full_well_e(capacity_e, prnu)
    for share in (1.0025, 1.01, 1.1):
        assert _variance_grows(capacity_e, share * well_e, prnu)
        assert not _variance_grows(capacity_e, max(well_e / share, 1.001 * capacity_e), prnu) or share < 1.003
