"""The page of a recording without truth, and what it warns of."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nir_render.report.pictures import labels_of
from nir_render.report.recording_checks import (
    darkness_warnings,
    shape_warnings,
    shapes_seen,
    spot_variance_px2,
)
from nir_render.report.recording_page import recording_html
from nir_render.run import folder as run_folder
from perception import (
    Detection,
    RawFrame,
    calibration_document,
    detect,
    detection_record,
    encode_png16,
    frame_record,
)
from perception.causes import CAUSES, DetectionCauses
from perception.types import Calibration
from tests.system.command import nir_render
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=200, height_px=160, fx_px=300.0, fy_px=300.0, cx_px=99.5, cy_px=79.5, sigma={})
RANGES_M = (1.2, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0)


def _frames(camera: Calibration = CAMERA, background_e: float = 0.0) -> list[RawFrame]:
    frames = []
    for number, range_m in enumerate(RANGES_M):
        mean_e = expected_e(camera, [(60.3 + 9.0 * number, 71.4, range_m)], 6e-5, background_e)
        frames.append(
            replace(expose(mean_e, camera, random(3, number), 6e-5), index=number, time_s=0.1 * number)
        )
    return frames


FRAMES = _frames()


def _page(
    frames: list[RawFrame], camera: Calibration, causes: Mapping[str, Sequence[DetectionCauses]] | None = None
) -> str:
    found = {"robust": {(one.camera, one.index): detect(one, camera) for one in frames}}
    by_key = {(one.camera, one.index): one for one in frames}
    return recording_html(
        keys=list(by_key),
        found=found,
        load=lambda key: by_key[key],
        calibrations={camera.camera: camera},
        folder_name="<folder>",
        files=["frames.jsonl"],
        causes=causes or {},
    )


def test_what_sigmas_are_made_of_is_drawn_where_it_was_asked_for() -> None:
    parts = dict.fromkeys(CAUSES, 0.0) | {"own_light_m": 0.03, "read_noise_m": 0.04}
    of_one = [DetectionCauses("r1.front", 0, k, 2.0 + k, 0.05, parts, 0.0) for k in range(3)]
    for causes in ({}, {"robust": of_one}):
        page = _page(FRAMES[:1], CAMERA, causes)
        assert ("What the σ of a range is made of" in page) == bool(causes)
        assert page.count('<figure class="plot">') == 1 + bool(causes)


def test_labels_of_flares_beside_each_other_do_not_overlap() -> None:
    """Eight within 40 px of a frame of 1280, at its edges too: each label by itself, and inside the frame."""
    unit_px = 12.8
    for u_px, v_px in ((600.0, 400.0), (1200.0, 955.0), (1010.0, 3.0), (20.0, 950.0)):
        texts = [(u_px + 5.0 * k, min(v_px + 3.0 * (k % 3), 959.0), "1.198 ± 0.001 m") for k in range(8)]
        boxes = []
        for at_px, down_px, anchor, text in labels_of(texts, 1280, 960):
            left_px = at_px - (17.0 * unit_px if anchor == "end" else 0.0)
            assert text == "1.198 ± 0.001 m"
            assert left_px >= 0.0
            assert left_px + 17.0 * unit_px <= 1280.0
            assert 2.3 * unit_px <= down_px <= 959.0
            boxes.append((left_px, down_px))
        for number, (left_px, down_px) in enumerate(boxes):
            for other_px, other_down_px in boxes[:number]:
                apart = (
                    abs(left_px - other_px) > 17.0 * unit_px or abs(down_px - other_down_px) > 2.2 * unit_px
                )
                assert apart, (u_px, v_px)


def test_what_paper_cannot_range_is_not_listed() -> None:
    """Without a range constant of its own paper has no ranges; another's that claims none are listed."""
    seen = {(one.camera, one.index): detect(one, CAMERA) for one in FRAMES[:2]}
    blind = {key: [replace(one, range_m=math.nan) for one in found] for key, found in seen.items()}
    for name, listed in (("paper", False), ("mine", True)):
        page = recording_html(
            keys=list(seen),
            found={"robust": seen, name: blind},
            load=lambda key: FRAMES[key[1]],
            calibrations={"r1.front": CAMERA},
            folder_name="run",
            files=[],
        )
        assert ("Without those of paper" in page) == (not listed)
        rows = page[page.index("<h2>Detections</h2>") :]
        assert rows.count("no range</td>") == (2 if listed else 0)


def test_it_shows_frames_and_ranges_with_their_sigma() -> None:
    page = _page(FRAMES, CAMERA)
    assert "&lt;folder&gt;" in page
    assert "<folder>" not in page
    assert "<script" not in page
    assert 'class="warning"' not in page
    assert "agree with the calibration" in page
    hits = [hit for frame in FRAMES for hit in detect(frame, CAMERA)]
    assert len(hits) == len(RANGES_M)
    for hit in hits:
        assert f"{hit.range_m:.3f} ± {hit.range_sigma_m:.3f} m" in page
    assert page.count("<figure>") == 4 + len(hits)


