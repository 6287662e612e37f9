"""Cores behind every lens model, and discs that are large against the core: light, place, and smoothness."""

import tracemalloc
from typing import Any

import numpy as np
import pytest

from nir_render.camera.optics.lens import Intrinsics
from nir_render.camera.optics.otf import Core
from nir_render.camera.optics.psf import Window, cone_nodes, source_window
from nir_render.camera.optics.waves import image_of_points
from perception.model.lens import Distortion

Array = np.ndarray

LENSES = {
    "rectilinear": Intrinsics(1680, 1400, 480.0, 480.0, 839.5, 699.5),
    "brown_conrady": Intrinsics(
        1680, 1400, 480.0, 480.0, 839.5, 699.5, Distortion("brown_conrady", (-0.1, 0.012, 2e-4, 3e-4, -5e-4))
    ),
    "fisheye": Intrinsics(
        1680, 1400, 590.0, 590.0, 839.5, 699.5, Distortion("fisheye", (-0.03, 0.005, -0.004, 4e-4))
    ),
}
CORES = {
    "Gaussian": Core(0.7),
    "Airy and Gaussian": Core(0.7, 0.5013),
    "Airy at f/5.6": Core(airy_px=1.526),
    "out of focus, crosstalk": Core(0.7, defocus_px=4.0, crosstalk=0.04),
}


def _even(cosine: Array) -> Array:
    return np.asarray(1.0e5 * cosine)


def _centroid(window: Window) -> tuple[float, float]:
    rows, columns = np.indices(window.values.shape)
    light = window.values.sum()
    u_px, v_px = ((at * window.values).sum() / light for at in (columns, rows))
    return float(u_px) + window.column, float(v_px) + window.row


@pytest.mark.parametrize("radius_rad", [0.0, 0.002, 0.02])
@pytest.mark.parametrize("place", [(839.8, 699.1), (1100.25, 520.6), (450.4, 1000.9)])
@pytest.mark.parametrize("core", CORES.values(), ids=CORES.keys())
@pytest.mark.parametrize("model", LENSES)
def test_energy_and_centroid_behind_every_lens(
    model: str, core: Core, place: tuple[float, float], radius_rad: float
) -> None:
    """Φ cos θ of the centre to 1e-3; the centroid that of directions over the cone, weighted by cos θ, to 0.001 px.

    Those are 40 rings of the cone, a number of their own; of a point it is the place itself.
    """
    lens = LENSES[model]
    direction = lens.unproject(np.array(place))
    window = source_window(lens, core, direction, radius_rad, _even)
    expected = 1.0e5 * direction[2] * 0.5 * (1.0 + np.cos(radius_rad))
    assert window.total == pytest.approx(expected, rel=1e-9)
    assert window.values.sum() == pytest.approx(expected, rel=1e-5)
    at = np.array(place)
    if radius_rad:
        directions, shares = cone_nodes(direction, radius_rad, 40)
        at = np.average(lens.project(directions), axis=0, weights=shares * directions[:, 2])
    assert _centroid(window) == pytest.approx(tuple(at), abs=0.001)


SHARP: dict[str, tuple[Core, float, int]] = {
    "diffraction alone": (Core(airy_px=0.5013), 0.09, 180),
    "σ = 0.3 px": (Core(0.3), 0.10, 270),
    "σ = 0.7 px": (Core(0.7), 0.20, 230),
}


@pytest.mark.parametrize("name", SHARP)
@pytest.mark.parametrize("model", LENSES)
def test_a_large_disc_under_a_sharp_core_has_no_grain(model: str, name: str) -> None:
    """Discs of 45 to 110 px radius, cut by no edge, against nodes as dense as the core asks for: to 1e-3 of the peak.

    They are put on the image by waves, whatever the core. Response cos⁹ θ, so that the inside has a slope.
    """
    core, radius_rad, rings = SHARP[name]
    wide = LENSES[model]
    lens = Intrinsics(400, 360, wide.fx_px, wide.fy_px, 120.3, 190.6, wide.distortion)
    direction = lens.unproject(np.array([201.7, 181.2]))

    def sloped(cosine: Array) -> Array:
        return np.asarray(cosine**9)

    window = source_window(lens, core, direction, radius_rad, sloped)
    assert window.values.sum() == pytest.approx(window.total, rel=2e-3 if core.airy_px else 1e-6)
    directions, shares = cone_nodes(direction, radius_rad, rings)
    power = shares * sloped(directions[:, 2])
    assert power.sum() == pytest.approx(window.total, rel=1e-9)
    image, expected = np.zeros((360, 400)), np.zeros((360, 400))
    window.add_into(image)
    Window(*image_of_points(core, lens.project(directions), power, 360, 400), 0.0).add_into(expected)
    np.testing.assert_allclose(image, expected, atol=1e-3 * expected.max())


@pytest.mark.parametrize("core", [Core(0.3), Core(airy_px=0.5013)])
def test_a_large_disc_is_cut_at_the_sensor_edge(core: Core) -> None:
    """A disc of 120 px radius that covers a sensor of 80 × 64 px, with its rim in one corner: as on a larger one."""
    lens = Intrinsics(80, 64, 360.0, 360.0, 39.5, 31.5)
    larger = Intrinsics(384, 360, 360.0, 360.0, 199.5, 183.5)
    direction = lens.unproject(np.array([-48.0, -40.0]))
    images: list[Any] = []
    for one in (lens, larger):
        image = np.zeros((one.height_px, one.width_px))
        source_window(one, core, direction, 0.32, _even).add_into(image)
        images.append(image)
    small, part = images[0], images[1][152:216, 160:240]
    assert part.min() < 0.1 * part.max()
    np.testing.assert_allclose(small, part, atol=1e-3 * part.max())


def test_a_disc_that_reaches_behind_the_camera() -> None:
    """1.2 rad about 40° off the axis: the sensor is covered evenly, Φ cos θ Ω_pixel / Ω in each pixel."""
    lens = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    direction = np.array([np.sin(0.7), 0.0, np.cos(0.7)])
    window = source_window(lens, Core(0.3), direction, 1.2, _even)
    x, y = (np.arange(64) - 31.5) / 60.0, (np.arange(48)[:, None] - 23.5) / 60.0
    expected = 1.0e5 / 3600.0 / (1.0 + x**2 + y**2) ** 2 / (2.0 * np.pi * (1.0 - np.cos(1.2)))
    inside = slice(6, -6)
    image = np.zeros((48, 64))
    window.add_into(image)
    np.testing.assert_allclose(image[inside, inside], expected[inside, inside], rtol=1e-3)


def test_a_disc_nearly_from_the_side_takes_no_frame() -> None:
    """A source of 1.5° radius at 85° to 89.9° from the axis: nothing of it falls on the sensor, all counts in the
    total, Φ cos θ of what is in front; less than 60 MiB are taken at once, a 16th of what its nodes would take.
    """
    lens, radius_rad = Intrinsics(1280, 960, 480.0, 480.0, 639.5, 479.5), 0.026
    for angle_rad in np.radians([85.0, 88.0, 88.45, 89.9]):
        direction = np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)])
        tracemalloc.start()
        window = source_window(lens, Core(0.7), direction, radius_rad, _even)
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert not window.values.any()
        assert peak_bytes < 60 * 2**20
        if angle_rad + radius_rad < 0.5 * np.pi:
            wanted = 1e5 * np.cos(angle_rad) * 0.5 * (1.0 + np.cos(radius_rad))
            assert window.total == pytest.approx(wanted, rel=1e-6)
