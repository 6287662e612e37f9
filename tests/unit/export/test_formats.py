"""A run in other programs' formats, read back by these programs' own libraries or the formats' own words."""

import dataclasses
import json
from pathlib import Path

import cv2
import h5py
import motmetrics
import numpy as np
import pytest
from pycocotools.coco import COCO
from scipy.spatial.transform import Rotation

from nir_render import calibration, load_scene
from nir_render.errors import InputError
from nir_render.export.boxes import KINDS, read_labelled
from nir_render.export.coco import export_coco
from nir_render.export.dataset import RunDataset, export_hdf5
from nir_render.export.mot import export_mot
from nir_render.export.opencv_file import export_opencv
from nir_render.export.trajectories import export_tum
from nir_render.run.folder import parse_lines
from nir_render.truth.poses import parse_pose
from perception import calibration_document, read_frames
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
        frame = cv2.imread(str(run / image["file_name"]), cv2.IMREAD_UNCHANGED).astype(float)
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
    assert min(light_in_boxes) > 0.85


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
    """`robust` finds every source within a pixel; an offset of one would show in the truth."""
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
        assert min(np.hypot(*(middle - aim)) for middle in middles) < 1.0
    assert (place / "img1" / "000001.png").is_file()
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
    with pytest.raises(InputError, match="no poses, odometry or tracks"):
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
        assert kinds == list(KINDS)


def test_the_command_writes_each_of_them_and_says_what(run: Path, tmp_path: Path) -> None:
    for form in ("coco", "mot", "tum", "opencv", "hdf5", "mcap"):
        done = nir_render(
            "export", str(run), "--format", form, "-o", str(tmp_path / form), "--json", cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
        record = json.loads(done.stdout)
        assert Path(record["file"]).exists()
        assert sum(record["messages"].values()) > 0
    done = nir_render("export", str(tmp_path), "--format", "coco", cwd=tmp_path)
    assert done.returncode == 2
    assert "has no truth.jsonl" in done.stderr
