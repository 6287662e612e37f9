"""Small sources under every form of core: energy, place, and the closed form of each part."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize_scalar
from scipy.signal import convolve2d
from scipy.special import j0, j1

from nir_render.camera.optics.gaussian_fit import gaussian_fit
from nir_render.camera.optics.lens import Intrinsics
from nir_render.camera.optics.otf import Core, core_of
from nir_render.camera.optics.psf import Window, cone_nodes, source_window
from nir_render.camera.optics.waves import convolve, image_of_points
from nir_render.scene.documents.point_spread import MeasuredKernel
from nir_render.scene.text.units import FRACTION, format_vector
from tests.unit.camera.conftest import CameraMaker

LENS = Intrinsics(640, 480, 480.0, 480.0, 319.5, 239.5)
WIDE = Intrinsics(1280, 960, 480.0, 480.0, 639.5, 479.5)
Array = np.ndarray


def _kernel(pitch_px: float, half: int, *spots: tuple[float, float, float]) -> MeasuredKernel:
    """Return samples of Gaussians of σ = 0.7 px: their light, and where they are, u and v in px."""
    at_px = pitch_px * np.arange(-half, half + 1)
    values = sum(
        light * np.exp(-((at_px - u) ** 2 + (at_px[:, None] - v) ** 2) / (2.0 * 0.7**2))
        for light, u, v in spots
    )
    rows = [format_vector(tuple(float(value) for value in row), FRACTION) for row in np.asarray(values)]
    return MeasuredKernel.model_validate({"pitch": f"{pitch_px} px", "values": rows})


CORES = {
    "Gaussian": Core(0.7),
    "Airy at f/2, 3.75 µm": Core(airy_px=0.5013),
    "Airy at f/5.6, 3.45 µm": Core(airy_px=1.526),
    "Airy and Gaussian": Core(0.7, 0.5013),
    "Airy out of focus": Core(airy_px=0.5013, defocus_px=3.0),
    "Gaussian out of focus": Core(0.7, defocus_px=4.0),
    "Gaussian slightly out of focus": Core(0.7, defocus_px=0.34),
    "crosstalk": Core(0.7, crosstalk=0.04),
    "kernel": Core(kernel=_kernel(0.25, 16, (1.0, 0.0, 0.0), (0.3, 0.9, -0.6))),
    "all": Core(0.5, 0.5013, 1.0, _kernel(0.25, 16, (1.0, 0.0, 0.0), (0.3, 0.9, -0.6)), 0.02),
}
every_core = pytest.mark.parametrize("core", CORES.values(), ids=CORES.keys())


def _even(cosine: Array) -> Array:
    return np.asarray(1.0e5 * cosine)


def _frame(window: Window, lens: Intrinsics = LENS) -> Array:
    image = np.zeros((lens.height_px, lens.width_px))
    window.add_into(image)
    return image


def _centroid(window: Window) -> tuple[float, float]:
    rows, columns = np.indices(window.values.shape)
    light = window.values.sum()
    return (
        float((columns * window.values).sum() / light) + window.column,
        float((rows * window.values).sum() / light) + window.row,
    )


def _passed_at_one_wave_per_pixel(core: Core, radius_px: float) -> float:
    """Return the contrast of waves of one pixel, of a disc's image before the pixels, from the definitions."""
    passed = math.exp(-2.0 * (math.pi * core.sigma_px) ** 2)
    if core.airy_px:
        half = math.acos(min(core.airy_px, 1.0))
        passed *= (2.0 * half - math.sin(2.0 * half)) / math.pi
    for diameter_px in (core.defocus_px, 2.0 * radius_px):
        if diameter_px:
            passed *= 2.0 * j1(math.pi * diameter_px) / (math.pi * diameter_px)
    return passed


OFFSETS = [(0.0, 0.0), (0.25, 0.5), (0.37, -0.11), (0.5, 0.5), (-0.48, 0.26)]


