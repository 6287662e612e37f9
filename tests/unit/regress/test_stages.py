"""Each stage's comparison, without any renderer: what passes, what does not, and where it says that it is."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render.light.light import DirectTable, Indirect, Light, Multiple
from nir_render.regress.checking import check_scenes
from nir_render.regress.findings import percent
from nir_render.regress.make import detections_of, electrons_of, frame_of, frame_settings
from nir_render.regress.reference import ReferenceLight, changes_of, document_of
from nir_render.regress.repeatable import check_repeatable
from nir_render.regress.stages.camera import compare_calibration, compare_electrons, compare_frame
from nir_render.regress.stages.direct import allowed_flips, compare_tables
from nir_render.regress.stages.light import compare_indirect, finding_of
from nir_render.regress.stages.perception import compare_detections
from nir_render.regress.statistics import judge
from nir_render.scene.scene import Scene
from tests.unit.regress import cases


def _hidden(fraction: float, shift: int = 0, level: float = 1.0, *, other_half: bool = False) -> DirectTable:
    seen = np.arange(1024) < round(1024 * fraction) + shift
    seen = seen[::-1] if other_half else seen
    share = float(seen.mean())
    irradiance = np.array([[0.0354 * level * share]])
    return cases.table(seen=seen[None], visible_fraction=np.array([share]), irradiance_per_w=irradiance)


@pytest.mark.parametrize(
    ("before", "after", "verdict", "said"),
    [
        (cases.table(), cases.table(), "pass", "equal"),
        (cases.table(), cases.table(distance_m=np.array([1.5 * (1 + 1e-12)])), "pass", ""),
        (cases.table(), cases.table(direction=np.array([[-0.1 + 1e-7, 0.0, 0.995]])), "fail", "moved by 1e-07 rad"),
        (cases.table(), cases.table(irradiance_per_w=np.array([[0.0354 * 1.0001]])), "fail", "irradiance +0.010 %"),
        (_hidden(0.5), _hidden(0.5, 3), "pass", ""),
        (_hidden(0.5), _hidden(0.5, 3, level=1.005), "pass", ""),  # 3 rays may bring 2 · 3 / 512 of it
        (_hidden(0.5), _hidden(0.5, 3, level=1.02), "fail", "irradiance +2.6 %"),
        (_hidden(0.5), _hidden(0.5, level=1.01), "fail", "irradiance +1.0 %"),  # the same rays bring the same
        (_hidden(0.5), _hidden(0.5, other_half=True), "fail", "1024 rays differ"),
        (_hidden(0.0), _hidden(0.0, 2), "pass", ""),
        (_hidden(0.5), _hidden(0.5, 40), "fail", "40 rays differ, seen of it 0.5000, now 0.5391"),
        (cases.table(), _hidden(0.5), "fail", "r2.top"),
    ],
)  # fmt: skip
def test_direct_tables(before: DirectTable, after: DirectTable, verdict: str, said: str) -> None:
    finding = compare_tables(cases.light(before), cases.light(after), "", exact=False)
    assert finding.verdict == verdict
    assert said in finding.seen


def test_a_source_that_is_gone_fails_a_sliver_of_a_ghost_does_not() -> None:
    empty = cases.table(**{
        name: getattr(cases.table(), name)[:0]
        for name in ("group", "facet", "direction", "distance_m", "angular_radius_rad", "seen", "visible_fraction",
                     "irradiance_per_w")
    })  # fmt: skip
    gone = compare_tables(cases.light(), cases.light(empty), "", exact=False)
    assert (gone.verdict, gone.seen) == ("fail", "r2.top is gone")
    sliver = compare_tables(cases.light(_hidden(2 / 1024)), cases.light(empty), "", exact=False)
    assert sliver.verdict == "pass"


def test_few_rays_may_fall_on_the_other_side_of_an_edge() -> None:
    """1024 · 4 ε / (π α) is 0.4 for a source of 10 mm at 1.5 m; of a disc as small as ε all may."""
    assert allowed_flips(0.0067, 1024) == 6
    assert allowed_flips(1e-7, 1024) > 1024


def test_the_same_versions_owe_the_same_bits() -> None:
    moved = cases.table(distance_m=np.array([1.5 * (1 + 1e-12)]))
    assert compare_tables(cases.light(), cases.light(moved), "", exact=True).verdict == "fail"


def _light_finding(
    level: float, *, same_bits: bool | None = None, must_be_same: bool = False, **dark: float
) -> str:
    reference = cases.light(noise=0.005)
    assert reference.indirect is not None
    reference = replace(reference, indirect=replace(reference.indirect, samples=256))
    light = cases.light(level=level, noise=0.02, seed=1)
    findings, pending = compare_indirect(ReferenceLight(reference, None, None, ""), light, "", alike=True)
    assert not findings
    (verdict,) = judge([one.parts for one in pending], 1e-3)
    finding = finding_of(pending[0], verdict, same_bits=same_bits, must_be_same=must_be_same)
    return f"{finding.verdict}: {finding.seen}"


def test_indirect_light() -> None:
    assert _light_finding(0.05).startswith("pass: frame ")
    assert _light_finding(0.0505).startswith("fail: +1.0 % in rows 0–15, columns 0–15; frame +0.89 %")


def _turned(light: Light, level: float, noise: float, seed: int, surface: int = 0) -> Light:
    """The light, a part of which was turned often and is averaged."""
    assert light.indirect is not None
    draw = np.random.default_rng(seed).standard_normal(light.indirect.radiance_per_w.shape)
    mean = (level * (1.0 + noise * draw)).astype(np.float32)
    numbers = np.zeros(mean.shape[2:], dtype=np.int32)
    numbers[0, :surface] = -1
    multiple = Multiple(mean, np.full_like(mean, (noise * level) ** 2), np.zeros_like(mean), numbers)
    return replace(light, indirect=replace(light.indirect, multiple=multiple))


def test_light_of_many_turns_is_held_apart_in_level_and_in_where_it_is_averaged() -> None:
    """3 % less of what is a tenth of all light is 0.3 % of the whole, within its noise."""
    reference = cases.light(noise=0.005)
    assert reference.indirect is not None
    reference = replace(reference, indirect=replace(reference.indirect, samples=256))
    known = ReferenceLight(_turned(reference, 0.005, 0.005, 2), None, None, "")

    def said(light: Light) -> dict[str, str]:
        findings, pending = compare_indirect(known, light, "", alike=True)
        verdicts = judge([one.parts for one in pending], 1e-3)
        findings += [
            finding_of(one, verdict, same_bits=None, must_be_same=False)
            for one, verdict in zip(pending, verdicts, strict=True)
        ]
        return {one.what: f"{one.verdict}: {one.seen}" for one in findings}

    light = cases.light(noise=0.02, seed=1)
    same = said(_turned(light, 0.005, 0.02, 3))
    assert [text.split(":")[0] for text in same.values()] == ["pass"] * 3
    assert same["averaged blocks"] == "pass: 0 of 768 are others"
    less = said(_turned(light, 0.00485, 0.02, 3))
    assert less["r2.top"].startswith("pass")
    assert less["r2.top, turned often"].startswith("fail: −2.9 %")
    assert said(_turned(light, 0.005, 0.02, 3, surface=20))["averaged blocks"] == "fail: 20 of 768 are others"
    assert said(light)["averaged blocks"] == "fail: there are none any more"
    older = ReferenceLight(reference, None, None, "")
    (finding,), _ = compare_indirect(older, _turned(light, 0.005, 0.02, 3), "", alike=True)
    assert finding.verdict == "skipped"


def test_light_with_the_references_own_bits_passes_and_must_where_it_is_owed() -> None:
    assert _light_finding(0.0505, same_bits=True, must_be_same=True).startswith("pass")
    assert _light_finding(0.05, same_bits=False, must_be_same=True).startswith("fail: other bits")
    assert _light_finding(0.05, same_bits=False).startswith("pass")


def test_light_of_the_same_random_numbers_is_compared_by_paths(tmp_path: Path) -> None:
    """0.2 % less in 200 of 768 pixels of 2 % of noise: by its paths it fails, by statistics it would not."""
    scene = cases.scene(tmp_path)
    own = cases.light(noise=0.02, seed=5)
    assert own.indirect is not None
    known = cases.reference(scene)
    kept = replace(known.lights[0], own_radiance_per_w=own.indirect.radiance_per_w)
    radiance = own.indirect.radiance_per_w.copy()
    radiance[..., :8, :25] *= 0.998
    darker = replace(own, indirect=replace(own.indirect, radiance_per_w=radiance))

    def said(
        light: Light, kept: ReferenceLight = kept, seed: int | None = None, scene: Scene = scene
    ) -> dict[str, str]:
        check = check_scenes(
            "suite", {"small": scene}, {"small": replace(known, lights=(kept,))}, seed=seed,
            rendered=lambda *_: light,
        )  # fmt: skip
        found = check.scenes[0].findings
        return {
            one.what: f"{one.verdict}: {one.seen}"
            for one in found
            if "paths" in one.what or one.what == "r2.top"
        }

    assert said(own) == {"r2.top": "pass: frame +0.0060 %", "paths": "pass: all the same"}
    told = said(darker)
    assert told.pop("r2.top").startswith("pass")
    assert told.pop("paths") == "pass: 200 of 768 pixels differ"
    (worst,) = told.values()
    assert list(told) == ["r2.top, same paths"]
    assert worst.startswith(
        "fail: of the pixels that differ: −0.20 % in rows 0–15, columns 0–15; frame −0.20 %"
    )
    without = said(darker, replace(kept, own_radiance_per_w=None))
    assert without["paths"].startswith("skipped: the reference has none: 'nir-render regress update --all'")
    others = said(cases.light(noise=0.02, seed=6))
    assert others["paths"].startswith("skipped: most are others of r2.top")
    assert list(said(darker, seed=99)) == ["r2.top"]
    assert list(said(darker, scene=scene.with_({"materials.paint.reflectance": 0.6}))) == ["r2.top"]


def test_other_groups_or_another_film_fail_at_once() -> None:
    before = ReferenceLight(cases.light(), None, None, "")
    renamed = replace(cases.light(), groups=("r3.top",))
    none = replace(cases.light(), indirect=None)
    small = replace(
        cases.light(), indirect=Indirect(*2 * (np.ones((1, 1, 12, 16), dtype=np.float32),), 2, 16)
    )
    for light, said in (
        (renamed, "r2.top → r3.top"),
        (none, "none any more"),
        (small, "32 × 24 → 16 × 12 pixels"),
    ):
        (finding,), pending = compare_indirect(before, light, "", alike=True)
        assert finding.verdict == "fail"
        assert said in finding.seen
        assert not pending


def test_electrons_frames_and_calibration_of_the_camera(tmp_path: Path) -> None:
    """Equal as they are; 1 % of gain is seen in frame and calibration, 1 nm of filter in electrons and calibration."""
    scene = cases.scene(tmp_path)
    reference = cases.reference(scene)
    (setting,) = frame_settings(scene)
    light = reference.lights[0]
    electrons = electrons_of(scene, setting, light.light)
    frame = frame_of(scene.camera("r1.front")[1], setting, electrons, 3)
    shot = replace(reference.shots[0], electrons=electrons, frame=frame)

    def verdicts(change: dict[str, str]) -> list[str]:
        changed = scene.with_({f"robots.r1.rig.cameras.front.{key}": value for key, value in change.items()})
        findings = [
            compare_electrons(changed, setting, shot, light, "", exact=False)[0],
            compare_frame(changed, setting, shot, 3, "", exact=False),
            compare_calibration(changed, "r1.front", reference.calibrations["r1.front"], exact=False),
        ]
        return [finding.verdict for finding in findings]

    assert verdicts({}) == ["pass"] * 3
    assert verdicts({"sensor.system_gain": "0.6969 DN/e"}) == ["pass", "fail", "fail"]
    assert verdicts({"filter.centre": "941 nm"}) == ["fail", "pass", "fail"]
    assert verdicts({"lens.principal_point": "[15.6, 11.5] px"}) == ["fail", "pass", "fail"]
    assert verdicts({"sensor.read_noise": "10.1 e"}) == ["pass", "fail", "fail"]


def test_a_spread_that_is_rounding_is_none(tmp_path: Path) -> None:
    """Equal sources have no spread, or one of 1e-16; a spread of 1 % is one."""
    scene = cases.scene(tmp_path)
    known = nr.calibration(scene, "r1.front")
    constant = known.range_constant_dn_m2_per_s
    for share, verdict in ((1e-15, "pass"), (0.01, "fail")):
        before = replace(known, sigma={"range_constant_dn_m2_per_s": share * constant})
        finding = compare_calibration(scene, "r1.front", before, exact=False)
        assert finding.verdict == verdict
    assert "σ of range_constant_dn_m2_per_s" in finding.seen


def test_a_few_counts_may_round_the_other_way(tmp_path: Path) -> None:
    scene = cases.scene(tmp_path)
    (setting,) = frame_settings(scene)
    shot = cases.reference(scene).shots[0]
    frame = frame_of(scene.camera("r1.front")[1], setting, shot.electrons, 3)
    for flips, by_dn, exact, verdict in ((2, 1, False, "pass"), (2, 1, True, "fail"), (1, 3, False, "fail"), (40, 1, False, "fail")):  # fmt: skip
        data = frame.data_dn.copy()
        data.ravel()[:flips] += np.uint16(by_dn)
        changed = replace(shot, frame=replace(frame, data_dn=data))
        finding = compare_frame(scene, setting, changed, 3, "", exact=exact)
        assert finding.verdict == verdict
        assert f"{flips} of 768 pixels differ, by {by_dn} DN at most" in finding.seen


@pytest.mark.parametrize(
    ("field", "share", "verdict"),
    [
        ("exposure_s", 1e-11, "fail"),
        ("exposure_s", 1e-15, "pass"),
        ("gain", 0.01, "fail"),
        ("black_level_dn", 0.01, "fail"),
        ("line_time_s", 0.01, "fail"),
        ("time_s", 0.01, "fail"),
    ],
)
def test_what_goes_with_the_counts_is_compared(
    tmp_path: Path, field: str, share: float, verdict: str
) -> None:
    scene = cases.scene(tmp_path)
    (setting,) = frame_settings(scene)
    setting = replace(setting, time_s=0.5)
    shot = cases.reference(scene).shots[0]
    frame = frame_of(scene.camera("r1.front")[1], setting, shot.electrons, 3)
    value = getattr(frame, field)
    other: dict[str, Any] = {field: value * (1 + share) if value else share * 1e-5}
    changed = replace(shot, frame=replace(frame, **other))
    finding = compare_frame(scene, setting, changed, 3, "", exact=False)
    assert finding.verdict == verdict
    assert finding.seen.startswith(field)


def test_the_second_time_gives_the_same_bits(tmp_path: Path) -> None:
    scene = cases.scene(tmp_path)
    reference = cases.reference(scene)
    taken = list(zip(frame_settings(scene), reference.shots, strict=True))
    found = detections_of([reference.shots[0].frame], reference.calibrations)
    assert check_repeatable(scene, reference, taken, found).verdict == "pass"
    other = check_repeatable(scene, reference, taken, found | {"robust": (cases.detection(),)})
    assert (other.verdict, other.seen) == ("fail", "other bits the second time: detections of robust")


def test_electrons_of_light_that_the_scene_has_no_emitter_for(tmp_path: Path) -> None:
    scene = cases.scene(tmp_path)
    reference = cases.reference(scene)
    stranger = replace(reference.lights[0], light=replace(reference.lights[0].light, groups=("r9.top",)))
    (setting,) = frame_settings(scene)
    finding, pair = compare_electrons(scene, setting, reference.shots[0], stranger, "", exact=False)
    assert (finding.verdict, finding.seen, pair) == ("fail", "the scene has no r9.top any more", None)


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, "pass"),
        ({"u_px": 12.2504}, "pass"),  # 0.02 of its σ: another last step of the fit
        ({"u_px": 12.252}, "fail"),  # 0.1 σ
        ({"flux_dn": 5000.0 * (1 + 0.0003)}, "pass"),
        ({"flux_dn": 5000.0 * 1.001}, "fail"),
        ({"range_m": 1.502}, "fail"),
        ({"area_px": 10}, "fail"),
        ({"saturated": True}, "fail"),
        ({"range_m": math.nan}, "fail"),
        ({"bearing_body": (0.995, 0.1003774, 0.0)}, "fail"),
    ],
)
def test_detections(change: dict[str, float], verdict: str) -> None:
    finding = compare_detections("robust", [cases.detection()], [cases.detection(**change)], exact=False)
    assert finding.verdict == verdict
    if verdict == "fail":
        assert next(iter(change)) in finding.seen


def test_detections_without_a_sigma_agree_to_rounding_and_in_number() -> None:
    plain = {"u_sigma_px": math.nan, "v_sigma_px": math.nan, "range_sigma_m": math.nan}
    before = [cases.detection(**plain)]
    after = [cases.detection(**plain, u_px=12.2504)]
    assert compare_detections("paper", before, before, exact=True).verdict == "pass"
    assert compare_detections("paper", before, after, exact=False).verdict == "fail"
    assert compare_detections("paper", before, [], exact=False).seen == "1 → 0 detections"


def test_changes_of_a_scene_are_named(tmp_path: Path) -> None:
    scene = cases.scene(tmp_path)
    changed = scene.with_({"materials.paint.reflectance": 0.735, "robots.r2.position": "[1.5, 0.3, 0] m"})
    assert changes_of(document_of(scene), document_of(changed)) == (
        "robots.r2.position: [1.5, 0.2, 0.0] m → [1.5, 0.3, 0.0] m",
        "materials.paint.reflectance: 0.7 → 0.735",
    )


def test_percent() -> None:
    assert percent(0.0123) == "1.2 %"
    assert percent(-0.25, signed=True) == "−25 %"
    assert percent(0.00047) == "0.047 %"
    assert percent(math.inf) == "light where there was none"
