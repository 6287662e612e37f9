import json
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception import ForwardLight, Layout, RecordingError, calibration_document, parse_calibration_document
from tests.unit.perception.simulation import calibration

ARRAYS = (
    "rotation_body_camera", "position_body_m", "response_angle_rad", "response_relative", "own_sources_body_m",
)  # fmt: skip
FULL = calibration(
    rotation_body_camera=Rotation.from_euler("xyz", [0.3, -1.2, 2.1]).as_matrix(),
    response_angle_rad=np.array([0.0, 0.1, 1.0 / 3.0]),
    response_relative=np.array([1.0, 0.98, 0.1]),
    sigma={
        "fx_px": 0.1,
        "range_constant_dn_m2_per_s": 1e6 / 3.0,
        "position_body_m": 1e-3,
        "rotation_body_camera": 2e-3,
        "saturation_dn": 0.5,
        "distortion": 1e-4,
        "dsnu_e": 0.1,
        "prnu": 2e-4,
    },
    own_sources_body_m=np.array([[0.0, 1.0 / 3.0, 0.28], [0.1, 0.0, 0.0]]),
    dsnu_e=4.0 + 1.0 / 3.0,
    prnu=0.009,
    layouts=(Layout("pair", ((0.06, 0.0, 1.0 / 3.0), (-0.06, 0.0, 0.28)), (1.0, 1.0 / 3.0), 0.1, 0.05),),
    forward_light=(
        ForwardLight(0.5, (1e-3, 1.0 / 300.0), (0.01, 1.0 / 30.0), 0.4, (0.001, -0.002, -0.001, 0.002)),
        ForwardLight(1.0, (1e-3,), (0.03,), deviations=(0.003, -0.003)),
    ),
    lens_model="brown_conrady",
    distortion=(-0.1, 0.01, 1e-3, -1.0 / 3.0, 0.0),
)


def test_round_trip_through_text() -> None:
    document = json.loads(json.dumps(calibration_document([FULL, calibration(camera="r1.left")])))
    cameras = parse_calibration_document(document)
    assert list(cameras) == ["r1.front", "r1.left"]
    back = cameras["r1.front"]
    for name in FULL.__dataclass_fields__:
        if name not in ARRAYS:
            assert getattr(back, name) == getattr(FULL, name), name
    for name in ARRAYS[1:]:
        assert np.array_equal(getattr(back, name), getattr(FULL, name)), name
    np.testing.assert_allclose(back.rotation_body_camera, FULL.rotation_body_camera, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": 0.1}, "forward_light[1]"),
        ({"deviations": [0.1]}, "forward_light[1].deviations': has 1 numbers"),
        ({"angle_rad": [2e-3]}, "has 2 numbers"),
        ({"angle_rad": [1e-3, 1e-3]}, "does not increase"),
        ({"share": [0.1, 0.05]}, "falls"),
    ],
)
def test_forward_light_that_contradicts_itself_is_refused(change: dict[str, Any], words: str) -> None:
    record = {"depth": 0.2, "angle_rad": [1e-3, 2e-3], "share": [0.1, 0.2]}
    document = calibration_document([FULL])
    document["cameras"]["r1.front"]["forward_light"] = [record, {**record, "depth": 0.3, **change}]
    with pytest.raises(RecordingError, match=re.escape(words)):
        parse_calibration_document(document)


def test_a_file_without_a_lens_model_is_of_a_rectilinear_lens() -> None:
    document = calibration_document([calibration()])
    for name in ("lens_model", "distortion"):
        del document["cameras"]["r1.front"][name]
    back = parse_calibration_document(document)["r1.front"]
    assert (back.lens_model, back.distortion) == ("rectilinear", ())