@every_core
@pytest.mark.parametrize("angular_radius_rad", [0.0, 0.001, 0.01])
@pytest.mark.parametrize("offset", OFFSETS)
def test_energy_and_centroid(core: Core, angular_radius_rad: float, offset: tuple[float, float]) -> None:
    """A sphere's flux is Φ cos θ of its centre, and its centroid its centre's projection, wherever that is.

    Pixels sample the image: where waves of one pixel pass with contrast T, its centroid moves by
    −T sin(2πu)/π (Poisson's sum of x·image; the pixel's sinc has slope ∓1 there). T is 6e-5 for σ = 0.7 px,
    but 0.39 for the Airy pattern of f/2 alone, which pixels of 3.75 µm undersample: ±0.12 px, as in a camera.
    """
    place = (760.0 + offset[0], 380.0 + offset[1])
    direction = WIDE.unproject(np.array(place))
    window = source_window(WIDE, core, direction, angular_radius_rad, _even)
    expected = 1.0e5 * direction[2] * 0.5 * (1.0 + np.cos(angular_radius_rad))
    assert window.total == pytest.approx(expected, rel=1e-9)
    assert window.values.sum() == pytest.approx(expected, rel=1e-6)
    assert window.values.min() > -1e-7 * expected
    sampled = []
    for x, slope in zip(place, direction[:2] / direction[2], strict=True):
        # How far a rectilinear image reaches along an axis: f α √(1 + tan² of that axis) / cos θ.
        half_px = 480.0 * angular_radius_rad * math.hypot(1.0, slope) / direction[2]
        passed = 0.0 if core.kernel else _passed_at_one_wave_per_pixel(core, half_px)
        sampled.append(x - passed * math.sin(2.0 * math.pi * x) / math.pi)
        assert abs(passed) < 0.005 or core.airy_px == 0.5013
    assert _centroid(window) == pytest.approx(sampled, abs=0.001)


@every_core
def test_light_beyond_the_frame_is_counted(core: Core) -> None:
    """The image on a sensor is that on a larger one, cut; a source on the edge leaves half of its light there."""
    larger = Intrinsics(1340, 1180, 480.0, 480.0, 669.5, 589.5)
    for u_px, v_px in [(-0.5, 240.1), (-1.3, 1.7), (638.9, 479.2)]:
        direction = LENS.unproject(np.array([u_px, v_px]))
        cut = source_window(LENS, core, direction, 0.002, _even)
        whole = source_window(larger, core, direction, 0.002, _even)
        np.testing.assert_allclose(
            _frame(cut), _frame(whole, larger)[350:830, 350:990], atol=1e-9 * cut.total
        )
        assert cut.total == whole.total == pytest.approx(whole.values.sum(), rel=1e-6)
        if u_px == -0.5 and core.kernel is None:
            assert cut.values.sum() == pytest.approx(0.5 * cut.total, rel=1e-3)
    assert source_window(LENS, core, LENS.unproject(np.array([-900.0, 50.0])), 0.0, _even).values.size == 0


@pytest.mark.parametrize(
    "core", [CORES["Airy and Gaussian"], CORES["Gaussian out of focus"], CORES["crosstalk"]]
)
def test_a_gradient_of_the_response_moves_the_centroid_to_that_of_the_weighted_disc(core: Core) -> None:
    """A filter that fades with the angle, as cos²⁰⁰ θ, at 30°: the centroid of directions so weighted.

    A disc of 12 px radius; the weighted mean over it is from 200 000 directions, evenly spread.
    """
    place = (900.3, 570.8)
    direction = WIDE.unproject(np.array(place))

    def fading(cosine: Array) -> Array:
        return np.asarray(cosine**200.0)

    window = source_window(WIDE, core, direction, 0.02, fading)
    directions, shares = cone_nodes(direction, 0.02, 200)
    weight = shares * fading(directions[:, 2])
    expected = weight @ WIDE.project(directions) / weight.sum()
    assert np.hypot(*(expected - place)) > 0.5
    assert _centroid(window) == pytest.approx(tuple(expected), abs=0.002)


