"""A measured source in the formats of others and of scenes: CSV, IES LM-63, YAML."""

import math
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from nir_render.scene.documents.built.source import BuiltSource
from nir_render.scene.text.units import LENGTH, parse_quantity
from nir_render.transport.goniometer.goniogram import Goniogram

Array = NDArray[np.float64]

_DIGITS = 5
_IES_PER_LINE = 10


def pattern_csv(gram: Goniogram) -> str:
    """Return relative intensity over the sphere, as `pattern: {file: …}` reads it; 1 at its largest."""
    lines = [
        f"# radiant intensity at {gram.distance_m:g} m over its largest; {gram.photons} photons",
        "polar_deg,azimuth_deg,value",
    ]
    azimuths_deg = np.rad2deg(gram.azimuth_rad)
    for polar_deg, row in zip(np.rad2deg(gram.polar_rad), _relative(gram), strict=True):
        lines += [
            f"{polar_deg:.10g},{azimuth_deg:.10g},{value:.{_DIGITS}g}"
            for azimuth_deg, value in zip(azimuths_deg, row, strict=True)
        ]
    return "\n".join(lines) + "\n"


def baked_document(built: BuiltSource, gram: Goniogram) -> dict[str, Any]:
    """Return the source that stands for a built one in scenes, as it is written: a sphere with its pattern.

    Its flux is what leaves, its middle that of the cover.
    """
    relative = [[float(f"{value:.{_DIGITS}g}") for value in row] for row in _relative(gram)]
    polar_deg = [f"{angle:.10g}" for angle in np.rad2deg(gram.polar_rad)]
    pattern: dict[str, Any]
    if gram.near.shape[1] == 1:
        pattern = {
            "points": [[f"{angle} deg", row[0]] for angle, row in zip(polar_deg, relative, strict=True)]
        }
    else:
        azimuths = ", ".join(f"{angle:.10g}" for angle in np.rad2deg(gram.azimuth_rad))
        rows = [f"[{', '.join(map(str, row))}]" for row in relative]
        pattern = {
            "grid": {"polar": f"[{', '.join(polar_deg)}] deg", "azimuth": f"[{azimuths}] deg", "values": rows}
        }
    return {
        "flux": f"{1e3 * built.flux_w * gram.left / gram.photons:.6g} mW",
        "radius": f"{1e3 * built.radius_m:.6g} mm",
        "spectrum": _in_nm(
            built.spectrum.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True)
        ),
        "pattern": pattern,
    }


def _in_nm(written: Any) -> Any:
    """Return a document with wavelengths in nanometres, where these are the same to the bit."""
    if isinstance(written, dict):
        return {key: _in_nm(value) for key, value in written.items()}
    if isinstance(written, list):
        return [_in_nm(value) for value in written]
    if isinstance(written, str) and written.endswith(" m"):
        value_m = parse_quantity(written, LENGTH)
        short = f"{1e9 * value_m:.10g} nm"
        return short if value_m < 1e-5 and parse_quantity(short, LENGTH) == value_m else written
    return written


def source_yaml(document: dict[str, Any], comments: list[str]) -> str:
    """Return a source as a preset file, to be named in a scene beside it."""
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None)
    return "".join(f"# {line}\n" for line in comments) + text


def ies_text(name: str, built: BuiltSource, gram: Goniogram, date: str) -> str:
    """Return a photometric file after IES LM-63-2002, type C, whose candela values are mW/sr.

    Vertical angle 0 is the source's own axis. The luminous opening is written as a sphere.
    """
    milli_w_per_sr = 1e3 * built.flux_w * gram.intensity_per_sr
    whole_turn = gram.near.shape[1] > 1
    horizontal_deg = [*np.rad2deg(gram.azimuth_rad), *([360.0] if whole_turn else [])]
    columns = [*milli_w_per_sr.T, *([milli_w_per_sr[:, 0]] if whole_turn else [])]
    vertical_deg = np.rad2deg(gram.polar_rad)
    size_m = -2.0 * built.radius_m
    lines = [
        "IESNA:LM-63-2002",
        f"[TEST] rendered goniometer, {gram.photons} photons",
        "[TESTLAB] nir_render",
        f"[ISSUEDATE] {date}",
        f"[MANUFAC] {_ascii(name)}",
        "[OTHER] radiometric: candela values are radiant intensity in mW/sr near 940 nm, not photometric",
        f"[_TESTDIST] {gram.distance_m:g} m",
        "[OTHER] input watts are the radiant flux of the dies",
        "[OTHER] vertical angle 0 is the axis of the source",
        "TILT=NONE",
        f"1 -1 1 {len(vertical_deg)} {len(horizontal_deg)} 1 2 {size_m:.6g} {size_m:.6g} {size_m:.6g}",
        f"1 1 {built.flux_w:.6g}",
        *_wrapped(vertical_deg),
        *_wrapped(np.array(horizontal_deg)),
    ]
    for column in columns:
        lines += _wrapped(column)
    return "\r\n".join(lines) + "\r\n"


def _relative(gram: Goniogram) -> Array:
    most = float(gram.intensity_per_sr.max())
    return gram.intensity_per_sr / most if most > 0.0 else gram.intensity_per_sr


def _wrapped(values: Array) -> list[str]:
    texts = [f"{value:.6g}" for value in values]
    rows = math.ceil(len(texts) / _IES_PER_LINE)
    return [" ".join(texts[row * _IES_PER_LINE : (row + 1) * _IES_PER_LINE]) for row in range(rows)]


def _ascii(text: str) -> str:
    return text.encode("ascii", errors="replace").decode()[:80]
