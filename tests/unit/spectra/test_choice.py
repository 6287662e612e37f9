"""How many wavelengths light is carried at."""

from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render.spectra.choice import choose_nodes
from nir_render.spectra.nodes import nodes_at
from nir_render.transport.wavelengths import carried_wavelengths
from tests.paths import SCENES

NM = np.arange(300.0, 1100.5, 0.5)
BAND = np.exp(-0.5 * ((NM - 940.0) / 8.0) ** 2)
FLOODED = BAND + 0.01 * (NM > 400)


def chosen(seen: Any, curves: Any, error: float = 2e-3, most: int = 24) -> Any:
    return choose_nodes(
        NM * 1e-9, np.array([seen]), np.array(curves), np.array([300e-9, 1100e-9]), error=error, most=most
    )


def error_by_hand(wavelengths_m: tuple[float, ...], seen: Any, product: Any) -> float:
    """The error of one product, by the hat functions with which the camera weighs nodes."""
    at_nodes = np.interp(wavelengths_m, NM * 1e-9, product)
    parts = zip(nodes_at(wavelengths_m), at_nodes, strict=True)
    carried = sum(value * (seen * node.weight(NM * 1e-9)).sum() for node, value in parts)
    return float(abs(carried / (seen * product).sum() - 1.0))


def test_one_node_where_one_does() -> None:
    assert len(chosen(BAND, [np.full(NM.size, 0.4)]).wavelengths_m) == 1
    gentle = chosen(BAND, [0.5 + 1e-4 * (NM - 940.0)])
    assert len(gentle.wavelengths_m) == 1
    assert gentle.wavelengths_m[0] == pytest.approx(940e-9, abs=1e-9)


@pytest.mark.parametrize("seen", [BAND, FLOODED])
def test_nodes_keep_the_error_that_they_state_in_every_product(seen: Any) -> None:
    dip = 0.7 - 0.4 * np.exp(-0.5 * ((NM - 935.0) / 12.0) ** 2)
    step = 0.1 + 0.6 / (1.0 + np.exp(-(NM - 600.0) / 15.0))
    found = chosen(seen, [dip, step], most=48)
    assert 1 < len(found.wavelengths_m) <= 48
    errors = [
        error_by_hand(found.wavelengths_m, seen, one)
        for one in (dip, dip**2, dip**3, step, step**3, dip * step)
    ]
    assert max(errors) == pytest.approx(found.error, rel=1e-6) or max(errors) < found.error
    assert found.error <= 2e-3
    alone = chosen(seen, [dip, step], most=1)
    assert alone.error > 2e-3


def scene(**reflectance: Any) -> nr.Scene:
    wall = {
        "type": "rectangle",
        "center": "[4, 0, 1] m",
        "size": "[4, 4] m",
        "normal": [-1, 0, 0],
        "material": "paint",
    }
    return nr.load_scene(
        SCENES / "one_source.yaml",
        {"materials": {"paint": {"type": "diffuse", "reflectance": reflectance or 0.5}}, "shapes": {"wall": wall},
         "render": {"indirect": {"samples": 4, "scale": 8}}},
    )  # fmt: skip


def test_numbers_alone_are_carried_at_940_nm() -> None:
    found = carried_wavelengths(scene().at(0.0), "r1.front")
    assert (found.wavelengths_m, found.error) == ((940e-9,), 0.0)
    world = scene().at(0.0)
    assert world.at_wavelength(800e-9) is world


def test_curves_that_end_within_what_is_seen_are_refused_with_the_way_to_mend_it() -> None:
    short = scene(points=[["930 nm", 0.5], ["1000 nm", 0.4]])
    with pytest.raises(
        nr.InputError, match=r"materials\.paint\.reflectance: covers 930 to 1000 nm, but .* give data there"
    ):
        carried_wavelengths(short.at(0.0), "r1.front")
    allowed = short.with_({"render.wavelengths.error": 0.5})
    assert carried_wavelengths(allowed.at(0.0), "r1.front").error > 0.01


def test_a_reflectance_above_one_is_refused() -> None:
    with pytest.raises(nr.InputError, match="values from 0 to 1 over wavelength"):
        scene(points=[["930 nm", 1.5], ["1000 nm", 0.4]])


@pytest.mark.mitsuba
def test_light_at_each_node_is_that_of_a_number() -> None:
    """A wall of one curve sends at each node what a wall of that number sends: all light goes with one reflectance."""
    varied = scene(points=[["800 nm", 0.8], ["940 nm", 0.5], ["1100 nm", 0.1]])
    light = nr.render(varied, camera="r1.front", time_s=0.0, seed=1)
    assert light.indirect is not None
    values = np.interp(light.wavelengths_m, [800e-9, 940e-9, 1100e-9], [0.8, 0.5, 0.1])
    means = light.indirect.radiance_per_w[1].mean(axis=(1, 2))
    np.testing.assert_allclose(means / means[0], values / values[0], rtol=1e-3)
