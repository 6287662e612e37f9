"""The diffuser experiment's outcome and page: how the intensity varies as a source turns."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.ending import write_ending
from nir_render.experiments.loop.runs import Progress, run_seeds
from nir_render.experiments.standing.sightings import STACKS, sighting_of
from nir_render.experiments.standing.turntable import SOURCES, Turntable
from nir_render.report.drawing import Drawing, legend, sheet, svg_of
from nir_render.report.parts import Table, render_page
from nir_render.report.style import INK, MATPLOTLIB, look
from nir_render.report.wording import counted, share
from nir_render.scene.scene import Scene

Array = NDArray[np.float64]

LIGHT = "light"
"""Beside the stacks: what truly comes from the source."""

RULES = {
    "variation": (
        'bare: (largest − smallest) / largest over the angles, the paper\'s "fluctuation". Under the shade: '
        "± (largest − smallest) / (largest + smallest)."
    ),
    "intensity": (
        "by the paper its m, (mean grey − background) / exposure; by robust the counts of the whole flare in "
        "a second; the light itself is what the camera's truth says."
    ),
    "robust": (
        "ties a flare's flux to its range by its constant, and where the disc is resolved, as it is at 1 m "
        "under the shade, its size holds the range: part of a change of intensity does not show in its flux."
    ),
    "in ranges": "half of the variation: by so much a robot is off that does not know the other's heading.",
}

_WHY = (
    "A bare LED shines by the cosine of the angle and its package, whatever looks at it. Under the shade "
    "light leaves after many scatterings: what is left of the variation is the globe's and the board's. Of "
    "the bare LED, less than a pixel wide, the paper's mean grey is no intensity: as it fades the mask "
    "shrinks to the brighter pixels, and the mean even rises. Under the shade the image is a disc, and it is "
    "one. No detector can tell a source that turned away from one that is farther off, unless its disc is "
    "resolved: what is left under the shade is a limit of ranging where headings are not known."
)


@dataclass(frozen=True)
class Outcome:
    """Runs of the experiment: by source and stack, and of the light, the mean intensity at each angle."""

    plan: Turntable
    scene: str
    seeds: Sequence[int]
    intensity: dict[str, dict[str, Array]]
    found: dict[str, dict[str, tuple[int, int]]]

    def record(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        return {
            "format": 1,
            "experiment": "diffuser",
            "seeds": list(self.seeds),
            "sources": {
                source: {
                    name: {"of_largest": spread_of(values)[0], "plus_minus": spread_of(values)[1]}
                    for name, values in by_stack.items()
                }
                for source, by_stack in self.intensity.items()
            },
            "found": {
                source: {name: list(counts) for name, counts in by_stack.items()}
                for source, by_stack in self.found.items()
            },
        }


def spread_of(intensity: Array) -> tuple[float | None, float | None]:
    """Return (largest − smallest) / largest, and (largest − smallest) / (largest + smallest)."""
    known = intensity[np.isfinite(intensity)]
    if not len(known):
        return None, None
    most, least = float(known.max()), float(known.min())
    return (most - least) / most, (most - least) / (most + least)


def outcome_of(
    scene: Scene, plan: Turntable, seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> Outcome:
    """Run it for each seed; errors as `run_seeds`."""
    records = run_seeds(scene, plan, seeds, folder, workers, progress)
    rows = [row for record in records for row in record["sightings"]]
    intensity: dict[str, dict[str, Array]] = {}
    found: dict[str, dict[str, tuple[int, int]]] = {}
    for source in SOURCES:
        own = [row for row in rows if row["source"] == source]
        intensity[source] = {name: _by_angle(own, plan, name) for name in (LIGHT, *STACKS)}
        found[source] = {
            name: (sum(row["seen"][name] is not None for row in own), len(own)) for name in STACKS
        }
    return Outcome(plan, scene.document.name, seeds, intensity, found)


def _by_angle(rows: Sequence[dict[str, Any]], plan: Turntable, name: str) -> Array:
    """Return the mean intensity at each angle; NaN where the source was not found."""
    means = []
    for angle_deg in plan.angles_deg:
        values = []
        for row in rows:
            if row["angle_deg"] != angle_deg:
                continue
            one = sighting_of(
                {key: value for key, value in row.items() if key not in ("source", "angle_deg")}
            )
            seen = one.seen.get(name)
            if name == LIGHT:
                values.append(one.light_e_per_s)
            elif seen is not None:
                values.append(seen.signal_dn_per_s if name == "paper" else seen.flux_dn_per_s)
        means.append(np.mean(values) if values else np.nan)
    return np.array(means)


def write_outcome(outcome: Outcome, folder: Path) -> Path:
    """Write the page and `outcome.json`; return the page's path."""
    html = render_page(
        "experiments/standing/page.html",
        title="diffuser: a source on a turntable",
        subtitle=[
            counted(len(outcome.seeds), "seed"),
            f"{len(outcome.plan.angles_deg)} angles",
            outcome.scene,
        ],
        sentence=sentence(outcome),
        beside=_beside(outcome),
        why=_WHY,
        drawing=intensity_plot(outcome),
        parts_title="Found",
        parts=_found(outcome),
        conditions=_conditions(outcome),
        rules=RULES,
    )
    return write_ending(folder, html, outcome.record())


