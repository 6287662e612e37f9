"""`explain.html`: the photon budget on a page that opens from disk; `explain.json` beside it."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nir_render.budget.budget import Budget, CameraBudget, SourceBudget
from nir_render.budget.plots import ambient_plot, electrons_plot, sigma_plot
from nir_render.budget.tables import (
    alike,
    ambient_table,
    cause_table,
    eye_table,
    fog_sentence,
    range_table,
    source_sentences,
    view_table,
    view_title,
)
from nir_render.errors import InputError
from nir_render.report.drawing import Drawing
from nir_render.report.parts import Table, render_page
from nir_render.report.wording import counted, degrees, share, significant
from nir_render.run.folder import write_file

PAGE, RECORD = "explain.html", "explain.json"

_MOST_SOURCES = 8  # of a kind of camera: these bound the size of the page

RULES = {
    "electrons": (
        "Φ/4π · e^(−σ_t d)/d² · A_ap · cos θ · C(θ) · t: of a source that is fully lit and sends its "
        "mean intensity, through the scene's fog all the way; where it varies over height, the mean at "
        "the heights of robots' sources. No body hides anything."
    ),
    "peak px": (
        "the most electrons in one pixel, with the background and the dark current; it clips where "
        "perception counts it as clipped, a few read noises below the well or full scale."
    ),
    "limit σ": (
        "the Cramér–Rao bound of the range through the scene's exact calibration, the same that a run "
        "is judged by. Its causes are the weights of the efficient estimate times each noise by itself: "
        "in quadrature they add up to it."
    ),
    "calibration": (
        "what the calibration says of its own σ: of the range constant, where the sources differ, of "
        "the source's radius and of the point spread."
    ),
    "LED temperature, LED to LED": (
        "changes of the range constant that no frame tells, by half of its relative change: the LED's "
        "spectrum moves behind the filter, and its flux changes."
    ),
    "field angle": (
        "how far the response changes within the σ of the field angle: steep behind a filter in front "
        "of the lens."
    ),
    "fog adds": ("by how much a range by flux alone is too long if fog is not known; no σ."),
    "fog": (
        "½ d² σ, with σ what the calibration says of its extinction: a robot in fog does not know how "
        "thick it is."
    ),
    "grey wall": (
        "a matt wall in the middle of the robots' sources, turned to each light by itself, lit by it "
        "alone and straight: no wall of that reflectance there is brighter. All of them together are "
        "the background of the flares here."
    ),
    "seen itself": "a pixel that a lamp, the sun's disc or the mean sky fills.",
    "kept out": (
        "1 − ∫ S η τ dλ / ∫ S η dλ over photons, S the light, η the quantum efficiency, τ the filter, "
        "on the axis."
    ),
    "leak": (
        "electrons from outside the filter's band over those from within, and between what they are "
        "known to lie: a blocking is stated as a bound, and quantum efficiencies are not published "
        "everywhere."
    ),
    "eye safety": (
        "IEC 62471:2006, 0.2 m from the source's middle where it is brightest, for any length of time: "
        "cornea and lens 100 W/m² (780 to 3000 nm); retina 6000/α W/m²/sr weighted by R(λ) (780 to 1400 "
        "nm, no visible light that warns), α between 0.011 and 0.1 rad, the radiance that of an even "
        "disc of the source's radius. What pulses counts with its mean, and each pulse by the limit of its "
        "length. Lasers, and so VCSELs, are IEC 60825's. No certificate."
    ),
}


@dataclass(frozen=True)
class SourceSection:
    """What the page says of a source before a camera."""

    title: str
    sentence: str
    electrons: Drawing
    ranges: Sequence[tuple[str, Table]]
    sigma: Drawing
    causes: Table


@dataclass(frozen=True)
class CameraSection:
    """What the page says of a kind of camera."""

    title: str
    sentence: str
    view_title: str
    view: Table | None
    sources: Sequence[SourceSection]
    left_out: str
    ambient: Table | None
    ambient_plot: Drawing | None


def budget_html(budget: Budget) -> str:
    """Write the page."""
    assumed = budget.assumptions
    return render_page(
        "budget/page.html",
        title=f"{budget.name or budget.scene}: photon budget",
        subtitle=[
            f"at {budget.time_s:g} s",
            counted(sum(len(one.cameras) for one in budget.cameras), "camera"),
            "nothing rendered, nothing hidden",
        ],
        fog=None if budget.fog is None else fog_sentence(budget.fog),
        cameras=[_camera_section(one) for one in budget.cameras],
        eyes=eye_table(budget) if budget.eye_safety else None,
        assumed=Table(
            (),
            [
                ("reflectance of the grey wall", share(assumed.wall_reflectance)),
                ("σ of an LED's temperature", f"{assumed.led_temperature_sigma_k:g} K"),
                ("σ of flux from LED to LED", share(assumed.unit_flux_sigma)),
                (
                    "σ of wavelength from LED to LED",
                    f"{significant(1e9 * assumed.unit_wavelength_sigma_m, 2)} nm",
                ),
                ("σ of the field angle", degrees(math.degrees(assumed.field_angle_sigma_rad))),
            ],
        ),
        rules=RULES,
    )


def check_free(folder: Path) -> None:
    """Raise InputError where a folder holds another budget's files."""
    held = next((name for name in (RECORD, PAGE) if (folder / name).exists()), None)
    if held is not None:
        raise InputError(f"{folder / held} is there already; give a new folder, or --overwrite to replace it")


