"""Glare and ghosts: closed forms near and far, direct summation, and no light lost."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nir_render.camera.beams import Beam, beam_electrons, beam_window, blur
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.response import response
from nir_render.camera.optics.veil import veil
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from tests.unit.camera.conftest import CameraMaker

Array = np.ndarray

GLARE = {"share": "2 %", "core_radius": "10 px", "exponent": 2.5}
GHOST = {"share": "0.1 %", "radius": "40 px", "magnification": -1.0}


def _camera(camera_with: CameraMaker, rows: int, columns: int, **spread: Any) -> Camera:
    return camera_with(sensor={"rows": rows, "columns": columns}, point_spread=spread)


def _density(distance_px: Array, core_radius_px: float, exponent: float) -> Array:
    scale = (exponent - 1.0) / (np.pi * core_radius_px**2)
    return np.asarray(scale * (1.0 + (distance_px / core_radius_px) ** 2) ** -exponent)


def _distance(rows: int, columns: int, row: float, column: float) -> Array:
    return np.asarray(np.hypot(np.arange(rows)[:, None] - row, np.arange(columns) - column))


@pytest.mark.parametrize(
    ("core_radius_px", "exponent"), [(3.0, 2.5), (10.0, 1.2), (10.0, 2.5), (40.0, 1.6), (60.0, 6.0)]
)
def test_glare_of_a_point_near_and_far(
    camera_with: CameraMaker, core_radius_px: float, exponent: float
) -> None:
    """One bright pixel off the middle: w(r) wherever the frame shows it, up to 1 000 px away.

    Within 0.4 % of itself, where it is above what rounding leaves (1e-15 of the brightest).
    """
    camera = _camera(
        camera_with,
        720,
        960,
        glare={"share": "2 %", "core_radius": f"{core_radius_px} px", "exponent": exponent},
    )
    core_e = np.zeros((720, 960))
    core_e[97, 131] = 0.98e6
    wide_e = veil(camera, core_e)
    expected_e = 0.02e6 * _density(_distance(720, 960, 97, 131), core_radius_px, exponent)
    seen = expected_e > 1e-11 * expected_e.max()
    assert seen.mean() > 0.4
    np.testing.assert_allclose(wide_e[seen], expected_e[seen], rtol=0.004)
    assert wide_e.sum() == pytest.approx(expected_e.sum(), rel=1e-4)


@pytest.mark.parametrize("core_radius_px", [3.0, 12.0])
def test_glare_as_by_direct_summation(camera_with: CameraMaker, core_radius_px: float) -> None:
    """Random light on 60 × 44 pixels, as large as the kernel: a sum over all pairs of pixels."""
    camera = _camera(
        camera_with, 44, 60, glare={"share": "30 %", "core_radius": f"{core_radius_px} px", "exponent": 1.5}
    )
    core_e = np.random.default_rng(2).random((44, 60)) ** 8
    expected_e = np.zeros((44, 60))
    for row, column in np.ndindex(44, 60):
        expected_e += core_e[row, column] * _density(_distance(44, 60, row, column), core_radius_px, 1.5)
    np.testing.assert_allclose(veil(camera, core_e), 0.3 / 0.7 * expected_e, rtol=0.002)


def test_no_light_is_lost_but_beyond_the_frame(camera_with: CameraMaker) -> None:
    """In the middle of 2400 × 2400 pixels: 1 − (1 + (r/r₀)²)^(1−γ) within r, here 600 and 1190 px, of w."""
    camera = _camera(
        camera_with, 2400, 2400, glare={"share": "10 %", "core_radius": "25 px", "exponent": 1.5}
    )
    core_e = np.zeros((2400, 2400))
    core_e[1200, 1200] = 0.9
    wide_e = veil(camera, core_e)
    distance_px = _distance(2400, 2400, 1200, 1200)
    for radius_px in (30.0, 600.0, 1190.0):
        held = 1.0 - (1.0 + (radius_px / 25.0) ** 2) ** -0.5
        # A pixel on the circle counts whole or not at all.
        assert wide_e[distance_px < radius_px].sum() == pytest.approx(
            0.1 * held, rel=0.004 if radius_px < 100 else 2e-4
        )


@pytest.mark.parametrize(
    ("magnification", "radius_px"), [(-1.0, 40.0), (-1.0, 9.0), (0.5, 21.0), (-2.3, 90.0), (3.0, 12.0)]
)
def test_a_ghost_is_a_disc_at_its_magnified_place(
    camera_with: CameraMaker, magnification: float, radius_px: float
) -> None:
    """About the principal point (310, 190), not the middle: light, place and second moment r²/4 per axis."""
    camera = camera_with(
        sensor={"rows": 400, "columns": 600},
        lens={"principal_point": "[310, 190] px"},
        point_spread={
            "ghosts": [{"share": "1 %", "radius": f"{radius_px} px", "magnification": magnification}]
        },
    )
    core_e = np.zeros((400, 600))
    core_e[205, 280] = 0.99
    wide_e = veil(camera, core_e)
    rows, columns = np.indices(core_e.shape)
    light = wide_e.sum()
    u_px, v_px = (columns * wide_e).sum() / light, (rows * wide_e).sum() / light
    assert light == pytest.approx(0.01, rel=1e-9)
    assert (u_px, v_px) == pytest.approx(
        (310.0 - 30.0 * magnification, 190.0 + 15.0 * magnification), abs=1e-6
    )
    assert ((columns - u_px) ** 2 * wide_e).sum() / light == pytest.approx(radius_px**2 / 4.0, rel=0.003)
    distance_px = np.hypot(columns - u_px, rows - v_px)
    assert wide_e[distance_px < 0.5 * radius_px].mean() == pytest.approx(
        0.01 / (np.pi * radius_px**2), rel=0.06
    )
    assert wide_e[distance_px > 1.7 * radius_px].max() < 1e-9


def test_ghosts_of_an_even_image_are_even(camera_with: CameraMaker) -> None:
    """Magnified twice, an even image is a quarter as bright, twice as far: even in the middle, 1 %/4 of it."""
    camera = _camera(
        camera_with, 300, 400, ghosts=[{"share": "1 %", "radius": "20 px", "magnification": -2.0}]
    )
    wide_e = veil(camera, np.full((300, 400), 0.99))
    np.testing.assert_allclose(wide_e[50:250, 50:350], 0.0025, rtol=1e-3)


def test_shares_of_all_parts_add_up(camera_with: CameraMaker) -> None:
    """The veil of two glares' worth of light is the sum of both; ghosts leave the frame where they lie outside."""
    both = _camera(camera_with, 200, 300, glare=GLARE, ghosts=[GHOST, {**GHOST, "magnification": 0.5}])
    random = np.random.default_rng(3)
    one_e, other_e = random.random((200, 300)), random.random((200, 300))
    np.testing.assert_allclose(
        veil(both, one_e + 2.0 * other_e), veil(both, one_e) + 2.0 * veil(both, other_e), rtol=1e-9
    )
    far = _camera(camera_with, 200, 300, ghosts=[{**GHOST, "magnification": -5.0}])
    corner_e = np.zeros((200, 300))
    corner_e[5, 5] = 1.0
    assert veil(far, corner_e).max() == 0.0


