"""A run in other programs' formats, read back by these programs' own libraries or the formats' own words."""

import dataclasses
import json
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import h5py
import motmetrics
import numpy as np
import pytest
from pycocotools.coco import COCO
from scipy.spatial.transform import Rotation

from nir_render import calibration, load_scene
from nir_render.errors import InputError
from nir_render.export import dataset
from nir_render.export.boxes import KINDS, read_labelled
from nir_render.export.coco import export_coco
from nir_render.export.dataset import RunDataset, collate, export_hdf5
from nir_render.export.mot import export_mot
from nir_render.export.opencv_file import export_opencv
from nir_render.export.trajectories import export_tum
from nir_render.run.folder import parse_lines, write_lines
from nir_render.truth.lamps import LampTruth
from nir_render.truth.poses import parse_pose
from nir_render.truth.sources import SourceTruth
from perception import (
    Detection,
    FrameRecord,
    RawFrame,
    calibration_document,
    detection_record,
    encode_png16,
    frame_record,
    read_frame,
    read_frames,
)
from perception.model.lens import project
from tests.paths import ROOT
from tests.system.command import nir_render

pytestmark = pytest.mark.mitsuba


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots, one moving; two cameras of the other, two times; a lamp in view of one of them."""
    folder = tmp_path_factory.mktemp("formats") / "run"
    settings = {
        "clock.frames": "2",
        "observe": "[r1.front, r1.left]",
        "shapes": "{}",
        "render.indirect": "{samples: 4, max_depth: 2}",
        "lamps": "{l: {center: '[3, 0.8, 1] m', size: '[0.2, 0.2] m', normal: [-1, 0, 0], "
        "luminous_flux: 10 lm, illuminant: LED-B3, infrared: {share: 0.002, least: 0, most: 0.004}}}",
    }
    words = [word for path, value in settings.items() for word in ("--set", f"{path}={value}")]
    done = nir_render(
        "run", str(ROOT / "scenes" / "one_source.yaml"), "-o", str(folder), *words, cwd=folder.parent
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_coco_has_every_source_where_its_light_is(run: Path, tmp_path: Path) -> None:
    counts = export_coco(run, tmp_path / "run.coco.json")
    known = COCO(str(tmp_path / "run.coco.json"))
    assert len(known.getImgIds()) == counts["images"] == 4
    assert [one["name"] for one in known.loadCats(known.getCatIds())] == list(KINDS)
    of_sources = known.getAnnIds(catIds=[1])
    assert counts["source"] == len(of_sources) == 2
    light_in_boxes = []
    for one in known.loadAnns(of_sources):
        (image,) = known.loadImgs([one["image_id"]])
        picture = cv2.imread(str(run / image["file_name"]), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        frame = picture.astype(float)
        assert frame.shape == (image["height"], image["width"])
        left, top, width, height = one["bbox"]
        rows, columns = np.indices(frame.shape) + 0.5  # of pixels' centres, from the corner
        excess = frame - np.median(frame)
        near = (abs(columns - one["center_px"][0]) < 30) & (abs(rows - one["center_px"][1]) < 30)
        inside = (abs(columns - left - width / 2) <= width / 2) & (abs(rows - top - height / 2) <= height / 2)
        light_in_boxes.append(excess[inside].sum() / excess[near].sum())
        # The light's centre is the one said, to a tenth of a pixel: an offset of half a pixel would show.
        weight = np.where(near & (excess > 0.05 * excess.max()), excess, 0.0)
        for axis, said in ((columns, one["center_px"][0]), (rows, one["center_px"][1])):
            assert (weight * axis).sum() / weight.sum() == pytest.approx(said, abs=0.1)
    # 0.911 of a point's; of a wide disc the edge alone loses any.
    assert min(light_in_boxes) > 0.98


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools' own
def test_coco_has_lamps_with_their_outlines(run: Path, tmp_path: Path) -> None:
    export_coco(run, tmp_path / "run.coco.json")
    known = COCO(str(tmp_path / "run.coco.json"))
    lamps = known.loadAnns(known.getAnnIds(catIds=[3]))
    assert len(lamps) == 2
    for one in lamps:
        assert known.annToMask(one).sum() == pytest.approx(one["bbox"][2] * one["bbox"][3], rel=0.1)


@pytest.mark.filterwarnings("ignore:Operation with tuple:DeprecationWarning")  # motmetrics' own
def test_mot_is_read_by_motmetrics(run: Path, tmp_path: Path) -> None:
    """`robust` finds every source within a fifth of a pixel: half a pixel's offset would show."""
    counts = export_mot(run, tmp_path / "mot")
    place = tmp_path / "mot" / "r1.front"
    truth = motmetrics.io.loadtxt(place / "gt" / "gt.txt", fmt="mot15-2D", min_confidence=1)
    assert len(truth) == counts["r1.front/gt/gt.txt"] == 2
    found = motmetrics.io.loadtxt(place / "det" / "robust.txt", fmt="mot15-2D")
    # Frames are numbered from 1, pixels too, from the corner: the middle of pixel (0, 0) is (1.5, 1.5).
    (labelled,) = {box.truth for box in read_labelled(run).boxes["r1.front", 0] if box.kind == "source"}
    assert labelled is not None
    first = truth.loc[1].iloc[0]
    # `loadtxt` takes 1 away from both.
    assert first["X"] + first["Width"] / 2 == pytest.approx(labelled.u_px + 0.5, abs=2e-3)
    assert first["Y"] + first["Height"] / 2 == pytest.approx(labelled.v_px + 0.5, abs=2e-3)
    for frame in (1, 2):
        middles = (
            found.loc[frame][["X", "Y"]].to_numpy() + 0.5 * found.loc[frame][["Width", "Height"]].to_numpy()
        )
        own = truth.loc[frame].iloc[0]
        aim = (own["X"] + own["Width"] / 2, own["Y"] + own["Height"] / 2)
        assert min(np.hypot(*(middle - aim)) for middle in middles) < 0.2
    picture = place / "img1" / "000001.png"
    assert picture.is_file()
    assert picture.is_symlink()  # who writes over a hard link's file changes the run's own
    assert "imWidth=1280" in (place / "seqinfo.ini").read_text()