@pytest.mark.parametrize("sigma_px", [0.3, 0.7, 2.0])
def test_waves_and_error_functions_agree_on_a_gaussian(sigma_px: float) -> None:
    """Five points of unlike power, placed by waves, against the exact integral over each pixel: to 1e-7."""
    places_px = np.array([[30.2, 31.7], [30.9, 32.2], [34.5, 28.0], [33.1, 30.0], [29.0, 35.5]])
    power = np.array([1.0, 0.5, 2.0, 0.1, 0.4])
    values, row, column = image_of_points(Core(sigma_px), places_px, power, 64, 64)
    expected = np.zeros((64, 64))
    for (u, v), light in zip(places_px, power, strict=True):
        axis = [
            [0.5 * math.erf(t) for t in (np.arange(65) - 0.5 - at) / (math.sqrt(2.0) * sigma_px)]
            for at in (v, u)
        ]
        expected += light * np.outer(np.diff(axis[0]), np.diff(axis[1]))
    image = np.zeros((64, 64))
    image[row : row + values.shape[0], column : column + values.shape[1]] = values
    np.testing.assert_allclose(image, expected, atol=2e-7)


def test_encircled_energy_of_the_airy_pattern() -> None:
    """Within r of its centre lies 1 − J₀²(v) − J₁²(v) of the light, v = π r / λN; at λN = 3 px.

    Pixels on the circle count by the part of them inside, of 40 × 40 points; that the light is uneven in them
    is what is left.
    """
    airy_px, middle = 3.0, (600.31, 599.87)
    values, row, column = image_of_points(Core(airy_px=airy_px), np.array([middle]), np.ones(1), 1200, 1200)
    image = np.zeros((1200, 1200))
    image[row : row + values.shape[0], column : column + values.shape[1]] = values
    part = np.ones((40, 40))
    fine = np.kron(image[560:640, 560:640] / 1600.0, part)
    at_px = 560.0 + (np.arange(fine.shape[0]) + 0.5) / 40.0 - 0.5
    radius_px = np.hypot(at_px - middle[0], at_px[:, None] - middle[1])
    for r_px, within in ((3.66, 2e-3), (6.0, 4e-3), (12.0, 1e-3), (30.0, 2e-4)):
        v = math.pi * r_px / airy_px
        assert fine[radius_px < r_px].sum() == pytest.approx(1.0 - j0(v) ** 2 - j1(v) ** 2, abs=within)


@pytest.mark.parametrize("at", [(0, 0), (1, 0), (2, 3), (9, 4), (40, 0)])
def test_the_airy_pattern_on_a_pixel(at: tuple[int, int]) -> None:
    """Its density π/(4 (λN)²) (2 J₁(v)/v)², integrated over a pixel by 24 × 24 Gauss nodes; λN = 1.1 px.

    What comes round the edges of the period, 1e-3 of the light over 400² pixels, is 6e-9 per pixel.
    """
    airy_px, centre = 1.1, (300.2, 299.65)
    values, row, column = image_of_points(Core(airy_px=airy_px), np.array([centre]), np.ones(1), 600, 600)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    u, v = 300.0 + at[0] + 0.5 * nodes - centre[0], 300.0 + at[1] + 0.5 * nodes - centre[1]
    x = np.pi * np.hypot(u, v[:, None]) / airy_px
    density = np.pi / (4.0 * airy_px**2) * (2.0 * j1(x) / x) ** 2
    expected = 0.25 * weights @ density @ weights
    assert values[300 + at[1] - row, 300 + at[0] - column] == pytest.approx(expected, rel=1e-3, abs=2e-8)


@pytest.mark.parametrize(
    "core", [Core(0.7, defocus_px=2.0), Core(0.7, defocus_px=9.0), Core(0.7, defocus_px=0.34)]
)
def test_second_moment_of_what_is_out_of_focus(core: Core) -> None:
    """Variances add along an axis: σ² of the Gaussian, D²/16 of the disc, 1/12 of the pixel."""
    window = source_window(LENS, core, LENS.unproject(np.array([300.2, 200.7])), 0.0, np.ones_like)
    u_px = np.arange(window.values.shape[1]) + window.column - _centroid(window)[0]
    expected = 0.49 + core.defocus_px**2 / 16.0 + 1.0 / 12.0
    assert window.values.sum(axis=0) @ u_px**2 == pytest.approx(expected, rel=4e-4)


