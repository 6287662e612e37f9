"""The labels of a run as a COCO annotation file, which detectors are trained and scored with."""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

from nir_render.export.boxes import KINDS, Box, Labelled, read_labelled
from nir_render.run.folder import write_file

_HALF_PX = 0.5  # COCO counts from the corner of the top left pixel, we from its centre


def export_coco(folder: Path, file: Path) -> dict[str, int]:
    """Write the labels of a run's frames as one COCO file; pictures stay where they are.

    `file_name` counts from the run's folder. Boxes are [left, top, width, height] in pixels from the frame's
    corner. Beside COCO's own fields an annotation has what a source's truth says: `name`, `range_m`,
    `center_px` (from the corner, too), `bearing_body`, `visible_fraction`, `on_fraction`, `direct_e`,
    `peak_snr`, `saturated_px`. A lamp has its polygon, cut at the frame's edges, and this one's area.

    Returns
    -------
    How many images and annotations of each kind there are.

    Raises
    ------
    InputError
        As `boxes.read_labelled`; or the disk refuses.
    """
    labelled = read_labelled(folder)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, record in enumerate(labelled.records, start=1):
        images.append(_image(number, record.file, labelled, record.camera, record.index, record.time_s))
        for box in labelled.boxes[record.camera, record.index]:
            annotations.append({"id": len(annotations) + 1, "image_id": number, **_annotation(box)})
    document = {
        "info": {"description": f"{folder.resolve().name}, rendered by nir_render", "version": "1"},
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": [
            {"id": number, "name": kind, "supercategory": "flare"}
            for number, kind in enumerate(KINDS, start=1)
        ],
    }
    write_file(file, json.dumps(document, allow_nan=False).encode())
    of_kind = Counter(KINDS[one["category_id"] - 1] for one in annotations)
    return {"images": len(images), **{str(kind): of_kind[kind] for kind in KINDS}}


def _image(
    number: int, file: str, labelled: Labelled, camera: str, index: int, time_s: float
) -> dict[str, Any]:
    known = labelled.calibrations[camera]
    size = {"width": known.width_px, "height": known.height_px}
    return {"id": number, "file_name": file, **size, "camera": camera, "index": index, "time_s": time_s}


def _annotation(box: Box) -> dict[str, Any]:
    corner = [box.left_px + _HALF_PX, box.top_px + _HALF_PX]
    found: dict[str, Any] = {
        "category_id": KINDS.index(box.kind) + 1,
        "bbox": [*corner, box.width_px, box.height_px],
        "area": box.area_px2,
        "iscrowd": 0,
        "name": box.name,
    }
    if box.outline_px:
        found["segmentation"] = [[value + _HALF_PX for point in box.outline_px for value in point]]
    if box.truth is not None:
        truth = box.truth
        found |= {
            "range_m": truth.range_m,
            "center_px": [truth.u_px + _HALF_PX, truth.v_px + _HALF_PX],
            "bearing_body": list(truth.bearing_body),
            "visible_fraction": truth.visible_fraction,
            "on_fraction": truth.on_fraction,
            "direct_e": truth.direct_e,
            "peak_snr": truth.peak_snr if math.isfinite(truth.peak_snr) else None,
            "saturated_px": truth.saturated_px,
        }
    return found
