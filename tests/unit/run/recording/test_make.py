"""From pictures and a short document to ranges with σ: as somebody would who has a camera and a data sheet."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from nir_render.errors import InputError
from nir_render.run.recording.make import import_recording, new_recording
from nir_render.run.recording.pictures import Pictures
from perception import detect, read_recording
from perception.calibration.dark import Darkness
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, expected_e, expose, random

RANGES_M = (0.6, 0.8, 1.0, 1.2, 1.5, 1.8, 2.0, 2.5)
EXPOSURE_S = 1e-3
# What is true: a camera of 8 bits that the document knows little of.
TRUE = replace(
    calibration(),
    width_px=200, height_px=160, fx_px=300.0, fy_px=300.0, cx_px=99.5, cy_px=79.5, bit_depth=8, saturation_dn=255,
    system_gain_dn_per_e=0.04, read_noise_e=30.0, black_level_dn=5.3, psf_sigma_px=0.8, range_constant_dn_m2_per_s=1e6,
    sigma={},
)  # fmt: skip
DOCUMENT: dict[str, Any] = {
    "format": 1,
    "source": {"radius": "10 mm ± 0.1 mm"},
    "cameras": {
        "r1.front": {
            "frames": "img*.png", "exposure": "1 ms", "frame_rate": "10 Hz", "focal_length": "300 px ± 1 px",
            "bit_depth": "8 bit",
        }
    },
    "known_ranges": [{"camera": "r1.front", "frame": 2, "range": "1 m ± 5 mm"}],
}  # fmt: skip


def _place(number: int) -> tuple[float, float]:
    return 60.3 + 11.7 * number, 50.2 + 7.1 * number


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    for number, range_m in enumerate(RANGES_M):
        mean_e = expected_e(TRUE, [(*_place(number), range_m)], EXPOSURE_S)
        data_dn = expose(mean_e, TRUE, random(7, number), EXPOSURE_S).data_dn.astype(np.uint8)
        assert cv2.imwrite(str(folder / f"img{number + 8}.png"), data_dn)  # img9 stands before img10
    return folder


def _folder(tmp_path: Path, pictures: Path, changes: dict[str, Any] | None = None, **camera: Any) -> Path:
    for path in pictures.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    document = json.loads(json.dumps({**DOCUMENT, **(changes or {})}))
    document["cameras"]["r1.front"] |= camera
    (tmp_path / "recording.yaml").write_text(yaml.safe_dump(document, allow_unicode=True), encoding="utf-8")
    return tmp_path


def _known(folder: Path) -> Calibration:
    return import_recording(folder, overwrite=False)["r1.front"].calibration


def test_ranges_from_one_known_range(tmp_path: Path, pictures: Path) -> None:
    """Black level, gain and noise are not said; the gain that is assumed is off by 1.6. Ranges hold to their σ."""
    known = _known(_folder(tmp_path, pictures))
    assert known.black_level_dn == pytest.approx(5.3, abs=0.1)
    assert known.read_noise_e * known.system_gain_dn_per_e == pytest.approx(30.0 * 0.04, rel=0.1)
    constant, sigma = known.range_constant_dn_m2_per_s, known.sigma["range_constant_dn_m2_per_s"]
    assert abs(constant - 1e6) < 2.5 * sigma
    assert sigma < 0.08 * constant
    recording = read_recording(tmp_path)
    assert [record.file for record in recording.records] == [f"img{number}.png" for number in range(8, 16)]
    assert [record.time_s for record in recording.records] == pytest.approx([0.1 * n for n in range(8)])
    pulls = []
    for number, frame in enumerate(recording.frames()):
        hits = [
            hit
            for hit in detect(frame, known)
            if math.hypot(hit.u_px - _place(number)[0], hit.v_px - _place(number)[1]) < 1
        ]
        assert len(hits) == 1
        assert hits[0].range_sigma_m < 0.1 * RANGES_M[number]
        pulls.append((hits[0].range_m - RANGES_M[number]) / hits[0].range_sigma_m)
    assert np.max(np.abs(pulls)) < 2.5


def test_the_constant_from_data_sheets(tmp_path: Path, pictures: Path) -> None:
    """K = gain · π/4 (f/N)² · τ · QE · λ/hc · I, by hand; the shares add in quadrature, those of f and N twice."""
    sheets = {"source": {"radius": "10 mm", "intensity": "16 mW/sr ± 20 %"}, "known_ranges": []}
    camera = {
        "focal_length": "4 mm ± 1 %",
        "pixel_pitch": "5 um",
        "f_number": "2 ± 5 %",
        "gain": "0.04 DN/e ± 10 %",
    }
    known = _known(
        _folder(
            tmp_path, pictures, sheets, **camera, transmission="0.5 ± 0.05", quantum_efficiency="0.1 ± 0.02"
        )
    )
    per_joule = 0.5 * 0.1 * 940e-9 / (6.62607015e-34 * 299_792_458.0)
    constant = 0.04 * math.pi * 1e-3**2 * per_joule * 16e-3
    assert known.range_constant_dn_m2_per_s == pytest.approx(constant, rel=1e-9)
    share = math.sqrt(0.2**2 + 0.1**2 + 0.1**2 + 0.2**2 + 0.1**2 + 0.02**2 + 0.05**2)
    assert known.sigma["range_constant_dn_m2_per_s"] == pytest.approx(share * constant, rel=1e-9)
    assert (known.fx_px, known.sigma["fx_px"]) == pytest.approx((800.0, 8.0))
    of_power = _folder(
        tmp_path, pictures, {**sheets, "source": {"radius": "10 mm", "power": "0.2 W"}}, **camera
    )
    again = import_recording(of_power, overwrite=True)["r1.front"].calibration
    ratio = (0.2 / (4.0 * math.pi) / 16e-3) * (0.8 * 0.12 / (0.5 * 0.1))
    assert again.range_constant_dn_m2_per_s == pytest.approx(ratio * constant, rel=1e-9)


@pytest.mark.parametrize(
    ("binning", "left", "top"), [(1, 0, 0), (2, 0, 0), (1, 24, 10), (2, 24, 10), (4, 8, 12)]
)
def test_binned_and_cropped_frames_see_the_same_directions(
    tmp_path: Path, pictures: Path, binning: int, left: int, top: int
) -> None:
    """A sensor of 1000 × 800 px with a point at one direction, cut and summed by hand: its centroid leads back."""
    direction = np.array([0.021, -0.013, 1.0])
    u, v = 499.5 + 2000.0 * direction[0], 399.5 + 2000.0 * direction[1]
    across, down = np.arange(1000.0), np.arange(800.0)
    sensor = np.exp(-0.5 * ((across[None, :] - u) ** 2 + (down[:, None] - v) ** 2) / 36.0)
    rows, columns = 720 // binning * binning, 880 // binning * binning
    cut = sensor[top : top + rows, left : left + columns]
    binned = cut.reshape(rows // binning, binning, columns // binning, binning).mean(axis=(1, 3))
    full_size = binning == 1 and left == 0
    for path in pictures.iterdir():
        counts = np.full(sensor.shape if full_size else binned.shape, 5, np.uint8)
        assert cv2.imwrite(str(tmp_path / path.name), counts)
    document = json.loads(json.dumps(DOCUMENT))
    document["source"] |= {"intensity": "16 mW/sr"}
    document["cameras"]["r1.front"] |= {
        "focal_length": "10 mm", "pixel_pitch": "5 um", "f_number": 2, "binning": binning, "roi_left": f"{left} px",
        "roi_top": f"{top} px", "sensor_size": "[1000, 800] px",
    }  # fmt: skip
    document["known_ranges"] = []
    (tmp_path / "recording.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    known = _known(tmp_path)
    light = sensor if full_size else binned
    rows_at, columns_at = np.indices(light.shape)
    place = (float((light * columns_at).sum() / light.sum()), float((light * rows_at).sum() / light.sum()))
    assert (known.width_px, known.height_px) == light.shape[::-1]
    assert (place[0] - known.cx_px) / known.fx_px == pytest.approx(direction[0], abs=1e-6)
    assert (place[1] - known.cy_px) / known.fy_px == pytest.approx(direction[1], abs=1e-6)
    assert (known.psf_sigma_px, known.sigma["psf_sigma_px"]) == pytest.approx((0.7 / binning, 0.2 / binning))


def test_what_jpeg_costs_is_added_to_the_read_noise(tmp_path: Path, pictures: Path) -> None:
    folder = _folder(tmp_path, pictures, frames="img*.jpg", gain="0.04 DN/e", read_noise="30 e")
    for path in pictures.iterdir():
        counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert counts is not None
        assert cv2.imwrite(str(folder / f"{path.stem}.jpg"), counts, [cv2.IMWRITE_JPEG_QUALITY, 90])
    done = import_recording(folder, overwrite=False)["r1.front"]
    assert done.lossy_sigma_dn > 1.0
    assert done.calibration.read_noise_e == pytest.approx(math.hypot(30.0, done.lossy_sigma_dn / 0.04))
    next(read_recording(folder).frames())
    document = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    document["cameras"]["r1.front"]["read_noise_e"] = 10.0
    (folder / "calibration.json").write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ValueError, match=r"is a JPEG whose compression alone has a σ of .* read_noise_e is"):
        next(read_recording(folder).frames())


def test_all_that_is_missing_or_wrong_is_said_at_once(tmp_path: Path, pictures: Path) -> None:
    for path in pictures.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "img9.png").write_bytes(b"no picture")
    new_recording(tmp_path)
    path = tmp_path / "recording.yaml"
    path.write_text(
        path.read_text(encoding="utf-8").replace("exposure: ", "exposure: 1 kg "), encoding="utf-8"
    )
    with pytest.raises(InputError) as error:
        import_recording(tmp_path, overwrite=False)
    lines = str(error.value).split("\n")
    for said in (
        "radius",
        "1 kg",
        "frame_rate",
        "focal_length",
        "bit_depth",
        "how bright",
        "img9.png: is no PNG",
    ):
        assert sum(said in line for line in lines) == 1, said
    assert len(lines) == 7
    assert not (tmp_path / "frames.jsonl").exists()


@pytest.mark.parametrize(
    ("changes", "camera", "said"),
    [
        ({}, {"bit_depth": "12 bit"}, "bit_depth: is 12 bit; the pictures hold 8 bits"),
        ({}, {"bit_depth": "7.5 bit"}, "whole number of bits"),
        ({}, {"saturation": "300 DN"}, "saturation: is beyond full scale, 255 DN"),
        ({}, {"black_level": "300 DN"}, "black level 300 DN is not below saturation"),
        ({}, {"frames": "none*.png"}, "'none*.png' names no file"),
        ({}, {"frames": "../*.png"}, "leads out of the folder"),
        ({}, {"focal_length": "4 mm"}, "pixel_pitch is missing"),
        ({}, {"roi_left": "3 px"}, "sensor_size is missing"),
        ({}, {"exposures": "1 ms"}, "unknown key 'exposures'; did you mean 'exposure'?"),
        ({"known_ranges": []}, {}, "nothing tells how bright a source looks"),
        ({"known_ranges": [{"camera": "r1.left", "frame": 0, "range": "1 m"}]}, {}, "there is no camera 'r1.left'"),
        ({"known_ranges": [{"camera": "r1.front", "frame": 99, "range": "1 m"}]}, {}, "there is no frame 99; write 0 to 7"),
        ({"source": {"radius": "1 cm", "power": "1 W"}, "known_ranges": []}, {}, "f_number is missing"),
        ({"source": {"radius": "1 cm", "power": "1 W", "intensity": "1 W/sr"}}, {}, "both given"),
        ({"cameras": {}}, {}, "cameras"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(
    tmp_path: Path, pictures: Path, changes: dict[str, Any], camera: dict[str, Any], said: str
) -> None:
    if changes.get("cameras") == {}:
        folder = _folder(tmp_path, pictures)
        document = {**DOCUMENT, "cameras": {}}
        (folder / "recording.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    else:
        folder = _folder(tmp_path, pictures, changes, **camera)
    with pytest.raises(InputError) as error:
        import_recording(folder, overwrite=False)
    assert said in str(error.value)


def test_a_dark_frame_tells_no_range(tmp_path: Path, pictures: Path) -> None:
    folder = _folder(tmp_path, pictures)
    assert cv2.imwrite(str(folder / "img10.png"), np.full((160, 200), 5, np.uint8))
    with pytest.raises(InputError, match=r"frame 2 of r1.front \(img10.png\) shows no flare that can"):
        import_recording(folder, overwrite=False)


def test_what_is_there_is_replaced_only_when_asked(tmp_path: Path, pictures: Path) -> None:
    folder = _folder(tmp_path, pictures)
    import_recording(folder, overwrite=False)
    with pytest.raises(InputError, match=r"holds frames.jsonl and calibration.json already; --overwrite"):
        import_recording(folder, overwrite=False)
    import_recording(folder, overwrite=True)
    with pytest.raises(InputError, match=r"recording.yaml: is there already"):
        new_recording(folder)
    (folder / "recording.yaml").unlink()
    with pytest.raises(InputError, match="nir-render new-recording"):
        import_recording(folder, overwrite=True)


def test_the_template_names_the_pictures_that_it_finds(tmp_path: Path, pictures: Path) -> None:
    (tmp_path / "raw").mkdir()
    for path in pictures.iterdir():
        (tmp_path / "raw" / path.name).write_bytes(path.read_bytes())
    assert new_recording(tmp_path) == ["raw/*.png"]
    text = (tmp_path / "recording.yaml").read_text(encoding="utf-8")
    assert "8 of them; the first has 200 × 160 pixels of 8 bits" in text
    assert yaml.safe_load(text)["cameras"]["r1.front"]["frames"] == "raw/*.png"
    assert new_recording(tmp_path / "new") == ["frames/*.png"]


def test_times_of_a_file_are_the_frames(tmp_path: Path, pictures: Path) -> None:
    times_s = [0.0, 0.0333, 0.07, 0.1, 0.2, 0.3, 0.4, 0.5]
    folder = _folder(tmp_path, pictures, times="times.txt")
    document = yaml.safe_load((folder / "recording.yaml").read_text())
    times = folder / "times.txt"

    def imported(written: str, *keys: str) -> None:
        times.write_text(written)
        cameras = document["cameras"]["r1.front"]
        kept = {key: value for key, value in cameras.items() if key not in keys}
        (folder / "recording.yaml").write_text(yaml.safe_dump({**document, "cameras": {"r1.front": kept}}))
        import_recording(folder, overwrite=True)

    imported("\n".join(map(str, times_s)), "frame_rate")
    assert [frame.time_s for frame in read_recording(folder).frames()] == times_s
    for written, keys, said in (
        ("0\n1", ("frame_rate",), "times.txt has 2 times, and there are 8 pictures"),
        ("0 1 2 3 4 5 5 6", ("frame_rate",), "must increase"),
        ("0 1 2 3 4 5 x 6", ("frame_rate",), "wanted a time in seconds on each line"),
        ("0 1 2 3 4 5 6 7", (), "frame_rate and times: each says when"),
        ("0 1 2 3 4 5 6 7", ("frame_rate", "times"), "frame_rate: this key is missing"),
    ):
        with pytest.raises(InputError, match=said):
            imported(written, *keys)


def _two_in_view(folder: Path) -> None:
    """Another source, 1.3 m away, beside the one at 1 m in the third picture."""
    mean_e = expected_e(TRUE, [(*_place(2), 1.0), (150.4, 110.7, 1.3)], EXPOSURE_S)
    data_dn = expose(mean_e, TRUE, random(8, 0), EXPOSURE_S).data_dn.astype(np.uint8)
    assert cv2.imwrite(str(folder / "img10.png"), data_dn)


def test_of_several_sources_in_a_frame_the_one_is_named_whose_range_is_known(
    tmp_path: Path, pictures: Path
) -> None:
    """Which of both it is nobody can tell but who measured: either leads to the same range constant."""
    constants = []
    for number, (range_text, place) in enumerate((("1 m", "[83, 65] px"), ("1.3 m", "[151, 110] px"))):
        known_range = {"camera": "r1.front", "frame": 2, "range": f"{range_text} ± 5 mm", "place": place}
        (tmp_path / str(number)).mkdir()
        folder = _folder(tmp_path / str(number), pictures, {"known_ranges": [known_range]})
        _two_in_view(folder)
        done = import_recording(folder, overwrite=False)["r1.front"]
        assert done.warnings == ()
        constants.append(done.calibration.range_constant_dn_m2_per_s)
    assert constants[0] == pytest.approx(1e6, rel=0.1)
    assert constants[1] == pytest.approx(constants[0], rel=0.1)

    (tmp_path / "unsaid").mkdir()
    folder = _folder(tmp_path / "unsaid", pictures)
    _two_in_view(folder)
    with pytest.raises(InputError, match=r'frame 2 .* shows 2 flares, .*; say which .* "\[84, 64\] px"'):
        import_recording(folder, overwrite=False)

    (tmp_path / "nowhere").mkdir()
    nowhere = {"camera": "r1.front", "frame": 2, "range": "1 m", "place": "[20, 20] px"}
    folder = _folder(tmp_path / "nowhere", pictures, {"known_ranges": [nowhere]})
    with pytest.raises(
        InputError, match=r"shows no flare within 12 px of \(20, 20\) px; there are \(84, 64\) px"
    ):
        import_recording(folder, overwrite=False)


def test_a_known_range_that_does_not_come_out_again_is_told(tmp_path: Path, pictures: Path) -> None:
    """A focal length in the wrong unit: light and size tell two ranges. As it should be, nothing is told."""
    for folder in ("right", "wrong"):
        (tmp_path / folder).mkdir()
    done = import_recording(_folder(tmp_path / "right", pictures), overwrite=False)["r1.front"]
    assert done.warnings == ()
    across_rad, down_rad = done.field_of_view_rad
    assert across_rad == pytest.approx(2.0 * math.atan(100.0 / 300.0))
    assert down_rad == pytest.approx(2.0 * math.atan(80.0 / 300.0))
    for number, (focal_length, range_text, told) in enumerate(
        (
            ("900 px ± 2 %", "1 m ± 5 mm", "1 m was measured of img10.png, and its flare at"),
            ("100 px ± 2 %", "1 m ± 5 mm", "1 m was measured of img10.png, and "),
            ("300 px ± 2 %", "2 m ± 5 mm", "2 m was measured of img10.png, and "),
            ("300 px ± 2 %", "0.5 m ± 5 mm", "0.5 m was measured of img10.png, and "),
        )
    ):
        (tmp_path / str(number)).mkdir()
        known_range = {"camera": "r1.front", "frame": 2, "range": range_text}
        wrong = _folder(
            tmp_path / str(number), pictures, {"known_ranges": [known_range]}, focal_length=focal_length
        )
        (said,) = import_recording(wrong, overwrite=False)["r1.front"].warnings
        assert told in said
        assert "Check the range that was measured, and of which source, focal_length" in said


def test_of_several_known_ranges_the_odd_one_is_told_with_what_the_others_say(
    tmp_path: Path, pictures: Path
) -> None:
    """1.5 m written where it was 1.2 m: that one alone, and 1.2 m within 5 %. As they should be, nothing."""
    for wrong, count in ((1.2, 0), (1.5, 1)):
        (tmp_path / str(count)).mkdir()
        ranges_m = [*RANGES_M[:3], wrong, *RANGES_M[4:6]]
        known = [
            {"camera": "r1.front", "frame": number, "range": f"{range_m} m ± 5 mm"}
            for number, range_m in enumerate(ranges_m)
        ]
        folder = _folder(tmp_path / str(count), pictures, {"known_ranges": known})
        warnings = import_recording(folder, overwrite=False)["r1.front"].warnings
        assert len(warnings) == count, warnings
    (said,) = warnings
    found = re.fullmatch(
        r"1.5 m was measured of img11.png, and by the light of the other 5, which agree, it would be "
        r"([\d.]+) m. Check it: all ranges lean on it",
        said,
    )
    assert found is not None, said
    assert float(found[1]) == pytest.approx(1.2, rel=0.05)


def test_the_field_of_view_of_a_part_beside_the_axis(tmp_path: Path, pictures: Path) -> None:
    """Of 200 columns, the first of which lies 300 px right of the axis."""
    sheets = {"source": {"radius": "10 mm", "intensity": "16 mW/sr"}, "known_ranges": []}
    folder = _folder(
        tmp_path, pictures, sheets, principal_point="[-300, 79.5] px", pixel_pitch="5 um", f_number=2
    )
    across_rad, down_rad = import_recording(folder, overwrite=False)["r1.front"].field_of_view_rad
    assert across_rad == pytest.approx(math.atan(499.5 / 300.0) - math.atan(299.5 / 300.0))
    assert down_rad == pytest.approx(2.0 * math.atan2(80.0, 300.0))


def test_missing_numbers_among_the_pictures_are_told(tmp_path: Path, pictures: Path) -> None:
    folder = _folder(tmp_path, pictures)
    (folder / "img12.png").unlink()
    (said,) = import_recording(folder, overwrite=False)["r1.front"].warnings
    assert said.startswith(
        "numbers are missing among the pictures, after img11.png comes img13.png: frame_rate"
    )
    times = folder / "times.txt"
    times.write_text("\n".join(f"{0.1 * n:g}" for n in (0, 1, 2, 3, 5, 6, 7)))
    document = yaml.safe_load((folder / "recording.yaml").read_text(encoding="utf-8"))
    camera = document["cameras"]["r1.front"]
    del camera["frame_rate"]
    camera["times"] = "times.txt"
    (folder / "recording.yaml").write_text(yaml.safe_dump(document, allow_unicode=True), encoding="utf-8")
    assert import_recording(folder, overwrite=True)["r1.front"].warnings == ()


@pytest.mark.parametrize(
    ("names", "gaps"),
    [
        ([f"img_{n:03d}_cam0.png" for n in (0, 1, 2, 4, 5)], [("img_002_cam0.png", "img_004_cam0.png")]),
        ([f"2026/{n}.png" for n in (0, 10, 20, 30, 60, 70)], [("2026/30.png", "2026/60.png")]),
        ([f"{n}.png" for n in (0, 33, 67, 100, 133, 167)], []),  # milliseconds
        ([f"{n}.png" for n in (1, 2, 3, 4)], []),
        (["a.png", "b.png", "c.png", "d.png"], []),
        (["a1.png", "a2.png", "b1.png", "b2.png"], []),
    ],
)
def test_gaps_are_those_of_a_number_that_counts(names: list[str], gaps: list[tuple[str, str]]) -> None:
    assert Pictures(tuple(names), 8, 8, 8, 255, 0.0, Darkness(5.0, 0.1, 1.0)).gaps == gaps


def test_twelve_bits_in_files_of_sixteen_are_asked_about(tmp_path: Path, pictures: Path) -> None:
    folder = _folder(tmp_path, pictures, bit_depth="16 bit")
    for path in folder.glob("*.png"):
        counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert counts is not None
        assert cv2.imwrite(str(path), counts.astype(np.uint16) * 10)
    warnings = import_recording(folder, overwrite=False)["r1.front"].warnings
    assert any("bit_depth is 16 bit, and no picture has a count above" in said for said in warnings)
    document = yaml.safe_load((folder / "recording.yaml").read_text(encoding="utf-8"))
    document["cameras"]["r1.front"]["saturation"] = "4095 DN"
    (folder / "recording.yaml").write_text(yaml.safe_dump(document, allow_unicode=True), encoding="utf-8")
    warnings = import_recording(folder, overwrite=True)["r1.front"].warnings
    assert not any("bit_depth" in said for said in warnings)


def test_a_key_that_stands_empty_is_not_called_missing(tmp_path: Path, pictures: Path) -> None:
    known_range = {"camera": "r1.front", "frame": 2, "range": None}
    folder = _folder(tmp_path, pictures, {"known_ranges": [known_range]}, exposure=None, bit_depth=None)
    with pytest.raises(InputError) as error:
        import_recording(folder, overwrite=False)
    told = [line.split(": ", 1)[1] for line in error.value.problems]
    for key in ("cameras.r1.front.exposure", "cameras.r1.front.bit_depth", "known_ranges.0.range"):
        assert f"{key}: stands empty; fill it in" in told
