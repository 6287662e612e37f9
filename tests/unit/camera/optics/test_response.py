"""C(θ), the one factor into which everything spectral folds."""

from typing import Any

import numpy as np
import pytest

from nir_render import InputError
from nir_render.camera.optics import response as response_module
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.response import incidence, response
from nir_render.scene.documents.emitters import Source
from tests.unit.camera.conftest import CameraMaker

PHOTONS_PER_J_940 = 4.7320e18


def test_without_a_filter_only_lens_and_efficiency_stand_between_light_and_electrons(
    camera_with: CameraMaker, source: Source
) -> None:
    """940 nm: 4.732e18 photons per joule (docs/physics.md, From source to pixel), times 0.9, times 0.15, at every angle."""
    whole = response(camera_with(filter=None), source)
    assert whole(0.0) == pytest.approx(0.9 * 0.15 * PHOTONS_PER_J_940, rel=2e-4)
    assert whole(0.9) == pytest.approx(float(whole(0.0)), rel=1e-12)


def test_a_10_nm_filter_passes_0_22_to_0_23_of_a_42_nm_led(camera_with: CameraMaker, source: Source) -> None:
    in_front = {"placement": "in_front_of_lens", "peak_transmission": 1.0}
    passed = response(camera_with(filter=in_front), source)(0.0) / response(camera_with(filter=None), source)(
        0.0
    )
    assert 0.22 < passed < 0.235


def test_a_filter_in_front_of_the_lens_dims_the_field(camera_with: CameraMaker, source: Source) -> None:
    """docs/physics.md, Narrowband filter, n_eff 2.0: .98, .91, .75, .26 at 10, 15, 20, 30°; the shape of the flanks is ours."""
    in_front = response(camera_with(filter={"placement": "in_front_of_lens"}), source)
    relative = in_front(np.radians([10.0, 15.0, 20.0, 30.0])) / in_front(0.0)
    np.testing.assert_allclose(relative, [0.98, 0.91, 0.75, 0.26], atol=0.015)
    assert in_front(np.radians(45.0)) / in_front(0.0) == pytest.approx(0.004, abs=0.001)


def test_interpolation_over_the_field_agrees_with_a_finer_table(
    camera_with: CameraMaker, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tables over angle and cosine are fine enough: ten times finer ones change C by less than 1e-4 of C(0)."""
    angle_rad = np.linspace(0.0, 0.9, 301)
    for placement in ("behind_lens", "in_front_of_lens"):
        camera = camera_with(filter={"placement": placement})
        coarse = response(camera, source)
        monkeypatch.setattr("nir_render.camera.optics.response._ANGLES", 1290)
        monkeypatch.setattr("nir_render.camera.optics.response._COSINES", 2570)
        fine = response_module._response.__wrapped__(camera, source, None)
        monkeypatch.undo()
        np.testing.assert_allclose(coarse(angle_rad), fine(angle_rad), atol=1e-4 * float(fine(0.0)))


def test_a_quantum_efficiency_must_cover_the_spectrum(camera_with: CameraMaker, source: Source) -> None:
    short = {"points": [["400 nm", 0.5], ["1000 nm", 0.1]]}
    with pytest.raises(
        InputError, match="quantum_efficiency covers 400 to 1000 nm, but is needed from 835 to 1045"
    ):
        response(camera_with(sensor={"quantum_efficiency": short}, filter=None), source)


def test_a_quantum_efficiency_curve_is_weighted_by_what_passes_the_filter(
    camera_with: CameraMaker, source: Source
) -> None:
    """A curve that falls linearly through 0.15 at 940 nm gives what a flat 0.15 gives, for the filter is symmetric."""
    sloped = {"points": [["800 nm", 0.29], ["1080 nm", 0.01]]}
    in_front = {"placement": "in_front_of_lens"}
    flat_c = response(camera_with(filter=in_front), source)(0.0)
    sloped_c = response(camera_with(filter=in_front, sensor={"quantum_efficiency": sloped}), source)(0.0)
    assert sloped_c == pytest.approx(float(flat_c), rel=1e-3)


@pytest.mark.parametrize(
    ("lens", "height"),
    [
        ({}, np.tan),
        ({"focal_length": "2.4 mm", "model": "brown_conrady", "distortion": [-0.06, 0, 0, 0]}, lambda a: np.tan(a) * (1 - 0.06 * np.tan(a) ** 2)),
        ({"focal_length": "2.4 mm", "model": "fisheye", "distortion": [0.02, 0, 0, 0]}, lambda a: a * (1 + 0.02 * a**2)),
    ],
)  # fmt: skip
def test_the_chief_ray_follows_the_distorted_image_height(
    camera_with: CameraMaker, lens: dict[str, Any], height: Any
) -> None:
    """Behind the lens the chief ray meets the filter at CRA · h(θ)/h(corner), h the height of the image as bent.

    The mean of tan² of all rays of a cone is tan² of the chief ray plus half the square of the pupil's radius,
    1/(2N); so the chief ray comes back from the rays, to 1e-9. A straight tan θ would miss by some percent.
    """
    camera = camera_with(lens=lens)
    assert camera.filter is not None
    corner_rad = intrinsics_of(camera).corner_angle_rad
    for angle_rad in (0.2, 0.5, 0.8 * corner_rad):
        cosines, weights = incidence(camera, np.array([angle_rad]))
        mean = float(weights @ (cosines[0] ** -2.0 - 1.0))
        chief_rad = np.arctan(np.sqrt(mean - 0.5 / (2.0 * camera.lens.f_number) ** 2))
        expected = camera.filter.chief_ray_angle_at_corner_rad * height(angle_rad) / height(corner_rad)
        assert chief_rad == pytest.approx(expected, rel=1e-9)