def sentence(outcome: Outcome) -> str:
    """Say in a sentence what was found."""
    light = {source: spread_of(by_stack[LIGHT]) for source, by_stack in outcome.intensity.items()}
    bare, diffused = light["bare"][0], light["diffused"][1]
    assert bare is not None
    assert diffused is not None
    return (
        f"Over ±{outcome.plan.reach_deg:g}° the bare source varies by {share(bare)} of its largest "
        f"intensity, under its shade by ±{share(diffused)}: ±{share(0.5 * diffused)} of a range."
    )


def _beside(outcome: Outcome) -> Table:
    def cells(source: str, at: int, sign: str) -> list[str]:
        values = [spread_of(outcome.intensity[source][name])[at] for name in (*STACKS, LIGHT)]
        return ["–" if value is None else f"{sign}{share(value)}" for value in values]

    ranges = [
        "–"
        if (value := spread_of(outcome.intensity["diffused"][name])[1]) is None
        else f"±{share(0.5 * value)}"
        for name in (*STACKS, LIGHT)
    ]
    rows = [
        ("bare", "> 40 %", *cells("bare", 0, "")),
        ("under its shade", "within ±10 %", *cells("diffused", 1, "±")),
        ("the shade, in ranges", "±5 % of ±10 %", *ranges),
    ]
    headings = (
        "variation",
        "the paper",
        "stack paper, here",
        "stack robust, here",
        "the light: physical limit",
    )
    return Table(headings, rows)


def _found(outcome: Outcome) -> Table:
    rows = [
        (source, *(f"{by_stack[name][0]} of {by_stack[name][1]}" for name in STACKS))
        for source, by_stack in outcome.found.items()
    ]
    return Table(("source", *STACKS), rows)


def _conditions(outcome: Outcome) -> Table:
    plan = outcome.plan
    rows = [
        (
            "sources",
            "the LED as it is built, 200 mW, bare and under its globe (nir-render goniometer, assumed)",
        ),
        ("distance", "1 m; nothing reflects"),
        ("angles", f"−{plan.reach_deg:g} to {plan.reach_deg:g}° in steps of {plan.step_deg:g}°"),
        ("frames", f"{plan.frames} at each angle"),
        ("exposure", "fixed: the brightest pixel at 70 % of full scale at 0°; 20 µs at least"),
        ("constant", "of the source at 0°, as a rail would tell it"),
    ]
    return Table((), rows)


def intensity_plot(outcome: Outcome) -> Drawing:
    """Draw the intensity against the angle, over that at 0°, of both sources."""
    angles_deg = np.array(outcome.plan.angles_deg)
    ahead = int(np.argmin(abs(angles_deg)))
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.6)
        for axes, source in zip(figure.subplots(1, 2), SOURCES, strict=True):
            for name in (LIGHT, *STACKS):
                values = outcome.intensity[source][name]
                if name == LIGHT:
                    axes.plot(angles_deg, values / values[ahead], color=INK, linewidth=1.2, label="the light")
                    continue
                marker, colour = look(name, STACKS)
                axes.plot(
                    angles_deg, values / values[ahead], marker, color=colour, markersize=4, linestyle="none",
                    label=name,
                )  # fmt: skip
            axes.set_title(source)
            axes.set_xlabel("angle in degrees")
            axes.set_ylabel("intensity, of that at 0°")
            if source == "bare":
                axes.set_ylim(0.0, None)
            legend(axes)
        return Drawing(svg_of(figure), "intensity against angle, bare and under the shade")
