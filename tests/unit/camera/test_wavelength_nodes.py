"""Light that is carried at several wavelengths: what a camera makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import constants

import nir_render as nr
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.optics.apertures import flare_apertures
from nir_render.camera.optics.response import response
from nir_render.camera.render_noise import aperture_variances_e2, render_noise, render_variance_e2
from nir_render.light.light import DirectTable, Indirect, Light
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.spectra.nodes import Node, nodes_at
from tests.paths import SCENES

NODES_M = (900e-9, 940e-9, 1000e-9)
EXPOSURE_S = 1e-3


@pytest.fixture(scope="module")
def scene() -> nr.Scene:
    """A camera without a filter, so that the whole spectrum of the source, 42 nm wide, gets through."""
    return nr.load_scene(SCENES / "one_source.yaml", {"robots.r1.rig.cameras.front.filter": None})


def _light(at_nodes: tuple[float, ...], wavelengths_m: tuple[float, ...]) -> Light:
    """The source of r2 at 3 m ahead, and a wall; both let through so much at each node."""
    share = np.array(at_nodes)
    radiance = np.zeros((2, len(share), 960, 1280), dtype=np.float32)
    radiance[1] = 1e-2 * share[:, None, None]
    table = DirectTable(
        group=np.array([1]), facet=np.array([-1]), direction=np.array([[0.0, 0.0, 1.0]]),
        distance_m=np.array([3.0]), angular_radius_rad=np.array([0.01 / 3.0]), seen=np.ones((1, 16), dtype=bool),
        visible_fraction=np.ones(1), irradiance_per_w=share[None] / (4.0 * np.pi * 9.0), visibility_rays=16,
    )  # fmt: skip
    indirect = Indirect(radiance, np.zeros_like(radiance), 1, 16)
    return Light("r1.front", 0.0, 1, ("r1.top", "r2.top"), wavelengths_m, table, indirect)


def test_hat_functions_add_up_to_one() -> None:
    wavelength_m = np.linspace(850e-9, 1050e-9, 401)
    total = sum(node.weight(wavelength_m) for node in nodes_at(NODES_M))
    np.testing.assert_allclose(total, 1.0, atol=1e-12)
    assert Node((940e-9,), 0).is_alone


def test_equal_light_at_all_nodes_is_light_of_one_node(scene: nr.Scene) -> None:
    world = scene.at(0.0)
    one, three = (
        mean_frame(_light((1.0,) * len(nodes), nodes), world, EXPOSURE_S) for nodes in ((940e-9,), NODES_M)
    )
    np.testing.assert_allclose(three.electrons, one.electrons, rtol=2e-6)
    assert three.windows[0].total == pytest.approx(one.windows[0].total, rel=2e-6)


@pytest.mark.parametrize("part", ["direct", "indirect"])
def test_light_that_falls_with_the_wavelength_is_weighted_by_the_spectrum(scene: nr.Scene, part: str) -> None:
    """What passes falls evenly from 1 at 900 nm to 0 at 1000 nm, which hat functions hold exactly: against an
    integral by hand of the source's spectrum × this × quantum efficiency × λ/hc."""
    line = tuple(float(1.0 - (node - 900e-9) / 100e-9) for node in NODES_M)
    world = scene.at(0.0)
    flat, falling = (
        mean_frame(_light(share, NODES_M), world, EXPOSURE_S) for share in ((1.0, 1.0, 1.0), line)
    )
    camera: Camera = scene.camera("r1.front")[1]
    source: Source = scene.sources()["r2.top"][1]
    gaussian = source.spectrum.gaussian
    assert gaussian is not None
    wavelength_m = np.linspace(gaussian.centroid_m - 150e-9, gaussian.centroid_m + 150e-9, 30001)
    sigma_m = gaussian.fwhm_m / np.sqrt(8.0 * np.log(2.0))
    spectrum = np.exp(-0.5 * ((wavelength_m - gaussian.centroid_m) / sigma_m) ** 2)
    per_j = spectrum * wavelength_m / (constants.h * constants.c)
    passed = np.interp(wavelength_m, NODES_M, line)
    share = np.trapezoid(per_j * passed) / np.trapezoid(per_j)
    assert camera.sensor.quantum_efficiency.constant is not None
    if part == "direct":
        assert falling.windows[0].total / flat.windows[0].total == pytest.approx(share, rel=1e-4)
    else:
        row, column = 100, 100  # far from the source's image
        assert falling.electrons[row, column] / flat.electrons[row, column] == pytest.approx(share, rel=1e-4)


def test_the_responses_of_nodes_add_up_to_that_of_the_whole_spectrum(scene: nr.Scene) -> None:
    camera, source = scene.camera("r1.front")[1], scene.sources()["r2.top"][1]
    parts = [response(camera, source, node).electrons_per_j for node in nodes_at(NODES_M)]
    np.testing.assert_allclose(sum(parts), response(camera, source).electrons_per_j, rtol=1e-9)


def test_rows_shine_where_any_node_does() -> None:
    table = _light((0.0, 0.0, 1.0), NODES_M).direct
    assert table.shining.tolist() == [0]
    assert replace(table, irradiance_per_w=np.zeros((1, 3))).shining.tolist() == []


def test_equal_noise_at_all_nodes_is_noise_of_one_node(scene: nr.Scene) -> None:
    """Nodes travel along the same paths: their errors add up, and not their squares."""
    world = scene.at(0.0)
    found = []
    for nodes in ((940e-9,), NODES_M):
        light = _light((1.0,) * len(nodes), nodes)
        assert light.indirect is not None
        variance = np.full_like(light.indirect.radiance_per_w, 1e-6)
        light = replace(light, indirect=replace(light.indirect, variance=variance))
        apertures = flare_apertures(light, world.camera("r1.front").camera)
        found.append(
            (
                render_variance_e2(light, world, EXPOSURE_S)[100, 100],
                aperture_variances_e2(light, world, EXPOSURE_S, apertures)[0],
                render_noise(mean_frame(light, world, EXPOSURE_S)).share_behind_lens,
            )
        )
    np.testing.assert_allclose(found[1][:2], found[0][:2], rtol=1e-4)
    # Behind the lens noise is drawn, 1.2 million pixels of it: right to 0.13 %.
    assert found[1][2] == pytest.approx(found[0][2], rel=0.005)


def test_nodes_increase() -> None:
    with pytest.raises(ValueError, match="wanted increasing wavelengths"):
        nodes_at((940e-9, 900e-9))
