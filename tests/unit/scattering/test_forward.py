"""Light that fog scatters forward, against photons that are thrown one by one, and against a closed form."""

import math

import numpy as np
import pytest

from nir_render.scattering.forward import scattered_forward, scattered_once
from nir_render.scattering.optics import ANGLE_RAD
from nir_render.scene.documents.ambient.droplets import Droplets

WITHIN_RAD = np.radians([0.1, 0.25, 0.5, 1.0, 2.0, 4.0])


@pytest.mark.parametrize(
    ("droplets", "depth"),
    [("advection_heavy", 0.5), ("advection_heavy", 2.0), ("radiation_moderate", 2.0)],
)
def test_photons_that_turn_at_places_of_their_way_arrive_as_the_table_has_them(
    droplets: str, depth: float
) -> None:
    """Two million photons, each turned a Poisson number of times, by angles of the phase function and about any axis.

    A turn at the share x of the way from the source moves the angle of arrival by x times itself. Expected: the light
    within each angle, over that which never turned, to 4 standard errors and 0.2 % for the grids.
    """
    optics = Droplets.model_validate(droplets).optics
    albedo = 1.0 - optics.absorbed_share
    draw, count = np.random.default_rng(7), 2_000_000
    angle = np.linspace(0.0, 0.5, 20001)
    density = np.interp(angle, ANGLE_RAD, optics.phase_per_sr) * angle
    below = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(angle))])
    turns = draw.poisson(depth * albedo * 2.0 * math.pi * below[-1], count)
    arriving = np.zeros(count, dtype=complex)
    for number in range(int(turns.max())):
        turned = np.flatnonzero(turns > number)
        sizes = np.interp(draw.random(turned.size) * below[-1], below, angle) * draw.random(turned.size)
        arriving[turned] += sizes * np.exp(2j * math.pi * draw.random(turned.size))
    straight = np.mean(turns == 0)
    off = np.abs(arriving[turns > 0])
    (expected,) = scattered_forward(ANGLE_RAD, optics.phase_per_sr, albedo, WITHIN_RAD, np.array([depth]))
    for within, share in zip(WITHIN_RAD, expected, strict=True):
        found = np.count_nonzero(off < within)
        error = 4.0 / math.sqrt(found) + 4.0 / math.sqrt(straight * count) + 0.002
        assert found / count / straight == pytest.approx(share, rel=error)


def test_light_scattered_once_by_a_flat_phase_function() -> None:
    """p = 1/(2π(1 − cos b)) within b, small: ∫ h 2πα dα up to ψ is 2 ψ/b − (ψ/b)² of it, ω = 1."""
    widest = 0.02
    angles = np.concatenate([np.linspace(0.0, widest, 4001), [widest * (1.0 + 1e-9), math.pi]])
    value = np.where(angles <= widest, 1.0 / (math.pi * widest**2), 0.0)
    within = np.array([0.002, 0.01, 0.02])
    expected = 2.0 * within / widest - (within / widest) ** 2
    np.testing.assert_allclose(scattered_once(angles, value, 1.0, within), expected, rtol=0.005)
