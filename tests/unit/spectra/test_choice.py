"""How many wavelengths light is carried at."""

import re
from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.response import response, sensed
from nir_render.spectra.choice import choose_nodes
from nir_render.spectra.nodes import nodes_at
from nir_render.transport.wavelengths import carried_wavelengths
from tests.paths import SCENES

NM = np.arange(300.0, 1100.5, 0.5)
BAND = np.exp(-0.5 * ((NM - 940.0) / 8.0) ** 2)
FLOODED = BAND + 0.01 * (NM > 400)


def chosen(seen: Any, curves: Any, error: float = 2e-3, most: int = 24) -> Any:
    bends_m = np.array([300e-9, 940e-9, 1100e-9])
    return choose_nodes(NM * 1e-9, np.array([seen]), np.array(curves), bends_m, error=error, most=most)


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
    products = (dip, dip**2, dip**3, step, step**3, dip * step, dip**2 * step)
    errors = [error_by_hand(found.wavelengths_m, seen, one) for one in products]
    assert max(errors) <= found.error * (1.0 + 1e-6) <= 2e-3
    alone = chosen(seen, [dip, step], most=1)
    assert alone.error > 2e-3


@pytest.mark.parametrize("known_nm", [(940.0, 940.5), (950.0, 951.0), (1090.0, 1100.0)])
def test_nodes_stay_within_what_is_known_however_little_that_is(known_nm: tuple[float, float]) -> None:
    curve = np.interp(NM, known_nm, (0.2, 0.9))
    found = choose_nodes(
        NM * 1e-9, FLOODED[None], curve[None], np.array(known_nm) * 1e-9, error=1e-6, most=64
    )
    assert known_nm[0] - 0.5 <= 1e9 * min(found.wavelengths_m)
    assert 1e9 * max(found.wavelengths_m) <= known_nm[1] + 0.5
    assert error_by_hand(found.wavelengths_m, FLOODED, curve) <= 1.001 * found.error + 1e-12 < 1e3


def test_one_node_where_nothing_is_seen_or_reflects() -> None:
    for seen, curve in ((0.0 * BAND, BAND), (BAND, 0.0 * BAND)):
        found = chosen(seen, [curve])
        assert (len(found.wavelengths_m), found.error) == (1, 0.0)


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
    short = scene(points=[["930 nm", 0.9], ["1000 nm", 0.85]])
    with pytest.raises(
        nr.InputError, match=r"materials\.paint\.reflectance: covers 930 to 1000 nm, but .* give data there"
    ) as refused:
        carried_wavelengths(short.at(0.0), "r1.front")
    advice = re.search(r"error: ([0-9.]+) %", str(refused.value))
    assert advice is not None
    allowed = short.with_({"render.wavelengths.error": float(advice[1]) / 100.0})
    assert 0.01 < carried_wavelengths(allowed.at(0.0), "r1.front").error < float(advice[1]) / 100.0


def test_what_little_lies_beyond_data_is_in_the_error_as_if_anything_could_be_there() -> None:
    """A wall of 0.75 known from 925 to 948 nm, which light may meet three times: 0.42, and beyond it could be 1."""
    wall = scene(points=[["925 nm", 0.75], ["948 nm", 0.75]]).with_({"render.wavelengths.error": 0.5})
    camera, source = wall.camera("r1.front")[1], wall.sources()["r2.top"][1]
    wavelength_m = np.arange(300e-9, 1100.1e-9, 0.25e-9)
    parts = sensed(camera, source, wavelength_m)
    share = (parts * ((wavelength_m < 925e-9) | (wavelength_m > 948e-9))).sum(axis=1).max()
    assert 1e-3 < share < 0.2
    found = carried_wavelengths(wall.at(0.0), "r1.front")
    assert found.error == pytest.approx(share * (0.75**-3 - 1.0), rel=0.02)


def test_what_is_sensed_is_what_the_camera_responds_to() -> None:
    """By the responses of two nodes, whose shares tell the mean wavelength, on the axis and at the corner."""
    camera, source = scene().camera("r1.front")[1], scene().sources()["r2.top"][1]
    wavelength_m = np.arange(300e-9, 1100.1e-9, 0.25e-9)
    parts = sensed(camera, source, wavelength_m)
    low, high = (response(camera, source, node) for node in nodes_at((850e-9, 1030e-9)))
    for angle_rad, seen in ((0.0, parts[0]), (intrinsics_of(camera).corner_angle_rad, parts[-1])):
        share = high(angle_rad) / (low(angle_rad) + high(angle_rad))
        mean_m = seen @ np.clip(wavelength_m, 850e-9, 1030e-9)
        assert mean_m - 850e-9 == pytest.approx(180e-9 * share, rel=1e-4)


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
