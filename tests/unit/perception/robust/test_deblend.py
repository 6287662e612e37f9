"""Flares that overlap, of the brute-force simulator, against bounds from its own numerical derivatives."""

import math
from dataclasses import replace

import numpy as np
import pytest

import perception
from perception.model.flare import PixelBox, flare_image
from perception.robust.overlap import deblend
from perception.robust.search.blobs import Blob, divide, near_groups
from tests.hard_frames.scores import (
    BACKGROUND_E,
    BRIGHT_E,
    POINT,
    Flare,
    cell_centres,
    frame_of,
    pair_sigmas,
    score,
)
from tests.unit.perception.simulation import calibration, random


def couples_of(apart_px: float, ratio: float, count: int, *key: int) -> list[tuple[Flare, Flare]]:
    number = random(1, *key)
    couples = []
    for u, v in list(cell_centres())[:count]:
        turn, du, dv = number.random(3) * (2.0 * math.pi, 1.0, 1.0)
        x, y = 0.5 * apart_px * math.cos(turn), 0.5 * apart_px * math.sin(turn)
        couples.append(
            (Flare(u + du - x, v + dv - y, BRIGHT_E), Flare(u + du + x, v + dv + y, BRIGHT_E / ratio))
        )
    return couples


def test_where_more_flares_than_are_tried_may_be_the_frame_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three in a row, of which two alone are looked for: `truncated`; and not where eight may be."""
    flares = [Flare(150.2 + 2.2 * k, 150.4 + 0.3 * k, BRIGHT_E) for k in range(3)]
    frame = frame_of(flares, POINT, BACKGROUND_E, 25)
    whole = perception.detect(frame, POINT)
    assert (len(whole), whole.truncated) == (3, False)
    monkeypatch.setattr(deblend, "MOST_FLARES", 2)
    assert perception.detect(frame, POINT).truncated


@pytest.mark.parametrize(("apart_px", "ratio"), [(1.0, 1.0), (2.0, 1.0), (3.0, 1.0), (2.0, 5.0), (3.0, 20.0)])
def test_pairs_are_told_apart_at_their_bound(apart_px: float, ratio: float) -> None:
    """12 pairs: none missed, none too many; errors over the pair's bound have the mean square 1 (4 σ of χ²).

    So have the errors over the claimed sigmas: one that did not know of the neighbour would be half as large
    at 1 px.
    """
    couples = couples_of(apart_px, ratio, 12, round(10 * apart_px), round(ratio))
    flares = [flare for couple in couples for flare in couple]
    frame = frame_of(flares, POINT, BACKGROUND_E, 2, round(10 * apart_px), round(ratio))
    scored = score(flares, perception.detect(frame, POINT), 0.5 * apart_px)
    assert not scored.false_alarms
    assert all(hit is not None and not hit.merged for hit in scored.hits)
    over_bound, pulls = [], []
    for index, couple in enumerate(couples):
        for flare, hit, sigma in zip(
            couple,
            scored.hits[2 * index : 2 * index + 2],
            pair_sigmas(*couple, POINT, BACKGROUND_E),
            strict=True,
        ):
            assert hit is not None
            log_flux = math.log(hit.flux_dn / POINT.system_gain_dn_per_e / flare.flux_e)
            error = np.array([hit.u_px - flare.u_px, hit.v_px - flare.v_px, log_flux])
            over_bound.append(error / sigma)
            pulls.append(error[:2] / (hit.u_sigma_px, hit.v_sigma_px))
    # At 1 px the errors of both flares go together: 12 independent ones of each kind.
    for values in (np.array(over_bound), np.array(pulls)):
        assert np.mean(values**2) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (12 * values.shape[1])))


@pytest.mark.parametrize("width", [0.97, 1.03])
def test_a_lone_flare_stays_one_though_the_point_spread_be_wrong(width: float) -> None:
    """81 points of 10³ to 10⁵ e⁻; the calibration says a point spread 3 % too narrow or too wide."""
    places = random(3, round(100 * width)).random((81, 3))
    flares = [
        Flare(u + du, v + dv, 10.0 ** (3.0 + 2.0 * share))
        for (u, v), (du, dv, share) in zip(cell_centres(), places, strict=True)
    ]
    frame = frame_of(flares, POINT, BACKGROUND_E, 4, round(100 * width))
    found = perception.detect(frame, replace(POINT, psf_sigma_px=width * POINT.psf_sigma_px))
    assert len(found) == len(flares)


def test_the_image_grows_as_its_derivative_says() -> None:
    """∂S/∂ln ρ of a disc of 3 px, off the axis, against a difference over ±0.1 %: to 0.6 % of its peak, as the image's middle moves too."""
    camera = calibration()
    box = PixelBox(280, 880, 41, 41)
    radius_rad = 3.0 / 480.0
    grown, shrunk = (
        flare_image(900.3, 300.7, factor * radius_rad, box, camera).fraction for factor in (1.001, 0.999)
    )
    image = flare_image(900.3, 300.7, radius_rad, box, camera)
    np.testing.assert_allclose(
        image.d_dgrowth, (grown - shrunk) / 0.002, atol=6e-3 * np.abs(image.d_dgrowth).max()
    )


def block(top: int, left: int, height: int = 2, width: int = 2) -> Blob:
    return Blob(PixelBox(top, left, height, width), np.ones((height, width), dtype=bool))


def test_blobs_are_grouped_by_what_lies_between_them() -> None:
    """Gaps of 3 px join, of 4 px do not; the first and the third meet by the second."""
    blobs = [block(0, 0), block(0, 5), block(5, 9), block(30, 0), block(0, 15)]
    assert near_groups(blobs, 3) == [[0, 1, 2], [3], [4]]
    assert near_groups([], 3) == []


def test_pixels_go_to_the_nearest_flare() -> None:
    first, second, dark = divide([block(0, 0, 2, 6)], np.array([0.5, 4.5, 9.0]), np.array([0.5, 0.5, 7.2]))
    assert first is not None
    assert second is not None
    assert (first.box, first.area_px) == (PixelBox(0, 0, 2, 3), 6)
    assert (second.box, second.area_px) == (PixelBox(0, 3, 2, 3), 6)
    assert dark is None
