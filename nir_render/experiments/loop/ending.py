"""How every experiment ends: a page, its figures, and of one run a film and an MCAP file."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from nir_render.experiments.loop.closed import LoopPlan
from nir_render.experiments.loop.film import FILM, film_into
from nir_render.experiments.loop.runs import run_folder
from nir_render.export.mcap_file import export_mcap
from nir_render.report.wording import share
from nir_render.run.folder import write_file, write_json

PAGE, RECORD, BAG = "index.html", "outcome.json", "run.mcap"
TRUTH = "truth"
"""Where the runs of robots that know the truth lie, in an experiment's folder."""

LEVEL_RULE = (
    "frames: every camera's frames are rendered, exposed and read by the whole stack. measurements: "
    "detections are drawn about the truth with the σ of their Cramér–Rao bound, and where a source is dark "
    "its pixels are drawn, with read noise and no other light; from there on it is the stack. Walls, lamps "
    "and false alarms are left out. truth: nothing is seen."
)


@dataclass(frozen=True)
class Shown:
    """The files beside a page that show one of its runs; None where there is none."""

    film: str | None = None
    bag: str | None = None


def show_run(folder: Path, seed: int, plan: LoopPlan, title: str) -> Shown:
    """Make the film and the MCAP file of the run of a seed, in the experiment's folder, beside the page.

    There is no film where OpenCV cannot write one, and no MCAP file where the package `mcap` is missing.

    Raises
    ------
    InputError
        The disk refuses, or the run's folder is broken.
    """
    run = run_folder(folder / TRUTH if plan.level == "truth" else folder, seed)
    has_film = film_into(run, plan, title, folder / FILM)
    has_bag = find_spec("mcap") is not None
    if has_bag:
        export_mcap(run, folder / BAG)
    return Shown(FILM if has_film else None, BAG if has_bag else None)


def write_ending(folder: Path, html: str, record: Mapping[str, Any]) -> Path:
    """Write the page and `outcome.json`; return the page's path; errors as `show_run`."""
    write_json(folder / RECORD, record)
    write_file(folder / PAGE, html.encode())
    return folder / PAGE


def base_rows(plan: LoopPlan) -> list[tuple[str, str]]:
    """Return the conditions that follow from the base: speed, bodies."""
    base = plan.base
    return [
        ("speed", f"{base.speed_m_per_s:g} m/s at most, {base.acceleration_m_per_s2:g} m/s² (assumed)"),
        ("bodies", f"{base.diameter_m:g} m wide (assumed); they hide nothing"),
    ]


def frame_rows(plan: LoopPlan, held_light_share: float | None) -> list[tuple[str, str]]:
    """Return the conditions that hold at the level of frames: the stack, how long light is held."""
    if plan.level != "frames":
        return []
    off = ""
    if held_light_share is not None:
        off = f"; off by {share(held_light_share)} of the noise's variance before it is, at most"
    return [
        ("stack", plan.stack),
        ("indirect light", f"rendered again after {plan.refresh_s:g} s, then as seldom as it changes{off}"),
    ]
