"""Estimators by name and of one's own: what works, and the one line that each mistake gets."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

import perception
from perception import EstimatorError, load_estimator
from perception.own_code import files_of
from perception.paper import detect_paper
from perception.robust.detect import detect_robust
from tests.paths import SCENES
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=120, height_px=100, cx_px=59.5, cy_px=49.5)
FRAME = expose(expected_e(CAMERA, [(60.3, 49.8, 2.0)], 2.4e-4, 1.0), CAMERA, random(71), 2.4e-4)


def test_names_choose_the_estimator() -> None:
    assert perception.detect(FRAME, CAMERA)[0].range_m == detect_robust(FRAME, CAMERA)[0].range_m
    paper = perception.detect(FRAME, CAMERA, "paper")[0]
    assert (paper.u_px, paper.range_m) == (
        detect_paper(FRAME, CAMERA)[0].u_px,
        detect_paper(FRAME, CAMERA)[0].range_m,
    )


def test_an_estimator_of_ones_own() -> None:
    hits = perception.detect(FRAME, CAMERA, lambda frame, camera: iter(detect_robust(frame, camera)))
    assert len(hits) == 1


def test_unknown_name() -> None:
    with pytest.raises(ValueError, match=r"'sound'.*paper, robust"):
        perception.detect(FRAME, CAMERA, "sound")


def test_time_is_limited_for_robust_alone() -> None:
    assert (
        perception.detect(FRAME, CAMERA, limit_s=60.0)[0].range_m == detect_robust(FRAME, CAMERA)[0].range_m
    )
    with pytest.raises(ValueError, match="only the estimator 'robust'"):
        perception.detect(FRAME, CAMERA, "paper", limit_s=1.0)
    for limit_s in (0.0, math.nan):
        with pytest.raises(ValueError, match="wanted a time above 0 s"):
            perception.detect(FRAME, CAMERA, limit_s=limit_s)


def test_time_is_limited_for_many_frames_sets_and_pipelines_too() -> None:
    """And what a set holds says so: that time was up is no empty frame."""
    known = {CAMERA.camera: CAMERA}
    for limit_s, counts, cut in ((60.0, [1], [False]), (1e-9, [0], [True])):
        pipeline = perception.Pipeline(known, limit_s=limit_s)
        for seen in (
            perception.detect_frames([FRAME], known, limit_s=limit_s),
            perception.detect_set([FRAME], known, limit_s=limit_s).detections,
            pipeline.push([FRAME]).measurements.detections,
        ):
            assert [len(found) for found in seen] == counts
            assert [found.truncated for found in seen] == cut
            assert [found.reason.startswith("time was up") for found in seen] == cut


def test_inputs_are_left_as_they_were() -> None:
    before = FRAME.data_dn.copy()
    perception.detect(FRAME, CAMERA)
    perception.detect(FRAME, CAMERA, "paper")
    assert np.array_equal(before, FRAME.data_dn)


# --- one's own ---

EXAMPLE = SCENES / "my_estimator.py"

HEAD = """
import dataclasses
import numpy as np
from perception.robust.detect import detect_robust
"""


def _of_frames(reference: str) -> perception.OwnEstimator:
    estimator = load_estimator(reference)
    assert isinstance(estimator, perception.OwnEstimator)
    return estimator


def _load(tmp_path: Path, body: str, name: str = "mine") -> perception.OwnEstimator:
    (tmp_path / "own.py").write_text(HEAD + body, encoding="utf-8")
    return _of_frames(f"{tmp_path / 'own.py'}:{name}")


def test_the_example_ranges_a_source_within_its_claims() -> None:
    """A source 2 m away; the claim is about 3 % of the limit's flux, so 4 σ is a few centimetres."""
    (hit,) = _of_frames(f"{EXAMPLE}:brightest_spot")(FRAME, CAMERA)
    assert abs(hit.range_m - 2.0) < 4.0 * hit.range_sigma_m < 0.1
    assert abs(hit.u_px - 60.3) < 0.1
    assert abs(hit.v_px - 49.8) < 0.1


def test_the_example_says_nothing_about_a_dark_frame() -> None:
    dark = expose(np.full((100, 120), 1.0), CAMERA, random(72), 2.4e-4)
    flat = perception.RawFrame("r1.front", 0, 0.0, 1e-3, np.full((100, 120), 64, dtype=np.uint16), 64.0)
    estimator = _of_frames(f"{EXAMPLE}:brightest_spot")
    assert estimator(dark, CAMERA) == []
    assert estimator(flat, CAMERA) == []