def test_tum_has_poses_as_they_are(run: Path, tmp_path: Path) -> None:
    counts = export_tum(run, tmp_path / "tum")
    read = np.loadtxt(tmp_path / "tum" / "truth.r1.txt")
    poses = [pose for pose in parse_lines(run / "poses.jsonl", parse_pose) if pose.robot == "r1"]
    assert len(read) == len(poses) == counts["truth.r1.txt"]
    for line, pose in zip(read, poses, strict=True):
        assert line[0] == pytest.approx(pose.time_s, abs=1e-9)
        assert line[1:4] == pytest.approx(pose.position_m, abs=1e-8)
        turned = Rotation.from_quat(line[4:]).inv() * Rotation.from_quat(pose.quaternion_xyzw)
        assert turned.magnitude() < 1e-7
    # The source drives away at 1 m/s, and 0.28 m above the ground; exposures are 0.2 ms.
    seen = np.loadtxt(tmp_path / "tum" / "relative.r1.r2.top.txt")
    assert seen[:, 0] == pytest.approx([1e-4, 1.0 + 1e-4], abs=1e-9)
    assert seen[0, 1:] == pytest.approx([1.0601, 0.20002, 0.28, 0, 0, 0, 1], abs=1e-7)
    assert seen[1, 1:4] - seen[0, 1:4] == pytest.approx([1.0, 0.2, 0.0], abs=1e-7)
    with pytest.raises(InputError, match="no poses, odometry, tracks or truth"):
        export_tum(tmp_path, tmp_path / "none")


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("rectilinear", ()),
        ("brown_conrady", (-0.1, 0.02, 1e-3, -2e-3)),
        ("brown_conrady", (0.1, 0.02, 1e-3, -2e-3, 0.01, 0.12, 0.01, 0.001)),
        ("fisheye", (0.01, -0.003, 0.001, 0.0)),
    ],
)
def test_opencv_images_where_perception_does(
    model: str, distortion: tuple[float, ...], tmp_path: Path
) -> None:
    """A point in camera axes, by the file's numbers and OpenCV's own function."""
    known = calibration(load_scene(ROOT / "scenes" / "one_source.yaml"), "r1.left")
    known = dataclasses.replace(known, lens_model=model, distortion=distortion)
    (tmp_path / "calibration.json").write_text(json.dumps(calibration_document([known])))
    export_opencv(tmp_path, tmp_path / "cv")
    file = cv2.FileStorage(str(tmp_path / "cv" / "r1.left.yaml"), cv2.FILE_STORAGE_READ)
    matrix, coefficients = (file.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    points = np.array([[0.1, 0.2, 1.0], [-0.4, 0.1, 1.2], [0.3, -0.3, 0.9]])
    images = cv2.fisheye.projectPoints if file.getNode("model").string() == "fisheye" else cv2.projectPoints
    shaped = points.reshape(-1, 1, 3)
    seen, _ = images(shaped, np.zeros(3), np.zeros(3), matrix, coefficients.ravel())
    assert seen.reshape(-1, 2) == pytest.approx(project(points, known), abs=1e-6)
    turn = file.getNode("rotation_body_camera").mat()
    assert turn @ [0.0, 0.0, 1.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)  # it looks to the left
    assert (file.getNode("image_width").real(), file.getNode("image_height").real()) == (1280, 960)


def test_opencv_refuses_a_calibration_of_nothing(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_text(json.dumps(calibration_document([])))
    with pytest.raises(InputError, match="names no camera"):
        export_opencv(tmp_path, tmp_path / "cv")
    assert not (tmp_path / "cv").exists()


def test_a_data_set_has_the_frames_as_they_are_and_their_labels(run: Path) -> None:
    both = RunDataset(run, run)
    frames = list(read_frames(run))
    assert len(both) == 2 * len(frames) == 8
    for number, frame in enumerate(frames):
        for sample in (both[number], both[number + 4], both[number - 8]):
            assert (sample.camera, sample.index) == (frame.camera, frame.index)
            assert np.array_equal(sample.data_dn, frame.data_dn)
    with pytest.raises(IndexError):
        both[8]
    seen = [sample for sample in both if "r2.top" in sample.names and sample.camera == "r1.front"]
    assert len(seen) == 4
    for sample in seen:
        which = sample.names.index("r2.top")
        left, top, right, bottom = sample.boxes_px[which]
        assert left < sample.places_px[which, 0] < right
        assert top < sample.places_px[which, 1] < bottom
        assert KINDS[sample.kinds[which]] == "source"
        assert np.linalg.norm(sample.bearings_body[which]) == pytest.approx(1.0, abs=1e-6)
    assert {name for sample in RunDataset(run, kinds=["lamp"]) for name in sample.names} == {"lamps.l"}


def test_hdf5_has_the_same_bits(run: Path, tmp_path: Path) -> None:
    counts = export_hdf5(run, tmp_path / "run.h5")
    assert counts == {"r1.front": 2, "r1.left": 2}
    with h5py.File(tmp_path / "run.h5") as file:
        kinds = list(file.attrs["kinds"])
        for sample in RunDataset(run):
            group = file[sample.camera]
            at = list(group["index"]).index(sample.index)
            assert np.array_equal(group["frames"][at], sample.data_dn)
            own = group["frame"][:] == at
            assert [name.decode() for name in group["name"][own]] == list(sample.names)
            assert np.array_equal(group["ranges_m"][own], sample.ranges_m, equal_nan=True)
            assert np.array_equal(group["boxes_px"][own], sample.boxes_px)
            assert np.array_equal(group["peak_snr"][own], sample.peak_snr, equal_nan=True)
            assert group["line_time_s"][at] == sample.line_time_s
            assert group["frame_kind"].asstr()[at] == sample.frame_kind == "scene"
        assert kinds == list(KINDS)


def test_the_command_writes_each_of_them_and_says_what(run: Path, tmp_path: Path) -> None:
    for form in ("coco", "mot", "tum", "opencv", "hdf5", "mcap"):
        done = nir_render(
            "export", str(run), "--format", form, "-o", str(tmp_path / form), "--json", cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
        record = json.loads(done.stdout)
        assert Path(record["file"]).exists()
        assert sum(record["counts"].values()) > 0
        assert ("messages" in record) == (form == "mcap")
    done = nir_render("export", str(tmp_path), "--format", "coco", cwd=tmp_path)
    assert done.returncode == 2
    assert "has no truth.jsonl" in done.stderr


KNOWN = dataclasses.replace(
    calibration(load_scene(ROOT / "scenes" / "one_source.yaml"), "r1.front"),
    width_px=64,
    height_px=48,
    cx_px=31.5,
    cy_px=23.5,
)

Made = Callable[..., Path]


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Make the folder of a run by hand: frames of one small camera, and what is said to be in them."""

    def make(
        truth: Iterable[SourceTruth] = (),
        lamps: Iterable[LampTruth] = (),
        found: Iterable[Detection] = (),
        frames: int = 1,
        **of_frame: Any,
    ) -> Path:
        folder = tmp_path / "made"
        folder.mkdir()
        (folder / "calibration.json").write_text(json.dumps(calibration_document([KNOWN])))
        records = []
        for index in range(frames):
            (folder / f"{index}.png").write_bytes(
                encode_png16(np.full((48, 64), 64 + index, dtype=np.uint16))
            )
            frame = RawFrame("r1.front", index, float(index), 0.01, np.empty(0, dtype=np.uint16), 64.0)
            records.append(frame_record(frame, f"{index}.png") | of_frame)
        write_lines(folder / "frames.jsonl", records)
        write_lines(folder / "truth.jsonl", (one.record() for one in truth))
        write_lines(folder / "lamps.jsonl", (one.record() for one in lamps))
        write_lines(folder / "detections.own.jsonl", map(detection_record, found))
        return folder

    return make


def _source(**other: Any) -> SourceTruth:
    known = {"camera": "r1.front", "index": 0, "time_s": 0.0, "source": "top", "robot": "r2"}
    place = {"u_px": 31.5, "v_px": 23.5, "range_m": 1e4, "bearing_body": (1.0, 0.0, 0.0), "peak_snr": 20.0}
    return SourceTruth(**known | place | other)  # type: ignore[arg-type]


def test_a_box_holds_as_much_of_a_points_light_as_it_says(made: Made) -> None:
    """Light drawn from the point spread, and again from a pixel's square: two σ each way hold 0.911 of it."""
    (box,) = read_labelled(made([_source()])).boxes["r1.front", 0]
    rng = np.random.default_rng(7)
    light = KNOWN.psf_sigma_px * rng.standard_normal((100_000, 2)) + rng.uniform(-0.5, 0.5, (100_000, 2))
    half = 0.5 * np.array([box.width_px, box.height_px])
    share = (abs(light) < half).all(axis=1).mean()
    # The square makes the sum's tails shorter than a Gaussian's, and the draw has a σ of 0.001.
    assert share == pytest.approx(0.911, abs=0.006)


def test_a_lamp_is_cut_at_the_frames_edges(made: Made, tmp_path: Path) -> None:
    """Squares on their corners about the frame's corners: a quarter of each is in view, a triangle."""

    def about(u_px: float, v_px: float, reach_px: float) -> LampTruth:
        turns = ((1, 0), (0, 1), (-1, 0), (0, -1))
        corners = tuple((u_px + reach_px * u, v_px + reach_px * v) for u, v in turns)
        return LampTruth("r1.front", 0, "lamps.l", corners)

    lamps = [about(-0.5, -0.5, 20.0), about(63.5, 47.5, 10.0), about(100.0, 20.0, 5.0)]
    folder = made(lamps=lamps)
    assert export_coco(folder, tmp_path / "c.json")["lamp"] == 2
    first, second = json.loads((tmp_path / "c.json").read_text())["annotations"]
    assert first["bbox"] == pytest.approx([0.0, 0.0, 20.0, 20.0])
    assert first["area"] == pytest.approx(200.0)
    corners = {tuple(corner) for corner in np.reshape(first["segmentation"], (-1, 2)).tolist()}
    assert corners == {(0.0, 0.0), (20.0, 0.0), (0.0, 20.0)}
    assert second["bbox"] == pytest.approx([54.0, 38.0, 10.0, 10.0])
    assert second["area"] == pytest.approx(50.0)


def test_mot_passes_over_what_cannot_be_found_and_what_is_known_for_a_mirror_image(
    made: Made, tmp_path: Path
) -> None:
    truth = [
        _source(robot="r2"),
        _source(robot="r3", visible_fraction=0.01),
        _source(robot="r4", peak_snr=0.01),
        _source(robot="r5", ghost_of="r2.top"),
    ]
    one = Detection(
        "r1.front", 0, 0.0, 31.5, 23.5, 0.1, 0.1, 1e3, 90.0, 64.0, 9, False, False, False, 2.0, 0.1, (1.0, 0.0, 0.0)
    )  # fmt: skip
    folder = made(truth, found=[one, dataclasses.replace(one, ghost=True, u_px=10.0)])
    export_mot(folder, tmp_path / "mot")
    rows = np.loadtxt(tmp_path / "mot" / "r1.front" / "gt" / "gt.txt", delimiter=",")
    assert rows[:, 6].tolist() == [1, 0, 0]
    assert rows[:, 8].tolist() == [1.0, 0.01, 1.0]
    found = np.loadtxt(tmp_path / "mot" / "r1.front" / "det" / "own.txt", delimiter=",", ndmin=2)
    assert len(found) == 1
    assert found[0, 2] + found[0, 4] / 2 == pytest.approx(33.0)
    (sample,) = RunDataset(folder, kinds=["source"])
    assert sample.peak_snr.tolist() == pytest.approx([20.0, 20.0, 0.01])


def test_hdf5_holds_no_frame_that_it_has_written(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run may be larger than the memory; the one before is let go as the next takes its name."""
    taken: list[weakref.ref[Any]] = []
    alive: list[int] = []

    def watched(folder: Path, record: FrameRecord) -> RawFrame:
        frame = read_frame(folder, record)
        alive.append(sum(one() is not None for one in taken))
        taken.append(weakref.ref(frame.data_dn))
        return frame

    folder = made([_source(index=4)], frames=5, line_time_s=1e-5, kind="rail")
    monkeypatch.setattr(dataset, "read_frame", watched)
    export_hdf5(folder, tmp_path / "run.h5")
    assert len(alive) == 5
    assert max(alive) <= 1
    with h5py.File(tmp_path / "run.h5") as file:
        group = file["r1.front"]
        assert group["frames"][:, 0, 0].tolist() == [64, 65, 66, 67, 68]
        assert group["line_time_s"][:].tolist() == [1e-5] * 5
        assert group["frame_kind"].asstr()[:].tolist() == ["rail"] * 5
        assert group["frame"][:].tolist() == [4]


@pytest.mark.parametrize("form", ["coco", "mot", "hdf5"])
def test_what_does_not_fit_together_is_refused_in_words(form: str, made: Made, tmp_path: Path) -> None:
    write: dict[str, Callable[[Path, Path], Any]] = {
        "coco": export_coco,
        "mot": export_mot,
        "hdf5": export_hdf5,
    }
    folder = made([_source()])
    kept = (folder / "frames.jsonl").read_text()
    (folder / "frames.jsonl").write_text(kept.replace("r1.front", "r1.back"))
    with pytest.raises(InputError, match=r"knows no camera 'r1\.back'.*known: r1\.front"):
        write[form](folder, tmp_path / form)
    (folder / "frames.jsonl").write_text("")
    with pytest.raises(InputError, match="names no frame"):
        write[form](folder, tmp_path / form)
    assert not (tmp_path / form).exists()


def test_a_picture_of_another_size_than_its_calibration_is_refused(made: Made, tmp_path: Path) -> None:
    folder = made([_source()])
    (folder / "0.png").write_bytes(encode_png16(np.zeros((48, 32), dtype=np.uint16)))
    with pytest.raises(
        InputError, match=r"0\.png: has 32 × 48 pixels, the calibration of r1\.front says 64 × 48"
    ):
        export_hdf5(folder, tmp_path / "run.h5")
    assert not (tmp_path / "run.h5").exists()


@pytest.mark.parametrize("kinds", [["sources"], "source", ["source", "lamps"]])
def test_a_kind_that_there_is_not_is_refused(kinds: Any, made: Made) -> None:
    with pytest.raises(InputError, match="wanted a list of some of source, ghost, lamp"):
        RunDataset(made([_source()]), kinds=kinds)


def test_frames_with_different_numbers_of_things_are_one_batch(made: Made) -> None:
    runs = RunDataset(made([_source(), _source(robot="r3"), _source(index=1)], frames=2))
    batch = collate(list(runs))
    assert [boxes.shape for boxes in batch["boxes_px"]] == [(2, 4), (1, 4)]
    assert batch["names"] == [("r2.top", "r3.top"), ("r2.top",)]
    assert [int(data_dn[0, 0]) for data_dn in batch["data_dn"]] == [64, 65]


def test_a_folder_given_as_a_dot_has_its_name(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(made([_source()]))
    export_coco(Path(), tmp_path / "c.json")
    assert json.loads((tmp_path / "c.json").read_text())["info"]["description"].startswith("made,")


def test_nothing_of_an_earlier_export_stays(made: Made, tmp_path: Path) -> None:
    folder, target = made([_source(), _source(robot="r3")]), tmp_path / "tum"
    command = ("export", str(folder), "--format", "tum", "-o", str(target))
    assert nir_render(*command, cwd=tmp_path).returncode == 0
    write_lines(folder / "truth.jsonl", [_source().record()])
    done = nir_render(*command, cwd=tmp_path)
    assert done.returncode == 2
    assert "holds another export" in done.stderr
    assert (target / "relative.r1.r3.top.txt").is_file()
    assert nir_render(*command, "--overwrite", cwd=tmp_path).returncode == 0
    assert [path.name for path in target.glob("*.txt")] == ["relative.r1.r2.top.txt"]
    # What is not ours is never taken away.
    done = nir_render(*command[:-1], str(folder), "--overwrite", cwd=tmp_path)
    assert done.returncode == 2
    assert "holds files that are no export" in done.stderr
    assert (folder / "truth.jsonl").is_file()