def test_a_blur_circle_is_even_inside() -> None:
    """Diameter 14 px under σ = 0.7 px: 4/(π D²) of the light in each pixel up to 3 σ from the rim."""
    window = source_window(
        LENS, Core(0.7, defocus_px=14.0), LENS.unproject(np.array([300.0, 200.0])), 0.0, np.ones_like
    )
    rows, columns = np.indices(window.values.shape)
    radius_px = np.hypot(rows + window.row - 200.0, columns + window.column - 300.0)
    np.testing.assert_allclose(window.values[radius_px < 4.0], 4.0 / (np.pi * 14.0**2), rtol=1e-3)
    assert window.values[radius_px > 11.0].max() < 1e-5


def test_crosstalk_gives_each_neighbour_a_quarter_of_its_share() -> None:
    """Against the image without it: 1 − s stays, s/4 goes to each of the four, none across the corner."""
    direction = LENS.unproject(np.array([300.3, 200.8]))
    without = _frame(source_window(LENS, Core(0.7), direction, 0.003, np.ones_like))
    kernel = np.array([[0.0, 0.01, 0.0], [0.01, 0.96, 0.01], [0.0, 0.01, 0.0]])
    expected = convolve2d(without, kernel, mode="same")
    image = _frame(source_window(LENS, Core(0.7, crosstalk=0.04), direction, 0.003, np.ones_like))
    np.testing.assert_allclose(image, expected, atol=2e-7)


def test_a_measured_kernel_keeps_its_shape_and_stands_on_its_centroid() -> None:
    """Samples of two Gaussians, 0.7 of the light left, 0.3 of it 2 px to the right and 1 px down.

    Their image must be that of the two, moved so that the common centroid, (0.6, 0.3) px from the first, is
    where the projection says.
    """
    kernel = _kernel(0.25, 28, (0.7, -1.0, 0.4), (0.3, 1.0, 1.4))
    direction = LENS.unproject(np.array([300.3, 200.8]))
    image = _frame(source_window(LENS, Core(kernel=kernel), direction, 0.0, np.ones_like))
    expected = sum(
        light * _frame(source_window(LENS, Core(0.7), LENS.unproject(np.array(place)), 0.0, np.ones_like))
        for light, place in ((0.7, (299.7, 200.5)), (0.3, (301.7, 201.5)))
    )
    np.testing.assert_allclose(image, np.asarray(expected), atol=1e-5)


def test_sums_of_sources_are_sums_of_images() -> None:
    places_px, power = np.array([[50.2, 40.1], [55.9, 43.3]]), np.array([2.0, 3.0])
    core = CORES["all"]
    both = np.zeros((100, 100))
    apart = np.zeros((100, 100))
    for image, chosen in ((both, [0, 1]), (apart, [0]), (apart, [1])):
        values, row, column = image_of_points(core, places_px[chosen], power[chosen], 100, 100)
        image[row : row + values.shape[0], column : column + values.shape[1]] += values
    # Both fill the frame; apart, the little that comes round the edges comes round elsewhere.
    np.testing.assert_allclose(both, apart, atol=5e-7)