def test_what_it_returns_arrives_with_plain_numbers(tmp_path: Path) -> None:
    """NumPy's numbers are none of JSON's; a generator is as good as a list; a module beside the file is found."""
    (tmp_path / "beside.py").write_text("FACTOR = 1.5\n")
    estimator = _load(
        tmp_path,
        """
from beside import FACTOR

def mine(frame, calibration):
    for hit in detect_robust(frame, calibration):
        yield dataclasses.replace(
            hit, area_px=np.int64(7), merged=np.bool_(True), range_m=np.float32(FACTOR), bearing_body=np.array(hit.bearing_body)
        )
""",
    )
    (hit,) = estimator(FRAME, CAMERA)
    assert estimator.name == "mine"
    assert (hit.area_px, hit.merged, hit.range_m) == (7, True, 1.5)
    assert [type(value) for value in (hit.area_px, hit.merged, hit.range_m, hit.bearing_body)] == [
        int, bool, float, tuple,
    ]  # fmt: skip
    perception.detection_record(hit)


def test_counts_may_be_changed_without_harm_to_others(tmp_path: Path) -> None:
    before = FRAME.data_dn.copy()
    estimator = _load(tmp_path, "def mine(frame, calibration):\n    frame.data_dn[:] = 0\n    return ()\n")
    assert estimator(FRAME, CAMERA) == []
    assert np.array_equal(FRAME.data_dn, before)


@pytest.mark.parametrize(
    ("body", "name", "said"),
    [
        ("", "mine", "there is no 'mine' in the file"),
        ("def yours(frame, calibration): ...\n", "mine", "it has yours"),
        ("mine = 3\n", "mine", "'mine' is an object of type int, which cannot be called"),
        ("def robust(frame, calibration): ...\n", "robust", "'robust' is an estimator that is built in"),
        ("def Paper(frame, calibration): ...\n", "Paper", "'paper' is an estimator that is built in"),
        ("def größe(frame, calibration): ...\n", "größe", "letters a to z"),
        ("x = 1 / 0\n", "mine", "importing it failed: ZeroDivisionError: division by zero (own.py, line 5)"),
        ("raise SystemExit('no')\n", "mine", "importing it failed: SystemExit: no"),
        ("def mine(:\n", "mine", "importing it failed: SyntaxError: invalid syntax"),
        ("import no_such_module_here\n", "mine", "No module named 'no_such_module_here' (own.py, line 5)"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, body: str, name: str, said: str) -> None:
    with pytest.raises(EstimatorError) as caught:
        _load(tmp_path, body, name)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("nowhere.py:mine", "there is no file 'nowhere.py'"),
        ("own.py", "wanted file.py:function"),
        ("own.py:", "wanted file.py:function"),
        (":mine", "wanted file.py:function"),
        (f"{Path(__file__).parent}:mine", "there is no file"),
        (f"{EXAMPLE.parent / 'one_source.yaml'}:mine", "its name must end in .py"),
    ],
)
def test_references_that_lead_nowhere(reference: str, said: str) -> None:
    with pytest.raises(EstimatorError, match="^" + reference.replace("\\", "\\\\")) as caught:
        load_estimator(reference)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("raise KeyError('x')", "frame 3 of r1.front: KeyError: 'x' (own.py, line 6)"),
        ("raise ValueError('two\\nlines')", "ValueError: two lines (own.py, line 6)"),
        ("return None", "returned None; wanted a list of detections"),
        ("return 3", "returned an object of type int; wanted a list"),
        ("return [(1.0, 2.0)]", "returned an object of type tuple among its detections; wanted a Detection"),
        ("yield 1 / 0", "ZeroDivisionError: division by zero (own.py, line 6)"),
        ("return [dataclasses.replace(hits[0], index=4)]", "returned a detection of frame 4 of r1.front"),
        ("return [dataclasses.replace(hits[0], camera='x')]", "give it this frame's camera and index"),
        (
            "return [dataclasses.replace(hits[0], range_m=np.inf)]",
            "range_m of a detection is inf: wanted a finite",
        ),
        ("return [dataclasses.replace(hits[0], range_m=None)]", "range_m of a detection is None"),
        ("return [dataclasses.replace(hits[0], area_px=2.5)]", "area_px of a detection is 2.5"),
        ("return [dataclasses.replace(hits[0], bearing_body=(1, 0))]", "wanted three numbers"),
    ],
)
def test_frames_that_go_wrong(tmp_path: Path, body: str, said: str) -> None:
    setup = "    hits = detect_robust(frame, calibration)\n" if "hits" in body else ""
    estimator = _load(tmp_path, f"def mine(frame, calibration):\n{setup}    {body}\n")
    with pytest.raises(EstimatorError) as caught:
        estimator(FRAME, CAMERA)
    assert said in str(caught.value)
    assert str(caught.value).startswith(f"{tmp_path / 'own.py'}:mine: frame 3 of r1.front: ")
    assert "\n" not in str(caught.value)


def test_a_range_that_is_unknown_stays_unknown(tmp_path: Path) -> None:
    body = "return [dataclasses.replace(hit, range_m=np.nan) for hit in detect_robust(frame, calibration)]"
    (hit,) = _load(tmp_path, f"def mine(frame, calibration):\n    {body}\n")(FRAME, CAMERA)
    assert math.isnan(hit.range_m)
    assert hit.u_px == detect_robust(FRAME, CAMERA)[0].u_px


