"""Fog by height on the device, in float32, against the host's in float64: what a way leaves, and where flights end."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render.scene.documents.fog import Fog
from nir_render.transport.backend.variant import mi
from nir_render.transport.indirect.kernel import fog as on_device
from nir_render.transport.indirect.kernel.tables import FogTable, upload_fog
from nir_render.transport.world.fog_depth import height_profile, optical_depth
from nir_render.transport.world.medium import Medium
from nir_render.transport.world.phase import henyey_greenstein, phase_table

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

Array = NDArray[np.float64]

FOGS: dict[str, dict[str, Any]] = {
    "a sharp layer under a high tail": {"profile": [["0 m", 1], ["0.3 m", 1], ["0.31 m", 0], ["1000 m", 0]]},
    "a haze above": {"profile": [["0 m", 1], ["0.3 m", 1], ["0.32 m", 0.1], ["300 m", 0.1]]},
    "denser below": {"profile": [["-0.5 m", 3], ["0.2 m", 1], ["0.25 m", 0.4], ["2 m", 0]]},
    "a gap": {"profile": [["0 m", 1], ["0.4 m", 0], ["0.9 m", 0], ["1.1 m", 2]], "top": "1.5 m"},
    "many points": {"profile": [[f"{0.07 * k**1.2} m", 1.0 + np.sin(k)] for k in range(63)]},
    "a bank": {"profile": [["0 m", 0.2], ["1 m", 1]], "center": "[0, 0, 0.5] m", "size": "[6, 6, 2] m"},
    "even": {"top": "1 m"},
}  # fmt: skip


def fog_of(name: str) -> tuple[Fog, FogTable]:
    fog = Fog.model_validate({"extinction": "0.3 /m", **FOGS[name]})
    phase = phase_table(henyey_greenstein(0.5))
    return fog, upload_fog(Medium(0.3, 1.0, *fog.region_m(), phase, height_profile(fog)))


def rays(count: int = 4000) -> tuple[Array, Array, Array]:
    """Return places, unit directions, many of them nearly level, and lengths, as float32 has them."""
    random = np.random.default_rng(3)
    start_m = random.uniform([-2, -2, -0.3], [2, 2, 1.2], (count, 3))
    direction = random.normal(size=(count, 3))
    direction[: count // 2, 2] *= 10.0 ** random.uniform(-6, -1, count // 2)
    direction[:10, 2] = 0.0
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length_m = random.uniform(0.05, 15, count)
    return tuple(np.float64(np.float32(values)) for values in (start_m, direction, length_m))  # type: ignore[return-value]


@pytest.mark.parametrize("name", FOGS)
def test_what_fog_leaves_on_the_device_is_what_it_leaves(name: str) -> None:
    """4 000 ways of up to 15 m, half of them nearly level, across all kinks: to 2·10⁻⁴ of what comes in."""
    fog, table = fog_of(name)
    start_m, direction, length_m = rays()
    left = on_device.transmittance(table, mi.Point3f(start_m.T), mi.Vector3f(direction.T), mi.Float(length_m))
    expected = np.exp(-optical_depth(fog, start_m, direction, length_m))
    np.testing.assert_allclose(np.array(left), expected, atol=2e-4)


@pytest.mark.parametrize("name", FOGS)
def test_flights_end_where_their_density_says(name: str) -> None:
    """Along each of 300 ways: the share of flights before a place is ∫ of the stated density, by both.

    64 flights by even numbers, and the density at 2 000 places. Expected: the number of flights before each tenth of a
    way is that of the integral within one flight and what steps of a way leave.
    """
    _, table = fog_of(name)
    ways, numbers, steps = 300, 64, 2000
    start_m, direction, length_m = rays(ways)

    def asked(count: int) -> tuple[Any, ...]:
        """Return rays and their intervals in the fog, each `count` times, as one array."""
        many = (np.repeat(values, count, axis=0) for values in (start_m, direction, length_m))
        place, towards, reach = (values.T for values in many)
        ray = mi.Point3f(place), mi.Vector3f(towards)
        return *ray, *on_device.fog_interval(table, *ray, mi.Float(reach))

    place, towards, begin, end = asked(numbers)
    even = mi.Float(np.tile((np.arange(numbers) + 0.5) / numbers, ways))
    flights = np.array(on_device.draw_flight(table, place, towards, begin, end, even)).reshape(ways, numbers)
    place, towards, begin, end = asked(steps)
    at = begin + (end - begin) * mi.Float(np.tile((np.arange(steps) + 0.5) / steps, ways))
    density = np.array(on_device.flight_density(table, place, towards, begin, end, at)).reshape(ways, steps)
    depth = np.array(on_device.optical_depth(table, place, towards, begin, end)).reshape(ways, steps)[:, 0]
    begin_m, end_m = (np.array(one).reshape(ways, steps)[:, 0] for one in (begin, end))
    lit = (end_m - begin_m > 0.05) & (depth > 1e-3)
    assert lit.sum() > 50
    integral = np.cumsum(density, axis=1) * (end_m - begin_m)[:, None] / steps
    np.testing.assert_allclose(integral[lit, -1], 1.0, atol=0.02)
    for tenth in range(1, 10):
        before = (flights < (begin_m + (end_m - begin_m) * tenth / 10)[:, None]).mean(axis=1)
        of_density = integral[:, steps * tenth // 10 - 1]
        np.testing.assert_allclose(before[lit], of_density[lit], atol=1.0 / numbers + 0.02)
