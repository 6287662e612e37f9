"""The σ of ranges: its limit is the judge's, its causes add up, and those that no calibration knows, by hand."""

import math
from typing import Any

import pytest

from nir_render import SourceTruth, calibration, load_scene
from nir_render.budget.assumptions import Assumptions, assumptions_of
from nir_render.budget.budget import CameraBudget, photon_budget
from nir_render.budget.causes import LIMIT_CAUSES, OTHER_CAUSES
from nir_render.budget.tables import fog_sentence
from nir_render.errors import InputError
from nir_render.evaluate.metrics import source_limits
from tests.paths import SCENES

CAMERA = "robots.r1.rig.cameras.front"


def _camera(changes: dict[str, Any] | None = None, **assumed: float) -> CameraBudget:
    scene = load_scene(SCENES / "one_source.yaml").with_(changes or {})
    return photon_budget(scene, 4.0, Assumptions(**assumed)).cameras[0]


@pytest.mark.parametrize("scene_name", ["one_source", "arena", "regression/glass", "foggy_hall"])
def test_the_limit_is_that_of_the_judge_and_causes_add_up(scene_name: str) -> None:
    scene = load_scene(SCENES / f"{scene_name}.yaml")
    (camera, *_) = photon_budget(scene).cameras
    for source in camera.sources:
        for curve in source.curves:
            for index, limit_m in enumerate(curve.range_limit_m):
                if limit_m is None:
                    continue
                causes = {cause: values[index] or 0.0 for cause, values in curve.causes_m.items()}
                assert set(causes) == {*LIMIT_CAUSES, *OTHER_CAUSES}
                assert math.hypot(*(causes[name] for name in LIMIT_CAUSES)) == pytest.approx(
                    limit_m, rel=1e-9
                )
                assert math.hypot(*causes.values()) == pytest.approx(curve.range_sigma_m[index], rel=1e-9)
    assert camera.in_view
    for row in camera.in_view:
        robot, source_name = row.source.split(".")
        share = next(source.flare_share for source in camera.sources if row.source in source.sources)
        truth = SourceTruth(
            camera=row.camera,
            index=0,
            time_s=0.0,
            source=source_name,
            robot=robot,
            u_px=row.u_px,
            v_px=row.v_px,
            range_m=row.range_m,
            bearing_body=(1.0, 0.0, 0.0),
            direct_e=row.electrons_e,
            background_e=camera.background_e_per_s * row.exposure_s,
            dark_e=camera.dark_rate_e_per_s * row.exposure_s,
            gain=row.gain,
            flare_share=share,
        )
        judged_m, _ = source_limits(truth, calibration(scene, row.camera))
        assert row.range_limit_m == pytest.approx(judged_m, rel=1e-9)


def test_heat_by_hand() -> None:
    """Without a filter ±10 K are ∓3 % of flux and, by λ/hc, ±2.8/940 of electrons: half of that of the range."""
    curve = _camera({f"{CAMERA}.filter": None}).sources[0].curves[0]
    up = math.log(0.97 * 942.8 / 940.0)
    down = math.log(1.03 * 937.2 / 940.0)
    share = 0.5 * math.sqrt(0.5 * (up**2 + down**2))
    index = curve.range_m.index(3.0)
    assert curve.causes_m["led_temperature_m"][index] == pytest.approx(3.0 * share, rel=1e-3)


def test_an_led_states_its_own_coefficients() -> None:
    """SFH 4545 at 25 °C: −0.5 %/K and 0.3 nm/K."""
    changes = {
        f"{CAMERA}.filter": None,
        "robots.r2.rig.sources.top.spectrum": {"led": {"preset": "sfh_4545", "skew": 0}},
    }
    curve = _camera(changes, led_temperature_sigma_k=4.0).sources[0].curves[0]
    up, down = math.log(0.98 * 941.2 / 940.0), math.log(1.02 * 938.8 / 940.0)
    share = 0.5 * math.sqrt(0.5 * (up**2 + down**2))
    index = curve.range_m.index(3.0)
    assert curve.causes_m["led_temperature_m"][index] == pytest.approx(3.0 * share, rel=1e-3)