def test_every_number_of_a_calibration_can_have_a_sigma() -> None:
    """What is written with a σ reads back with it, whichever entry it is of."""
    names = {*FULL.__dataclass_fields__} - {
        "camera",
        "sigma",
        "lens_model",
        "offset_dn",
        "offset_file",
        "layouts",
        "forward_light",
    }
    sigma = {name: 0.01 * number for number, name in enumerate(sorted(names), 1)}
    document = json.loads(json.dumps(calibration_document([replace(FULL, sigma=sigma)])))
    back = parse_calibration_document(document)["r1.front"]
    assert back.sigma == sigma
    assert (back.dsnu_e, back.prnu) == (FULL.dsnu_e, FULL.prnu)


def test_a_file_without_fixed_patterns_is_of_a_camera_that_has_none() -> None:
    document = calibration_document([calibration(dsnu_e=4.0, prnu=0.01)])
    for name in ("dsnu_e", "prnu"):
        del document["cameras"]["r1.front"][name]
    back = parse_calibration_document(document)["r1.front"]
    assert (back.dsnu_e, back.prnu) == (0.0, 0.0)


def test_layout() -> None:
    camera = calibration_document([FULL])["cameras"]["r1.front"]
    assert camera["fx_px"] == {"value": 480.0, "sigma": 0.1}
    assert camera["fy_px"] == 480.0
    assert camera["quaternion_body_camera_xyzw"]["sigma"] == 2e-3
    # A quarter turn about z, scalar last.
    turned = calibration(rotation_body_camera=Rotation.from_euler("z", 90, degrees=True).as_matrix())
    quaternion = calibration_document([turned])["cameras"]["r1.front"]["quaternion_body_camera_xyzw"]
    np.testing.assert_allclose(quaternion, [0, 0, math.sqrt(0.5), math.sqrt(0.5)], atol=1e-15)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("fx_px", None, "the field is missing"),
        ("fx_px", -1.0, "above 0.001"),
        ("fx_px", {"value": 480.0}, "sigma"),
        ("fx_px", {"value": 480.0, "sigma": -1.0}, "0 or more"),
        ("fx_px", "480", "finite number"),
        ("width_px", 1280.5, "whole number"),
        ("position_body_m", [0.0, 1.0], "3 numbers"),
        ("quaternion_body_camera_xyzw", [0.0, 0.0, 0.0, 1.1], "unit quaternion"),
        ("response_angle_rad", [0.0, 0.2, 0.1], "increase"),
        ("response_angle_rad", [0.0, 0.2], "2 numbers"),
        ("read_noise_e", -3.0, "0 or more"),
        ("dsnu_e", -3.0, "0 or more"),
        ("prnu", {"value": -0.01, "sigma": 1e-3}, "0 or more"),
        ("prnu", {"value": 0.01, "sigma": -1e-3}, "0 or more"),
        ("prnu", {"value": 0.01}, "sigma"),
        ("lens_model", "pinhole", "Known are rectilinear, brown_conrady, fisheye"),
        ("lens_model", "fisheye", "A fisheye lens takes 4 numbers in OpenCV's order"),
        ("lens_model", "rectilinear", "A rectilinear lens takes 0 numbers"),
        ("distortion", [0.1] * 12, "A brown_conrady lens takes 4 or 5 or 8 numbers"),
        ("distortion", [0.1, 0.0, "0", 0.0], "finite number"),
    ],
)
def test_bad_entries_name_camera_and_field(field: str, value: Any, text: str) -> None:
    document = calibration_document([FULL])
    camera = document["cameras"]["r1.front"]
    if value is None:
        del camera[field]
    else:
        camera[field] = value
    with pytest.raises(RecordingError, match=rf"calibration.json, field 'cameras.r1.front.*{text}"):
        parse_calibration_document(document)


def test_what_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="two calibrations"):
        calibration_document([FULL, FULL])
    with pytest.raises(ValueError, match="no entry"):
        calibration_document([calibration(sigma={"fx": 1.0})])
    with pytest.raises(ValueError, match="rotation"):
        calibration_document([calibration(rotation_body_camera=np.diag([1.0, 1.0, -1.0]))])


def test_cameras_must_be_an_object() -> None:
    with pytest.raises(RecordingError, match="cameras"):
        parse_calibration_document({"format": 1, "cameras": []})
