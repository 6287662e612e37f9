"""References on disk: they come back as they were, and whatever is wrong with them says how to mend it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nir_render.errors import InputError
from nir_render.light.npz import light_hash
from nir_render.regress import create, update
from nir_render.regress.following import Followed, Following, as_kept
from nir_render.regress.scenes_of import scenes_of
from nir_render.regress.stages.following import compare_followed, compare_odometry
from nir_render.regress.store import names_in, read_reference, write_references
from perception import (
    Message,
    Odometry,
    Track,
    read_calibrations,
    read_frames,
)
from tests.unit.regress import cases


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    suite = cases.suite(tmp_path / "suite")
    reference = cases.reference(cases.scene(tmp_path))
    write_references(suite / "references", {"small": reference}, [], lambda: None)
    return suite


def test_a_reference_comes_back_as_it_was(stored: Path, tmp_path: Path) -> None:
    before = cases.reference(cases.scene(tmp_path))
    after = read_reference(stored / "references", "small", stored)
    assert light_hash(after.lights[0].light) == light_hash(before.lights[0].light)
    own, known = (reference.lights[0].own_radiance_per_w for reference in (after, before))
    assert own is not None
    assert known is not None
    assert np.array_equal(own, known)
    assert np.array_equal(after.shots[0].electrons, before.shots[0].electrons)
    assert np.array_equal(after.shots[0].frame.data_dn, before.shots[0].frame.data_dn)
    assert after.shots[0].frame.exposure_s == before.shots[0].frame.exposure_s
    assert repr(after.detections["robust"]) == repr(before.detections["robust"])
    assert after.detections["paper"] == ()
    for name in ("document", "seed", "renders", "made_by", "history"):
        assert getattr(after, name) == getattr(before, name)


def test_an_older_reference_has_no_light_of_its_own_seed(stored: Path) -> None:
    folder = stored / "references"
    (folder / "small" / "own.npz").unlink()
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["sha256"]["small/own.npz"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert read_reference(folder, "small", stored).lights[0].own_radiance_per_w is None


def test_what_follows_from_it_comes_back_with_its_bits(tmp_path: Path) -> None:
    """A robot that turns, seen from one whose odometry is noisy: what was written is what is compared."""
    known = cases.reference(cases.scene(tmp_path))
    turn = Rotation.from_euler("z", 0.123).as_matrix()
    odometry = Odometry("r1", 0.1, np.array([0.1, 1.0 / 3.0, 0.0]), turn, 0.01, 0.002)
    track = Track("r1", 0.1, 3, np.array([2.0, 1.0 / 3.0, 0.1]), np.full(3, 0.1), np.eye(6) / 3.0)
    word = Message("r1", 3, np.float64(1.0) / 3.0, 6.75, 11, "recover", 0.9999, 5)
    following = Following(
        {"r1": (odometry,)}, {"robust": Followed((track,), (word,)), "paper": Followed((), ())}
    )
    write_references(tmp_path / "refs", {"small": replace(known, following=following)}, [], lambda: None)
    read = read_reference(tmp_path / "refs", "small", tmp_path).following
    assert read is not None
    assert compare_odometry(as_kept(following.odometry), read.odometry, exact=True).same_bits
    for name, before in following.by_estimator.items():
        findings = compare_followed(name, before, read.by_estimator[name], exact=True)
        assert [finding.same_bits for finding in findings] == [True, True]


def test_its_folder_is_a_recording(stored: Path) -> None:
    """So any stack can be run over the frames of a reference."""
    (frame,) = read_frames(stored / "references" / "small")
    assert frame.camera in read_calibrations(stored / "references" / "small")


def _break(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def _set(key: str, value: object) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))

    return change


@pytest.mark.parametrize(
    ("file", "fault", "said"),
    [
        ("small/light.0.npz", Path.unlink, "is missing; restore it from version control, or remove"),
        ("small/expected.npz", _break, "is not what was written there; restore it"),
        ("small/frames/r1.front/000000.png", _break, "is not what was written there"),
        ("small/reference.json", _set("seed", 4), "is not what was written there"),
        ("manifest.json", Path.unlink, "holds no references; make them: nir-render regress create"),
        ("manifest.json", _break, "broken JSON"),
        ("manifest.json", _set("scenes", None), "names no scenes of a suite; give the folder of references with --refs"),
        ("manifest.json", _set("format", 2), "references of format 2, this version reads 1; remove the folder and make"),
    ],
)  # fmt: skip
def test_what_is_broken_says_how_to_mend_it(
    stored: Path, file: str, fault: Callable[[Path], None], said: str
) -> None:
    fault(stored / "references" / file)

    def read() -> None:
        for name in names_in(stored / "references", stored):
            read_reference(stored / "references", name, stored)

    with pytest.raises(InputError) as error:
        read()
    assert said in str(error.value)


def test_what_is_left_out_of_a_file_says_so(stored: Path, tmp_path: Path) -> None:
    """A reference that is whole by its hashes, and yet not what this version writes."""
    reference = stored / "references" / "small" / "reference.json"
    document = json.loads(reference.read_text())
    del document["renders"]
    reference.write_text(json.dumps(document))
    from nir_render.run.folder import write_manifest

    write_manifest(stored / "references", {"scenes": ["small"]})
    with pytest.raises(InputError, match=r"small: cannot be read \('renders'\); restore it"):
        read_reference(stored / "references", "small", stored)


def test_suites_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder"):
        scenes_of(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no scene file"):
        scenes_of(tmp_path / "empty")
    cases.suite(tmp_path / "short", small=cases.SCENE).joinpath("small.yaml").rename(
        tmp_path / "short" / "a.yml"
    )
    with pytest.raises(InputError, match=r"a\.yml: scenes of a suite end in \.yaml; rename it"):
        scenes_of(tmp_path / "short")
    noisy = cases.SCENE.replace("samples: 16, ", "")
    with pytest.raises(InputError, match=r"small\.yaml: render: the scenes of a suite fix their samples"):
        scenes_of(cases.suite(tmp_path / "noisy", small=noisy))


def test_create_overwrites_nothing_and_update_wants_a_reason(stored: Path) -> None:
    with pytest.raises(
        InputError, match="is there already and is not overwritten; 'nir-render regress update"
    ):
        create(stored)
    with pytest.raises(InputError, match="--reason is empty"):
        update(stored, "  ")


def test_what_is_stopped_leaves_the_old_references_and_nothing_half_written(
    stored: Path, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in stored.rglob("*") if path.is_file()}
    reference = cases.reference(cases.scene(tmp_path))

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_references(stored / "references", {"other": reference}, ["small"], stop)
    assert {path: path.read_bytes() for path in stored.rglob("*") if path.is_file()} == before


def test_kept_references_are_copied_bit_by_bit(stored: Path, tmp_path: Path) -> None:
    folder = stored / "references"
    shutil.copytree(folder / "small", tmp_path / "copy")
    write_references(folder, {"other": cases.reference(cases.scene(tmp_path))}, ["small"], lambda: None)
    assert names_in(folder, stored) == ["other", "small"]
    for path in (tmp_path / "copy").rglob("*.npz"):
        assert path.read_bytes() == (folder / "small" / path.name).read_bytes()
    read_reference(folder, "small", stored)
