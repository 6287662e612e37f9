"""Indirect light as spectral OpenEXR: float32 channels named by Stokes component and wavelength.

The layout is that of A. Fichet, R. Pacanowski, A. Wilkie, "An OpenEXR Layout for Spectral Images", JCGT
10(3), 2021; a channel is called S0.940,000000nm. One part per light group, and one more, `GROUP.variance`,
with the variance of each mean. Values are per watt of the group (`perWattOf`): times its flux they have the
declared unit. Where the samples differ from pixel to pixel, a part `samples` counts them. The direct part has
no pixels; it goes beside the image as a table.

The pixels are those that were rendered: `scale` × `scale` of the camera's. What keeps edges sharp in frames
made of them (`Indirect.edges`) is left out, as the attribute `edges` says, and so is what is averaged over
blocks in fog (`Indirect.multiple`), as `averaged` says: values and variances here are those before, of
independent blocks. A light cache keeps all of it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from nir_render.light.light import Light

_AVERAGED = "in frames light of many turns is averaged over blocks; not here"
_LEFT_OUT = "left out: frames made of this file are blurred where surfaces meet"


def write_light(path: Path, light: Light) -> None:
    """Write the indirect light of a `Light`, in radiance per watt of each group, 1/(m² sr).

    Nothing is written where there is no indirect light.
    """
    if light.indirect is None:
        return
    channels = [
        f"S0.{wavelength_m * 1e9:.6f}nm".replace(".", ",").replace("S0,", "S0.")
        for wavelength_m in light.wavelengths_m
    ]
    common: dict[str, Any] = {
        "scale": light.indirect.scale,
        "samples": light.indirect.samples,
        "edges": "none" if light.indirect.edges is None else _LEFT_OUT,
        "averaged": "no" if light.indirect.multiple is None else _AVERAGED,
    }
    parts = []
    for group, name in enumerate(light.groups):
        for part, arrays in (
            (name, light.indirect.radiance_per_w),
            (f"{name}.variance", light.indirect.variance),
        ):
            header: dict[str, Any] = {
                "compression": OpenEXR.ZIP_COMPRESSION,
                "type": OpenEXR.scanlineimage,
                "spectralLayoutVersion": "1.0",
                "emissiveUnits": "W.m^-2.sr^-1",
                "perWattOf": name,
                **common,
            }
            layers = {
                channel: np.ascontiguousarray(arrays[group, node]) for node, channel in enumerate(channels)
            }
            parts.append(OpenEXR.Part(header, layers, part))
    if light.indirect.counts is not None:
        counts = {"samples": np.ascontiguousarray(light.indirect.counts, dtype=np.uint32)}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **common}
        parts.append(OpenEXR.Part(header, counts, "samples"))
    OpenEXR.File(parts).write(str(path))


def direct_document(light: Light) -> dict[str, Any]:
    """Return the direct table of a light as a JSON document: one row per source and way.

    `mirror` is the surface that shows a ghost, null where the source itself is seen. `distance_m` is null for
    the sun. `seen` tells which rays of the disc arrive, as bits, the first the highest, in hexadecimal; null
    where all of them do, or none.
    """
    table = light.direct
    rows = [
        {
            "group": light.groups[table.group[row]],
            "mirror": light.mirrors[table.facet[row]] if table.facet[row] >= 0 else None,
            "direction_camera": table.direction[row].tolist(),
            "distance_m": float(table.distance_m[row]) if np.isfinite(table.distance_m[row]) else None,
            "angular_radius_rad": float(table.angular_radius_rad[row]),
            "visible_fraction": float(table.visible_fraction[row]),
            "seen": np.packbits(table.seen[row]).tobytes().hex()
            if 0.0 < table.visible_fraction[row] < 1.0
            else None,
            "irradiance_per_w": table.irradiance_per_w[row].tolist(),
        }
        for row in range(len(table.group))
    ]
    return {"format": 1, "visibility_rays": table.visibility_rays, "rows": rows}