# --- one's own, of sets of frames ---


def _load_set(tmp_path: Path, body: str) -> perception.OwnSetEstimator:
    (tmp_path / "own.py").write_text(HEAD + body, encoding="utf-8")
    estimator = load_estimator(f"{tmp_path / 'own.py'}:mine")
    assert isinstance(estimator, perception.OwnSetEstimator)
    return estimator


OTHER = dataclasses.replace(FRAME, camera="r1.left", index=FRAME.index + 4)


def test_a_function_of_sets_gets_all_frames_and_calibrations_by_name(tmp_path: Path) -> None:
    """Parameters may stand in any order; odometry is None where there is none; detections are of any frame of the set."""
    estimator = _load_set(
        tmp_path,
        """
def mine(odometry, calibrations, frames):
    assert odometry is None
    for frame in frames:
        yield from detect_robust(frame, calibrations[frame.camera])
        frame.data_dn[:] = 0
""",
    )
    cameras = {"r1.front": CAMERA, "r1.left": dataclasses.replace(CAMERA, camera="r1.left")}
    before = FRAME.data_dn.copy()
    first, second = estimator([FRAME, OTHER], cameras)
    assert (first.camera, first.index) == ("r1.front", FRAME.index)
    assert (second.camera, second.index) == ("r1.left", FRAME.index + 4)
    assert first.range_m == second.range_m == detect_robust(FRAME, CAMERA)[0].range_m
    assert np.array_equal(FRAME.data_dn, before)


def test_a_function_of_sets_may_do_without_odometry(tmp_path: Path) -> None:
    assert _load_set(tmp_path, "def mine(frames, calibrations, strict=True): return []\n")([FRAME], {}) == []


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("def mine(frames, calibration): ...", "takes (frames, calibration); wanted (frame, calibration), or"),
        ("def mine(frames, calibrations, odometry, gyro): ...", "takes (frames, calibrations, odometry, gyro); wanted"),
        ("def mine(frames, /, calibrations): ...", "wanted (frame, calibration), or for sets of frames"),
    ],
)  # fmt: skip
def test_parameters_that_are_neither_kinds(tmp_path: Path, body: str, said: str) -> None:
    with pytest.raises(EstimatorError) as raised:
        _load_set(tmp_path, body + "\n")
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        ("[1 / 0]", "set of frame 3 of r1.front: ZeroDivisionError: division by zero (own.py, line 5)"),
        ("None", "returned None; wanted a list"),
        ("[3]", "returned an object of type int among its detections"),
        ("[dataclasses.replace(h, index=9) for h in detect_robust(frames[0], calibrations['r1.front'])]",
         "returned a detection of frame 9 of r1.front; give it"),
    ],
)  # fmt: skip
def test_a_function_of_sets_that_fails_gets_one_line(tmp_path: Path, returned: str, said: str) -> None:
    estimator = _load_set(tmp_path, f"def mine(frames, calibrations, odometry): return {returned}\n")
    with pytest.raises(EstimatorError) as raised:
        estimator([FRAME, OTHER], {"r1.front": CAMERA})
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_two_versions_of_ones_own_code_each_have_their_own_helper(tmp_path: Path) -> None:
    """`helper.py` beside each says which it is: the second must not run with the first one's."""
    for version in ("old", "new"):
        folder = tmp_path / version
        folder.mkdir()
        (folder / "own_code_helper.py").write_text(f"NAME = {version!r}\n")
        (folder / "mine.py").write_text(
            "from own_code_helper import NAME\ndef find(frame, calibration):\n    raise ValueError(NAME)\n"
        )
    loaded = [load_estimator(f"{tmp_path / version / 'mine.py'}:find") for version in ("old", "new")]
    assert [one.function.__globals__["NAME"] for one in loaded] == ["old", "new"]


def test_a_helper_that_was_edited_is_imported_anew(tmp_path: Path) -> None:
    """A worker of a cluster lives longer than a version of its user's code; each file has its own helpers."""
    for name in ("mine", "yours"):
        (tmp_path / f"{name}.py").write_text(
            f"from helper_of_{name} import NAME\ndef find(frame, calibration):\n    return NAME\n"
        )
    (tmp_path / "helper_of_yours.py").write_text("NAME = 'yours'\n")
    seen = []
    for version in ("old", "newer"):
        (tmp_path / "helper_of_mine.py").write_text(f"NAME = {version!r}\n")
        seen.append(load_estimator(f"{tmp_path / 'mine.py'}:find").function.__globals__["NAME"])
        load_estimator(f"{tmp_path / 'yours.py'}:find")
    assert seen == ["old", "newer"]
    for name in ("mine", "yours"):
        assert files_of(tmp_path / f"{name}.py") == (
            tmp_path / f"{name}.py",
            tmp_path / f"helper_of_{name}.py",
        )
