"""First guesses of clipped flares: those followed lead to where the best of all leads."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import Detection, detect
from perception.model.bearing import direction_camera
from perception.model.flare import PixelBox, flare_image
from perception.model.layout import CLIPPED, SEEN, UNUSABLE
from perception.model.ranging import exposure_towards
from perception.model.window import Camera, lay_out
from perception.robust import solve as solve_module
from perception.robust.problem import Problem, Window
from perception.robust.starts import at_rest
from perception.robust.starts.guesses import more_guesses
from perception.robust.starts.likely import start_costs
from perception.types import Calibration
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, calibration, expected_e, expose, random

Array = NDArray[np.float64]
CAMERA = calibration(width_px=320, height_px=256, cx_px=159.5, cy_px=127.5, sigma={})


FISHEYE = replace(
    CAMERA, lens_model="fisheye", distortion=(0.02, -0.01, 0.002, 0.0), fx_px=200.0, fy_px=200.0,
    response_angle_rad=np.array([0.0, 0.5, 1.1]), response_relative=np.array([1.0, 0.7, 0.2]),
)  # fmt: skip


def _images_e(camera: Calibration, places: list[tuple[float, float, float]], exposure_s: float) -> Array:
    """Return the mean frame of sources, by brute force where a camera lets that."""
    if camera is CAMERA:
        return expected_e(camera, places, exposure_s, 3.0)
    mean_e = np.full((camera.height_px, camera.width_px), 3.0)
    for u, v, range_m in places:
        window = PixelBox.around(u, v, 40.0, camera)
        image = flare_image(u, v, math.asin(camera.source_radius_m / range_m), window, camera)
        direction = direction_camera([(u, v)], camera)
        flux_e = (
            float(exposure_towards(direction, exposure_s, 1.0, camera)[0]) * FLUX_PER_S_AT_1_M / range_m**2
        )
        mean_e[window.slices] += flux_e * image.fraction
    return mean_e


def _told(key: int, nearest_m: float = 0.8, camera: Calibration = CAMERA) -> list[Detection]:
    """Return what is told of six flares, points and discs, clipped up to fifty times, some at the edge."""
    number = random(83, key)
    places = [
        (5.0 + 62.0 * k + number.uniform(0.0, 1.0), row + number.uniform(-0.5, 0.5), nearest_m * 10.0**share)
        for row in (1.0, 128.0)
        for k, share in enumerate(number.random(6).tolist())
    ]
    exposure_s = 10.0 ** number.uniform(-3.3, -2.3)
    return list(detect(expose(_images_e(camera, places, exposure_s), camera, number, exposure_s), camera))


@pytest.mark.parametrize("key", range(2))
def test_the_likeliest_guesses_lead_where_all_lead(key: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """To a tenth of a σ: images are not laid out anew where that is not seen.

    Nor are σ then quite the same: of one that the border cuts, .3 px from where it was laid out, by 2e-3.
    """
    few, followed = _told(key), 0

    def all_of(problems: Sequence[Sequence[Problem]], _: object) -> list[tuple[int, Problem]]:
        nonlocal followed
        chosen = [(index, each) for index, of_one in enumerate(problems) for each in of_one]
        followed += len(chosen)
        return chosen

    monkeypatch.setattr(at_rest, "likely_starts", all_of)
    monkeypatch.setattr(at_rest, "guesses", more_guesses)  # several, also where the light tells one
    every = _told(key)
    assert followed > 2 * len(every)
    assert len(few) == len(every) >= 10
    assert sum(one.saturated for one in few) >= 4
    for one, other in zip(few, every, strict=True):
        assert one.u_px == pytest.approx(other.u_px, abs=0.1 * other.u_sigma_px, nan_ok=True)
        assert one.v_px == pytest.approx(other.v_px, abs=0.1 * other.v_sigma_px, nan_ok=True)
        assert one.range_m == pytest.approx(other.range_m, abs=0.1 * other.range_sigma_m, nan_ok=True)
        assert one.range_sigma_m == pytest.approx(other.range_sigma_m, rel=3e-3, nan_ok=True)


def _cost_by_hand(problem: Problem, clip_e: float, camera: Calibration = CAMERA) -> float:
    """Return −2 ln L of guesses, images by brute force."""
    window = problem.window
    assert window.known_e is not None
    places = [(u, v, math.exp(log_range)) for u, v, log_range in problem.starts]
    mean_e = expected_e(camera, places, 1e-4, problem.background_e)[window.box.slices] + window.known_e
    variance = mean_e + (0.03 * mean_e) ** 2 + window.floor_e2
    seen, clipped = window.state == SEEN, window.state == CLIPPED
    cost = float(((window.image_e - mean_e) ** 2 / variance + np.log(variance))[seen].sum())
    sigmas = (clip_e - mean_e[clipped]) / np.sqrt(variance[clipped])
    return cost - 2.0 * sum(math.log(0.5 * math.erfc(z * math.sqrt(0.5))) for z in sigmas.tolist())


def test_first_guesses_are_as_likely_as_their_images_say() -> None:
    """Two windows, of one flare and of two, unlike in background, noise and light that is known, pixels clipped and
    unusable, responses 3 % apart: by hand, images by brute force."""
    known, problems = Camera(replace(CAMERA, prnu=0.03), 1e-4, 1.0), []
    clip_e = 900.0
    for key, places in enumerate([[(30.3, 22.2, 2.0)], [(100.1, 120.7, 1.5), (108.6, 117.2, 3.0)]]):
        background_e, floor_e2, known_e = (
            9.0 + 40.0 * key,
            100.0 + 80.0 * key,
            30.0 * key + np.arange(41.0 * 41.0) / 50.0,
        )
        box = PixelBox(round(places[0][1]) - 20, round(places[0][0]) - 20, 41, 41)
        whole_e = expected_e(CAMERA, places, 1e-4, background_e)[box.slices] + known_e.reshape(41, 41)
        image_e = np.minimum(random(92, key).poisson(whole_e) + 0.0, clip_e)
        state = np.where(image_e < clip_e, SEEN, CLIPPED).astype(np.uint8)
        state[3, 4] = UNUSABLE
        starts = [(u + 0.2, v, math.log(1.1 * range_m)) for u, v, range_m in places]
        window = Window(box, image_e, state, floor_e2, clip_e, 0.03, known_e=known_e.reshape(41, 41))
        nearer = [(u, v, log_range - 0.7) for u, v, log_range in starts]
        beyond = [(u + 50.0, v, log_range) for u, v, log_range in starts]
        around = [(u, v, math.log(0.0105)) for u, v, _ in starts]  # in the corner partly behind the camera
        problems.append([Problem(window, each, background_e) for each in (starts, nearer, beyond, around)])
    told = start_costs(problems, known)
    for of_window, costs in zip(problems, told, strict=True):
        assert (of_window[0].window.state == CLIPPED).sum() > 5
        for problem, cost, within in zip(of_window, costs, (1e-3, 2e-3), strict=False):
            assert cost == pytest.approx(_cost_by_hand(problem, clip_e), rel=within)
        assert costs[2] == math.inf
    assert told[0][3] == math.inf


def test_a_large_disc_off_the_axis_is_as_likely_as_its_own_image_says() -> None:
    """45° off the axis one of 10 px leans otherwise than one of 30 px, by whose image -2 ln L would be three times that."""
    camera = replace(CAMERA, fx_px=100.0, fy_px=100.0, prnu=0.03)
    place = (59.7, 127.5, 0.2)
    box = PixelBox(87, 20, 81, 81)
    mean_e = expected_e(camera, [place], 1e-4, 3.0)[box.slices]
    nothing_e = np.zeros(mean_e.shape)
    state = np.full(mean_e.shape, SEEN, dtype=np.uint8)
    window = Window(box, mean_e, state, 100.0, math.inf, 0.03, known_e=nothing_e)
    starts = [[(*place[:2], math.log(times * place[2]))] for times in (1.0, 1.0 / 3.0)]
    problems = [Problem(window, each, 3.0) for each in starts]
    ((cost, _),) = start_costs([problems], Camera(camera, 1e-4, 1.0))
    assert cost == pytest.approx(_cost_by_hand(problems[0], math.inf, camera), rel=2e-3)


def test_what_is_larger_than_its_window_is_not_laid_out() -> None:
    """A ball of 1 cm at 12 mm, of a million points, and at 10 cm, of which hardly any is seen; at 1 m it is."""
    u_px, v_px, log_range = np.full(3, 70.0), np.full(3, 60.0), np.log([0.012, 0.1, 1.0])
    laid, imaged = lay_out(Camera(CAMERA, 1e-4, 1.0), u_px, v_px, log_range, most_radius_px=np.full(3, 30.0))
    assert imaged.tolist() == [False, False, True]
    assert np.diff(laid.first_node)[:2].tolist() == [1, 1]
    _, imaged = lay_out(
        Camera(CAMERA, 1e-4, 1.0), u_px[1:], v_px[1:], log_range[1:], most_radius_px=np.full(2, 60.0)
    )
    assert imaged.all()


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["rectilinear", "fisheye"])
def test_images_are_laid_out_anew_where_it_is_seen(
    camera: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Discs of up to 20 px and points, half of them clipped: by far fewer images what ever finer ones say.

    Where a lens is not rectilinear, or its response falls off, the middle of a disc's light is not at its place.
    """
    laid = 0

    def counted(*arguments: object) -> object:
        nonlocal laid
        result = lay_out(*arguments)  # type: ignore[arg-type]
        laid += len(result[1])
        return result

    monkeypatch.setattr(solve_module, "lay_out", counted)
    told, images = [], []
    for kept in ((solve_module._GROWTH_KEPT, solve_module._KEPT_SIGMAS), (-1.0, 0.0)):
        monkeypatch.setattr(solve_module, "_GROWTH_KEPT", kept[0])
        monkeypatch.setattr(solve_module, "_KEPT_SIGMAS", kept[1])
        laid = 0
        told.append([one for key in range(2) for one in _told(key, 0.25, camera)])
        images.append(laid)
    assert images[0] < 0.4 * images[1]
    assert len(told[0]) == len(told[1]) > 20
    for one, other in zip(*told, strict=True):
        assert one.u_px == pytest.approx(other.u_px, abs=0.05 * other.u_sigma_px, nan_ok=True)
        assert one.v_px == pytest.approx(other.v_px, abs=0.05 * other.v_sigma_px, nan_ok=True)
        assert one.range_m == pytest.approx(other.range_m, abs=0.05 * other.range_sigma_m, nan_ok=True)