@pytest.mark.parametrize("core", [Core(0.7, crosstalk=0.04), Core(0.7, defocus_px=3.0), Core(airy_px=0.5013)])
def test_extended_light_is_spread_as_by_direct_summation(core: Core) -> None:
    """Light of 24 × 17 random pixels, edge pixels continued, against a sum over all pairs of pixels."""
    image = np.random.default_rng(5).random((17, 24))
    spread = convolve(core, image)
    optics = Core(
        math.sqrt(max(core.sigma_px**2 - 1.0 / 12.0, 0.0)),
        core.airy_px,
        core.defocus_px,
        None,
        core.crosstalk,
    )
    kernel, _, _ = image_of_points(optics, np.array([[300.0, 300.0]]), np.ones(1), 601, 601)
    half = kernel.shape[0] // 2
    padded = np.pad(image, half, mode="edge")
    expected = [
        [(kernel[::-1, ::-1] * padded[row + 1 : row + 1 + 2 * half, column + 1 : column + 1 + 2 * half]).sum() for column in range(24)]
        for row in range(17)
    ]  # fmt: skip
    np.testing.assert_allclose(spread, expected, rtol=1e-9)
    np.testing.assert_allclose(convolve(core, np.full((17, 24), 3.0)), 3.0, rtol=1e-6)


def test_extended_light_under_a_gaussian_and_hardly_more() -> None:
    """With next to no crosstalk it must come out as under the Gaussian alone: a step within 0.2 % of it."""
    image = np.zeros((40, 40))
    image[:, 20:] = 1.0
    expected = gaussian_filter(image, 0.7, mode="nearest", truncate=6.0)
    np.testing.assert_allclose(convolve(Core(0.7, crosstalk=1e-12), image), expected, atol=0.002)


def test_the_gaussian_that_looks_most_like_a_core() -> None:
    """Exact for Gaussians; for an Airy disc far larger than a pixel, the fit of the two densities by integrals."""
    assert gaussian_fit(Core(0.7)).sigma_px == 0.7
    assert gaussian_fit(Core(0.7)).share == 1.0
    measured = gaussian_fit(Core(kernel=_kernel(0.25, 20, (1.0, 0.0, 0.0))))
    assert (measured.sigma_px, measured.share) == pytest.approx((0.7, 1.0), rel=1e-4)
    slight = gaussian_fit(Core(0.7, defocus_px=0.36))
    assert slight.sigma_px == pytest.approx(math.hypot(0.7, 0.09), rel=1e-3)

    def airy(r: float) -> float:
        return float((2.0 * j1(math.pi * r) / (math.pi * r)) ** 2)

    def missed(sigma: float) -> float:
        overlap = quad(lambda r: airy(r) * math.exp(-0.5 * (r / sigma) ** 2) * r, 0.0, 6.0, limit=200)[0]
        return -(overlap**2) / (0.5 * sigma**2)

    best = float(minimize_scalar(missed, bounds=(0.2, 0.8), method="bounded").x)
    assert best == pytest.approx(0.42, abs=0.01)
    large = gaussian_fit(Core(airy_px=4.0))
    # The pixel, in both images, matters to second order only.
    assert large.sigma_px == pytest.approx(4.0 * best, rel=0.003)
    v = 3.0 * best * math.pi
    held = (1.0 - j0(v) ** 2 - j1(v) ** 2) / (1.0 - math.exp(-4.5))
    assert large.share == pytest.approx(held, rel=0.004)


def test_the_core_of_a_camera(camera_with: CameraMaker) -> None:
    """λ N / pitch = 940 nm · 2 / 3.75 µm; focused at 2 m, the blur circle at 0.5 m and at infinity.

    c = (f/N) · f |d − d_f| / (d (d_f − f)): 0.9 mm · 1.8 mm · 1.5 m / (0.5 m · 1.9982 m) = 2.432 µm.
    """
    camera = camera_with(
        point_spread={"diffraction": "940 nm", "crosstalk": "2 %"}, lens={"focus_distance": "2 m"}
    )
    core = core_of(camera, 0.5)
    assert (core.sigma_px, core.crosstalk) == (0.7, 0.02)
    assert core.airy_px == pytest.approx(0.940 * 2.0 / 3.75)
    assert core.defocus_px == pytest.approx(2.432 / 3.75, rel=1e-3)
    assert core_of(camera).defocus_px == pytest.approx(0.9e-3 * 1.8e-3 / 1.9982 / 3.75e-6, rel=1e-4)
    assert core_of(camera_with()) == Core(0.7)
