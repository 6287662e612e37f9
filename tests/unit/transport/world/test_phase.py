"""Phase functions as tables: normalised, read back, and drawn from as they say."""

import math

import numpy as np
import pytest
from scipy import stats

from nir_render.errors import InputError
from nir_render.transport.world.phase import CELLS, PhaseTable, henyey_greenstein, phase_table, tabulated

# A droplet's forward peak: 5000 times the side, within a degree, in steps of any size.
PEAK_DEG = [0.0, 0.3, 0.7, 1.1, 2.0, 5.0, 12.0, 30.0, 75.0, 110.0, 141.0, 150.0, 180.0]
PEAK = [5200.0, 3900.0, 1300.0, 420.0, 60.0, 14.0, 4.0, 1.0, 0.1, 0.04, 0.3, 0.08, 0.1]


def _tables() -> dict[str, PhaseTable]:
    return {
        "isotropic": phase_table(henyey_greenstein(0.0)),
        "forward": phase_table(henyey_greenstein(0.85)),
        "very forward": phase_table(henyey_greenstein(0.98)),
        "backward": phase_table(henyey_greenstein(-0.5)),
        "droplet": phase_table(tabulated(np.radians(PEAK_DEG), np.array(PEAK))),
    }


TABLES = _tables()


@pytest.mark.parametrize("name", TABLES)
def test_the_integral_over_the_sphere_is_one(name: str) -> None:
    table = TABLES[name]
    fine = np.linspace(0.0, 1.0, 200_001) ** 2 * math.pi
    density = np.interp(1.0 - np.cos(fine), table.versine, table.density_per_sr)
    whole = 2.0 * math.pi * np.trapezoid(density * np.sin(fine), fine)
    assert whole == pytest.approx(1.0, abs=1e-5)
    assert table.cumulative[-1] == pytest.approx(1.0, abs=1e-12)


def test_henyey_greenstein_is_its_formula_and_its_mean_cosine_is_g() -> None:
    for asymmetry in (-0.5, 0.0, 0.85, 0.98):
        table = phase_table(henyey_greenstein(asymmetry))
        angle = np.radians([0.0, 1.0, 10.0, 90.0, 180.0])
        density = np.interp(angle, table.angle_rad, table.density_per_sr)
        formula = (1.0 - asymmetry**2) / (
            4.0 * math.pi * (1.0 + asymmetry**2 - 2.0 * asymmetry * np.cos(angle)) ** 1.5
        )
        np.testing.assert_allclose(density, formula, rtol=2e-4)
        middle = 0.5 * (table.versine[1:] + table.versine[:-1])
        mean_cosine = float(((1.0 - middle) * np.diff(table.cumulative)).sum())
        assert mean_cosine == pytest.approx(asymmetry, abs=1e-4)


def test_a_table_that_falls_between_the_angles_is_refused_and_one_of_a_cell_is_not() -> None:
    """A spike of 0.1 deg where the table's angles are 0.26 deg apart is nothing to draw from; of 1 deg, it is."""
    for width_deg, held in ((0.1, False), (1.0, True)):
        at_deg = 100.0 + np.array([0.0, 0.5, 1.0]) * width_deg
        spike = tabulated(np.radians([0.0, *at_deg, 180.0]), np.array([0.0, 0.0, 1.0, 0.0, 0.0]))
        if held:
            assert phase_table(spike).cumulative[-1] == pytest.approx(1.0, abs=1e-12)
        else:
            with pytest.raises(InputError, match="widen it to 1 deg"):
                phase_table(spike)


@pytest.mark.mitsuba
@pytest.mark.parametrize("name", TABLES)
def test_turns_are_drawn_as_the_table_says(name: str) -> None:
    """χ² of 400 000 turns in 64 bins of equal chance, and evenly around; the device's own reading of p agrees.

    A table that is off by 2 % in one half of the angles fails: χ² would exceed its mean by a hundred.
    """
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.indirect.kernel.fog import draw_scattering, phase_function
    from nir_render.transport.indirect.kernel.tables import upload_fog
    from nir_render.transport.world.medium import Medium

    table = TABLES[name]
    mi = backend().mi
    everywhere = np.full(3, np.inf)
    fog = upload_fog(Medium(0.1, 1.0, -everywhere, everywhere, table))
    random = np.random.default_rng(7)
    count = 400_000
    u, v = (mi.Float(random.random(count).astype(np.float32)) for _ in range(2))
    axis = np.array([0.48, -0.6, 0.64])
    turned = np.array(draw_scattering(fog, mi.Vector3f(*axis.tolist()), u, v)).T.astype(float)
    versine = 0.5 * ((turned - axis) ** 2).sum(axis=1)
    edges = np.interp(np.linspace(0.0, 1.0, 65), table.cumulative, table.versine)
    # Exact edges: within a cell the share grows with the square of the versine.
    shares = np.array([_share_below(table, edge) for edge in edges])
    found, _ = np.histogram(versine, np.r_[-1.0, edges[1:-1], 3.0])
    expected = count * np.diff(shares)
    assert stats.chisquare(found, expected * count / expected.sum()).pvalue > 1e-3
    across = np.array([0.8, 0.64, 0.0]) / np.hypot(0.8, 0.64)
    around = np.arctan2(turned @ np.cross(axis, across), turned @ across)
    assert stats.chisquare(np.histogram(around, 16, (-np.pi, np.pi))[0]).pvalue > 1e-3

    asked = mi.Float(np.array([1e-7, 1e-5, 1e-3, 0.1, 1.0, 1.9], dtype=np.float32))
    np.testing.assert_allclose(
        np.array(phase_function(fog, asked)),
        np.interp(np.array(asked), table.versine, table.density_per_sr),
        rtol=2e-3,
    )


def _share_below(table: PhaseTable, versine: float) -> float:
    cell = int(np.clip(np.searchsorted(table.versine, versine, side="right") - 1, 0, CELLS - 1))
    low, high = table.versine[cell], table.versine[cell + 1]
    p0, p1 = table.density_per_sr[cell], table.density_per_sr[cell + 1]
    x = (versine - low) / (high - low)
    within = (p0 * x + 0.5 * (p1 - p0) * x * x) / (0.5 * (p0 + p1))
    return float(table.cumulative[cell] + within * (table.cumulative[cell + 1] - table.cumulative[cell]))
