"""References on disk: a folder for each scene, which is also a recording that any stack can read.

reference.json (the scene, seed, versions, history), light.N.npz, third.npz, own.npz, expected.npz,
frames.jsonl with frames/, calibration.json, detections.NAME.jsonl; of sequences odometry.jsonl, and tracks
and messages of NAME in .jsonl; and above all scenes manifest.json with every file's hash.
"""

import hashlib
import io
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.timing.exposure_control import Setting
from nir_render.errors import InputError
from nir_render.light.npz import read_light, write_light
from nir_render.regress.following import Followed, Following
from nir_render.regress.reference import Reference, ReferenceLight, ReferenceShot
from nir_render.run import folder as run_folder
from perception import (
    calibration_document,
    detection_record,
    encode_png16,
    frame_record,
    message_record,
    odometry_record,
    parse_detection,
    parse_message,
    parse_track,
    read_calibrations,
    read_frame,
    read_frame_records,
    read_odometry,
    track_record,
)
from perception.files.tracks import ODOMETRY

FORMAT = 1
_FILE = "reference.json"


def names_in(folder: Path, suite: Path) -> list[str]:
    """Return the scenes that a folder holds references of.

    Raises
    ------
    InputError
        It holds none, or is of an unknown format.
    """
    if not (folder / run_folder.MANIFEST).is_file():
        raise InputError(f"{folder}: holds no references; make them: nir-render regress create {suite}")
    manifest = run_folder.read_json(folder / run_folder.MANIFEST)
    names = manifest.get("scenes") if isinstance(manifest, dict) else None
    hashes = manifest.get("sha256") if isinstance(manifest, dict) else None
    if not isinstance(names, list) or not isinstance(hashes, dict):
        raise InputError(
            f"{folder / run_folder.MANIFEST}: names no scenes of a suite; give the folder of references "
            "with --refs"
        )
    if manifest.get("format") != FORMAT:
        raise InputError(
            f"{folder}: references of format {manifest.get('format')!r}, this version reads {FORMAT}; "
            f"remove the folder and make them anew: nir-render regress create {suite}"
        )
    return [str(name) for name in names]


def read_reference(folder: Path, name: str, suite: Path) -> Reference:
    """Read the reference of a scene.

    Raises
    ------
    InputError
        A file is missing, or not what was written.
    """
    mend = (
        f"restore it from version control, or remove {folder} and make all anew: "
        f"nir-render regress create {suite}"
    )
    for file, wanted in run_folder.read_json(folder / run_folder.MANIFEST)["sha256"].items():
        if not file.startswith(f"{name}/"):
            continue
        path = folder / file
        if not path.is_file():
            raise InputError(f"{path}: is missing; {mend}")
        if hashlib.sha256(path.read_bytes()).hexdigest() != wanted:
            raise InputError(f"{path}: is not what was written there; {mend}")
    try:
        return _read(folder / name)
    except Exception as error:  # of a dozen types, from NumPy, zipfile, a missing key, a broken line, ...
        raise InputError(f"{folder / name}: cannot be read ({error}); {mend}") from None


def write_references(
    folder: Path, made: Mapping[str, Reference], kept: Sequence[str], before_done: Callable[[], None]
) -> None:
    """Write a whole suite; what stood there goes when the new stands, and stays if anything fails.

    Parameters
    ----------
    kept
        Scenes whose references are copied from the folder as they are.
    before_done
        Called when everything is written, before it takes its place.

    Raises
    ------
    InputError
        The disk refuses.
    """
    with run_folder.new_run_folder(folder, overwrite=True) as aside:
        for name in kept:
            shutil.copytree(folder / name, aside / name)
        for name, reference in made.items():
            (aside / name).mkdir()
            _write(aside / name, reference)
        run_folder.write_manifest(aside, {"scenes": sorted([*kept, *made])})
        before_done()


