"""The commands of recordings of a real camera: new-recording, import."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from nir_render.command.options import Json


def new_recording(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of the pictures, or a new one.")],
    as_json: Json = False,
) -> None:
    """Write a commented template for the frames of one's own camera: recording.yaml, to fill in."""
    from nir_render.command.console import print_json
    from nir_render.run.recording.make import FILE, new_recording

    pattern = new_recording(folder)
    if as_json:
        print_json({"folder": str(folder), "file": FILE, "frames": pattern})
    else:
        typer.echo(f"fill in {folder / FILE} (pictures: {pattern})")
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
    from nir_render.command.console import note, print_json, warn
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
            }
            for name, one in done.items()
        }
        print_json({"format": 1, "folder": str(folder), "cameras": cameras})
        return
    for name, one in done.items():
        share = one.constant.sigma_dn_m2_per_s / one.constant.value_dn_m2_per_s
        typer.echo(
            f"{name}: {one.frames} frames; range constant {one.constant.value_dn_m2_per_s:.4g} DN m²/s ± "
            f"{share:.1%} from {one.constant.origin}: ranges ± {0.5 * share:.1%} or worse"
        )
        for line in one.assumed:
            note(f"{name}: assumed {line}")
        if one.lossy_sigma_dn > 0.0:
            warn(
                f"{name}: JPEG is lossy: compression changes a pixel by a σ of {one.lossy_sigma_dn:.2g} DN, "
                "which was added to the read noise; record PNG or TIFF for fainter flares"
            )
    typer.echo(f"next: nir-render perceive {shlex.quote(str(folder))}")
