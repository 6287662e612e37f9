"""The commands that lead in and out: new-recording and import of a real camera's frames, export of a run."""

import math
import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from nir_render.command.options import FolderArgument, Json


def new_recording(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of the pictures, or a new one.")],
    bag: Annotated[
        Path | None,
        typer.Option("--bag", metavar="FILE", help="Unpack the grey pictures of a ROS 2 bag (MCAP) first."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a commented template for the frames of one's own camera: recording.yaml, to fill in."""
    from nir_render.command.terminal.console import print_json
    from nir_render.run.recording.make import FILE, new_recording

    patterns = new_recording(folder, bag)
    if as_json:
        print_json({"folder": str(folder), "file": FILE, "frames": patterns[0], "cameras": patterns})
    else:
        typer.echo(f"fill in {folder / FILE} (pictures: {', '.join(patterns)})")
        typer.echo(f"next: nir-render import {shlex.quote(str(folder))}")


def import_recording(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder with pictures and a recording.yaml.")
    ],
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace the frames.jsonl and calibration.json that are there."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Make frames.jsonl and calibration.json of pictures and a recording.yaml; say what was assumed."""
    from nir_render.command.terminal.console import note, print_json, warn
    from nir_render.run.recording.make import import_recording

    done = import_recording(folder, overwrite=overwrite)
    if as_json:
        cameras = {
            name: {
                "frames": one.frames,
                "range_constant_dn_m2_per_s": one.constant.value_dn_m2_per_s,
                "range_constant_sigma_dn_m2_per_s": one.constant.sigma_dn_m2_per_s,
                "from": one.constant.origin,
                "lossy_sigma_dn": one.lossy_sigma_dn,
                "assumed": [str(line) for line in one.assumed],
                "warnings": list(one.warnings),
            }
            for name, one in done.items()
        }
        print_json({"format": 1, "folder": str(folder), "cameras": cameras})
        return
    for name, one in done.items():
        share = one.constant.sigma_dn_m2_per_s / one.constant.value_dn_m2_per_s
        typer.echo(
            f"{name}: {one.frames} frames; range constant {one.constant.value_dn_m2_per_s:.4g} DN m²/s ± "
            f"{share:.1%} from {one.constant.origin}: ranges ± {0.5 * share:.1%} or worse by light alone"
        )
        across_deg, down_deg = (math.degrees(angle_rad) for angle_rad in one.field_of_view_rad)
        typer.echo(f"{name}: sees {across_deg:.0f}° across and {down_deg:.0f}° down")
        for line in one.assumed:
            note(f"{name}: assumed {line}")
        if one.lossy_sigma_dn > 0.0:
            warn(
                f"{name}: JPEG is lossy: compression changes a pixel by a σ of {one.lossy_sigma_dn:.2g} DN, "
                "which was added to the read noise; record PNG or TIFF for fainter flares"
            )
        for doubt in one.warnings:
            warn(f"{name}: {doubt}")
    typer.echo(f"next: nir-render perceive {shlex.quote(str(folder))}")


class Format(StrEnum):
    """The formats that there are."""

    MCAP = "mcap"
    COCO = "coco"
    MOT = "mot"
    TUM = "tum"
    OPENCV = "opencv"
    HDF5 = "hdf5"


_FORMATS_SAID = (
    "mcap: frames, poses, detections, tracks and words for ROS 2 and Foxglove. coco: labels of all frames. "
    "mot: truth and detections of each camera, as MOTChallenge. tum: trajectories. opencv: calibrations. "
    "hdf5: raw frames and labels in one file."
)
_ENDINGS = {Format.COCO: "coco.json", Format.HDF5: "h5"}


def export(
    folder: FolderArgument,
    form: Annotated[Format, typer.Option("--format", help=_FORMATS_SAID)],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="PATH", help="Where it goes; DIR.mcap by default, and so on."),
    ] = None,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace the export that the folder holds (mot, tum, opencv)."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a run in another program's format; what its folder holds is written, whatever that is."""
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.export.mcap_file import export_mcap

    whole = folder.resolve()
    place = (
        output if output is not None else whole.with_name(f"{whole.name}.{_ENDINGS.get(form, form.value)}")
    )
    ahead_s = None
    if form is Format.MCAP:
        with progress_bar("export") as progress:
            done = export_mcap(folder, place, progress)
        counts, ahead_s = done.messages, done.ahead_s
    else:
        counts = _exported(form, folder, place, overwrite)
    if as_json:
        of_mcap = {} if ahead_s is None else {"ahead_s": ahead_s, "messages": counts}
        print_json({"format": 1, "file": str(place), **of_mcap, "counts": counts})
        return
    for name, count in counts.items():
        typer.echo(f"{count:8d}  {name}")
    if ahead_s:
        typer.echo(f"its clock is {ahead_s} s ahead of the run's: ROS has no time below 0")
    typer.echo(f"{'open' if form is Format.MCAP else 'see'} {place}")


def _exported(form: Format, folder: Path, place: Path, overwrite: bool) -> dict[str, int]:
    """Write one of the formats that need no clock; return how much of what there is."""
    from nir_render.errors import InputError
    from nir_render.export.coco import export_coco
    from nir_render.export.dataset import export_hdf5
    from nir_render.export.mot import export_mot
    from nir_render.export.opencv_file import export_opencv
    from nir_render.export.trajectories import export_tum
    from perception import RecordingError

    files = {Format.COCO: export_coco, Format.HDF5: export_hdf5}
    folders = {Format.MOT: export_mot, Format.TUM: export_tum, Format.OPENCV: export_opencv}
    try:
        return files[form](folder, place) if form in files else folders[form](folder, place, overwrite)
    except RecordingError as error:
        raise InputError(*error.problems) from None