def _write(folder: Path, reference: Reference) -> None:
    lights = []
    thirds: dict[str, NDArray[Any]] = {}
    own: dict[str, NDArray[Any]] = {}
    for number, one in enumerate(reference.lights):
        write_light(folder / f"light.{number}.npz", one.light, compressed=True)
        lights.append({"file": f"light.{number}.npz", "own_sha256": one.own_hash})
        if one.own_radiance_per_w is not None:
            own[str(number)] = one.own_radiance_per_w
        parts = {"film": one.third, "edges": one.third_edges, "multiple": one.third_multiple}
        thirds |= {f"{part}.{number}": array for part, array in parts.items() if array is not None}
    if thirds:
        run_folder.write_file(folder / "third.npz", _archive(thirds))
    if own:
        run_folder.write_file(folder / "own.npz", _archive(own))
    records = []
    for shot in reference.shots:
        file = f"frames/{shot.frame.camera}/{shot.frame.index:06d}.png"
        run_folder.write_file(folder / file, encode_png16(shot.frame.data_dn))
        records.append(frame_record(shot.frame, file))
    run_folder.write_lines(folder / "frames.jsonl", records)
    electrons = {_key(shot): shot.electrons for shot in reference.shots}
    run_folder.write_file(folder / "expected.npz", _archive(electrons))
    calibrations = calibration_document(reference.calibrations.values())
    run_folder.write_json(folder / "calibration.json", calibrations)
    for estimator, found in reference.detections.items():
        run_folder.write_lines(folder / f"detections.{estimator}.jsonl", map(detection_record, found))
    if reference.following is not None:
        _write_following(folder, reference.following)
    facts = {
        "format": FORMAT,
        "follows": reference.following is not None,
        "seed": reference.seed,
        "renders": reference.renders,
        "lights": lights,
        "light_of_frames": [shot.light for shot in reference.shots],
        "chosen_after_frames": [
            None if shot.chosen is None else asdict(shot.chosen) for shot in reference.shots
        ],
        "history": list(reference.history),
        "made_by": reference.made_by,
        "document": reference.document,
    }
    run_folder.write_json(folder / _FILE, facts)


def _read(folder: Path) -> Reference:
    facts = run_folder.read_json(folder / _FILE)
    if facts["format"] != FORMAT:
        raise ValueError(f"format {facts['format']!r}, this version reads {FORMAT}")
    thirds, own = (
        _arrays(folder / name) if (folder / name).is_file() else {} for name in ("third.npz", "own.npz")
    )
    lights = [
        ReferenceLight(
            light=read_light(folder / one["file"]),
            third=thirds.get(f"film.{number}"),
            third_edges=thirds.get(f"edges.{number}"),
            third_multiple=thirds.get(f"multiple.{number}"),
            own_hash=one["own_sha256"],
            own_radiance_per_w=own.get(str(number)),
        )
        for number, one in enumerate(facts["lights"])
    ]
    electrons = _arrays(folder / "expected.npz")
    frames = [read_frame(folder, record) for record in read_frame_records(folder)]
    # References that were made before exposure control was judged have none.
    chosen = facts.get("chosen_after_frames", [None] * len(frames))
    shots = [
        ReferenceShot(
            light,
            electrons[f"{frame.camera}.{frame.index}"],
            frame,
            None if setting is None else Setting(**setting),
        )
        for light, frame, setting in zip(facts["light_of_frames"], frames, chosen, strict=True)
    ]
    detections = {
        name: tuple(map(parse_detection, run_folder.read_lines(file)))
        for name, file in run_folder.detection_files(folder).items()
    }
    return Reference(
        document=facts["document"],
        seed=facts["seed"],
        renders=facts["renders"],
        made_by=facts["made_by"],
        lights=tuple(lights),
        shots=tuple(shots),
        calibrations=read_calibrations(folder),
        detections=detections,
        history=tuple(facts["history"]),
        following=_read_following(folder, detections) if facts.get("follows", False) else None,
    )


def _write_following(folder: Path, following: Following) -> None:
    odometry = [odometry_record(one) for records in following.odometry.values() for one in records]
    if odometry:
        run_folder.write_lines(folder / ODOMETRY, odometry)
    for name, followed in following.by_estimator.items():
        run_folder.write_lines(folder / f"tracks.{name}.jsonl", map(track_record, followed.tracks))
        run_folder.write_lines(folder / f"messages.{name}.jsonl", map(message_record, followed.messages))


def _read_following(folder: Path, estimators: Iterable[str]) -> Following:
    found = {
        name: Followed(
            tuple(run_folder.parse_lines(folder / f"tracks.{name}.jsonl", parse_track)),
            tuple(run_folder.parse_lines(folder / f"messages.{name}.jsonl", parse_message)),
        )
        for name in estimators
        if (folder / f"tracks.{name}.jsonl").is_file()
    }
    return Following(read_odometry(folder), found)


def _key(shot: ReferenceShot) -> str:
    return f"{shot.frame.camera}.{shot.frame.index}"


def _archive(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    file = io.BytesIO()
    named: dict[str, Any] = dict(arrays)
    np.savez_compressed(file, **named)
    return file.getvalue()


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