def test_units_by_hand() -> None:
    """Behind a passband as narrow as a line: 15 % of flux, and exp(−½ (7 nm/σ)²) of the LED's flank either way."""
    narrow = {"preset": "bp940_10nm_behind", "fwhm": "2 nm", "cavities": 10, "effective_index": 1e6}
    curve = _camera({f"{CAMERA}.filter": narrow}).sources[0].curves[0]
    led_sigma_nm = 42.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))
    share = 0.5 * math.hypot(0.15, 0.5 * (7.0 / led_sigma_nm) ** 2)
    index = curve.range_m.index(3.0)
    # What leaks at OD 4 does not move with the LED: 42 nm · 10⁻⁴ beside 2 nm.
    assert curve.causes_m["unit_spread_m"][index] == pytest.approx(3.0 * share, rel=0.01)


def test_the_field_angle_by_hand() -> None:
    """Without filter and vignetting cos θ alone: half a degree is ½ d tan θ · 0.0087, and 0 on the axis but for θ²."""
    axis, edge = _camera({f"{CAMERA}.filter": None}).sources[0].curves
    index = axis.range_m.index(3.0)
    angle_rad = math.atan(576.0 / 480.0)
    assert edge.place.field_angle_rad == pytest.approx(angle_rad, abs=2e-3)
    turn_rad = math.radians(0.5)
    expected_m = 1.5 * math.tan(edge.place.field_angle_rad) * turn_rad
    assert edge.causes_m["field_angle_m"][index] == pytest.approx(expected_m, rel=1e-3)
    assert (axis.causes_m["field_angle_m"][index] or 0.0) < 1.5 * turn_rad**2


def test_fog_is_what_the_calibration_does_not_know_of_it() -> None:
    """σ = 0.05 /m of the extinction: ½ d² of it."""
    curve = _camera({"fog": {"extinction": "0.01 /m"}}).sources[0].curves[0]
    assert curve.causes_m["fog_m"][curve.range_m.index(4.0)] == pytest.approx(0.5 * 16.0 * 0.05)
    clear = _camera().sources[0].curves[0]
    assert max(value or 0.0 for value in clear.causes_m["fog_m"]) == 0.0


def test_assumptions_are_read_with_their_units() -> None:
    assumed = assumptions_of(
        ["led_temperature=5 K", "unit_flux=3 %", "unit_wavelength=2 nm", "field_angle=0.1 deg"]
    )
    assert (assumed.wall_reflectance, assumed.led_temperature_sigma_k) == (0.5, 5.0)
    assert assumed.unit_flux_sigma == pytest.approx(0.03)
    assert assumed.unit_wavelength_sigma_m == pytest.approx(2e-9)
    assert assumed.field_angle_sigma_rad == pytest.approx(math.radians(0.1))
    for text, said in (
        ("unit_flux", "wanted NAME=VALUE"),
        ("colour=3", "one of wall_reflectance"),
        ("led_temperature=5", "bare number"),
        ("wall_reflectance=2", "outside 0 to 1"),
    ):
        with pytest.raises(InputError, match=said):
            assumptions_of([text])


def test_the_fog_is_told_in_a_sentence() -> None:
    """Heavy advection fog at V = 136.1 m: 20 droplets per cm³, 0.372 g/m³; without droplets the ratio has a σ."""
    scene = load_scene(SCENES / "one_source.yaml")
    known = photon_budget(scene.with_({"fog": {"visibility": "136.1 m", "droplets": "advection_heavy"}})).fog
    assert known is not None
    said = fog_sentence(known)
    for words in ("extinction 0.0291 /m at 940 nm", "visibility of 136 m", "that of advection_heavy", "g 0.868", "20 droplets per cm³", "0.372 cm³"):  # fmt: skip
        assert words in said
    unnamed = photon_budget(scene.with_({"fog": {"visibility": "50 m"}})).fog
    assert unnamed is not None
    assert "± 0.014, that of radiation_heavy (assumed)" in fog_sentence(unnamed)
    assert photon_budget(scene).fog is None