@pytest.mark.parametrize(("psf_sigma_px", "radius_px"), [(0.4, 1.5), (0.7, 3.0)])
@pytest.mark.parametrize("too_far", [0.6, 1.2])
def test_a_guess_that_is_far_too_small_does_not_matter(
    psf_sigma_px: float, radius_px: float, too_far: float
) -> None:
    """Laid out for a disc of a third of the size, images of it have too few strips: that is half a σ of range."""
    camera = replace(CAMERA, psf_sigma_px=psf_sigma_px)
    u, v, range_m = 162.3, 125.6, 480.0 * camera.source_radius_m / radius_px
    box, number = PixelBox(100, 135, 51, 51), random(95)
    mean_e = expected_e(camera, [(u, v, range_m)], 1.5e-4, 3.0)[box.slices]
    image_e = number.poisson(mean_e) + number.normal(0.0, 10.0, mean_e.shape)
    window = Window(box, image_e, np.full(mean_e.shape, SEEN, dtype=np.uint8), 100.0, math.inf, 0.0)
    problems = [Problem(window, [(u, v, math.log(range_m) + off)], 3.0) for off in (0.0, too_far)]
    one, other = solve_module.solve(problems, Camera(camera, 1.5e-4, 1.0))
    assert one is not None
    assert other is not None
    assert abs(other.u_px[0] - one.u_px[0]) < 0.02 * one.u_sigma_px[0]
    assert abs(other.log_range[0] - one.log_range[0]) < 0.02 * one.log_range_sigma[0]