def _beam(camera: Camera, source: Source, place: tuple[float, float], range_m: float) -> Beam:
    return Beam(
        direction=intrinsics_of(camera).unproject(np.array(place)),
        angular_radius_rad=float(np.arcsin(0.01 / range_m)),
        irradiance_w_per_m2=0.2 / (4.0 * np.pi * range_m**2),
        response=response(camera, source),
        distance_m=range_m,
    )


@pytest.mark.parametrize("range_m", [0.4, 6.0])
@pytest.mark.parametrize("place", [(640.0, 480.0), (611.37, 498.81), (700.5, 410.25), (3.2, 500.4)])
def test_all_light_of_a_source_is_in_the_frame_or_beyond(
    camera_with: CameraMaker, source: Source, place: tuple[float, float], range_m: float
) -> None:
    """A resolved and an unresolved source through lens, every part of the point spread, and pixels: 0.1 %.

    Beyond the frame: of the core what a larger sensor shows there, of glare what w has there, of the ghost
    what of its disc is there. The closed form is E A_ap cos θ C(θ) t, whatever the point spread.
    """
    spread = {
        "sigma": "0.5 px", "diffraction": "940 nm", "crosstalk": "2 %", "ghosts": [GHOST],
        "glare": {"share": "3 %", "core_radius": "10 px", "exponent": 1.5},
    }  # fmt: skip
    camera = camera_with(point_spread=spread, lens={"focus_distance": "2 m"})
    beam = _beam(camera, source, place, range_m)
    image_e = beam_electrons(camera, [beam], 1e-3)
    cosine = float(beam.direction[2])
    aperture_m2 = np.pi * 0.9e-3**2 / 4.0
    per_j = float(beam.response(np.arccos(cosine)))
    all_e = beam.irradiance_w_per_m2 * aperture_m2 * cosine * per_j * 1e-3
    total_e = beam_window(camera, beam, 1e-3).total
    # The response bends over the disc of the near source.
    assert total_e == pytest.approx(all_e, rel=1e-4 if place[0] > 600.0 else 4e-3)
    # A sensor with 300 px more on all sides holds the whole core, but for 1e-3 of the Airy pattern at most.
    larger = camera_with(
        sensor={"rows": 1560, "columns": 1880}, point_spread={**spread, "glare": None, "ghosts": None},
        lens={"focus_distance": "2 m"},
    )  # fmt: skip
    window = beam_window(
        larger, replace(beam, direction=intrinsics_of(larger).unproject(np.array(place) + 300.0)), 1e-3
    )
    core_e = np.zeros((1560, 1880))
    window.add_into(core_e)
    assert core_e.sum() == pytest.approx(window.total, rel=1e-3)
    share_in_frame = core_e[300:1260, 300:1580].sum() / window.total
    light_e = total_e * share_in_frame
    # What a wide part shows of light depends on its column, near the edge; the row is always in the middle.
    columns_e = core_e[300:1260, 300:1580].sum(axis=0)
    columns = np.flatnonzero(columns_e > 1e-3 * columns_e.max())
    share = columns_e[columns] / columns_e[columns].sum()
    glare_share = share @ [
        _density(_distance(960, 1280, place[1], float(at)), 10.0, 1.5).sum() for at in columns
    ]
    # The ghost stands opposite; of a disc the share 1/2 + (x √(1 − x²) + asin x)/π lies this side of x.
    x = np.minimum((columns + 0.5) / 40.0, 1.0)
    ghost_share = share @ (0.5 + (x * np.sqrt(1.0 - x**2) + np.arcsin(x)) / np.pi)
    expected_e = light_e * (1.0 - 0.03 * (1.0 - glare_share) - 0.001 * (1.0 - ghost_share))
    assert image_e.sum() == pytest.approx(expected_e, rel=2e-4 if place[0] > 600.0 else 1e-3)


def test_the_core_holds_what_is_left(camera_with: CameraMaker, source: Source) -> None:
    """Window and blur carry 1 − glare − ghosts of what they do without; the window's total stays."""
    plain, veiled = camera_with(), camera_with(point_spread={"glare": GLARE, "ghosts": [GHOST]})
    beams = [_beam(camera, source, (611.37, 498.81), 3.0) for camera in (plain, veiled)]
    windows = [beam_window(camera, beam, 1e-3) for camera, beam in zip((plain, veiled), beams, strict=True)]
    np.testing.assert_allclose(windows[1].values, 0.979 * windows[0].values, rtol=1e-12)
    assert windows[1].total == windows[0].total
    image_e = np.random.default_rng(4).random((960, 1280))
    np.testing.assert_allclose(blur(veiled, image_e), 0.979 * blur(plain, image_e), rtol=1e-12)
