"""Sources before a bright background: a black sphere takes away what it stands before."""

import math
from dataclasses import replace

import numpy as np
import pytest

from perception import RawFrame, detect
from perception.model.ranging import range_from_flux
from perception.rig.extinction import Extinction, corrected
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, expected_e

EXPOSURE_S = 2e-4
BACKGROUND_E = 90.0
CAMERA = calibration(sigma={}, hidden_background=1.0, system_gain_dn_per_e=0.74, read_noise_e=1.0)


def _frame(place: tuple[float, float, float], white: float) -> RawFrame:
    """A frame without noise of a source that sends back `white` of the ambient light that it hides.

    The covered part of each pixel is the source's own image, its sum the solid angle of the sphere's cap over
    that of a pixel, cos³ θ/(fx fy), and a pixel more off the axis sees less of it.
    """
    u, v, range_m = place
    image = expected_e(CAMERA, [place], EXPOSURE_S)
    x, y = (u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px
    pixel_sr = (1.0 + x**2 + y**2) ** -1.5 / (CAMERA.fx_px * CAMERA.fy_px)
    cap_sr = 2.0 * math.pi * (1.0 - math.sqrt(1.0 - (CAMERA.source_radius_m / range_m) ** 2))
    covered = image / image.sum() * cap_sr / pixel_sr
    mean_e = image + BACKGROUND_E * (1.0 - (1.0 - white) * covered)
    # Rounded by chance, as noise would: a background of one count lacks the fit's own scatter.
    counts = CAMERA.system_gain_dn_per_e * mean_e + CAMERA.black_level_dn
    chance = np.random.Generator(np.random.Philox(3)).random(counts.shape)
    return RawFrame("r1.front", 0, 0.0, EXPOSURE_S, np.floor(counts + chance).astype(np.uint16), 64.0)


def _range_m(frame: RawFrame, known: Calibration) -> float:
    (found,) = detect(frame, known)
    return found.range_m


@pytest.mark.parametrize("place", [(600.3, 460.7, 4.0), (850.2, 350.4, 2.2), (660.0, 480.0, 1.2)])
def test_ranges_are_those_in_the_dark(place: tuple[float, float, float]) -> None:
    """Within 0.1 %; who does not know of it ranges up to 2.5 % too far."""
    frame = _frame(place, 0.0)
    assert _range_m(frame, CAMERA) == pytest.approx(place[2], rel=1e-3)
    assert _range_m(frame, replace(CAMERA, hidden_background=0.0)) > 1.004 * place[2]


def test_what_a_white_source_sends_back_is_not_hidden() -> None:
    place = (600.3, 460.7, 4.0)
    assert _range_m(_frame(place, 0.6), replace(CAMERA, hidden_background=0.4)) == pytest.approx(
        4.0, rel=1e-3
    )
    assert _range_m(_frame(place, 1.0), replace(CAMERA, hidden_background=0.0)) == pytest.approx(
        4.0, rel=1e-3
    )


@pytest.mark.parametrize("fog", [{}, {"extinction_per_m": 1e-6}])
def test_who_does_not_know_how_white_says_so(fog: dict[str, float]) -> None:
    """Also where there may be fog, of which σ is 1e-6 /m. At ± 0.5 the ranges at 0 and 1 lie two σ apart, of one so far that its size says nothing."""
    frame = _frame((600.3, 460.7, 8.0), 0.0)
    plain, unsure = (replace(CAMERA, sigma=sigma) for sigma in (fog, {**fog, "hidden_background": 0.5}))
    near, far = _range_m(frame, CAMERA), _range_m(frame, replace(CAMERA, hidden_background=0.0))
    (exact,), (told,) = detect(frame, plain), detect(frame, unsure)
    added_m = math.sqrt(told.range_sigma_m**2 - exact.range_sigma_m**2)
    assert added_m == pytest.approx(0.5 * (far - near), rel=0.05)
    assert told.range_sigma_common_m == pytest.approx(added_m, rel=0.01)
    if fog:
        # Fog that is found afterwards leaves it as it is.
        found = Extinction(0.0, 1e-6)
        ((again,),) = corrected([frame], [[told]], {"r1.front": unsure}, found)
        assert again.range_sigma_m == pytest.approx(told.range_sigma_m, rel=1e-6)
        assert again.range_sigma_common_m == pytest.approx(told.range_sigma_common_m, rel=1e-6)


def test_by_aperture_likewise() -> None:
    """F = F₁/d² − π r² B/(Ω d²), Ω = cos³ θ/f²; on the axis."""
    at_1_m_dn = CAMERA.range_constant_dn_m2_per_s * EXPOSURE_S
    hidden_dn = math.pi * CAMERA.source_radius_m**2 * 100.0 * CAMERA.fx_px**2
    flux_dn = (at_1_m_dn - hidden_dn) / 9.0
    found = range_from_flux(flux_dn, 0.0, 639.5, 479.5, EXPOSURE_S, 1.0, CAMERA, background_dn=100.0)
    assert found.range_m == pytest.approx(3.0, rel=1e-6)


def test_sources_that_hide_each_other_are_as_unsure_in_fog() -> None:
    """At 4 m and 6.7 m, 1.9 px apart: too small to tell how much of the farther is hidden. In air and hardly any fog."""
    pair_e = expected_e(CAMERA, [(600.2, 460.1, 4.0), (602.1, 460.4, 6.7)], EXPOSURE_S, 5.0)
    counts = np.rint(CAMERA.system_gain_dn_per_e * pair_e + CAMERA.black_level_dn).astype(np.uint16)
    frame = RawFrame("r1.front", 0, 0.0, EXPOSURE_S, counts, 64.0)
    known = replace(CAMERA, hidden_background=0.0, read_noise_e=10.0)
    unsure = replace(known, extinction_per_m=1e-6, sigma={"extinction_per_m": 1e-6})
    clear, foggy = (sorted(detect(frame, one), key=lambda hit: hit.u_px)[-1] for one in (known, unsure))
    assert clear.range_sigma_m > 0.1
    assert foggy.range_sigma_m == pytest.approx(clear.range_sigma_m, rel=0.1)
