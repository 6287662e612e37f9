"""Light that fog scatters forward, beside a flare's own: its image, and ranges with and without it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from nir_render.simulation.fog_known import USUAL, forward_light
from perception import Calibration, ForwardLight, RawFrame, detect
from perception.model.bearing import direction_camera
from perception.model.flare import PixelBox, flare_image
from perception.robust.forward_light import forward_shares, halos_e
from tests.unit.perception.simulation import calibration

Array = NDArray[np.float64]

EXPOSURE_S = 5e-4
ANGLES_RAD = (0.001, 0.002, 0.004, 0.008, 0.016, 0.03)


def _light(depth: float, scale: float = 1.0, sigma: float = 0.0) -> ForwardLight:
    """A halo of 1/α e^(−α/0.01) per rad², of as much light as comes straight at an optical depth of 1."""
    shares = tuple(scale * depth * (1.0 - math.exp(-angle / 0.01)) for angle in ANGLES_RAD)
    return ForwardLight(depth, ANGLES_RAD, shares, sigma)


def _foggy() -> Calibration:
    """A small camera in fog of 0.08 /m, which it knows, and of which it knows the forward light."""
    return calibration(
        width_px=97, height_px=97, cx_px=48.0, cy_px=48.0, extinction_per_m=0.08, forward_light=(_light(1.0),)
    )


def _foggy_e(camera: Calibration, sources: Sequence[tuple[float, float, float]]) -> Array:
    """Mean electrons of sources at (u, v, range) and their halos, each of a table of its own depth on a finer grid."""
    whole = PixelBox(0, 0, camera.height_px, camera.width_px)
    image = np.full((camera.height_px, camera.width_px), 20.0)
    fine = np.geomspace(1e-4, ANGLES_RAD[-1], 400)
    for u_px, v_px, range_m in sources:
        depth = camera.extinction_per_m * range_m
        cosine = float(direction_camera(np.array([[u_px, v_px]]), camera)[0, 2])
        at_1_m_e = camera.range_constant_dn_m2_per_s * EXPOSURE_S / camera.system_gain_dn_per_e
        flux_e = at_1_m_e * cosine * math.exp(-depth) / range_m**2
        radius_rad = math.asin(camera.source_radius_m / range_m)
        image += flux_e * flare_image(u_px, v_px, radius_rad, whole, camera).fraction
        shares = depth * (1.0 - np.exp(-fine / 0.01))
        exact = replace(camera, forward_light=(ForwardLight(depth, tuple(fine), tuple(shares)),))
        image += halos_e(u_px, v_px, flux_e, 0.0, depth, whole, exact)[0]
    return image


def _frames(camera: Calibration, expected_e: Array, count: int) -> Iterator[RawFrame]:
    draw = np.random.default_rng(3)
    for index in range(count):
        electrons = draw.poisson(expected_e) + draw.normal(0.0, camera.read_noise_e, expected_e.shape)
        counts = electrons * camera.system_gain_dn_per_e + camera.black_level_dn
        data_dn = np.clip(np.rint(counts), 0, camera.saturation_dn).astype(np.uint16)
        yield RawFrame(camera.camera, index, 0.0, EXPOSURE_S, data_dn, camera.black_level_dn)


def test_shares_between_optical_depths_go_by_their_rate() -> None:
    (share,), angle_rad = forward_shares((_light(0.5), _light(1.0, 1.2)), 0.75)
    assert angle_rad[0] == share[0] == 0.0
    np.testing.assert_allclose(share[1:], 0.75 * np.array(_light(1.0, 1.1).share), rtol=1e-12)
    for depth, scale in ((0.1, 1.0), (3.0, 1.2)):
        (held,), _ = forward_shares((_light(0.5), _light(1.0, 1.2)), depth)
        np.testing.assert_allclose(held[1:], _light(depth, scale).share, rtol=1e-12)


@pytest.mark.parametrize(("u_px", "v_px", "most"), [(640.3, 480.2, 0.01), (340.7, 580.4, 0.05)])
def test_a_halo_is_the_sum_of_many_points_about_the_flare(u_px: float, v_px: float, most: float) -> None:
    """Points of light at directions around the source, spread as the table has it, each with the camera's point spread.

    Also 33° off the axis, where a lens stretches the halo and not its own point spread. Expected: each pixel to 1 % of
    the brightest, 5 % there, and the sum over 21 × 21 pixels to 1 %.
    """
    camera = calibration(forward_light=(_light(1.0),))
    depth, flux_e = 0.8, 1e4
    box = PixelBox(round(v_px) - 10, round(u_px) - 10, 21, 21)
    (found,) = halos_e(u_px, v_px, flux_e, 0.0, depth, box, camera)
    middle = direction_camera(np.array([[u_px, v_px]]), camera)[0]
    across = np.cross(middle, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(middle, across)])
    (share,), angle_rad = forward_shares(camera.forward_light, depth)
    rings, around = 400, 48
    edges = np.linspace(0.0, 1.0, rings + 1) ** 2 * ANGLES_RAD[-1]
    light = np.repeat(np.diff(np.interp(edges, angle_rad, share)) / around, around)
    angle = np.repeat(0.5 * (edges[1:] + edges[:-1]), around)[:, None]
    turn = 2.0 * math.pi * 0.618034 * np.arange(rings * around)
    towards = np.cos(angle) * middle + np.sin(angle) * np.stack([np.cos(turn), np.sin(turn)], 1) @ frame
    places = towards[:, :2] / towards[:, 2:] * camera.fx_px + [camera.cx_px, camera.cy_px]
    across_px, down_px = (
        norm.cdf((corner + np.arange(22) - 0.5 - place[:, None]) / camera.psf_sigma_px)
        for corner, place in ((box.left, places[:, 0]), (box.top, places[:, 1]))
    )
    expected = flux_e * np.einsum("p,pr,pc->rc", light, np.diff(down_px), np.diff(across_px))
    np.testing.assert_allclose(found, expected, atol=most * expected.max())
    assert found.sum() == pytest.approx(expected.sum(), rel=0.01)


@pytest.mark.parametrize("inside_px", [0.5, 5.0])
def test_a_halo_ends_at_the_edge_of_an_image_circle(inside_px: float) -> None:
    """180° of a fisheye end within the window: beyond is no halo, and within it is that of a window that ends there.

    Right at the edge it is that of a flare five pixels farther in, to the 2 % by which pixels differ.
    """
    camera = calibration(
        lens_model="fisheye", distortion=(0.0, 0.0, 0.0, 0.0), fx_px=240.0, fy_px=240.0,
        forward_light=(_light(1.0),),
    )  # fmt: skip
    edge_px = camera.cx_px + 240.0 * 0.5 * math.pi
    u_px, v_px = edge_px - inside_px, 479.7
    box = PixelBox(470, round(u_px) - 10, 21, 21)
    within = math.floor(edge_px) - box.left - 1
    (found,) = halos_e(u_px, v_px, 1e4, 0.0, 0.8, box, camera)
    (cut,) = halos_e(u_px, v_px, 1e4, 0.0, 0.8, PixelBox(470, box.left, 21, within), camera)
    np.testing.assert_allclose(found[:, :within], cut, rtol=2e-3)
    assert cut.min() > 0.0
    assert (found[:, box.left + np.arange(21) > edge_px] == 0.0).all()
    (shifted,) = halos_e(u_px - 5.0, v_px, 1e4, 0.0, 0.8, PixelBox(470, box.left - 5, 21, 21), camera)
    own = np.s_[8:12, 6:within]
    assert found[own].sum() == pytest.approx(shifted[own].sum(), rel=0.02)


def test_ranges_know_the_forward_light_of_fog() -> None:
    """A source in fog of 0.08 /m at 7 m, its halo in the frame by points as above but drawn on a finer grid, 24 frames.

    Expected: with the halo known the mean range is right within 4 standard errors and σ true to 30 %; not known it is
    short by more than 1 %; with half of it known, ± 50 %, and with extinction not known the error is within 2 σ.
    """
    range_m = 7.0
    camera = _foggy()
    frames = _frames(camera, _foggy_e(camera, [(49.3, 46.6, range_m)]), 24)
    versions = {
        "known": camera,
        "not": replace(camera, forward_light=()),
        "half": replace(camera, forward_light=(_light(1.0, 0.5, 0.5),)),
        "no extinction": replace(camera, extinction_per_m=0.0, sigma={"extinction_per_m": 0.08}),
    }
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in versions}
    for frame in frames:
        for name, one in versions.items():
            (hit,) = detect(frame, one, estimator="robust")
            errors[name].append((hit.range_m / range_m - 1.0, hit.range_sigma_m / range_m))
    means = {name: np.mean(pairs, axis=0) for name, pairs in errors.items()}
    spread = np.std([error for error, _ in errors["known"]], ddof=1)
    assert abs(means["known"][0]) < 4.0 * spread / math.sqrt(24)
    assert spread == pytest.approx(means["known"][1], rel=0.3)
    assert means["not"][0] < -0.01
    for name in ("half", "no extinction"):
        assert abs(means[name][0]) < 2.0 * means[name][1]
        assert means[name][1] > means["known"][1]


def test_a_halo_stays_unsure_on_uneven_ground() -> None:
    """The border of a shadow, a step of 40 electrons six pixels beside the flare, where extinction is not known.

    12 frames. Expected: the mean error of the range is within 1.5 of its σ, which says that fog may be about.
    """
    camera = _foggy()
    range_m = 7.0
    shadow_e = np.where(np.arange(camera.width_px) > 55, 40.0, 0.0)
    unknown = replace(camera, extinction_per_m=0.0, sigma={**camera.sigma, "extinction_per_m": 0.08})
    pulls = []
    for frame in _frames(camera, _foggy_e(camera, [(49.3, 46.6, range_m)]) + shadow_e, 12):
        (hit,) = detect(frame, unknown, estimator="robust")
        pulls.append((hit.range_m - range_m) / hit.range_sigma_m)
    assert abs(np.mean(pulls)) < 1.5


@pytest.mark.parametrize(("apart_px", "ranges_m"), [(2.0, (7.0, 7.0)), (3.0, (7.0, 9.0))])
def test_each_of_two_flares_in_fog_has_its_own_halo(apart_px: float, ranges_m: tuple[float, float]) -> None:
    """One blob of two flares, 16 frames, halos known. Expected: pulls of the ranges of 1, to what chance allows."""
    camera = _foggy()
    sources = [(49.3 - apart_px, 46.6, ranges_m[0]), (49.3, 46.6, ranges_m[1])]
    pulls = []
    for frame in _frames(camera, _foggy_e(camera, sources), 16):
        hits = sorted(detect(frame, camera, estimator="robust"), key=lambda hit: hit.u_px)
        assert len(hits) == 2
        pulls += [(hit.range_m - r) / hit.range_sigma_m for hit, r in zip(hits, ranges_m, strict=True)]
    assert np.sqrt(np.mean(np.square(pulls))) < 1.0 + 2.5 / math.sqrt(2.0 * len(pulls))


@pytest.mark.parametrize("most_dn", [400, 800])
def test_a_clipped_flare_in_fog_has_the_range_of_its_flux(most_dn: int) -> None:
    """Clipped at a quarter, or at half, of its peak: 16 frames, pulls of ranges of 1, to what chance allows.

    What size says of a clipped flare is worth little; where extinction is known its flux is enough.
    """
    camera = replace(_foggy(), saturation_dn=most_dn)
    range_m = 7.0
    pulls = []
    for frame in _frames(camera, _foggy_e(camera, [(49.3, 46.6, range_m)]), 16):
        (hit,) = detect(frame, camera, estimator="robust")
        assert hit.saturated
        pulls.append((hit.range_m - range_m) / hit.range_sigma_m)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.0 + 2.5 / math.sqrt(2.0 * len(pulls))


@pytest.mark.parametrize("range_m", [5.0, 12.0])
def test_sigma_knows_that_droplets_may_be_of_one_of_four_kinds(range_m: float) -> None:
    """A source in fog of 0.08 /m whose droplets are each of four in turn, their mean and deviations known; 8 frames each.

    Expected: errors over σ of 1 rms over the kinds, within what 32 of them scatter by (2.8 standard errors); with a
    halo of free brightness and the width of the mean it was 1.38 and 1.70.
    """
    known = calibration(
        width_px=97, height_px=97, cx_px=48.0, cy_px=48.0, extinction_per_m=0.08, forward_light=forward_light(USUAL),
        sigma={"extinction_per_m": 1e-6},
    )  # fmt: skip
    u_px, v_px, depth, exposure_s = (
        49.3,
        46.6,
        0.08 * range_m,
        8.0 * EXPOSURE_S if range_m > 10.0 else EXPOSURE_S,
    )
    whole = PixelBox(0, 0, 97, 97)
    cosine = float(direction_camera(np.array([[u_px, v_px]]), known)[0, 2])
    at_1_m_e = known.range_constant_dn_m2_per_s * exposure_s / known.system_gain_dn_per_e
    flux_e = at_1_m_e * cosine * math.exp(-depth) / range_m**2
    own_e = (
        20.0
        + flux_e * flare_image(u_px, v_px, math.asin(known.source_radius_m / range_m), whole, known).fraction
    )
    pulls = []
    for kind in USUAL:
        camera = replace(known, forward_light=forward_light((kind,)))
        (halo_e,) = halos_e(u_px, v_px, flux_e, 0.0, depth, whole, camera)
        for frame in _frames(known, own_e + halo_e, 8):
            (hit,) = detect(replace(frame, exposure_s=exposure_s), known)
            pulls.append((hit.range_m - range_m) / hit.range_sigma_m)
    assert 0.65 < np.sqrt(np.mean(np.square(pulls))) < 1.35