def write_budget(budget: Budget, folder: Path) -> Path:
    """Write `explain.html` and `explain.json` into a folder, and return the page's path.

    Raises
    ------
    InputError
        A file cannot be written.
    """
    write_file(folder / RECORD, (json.dumps(budget.record(), indent=1, allow_nan=False) + "\n").encode())
    write_file(folder / PAGE, budget_html(budget).encode())
    return folder / PAGE


def _camera_section(camera: CameraBudget) -> CameraSection:
    shown = camera.sources[:_MOST_SOURCES]
    more = len(camera.sources) - len(shown)
    return CameraSection(
        title=alike(camera.cameras),
        sentence=camera_sentence(camera),
        view_title=view_title(camera),
        view=view_table(camera) if camera.in_view else None,
        sources=[_source_section(camera, one) for one in shown],
        left_out=f"{counted(more, 'more kind')} of sources: {RECORD} has them." if more else "",
        ambient=ambient_table(camera) if camera.ambient else None,
        ambient_plot=ambient_plot(camera) if camera.ambient else None,
    )


def camera_sentence(camera: CameraBudget) -> str:
    """Say how a camera exposes, where it clips, and what it has for a background."""
    exposures = f"exposure {', '.join(camera.exposures)}"
    if camera.exposures == ("automatic",):
        exposures = "its exposure is chosen by the brightest pixel, here by flare and wall with robots lit"
    exposure_s = camera.stated_exposure_s[0]
    wall_e = camera.background_e_per_s * exposure_s
    behind = f"the wall behind flares has {wall_e:.3g} e per pixel in {1e3 * exposure_s:.3g} ms"
    return (
        f"A pixel clips at {camera.clip_e[0]:,.0f} e; {exposures}; "
        f"{behind if camera.ambient else 'there is no other light, so flares have no background'}."
    )


def _source_section(camera: CameraBudget, source: SourceBudget) -> SourceSection:
    first = [curve for curve in source.curves if curve.exposure == camera.exposures[0]]
    return SourceSection(
        title=f"{alike(source.sources)} before {alike(camera.cameras)}",
        sentence=source_sentences(source),
        electrons=electrons_plot(camera, source),
        ranges=[
            (f"{curve.exposure} exposure, on the axis", range_table(curve))
            for curve in source.curves
            if curve.place.name == "axis"
        ],
        sigma=sigma_plot(first),
        causes=cause_table(first),
    )
