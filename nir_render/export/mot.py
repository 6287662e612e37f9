"""A run as MOTChallenge sequences, one for each camera: truth, and what each estimator has found."""

import math
import shutil
from pathlib import Path

from nir_render.evaluate.match import countable
from nir_render.export.aside import export_folder
from nir_render.export.boxes import Labelled, read_labelled
from nir_render.run import folder as run_folder
from nir_render.run.folder import write_file
from perception import Detection, parse_detection

# MOTChallenge counts pixels from 1 at the frame's corner, we from 0 at the centre of the top left pixel.
_OFFSET_PX = 1.5
_LEAST_PX = 1.0


def export_mot(folder: Path, target: Path, overwrite: bool = False) -> dict[str, int]:
    """Write a folder for each camera, as MOTChallenge has it.

    `gt/gt.txt` holds sources, 1 to a robot's source in the order of their names: frame (from 1), id, box,
    flag, class 1, visible share; the flag is 1 where the source counts for recall (`match.countable`), 0
    where it is to be passed over. `det/NAME.txt` holds what the estimator NAME has found and does not take
    for a mirror image: frame, -1, box, 1, and the place in the robot's body axes in metres, or -1, -1, -1
    without a range. `seqinfo.ini` says the rest; pictures are linked as `img1`, or copied where there are no
    links.

    Returns
    -------
    How many rows there are, by file.

    Raises
    ------
    InputError
        As `boxes.read_labelled` and `aside.export_folder`.
    """
    labelled = read_labelled(folder)
    names = sorted({box.name for boxes in labelled.boxes.values() for box in boxes if box.kind == "source"})
    numbers = {name: number for number, name in enumerate(names, start=1)}
    found = {
        name: run_folder.parse_lines(path, parse_detection)
        for name, path in run_folder.detection_files(folder).items()
    }
    with export_folder(target, overwrite) as aside:
        return _write_cameras(labelled, aside, numbers, found)


def _write_cameras(
    labelled: Labelled, target: Path, numbers: dict[str, int], found: dict[str, list[Detection]]
) -> dict[str, int]:
    counts: dict[str, int] = {}
    for camera in dict.fromkeys(record.camera for record in labelled.records):
        place = target / camera
        order = {
            index: number
            for number, index in enumerate(
                (record.index for record in labelled.records if record.camera == camera), start=1
            )
        }
        truth = _truth_rows(labelled, camera, order, numbers)
        counts[f"{camera}/gt/gt.txt"] = _write(place / "gt" / "gt.txt", truth)
        for name, detections in found.items():
            rows = _found_rows(labelled, camera, order, detections)
            counts[f"{camera}/det/{name}.txt"] = _write(place / "det" / f"{name}.txt", rows)
        write_file(place / "seqinfo.ini", _sequence(labelled, camera, len(order)).encode())
        _link_pictures(labelled, camera, place)
    return counts


def _truth_rows(labelled: Labelled, camera: str, order: dict[int, int], numbers: dict[str, int]) -> list[str]:
    rows = []
    for index, frame in order.items():
        for box in labelled.boxes[camera, index]:
            if box.kind == "source" and box.truth is not None:
                corner = f"{box.left_px + _OFFSET_PX:.3f},{box.top_px + _OFFSET_PX:.3f}"
                size = f"{box.width_px:.3f},{box.height_px:.3f}"
                flag = int(countable(box.truth, labelled.calibrations[camera]))
                visible = f"{box.truth.visible_fraction:.4f}"
                rows.append(f"{frame},{numbers[box.name]},{corner},{size},{flag},1,{visible}")
    return rows


def _found_rows(
    labelled: Labelled, camera: str, order: dict[int, int], detections: list[Detection]
) -> list[str]:
    known = labelled.calibrations[camera]
    rows = []
    own = (one for one in detections if one.camera == camera and one.index in order and not one.ghost)
    for one in sorted(own, key=lambda each: each.index):
        # As large as the light that was found is wide, if it were round.
        side_px = max(one.area_px**0.5, _LEAST_PX)
        left, top = one.u_px - 0.5 * side_px + _OFFSET_PX, one.v_px - 0.5 * side_px + _OFFSET_PX
        at = "-1,-1,-1"
        if not math.isnan(one.range_m):
            place = zip(known.position_body_m, one.bearing_body, strict=True)
            at = ",".join(f"{begin + one.range_m * towards:.4f}" for begin, towards in place)
        rows.append(f"{order[one.index]},-1,{left:.3f},{top:.3f},{side_px:.3f},{side_px:.3f},1,{at}")
    return rows


def _sequence(labelled: Labelled, camera: str, length: int) -> str:
    known = labelled.calibrations[camera]
    times_s = [record.time_s for record in labelled.records if record.camera == camera]
    span_s = times_s[-1] - times_s[0]
    rate_hz = (length - 1) / span_s if length > 1 and span_s > 0.0 else 1.0
    return (
        f"[Sequence]\nname={camera}\nimDir=img1\nframeRate={rate_hz:.6g}\nseqLength={length}\n"
        f"imWidth={known.width_px}\nimHeight={known.height_px}\nimExt=.png\n"
    )


def _link_pictures(labelled: Labelled, camera: str, place: Path) -> None:
    """Name the pictures as MOTChallenge does; a hard link would let who edits one change the run."""
    images = place / "img1"
    images.mkdir()
    records = [record for record in labelled.records if record.camera == camera]
    for number, record in enumerate(records, start=1):
        link, picture = images / f"{number:06d}.png", (labelled.folder / record.file).resolve()
        try:
            link.symlink_to(picture)
        except OSError:
            shutil.copyfile(picture, link)


def _write(path: Path, rows: list[str]) -> int:
    write_file(path, "".join(f"{row}\n" for row in rows).encode())
    return len(rows)
