"""The interference filter against figures worked out by hand."""

import numpy as np
import pytest

from nir_render.scene.documents.spectral.bandpass import Bandpass


def _filter(**changes: object) -> Bandpass:
    figures = {
        "placement": "in_front_of_lens", "centre": "940 nm", "fwhm": "10 nm", "peak_transmission": 0.9,
        "effective_index": 1.8, "blocking_od": 4.0,
    }  # fmt: skip
    return Bandpass.model_validate({**figures, **changes})


@pytest.mark.parametrize(
    ("index", "shifts_nm"),
    [(1.8, {10: 4.4, 15: 9.8, 20: 17.1, 30: 37.0}), (2.0, {10: 3.6, 15: 7.9, 20: 13.9, 30: 29.9})],
)
def test_the_passband_moves_to_the_blue_with_the_angle(index: float, shifts_nm: dict[int, float]) -> None:
    """docs/physics.md, Narrowband filter, gives the shifts; the passband's centre of mass must lie there."""
    nm = np.linspace(840.0, 1000.0, 16001)
    for angle_deg, shift_nm in shifts_nm.items():
        passed = _filter(effective_index=index).transmission(nm * 1e-9, np.cos(np.radians(angle_deg)))
        passed = np.where(passed > 1e-3, passed, 0.0)
        assert 940.0 - (passed * nm).sum() / passed.sum() == pytest.approx(shift_nm, abs=0.07)


@pytest.mark.parametrize("cavities", [1, 3, 5])
def test_peak_width_and_floor_are_those_of_the_data_sheet(cavities: int) -> None:
    bandpass = _filter(cavities=cavities)
    assert bandpass.transmission(940e-9, 1.0) == pytest.approx(0.9)
    assert bandpass.transmission([935e-9, 945e-9], 1.0) == pytest.approx([0.45, 0.45])
    assert bandpass.transmission(400e-9, 1.0) >= 1e-4
    if cavities > 1:
        assert bandpass.transmission(400e-9, 1.0) == pytest.approx(1e-4)
