"""What `nir-render goniometer` does: measure a built source, and write all that follows from it."""

from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.run import folder as run_folder
from nir_render.run.goniometer.formats import baked_document, ies_text, pattern_csv, source_yaml
from nir_render.run.goniometer.polar import figures_text, polar_png
from nir_render.run.manifest import versions
from nir_render.scene.documents.built.source import BuiltSource
from nir_render.scene.load import load_built
from nir_render.transport.goniometer.goniogram import Goniogram, variation
from nir_render.transport.goniometer.measure import KEPT, Settings, measure

FIGURES, PATTERN, IES, SOURCE, POLAR = (
    "goniometer.json", "pattern.csv", "pattern.ies", "source.yaml", "polar.png",
)  # fmt: skip
_DIGITS = 6
_UNCOVERED_PHOTONS = 1_000_000  # as none of them scatters this is a moment


def measure_into(
    name: str,
    folder: Path,
    settings: Settings,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure a source as it is built, a preset's name or a file, and fill a new folder.

    Returns
    -------
    What `goniometer.json` holds.

    Raises
    ------
    InputError
        The source is wrong, settings are out of range, or the folder cannot be written.
    """
    built = load_built(name)
    run_folder.check_free(folder, overwrite)
    gram = measure(built, settings, progress, KEPT)
    uncovered = None
    if built.cover is not None:
        plain = replace(settings, photons=max(settings.photons, _UNCOVERED_PHOTONS))
        uncovered = measure(built.model_copy(update={"cover": None}), plain, cache=KEPT)
    title = Path(name).stem
    figures = _figures(name, built, gram, settings, uncovered)
    with run_folder.new_run_folder(folder, overwrite) as aside:
        run_folder.write_file(aside / PATTERN, pattern_csv(gram).encode())
        today = datetime.now(UTC).date().isoformat()
        run_folder.write_file(aside / IES, ies_text(title, built, gram, today).encode("ascii"))
        source = source_yaml(baked_document(built, gram), _comments(name, gram, settings))
        run_folder.write_file(aside / SOURCE, source.encode())
        run_folder.write_file(aside / POLAR, polar_png(title, gram, uncovered))
        run_folder.write_json(aside / FIGURES, figures)
        run_folder.write_manifest(aside, {"versions": versions()})
    return figures


def _figures(
    name: str, built: BuiltSource, gram: Goniogram, settings: Settings, uncovered: Goniogram | None
) -> dict[str, Any]:
    shares = {
        "left": gram.left,
        "absorbed_in_cover": gram.in_cover,
        "absorbed_in_board": gram.in_board,
        "given_up": gram.lost,
    }
    largest = float(gram.intensity_per_sr.max()) or 1.0
    return {
        "format": 1,
        "source": name,
        "photons": gram.photons,
        "seed": settings.seed,
        "distance_m": gram.distance_m,
        "flux_of_dies_w": built.flux_w,
        "flux_w": _rounded(built.flux_w * gram.left / gram.photons),
        "shares": {key: _rounded(count / gram.photons) for key, count in shares.items()},
        "largest_intensity_w_per_sr": _rounded(largest * built.flux_w),
        "variation": _variation(gram),
        "variation_without_cover": None if uncovered is None else _variation(uncovered),
        "azimuthal_spread": _azimuthal_spread(gram),
        "rms_difference_from_afar": _rounded(gram.difference_from_afar),
        "largest_sigma": _rounded(float(gram.sigma_per_sr.max()) / largest),
    }


def _variation(gram: Goniogram) -> dict[str, float]:
    figures = asdict(variation(gram))
    reach_rad = figures.pop("reach_rad")
    return {
        "reach_deg": _rounded(float(np.rad2deg(reach_rad))),
        **{key: _rounded(value) for key, value in figures.items()},
    }


def _azimuthal_spread(gram: Goniogram) -> float | None:
    """Return the largest (max − min)/(max + min) around the axis within ±85°; None where all is averaged."""
    if gram.near.shape[1] == 1:
        return None
    rows = gram.intensity_per_sr[gram.polar_rad <= np.deg2rad(85.0) + 1e-9]
    most, least = rows.max(axis=1), rows.min(axis=1)
    return _rounded(float(np.max((most - least) / np.maximum(most + least, 1e-30))))


def _comments(name: str, gram: Goniogram, settings: Settings) -> list[str]:
    options, usual = (
        {
            "step": 180.0 / one.polar_steps,
            "azimuths": one.azimuths,
            "distance": one.distance_m,
            "seed": one.seed,
        }
        for one in (settings, Settings())
    )
    changed = [f" --{key} {value:.10g}" for key, value in options.items() if value != usual[key]]
    return [
        f"Measured from {name} as it is built, by:",
        f"nir-render goniometer {name} --photons {settings.photons}{''.join(changed)}",
        f"At {gram.distance_m:g} m it {figures_text(variation(gram))}.",
        "Its position is the centre of its cover, or of its board where it has none; its axis is z.",
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