@pytest.mark.parametrize(("sigma_px", "within"), [(0.5, 0.2), (0.7, 0.08), (1.0, 0.08), (1.6, 0.08)])
def test_the_width_of_bright_spots_is_the_point_spread(sigma_px: float, within: float) -> None:
    """Of flares that are photons on a sensor's noise; half a pixel is as good as its pixel aperture."""
    camera = replace(CAMERA, psf_sigma_px=sigma_px)
    frames = _frames(camera)
    seen = shapes_seen(frames, [detect(frame, camera) for frame in frames], camera)
    assert seen.psf_sigma_px == pytest.approx(sigma_px, rel=within)
    assert list(shape_warnings("r1.front", "robust", seen, camera)) == []


@pytest.mark.parametrize("said_px", [0.35, 1.4])
def test_a_point_spread_that_is_not_calibrated_is_told(said_px: float) -> None:
    """Found or not: flares sharper than the calibration are passed over by the estimator, but not by the check."""
    page = _page(FRAMES, replace(CAMERA, psf_sigma_px=said_px))
    assert f"the calibration says psf_sigma_px = {said_px:.2f}" in page
    wide = replace(CAMERA, psf_sigma_px=said_px, sigma={"psf_sigma_px": 0.5})
    assert "the calibration says psf_sigma_px" not in _page(FRAMES, wide)


def test_many_merged_flares_are_told() -> None:
    seen = replace(shapes_seen(FRAMES, [[] for _ in FRAMES], CAMERA), flares=10, merged=4)
    (told,) = shape_warnings("r1.front", "robust", seen, CAMERA)
    assert "robust found 10 flares there, 4 merged" in told
    assert list(shape_warnings("r1.front", "robust", replace(seen, merged=3), CAMERA)) == []


@pytest.mark.parametrize(
    ("black_dn", "changes", "said"),
    [
        (64.0, {}, None),
        (66.0, {}, "dark pixels count 64.0 DN, below the black level of 66.0 DN"),
        (60.0, {}, None),  # light of 4 DN may well be there
        (30.0, {"system_gain_dn_per_e": 9.0, "read_noise_e": 0.8}, "too quiet for so much light"),
        (64.0, {"read_noise_e": 4.0}, "dark pixels scatter by 7.4 DN"),
        (66.0, {"sigma": {"black_level_dn": 1.0}}, None),
    ],
)
def test_dark_pixels_are_held_against_the_calibration(
    black_dn: float, changes: dict[str, float], said: str | None
) -> None:
    """Frames of black level 64 DN, gain 0.74 DN/e and read noise 10 e."""
    frames = [replace(frame, black_level_dn=black_dn) for frame in FRAMES]
    told = list(darkness_warnings(frames, replace(CAMERA, black_level_dn=black_dn, **changes)))  # type: ignore[arg-type]
    assert len(told) == (said is not None)
    assert said is None or said in told[0]


def test_light_is_no_contradiction() -> None:
    """200 e of ambient light, 148 DN, with its shot noise."""
    assert list(darkness_warnings(_frames(background_e=200.0), CAMERA)) == []


def test_hot_pixels_and_noise_have_no_width() -> None:
    hot = np.random.default_rng(1).normal(0.0, 1.0, (17, 17))
    assert math.isnan(spot_variance_px2(hot, 1.0))
    hot[8, 8] += 4000.0
    assert math.isnan(spot_variance_px2(hot, 1.0))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    run_folder.write_json(tmp_path / "calibration.json", calibration_document([CAMERA]))
    for frame in FRAMES:
        (tmp_path / f"{frame.index}.png").write_bytes(encode_png16(frame.data_dn))
    run_folder.write_lines(
        tmp_path / "frames.jsonl", [frame_record(frame, f"{frame.index}.png") for frame in FRAMES]
    )
    return tmp_path


def test_the_command_makes_the_page(folder: Path) -> None:
    without = nir_render("report", str(folder), cwd=folder)
    assert without.returncode == 2
    assert "there are no detections; run 'nir-render perceive" in without.stderr
    assert nir_render("perceive", str(folder), cwd=folder).returncode == 0
    done = nir_render("report", str(folder), cwd=folder)
    assert done.returncode == 0, done.stderr
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "a recording without truth" in page
    assert "estimators: paper, robust" in page


def test_detections_that_say_nothing_are_shown_too(folder: Path) -> None:
    nan = math.nan
    hit = Detection(
        "r1.front", 0, 0.0, 60.0, 70.0, nan, nan, nan, nan, nan, 3, False, False, True, nan, nan, (nan, nan, nan)
    )  # fmt: skip
    run_folder.write_lines(folder / "detections.mine.jsonl", [detection_record(hit)])
    assert nir_render("report", str(folder), cwd=folder).returncode == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "no range" in page
    assert "Nothing was ranged." in page
