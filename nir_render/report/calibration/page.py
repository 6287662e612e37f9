"""`calibration.html`: what frames told of cameras, each figure with its σ beside what was known before."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from numpy.typing import NDArray

from nir_render.report.drawing import Drawing, legend, sheet, svg_of
from nir_render.report.parts import Table, render_page
from nir_render.report.plots import causes_plot
from nir_render.report.style import INK, LIMIT, LINE, MATPLOTLIB, TRUTH, look
from nir_render.report.wording import counted
from perception.calibration.camera import CalibratedCamera
from perception.calibration.result import HeldOut, RailCalibration
from perception.extrinsics.calibrate import Extrinsics
from perception.types import Calibration

_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class LearnedCamera:
    """What a page shows of a camera: its name, what was known and learned, and sentences on what was not."""

    name: str
    before: Calibration
    result: CalibratedCamera
    kept: Sequence[str]


@dataclass(frozen=True)
class _Camera:
    """The section of a camera, as the page has it."""

    name: str
    learned: Table
    kept: Sequence[str]
    rail: Table | None
    errors: Drawing | None
    causes: Drawing | None
    response: Drawing | None


@dataclass(frozen=True)
class _Rig:
    """The section of a robot's cameras, as the page has it."""

    name: str
    sentence: str
    poses: Table
    picture: Drawing


Row = tuple[str, float, float, float]
"""Name, value, σ, and what it was before."""


def calibration_html(
    *,
    cameras: Mapping[LearnedCamera, Sequence[Row]],
    rigs: Mapping[str, Extrinsics],
    faults: Sequence[str],
    folder_name: str,
    files: Sequence[str],
) -> str:
    """Write the page.

    Parameters
    ----------
    cameras
        Each with what was learned of it beside K.
    rigs
        By robot, how its cameras stand.
    faults
        What speaks against all of it, a sentence each.
    folder_name
        The title.
    files
        Names of files that lie beside the page, to link to.

    Returns
    -------
    An HTML document. Whatever comes from the folder is escaped in it.
    """
    subtitle = [counted(len(cameras), "camera")] if cameras else []
    subtitle += [f"how the cameras of {robot} stand" for robot in rigs]
    return render_page(
        "report/calibration/page.html",
        title=f"Calibration: {folder_name}",
        subtitle=[*subtitle, "holds" if not faults else f"{counted(len(faults), 'check')} failed"],
        faults=list(faults),
        cameras=[_camera(camera, learned) for camera, learned in cameras.items()],
        rigs=[_rig(robot, rig) for robot, rig in rigs.items()],
        files=list(files),
    )


def _camera(camera: LearnedCamera, learned: Sequence[Row]) -> _Camera:
    rail, known = camera.result.rail, camera.before.sigma
    rows = [(_words(name), value, sigma, was, known.get(name, 0.0)) for name, value, sigma, was in learned]
    if rail is not None:
        fit, name = rail.fit, "range_constant_dn_m2_per_s"
        was = camera.before.range_constant_dn_m2_per_s
        sigma = rail.calibration.sigma.get(name, fit.range_constant_sigma_dn_m2_per_s)
        rows.append(
            ("range constant K, DN m²/s", fit.range_constant_dn_m2_per_s, sigma, was, known.get(name, 0.0))
        )
    headings = ["", "learned", "σ", "before", "moved, σ"]
    cells = [
        [name, *_with_sigma(value, sigma), _number(was), _pull(value - was, math.hypot(sigma, sigma_before))]
        for name, value, sigma, was, sigma_before in rows
    ]
    flat = camera.result.flat
    return _Camera(
        name=camera.name,
        learned=Table(headings, cells),
        kept=[sentence.rstrip(".") for sentence in camera.kept],
        rail=None if rail is None else _rail_table(rail),
        errors=None if rail is None or not len(rail.judged_m) else _errors_plot(rail),
        causes=Drawing(causes_plot({"robust": rail.causes}), "σ of ranges by cause, against range")
        if rail is not None and rail.causes
        else None,
        response=None
        if flat is None
        else _response_plot(camera.before, flat.angle_rad, flat.response, flat.response_sigma),
    )


def _rail_table(rail: RailCalibration) -> Table:
    def cells(name: str, held_out: HeldOut) -> list[str]:
        numbers = held_out.range_rmse_m, held_out.range_mae_m, held_out.range_bias_m
        return [
            name, f"{held_out.found} of {rail.frames_held_out}",
            *("–" if math.isnan(number) else f"{1e3 * number:.2f}" for number in numbers),
            _number(held_out.reduced_chi2),
        ]  # fmt: skip

    headings = ["", "ranged", "RMSE, mm", "MAE, mm", "bias, mm", "χ² of the claims (1 is honest)"]
    limit = ["limit", "", f"{1e3 * rail.range_limit_m:.2f}", "", "", ""]
    return Table(headings, [cells("robust", rail.robust), cells("paper", rail.paper_held_out), limit])


def _errors_plot(rail: RailCalibration) -> Drawing:
    range_m, error_m, sigma_m = rail.judged_m.T
    with rc_context(MATPLOTLIB):
        figure = sheet(3.8)
        axes = figure.subplots()
        colour = look("robust", ("robust",)).colour
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.errorbar(
            range_m, 1e3 * error_m, 1e3 * sigma_m, fmt="o", color=colour, markersize=2.5, elinewidth=0.6,
            alpha=0.7, label="a frame, 1 σ",
        )  # fmt: skip
        places_m, place = np.unique(range_m, return_inverse=True)
        mean_mm = 1e3 * np.bincount(place, weights=error_m) / np.bincount(place)
        axes.plot(places_m, mean_mm, "-", color=LIMIT, linewidth=1.4, label="mean of a range")
        axes.set_xlabel("true range, m")
        axes.set_ylabel("error of the range, mm")
        legend(axes)
        return Drawing(svg_of(figure), "range errors held out, with their σ, against range")


def _response_plot(
    before: Calibration,
    angle_rad: NDArray[np.float64],
    response: NDArray[np.float64],
    sigma: NDArray[np.float64],
) -> Drawing:
    with rc_context(MATPLOTLIB):
        figure = sheet(3.8)
        axes, apart = figure.subplots(1, 2)
        corner = angle_rad <= angle_rad[-2]  # beyond the frame's corner it is held
        angle_deg = np.degrees(angle_rad)
        start = np.interp(angle_rad, before.response_angle_rad, before.response_relative)
        colour = look("robust", ("robust",)).colour
        axes.plot(angle_deg[corner], start[corner], ":", color=TRUTH, linewidth=1.4, label="before")
        axes.plot(angle_deg[corner], response[corner], color=colour, linewidth=1.2, label="learned")
        axes.set_ylabel("response over that on the axis")
        off = 100.0 * (response / start - 1.0)
        wide = 100.0 * sigma / start
        apart.axhline(0.0, color=LINE, linewidth=1.0)
        apart.fill_between(
            angle_deg[corner], (off - wide)[corner], (off + wide)[corner], color=colour, alpha=0.3,
            linewidth=0.0, label="1 σ",
        )  # fmt: skip
        apart.plot(angle_deg[corner], off[corner], color=colour, linewidth=1.2, label="learned over before")
        apart.set_ylabel("difference, %")
        for panel in (axes, apart):
            panel.set_xlabel("angle off the axis, degrees")
            legend(panel)
        return Drawing(svg_of(figure), "response over the field angle, before and learned")


def _rig(robot: str, rig: Extrinsics) -> _Rig:
    rows = []
    for pose in rig.poses:
        sigma = np.sqrt(np.diagonal(pose.covariance))
        turned = (
            _three(1e3 * pose.turned_rad, 1e3 * sigma[:3]) if pose.has_rotation else "not told: as it was"
        )
        shifted = (
            _three(1e3 * pose.shifted_m, 1e3 * sigma[3:]) if pose.has_position else "not told: as it was"
        )
        rows.append([pose.camera, str(pose.flares), turned, shifted])
    headings = ["", "flares", "turned about x, y, z, mrad", "shifted along x, y, z, mm"]
    sentence = (
        f"{rig.reference} is where it was; {counted(rig.flares, 'flare')} that two cameras share tell the "
        f"others, with a reduced χ² of {rig.reduced_chi2:.2f}."
    )
    if rig.refused:
        sentence += f" {rig.refused} more do not agree with these."
    return _Rig(robot, sentence, Table(headings, rows), _poses_plot(rig))


def _poses_plot(rig: Extrinsics) -> Drawing:
    """Draw by how much cameras stand otherwise than said, axis by axis, and how sure that is."""
    with rc_context(MATPLOTLIB):
        figure = sheet(3.4)
        panels = figure.subplots(1, 2)
        names = [pose.camera for pose in rig.poses]
        for panel, first, unit in ((panels[0], 0, "mrad"), (panels[1], 3, "mm")):
            for axis, colour in enumerate(("#ff9f1c", "#70e000", "#4cc9f0")):
                told = [
                    k for k, one in enumerate(rig.poses) if (one.has_position if first else one.has_rotation)
                ]
                moved = [rig.poses[k].shifted_m if first else rig.poses[k].turned_rad for k in told]
                sigma = [math.sqrt(rig.poses[k].covariance[first + axis, first + axis]) for k in told]
                panel.errorbar(
                    [k + 0.18 * (axis - 1) for k in told], [1e3 * one[axis] for one in moved],
                    [1e3 * one for one in sigma], fmt="o", color=colour, markersize=4, capsize=3,
                    label=f"{'about' if not first else 'along'} {_AXES[axis]}, 1 σ",
                )  # fmt: skip
            panel.axhline(0.0, color=LINE, linewidth=1.0)
            panel.set_xticks(range(len(names)), names)
            panel.set_xlim(-0.6, len(names) - 0.4)
            panel.set_ylabel(f"{'shifted' if first else 'turned'} by, {unit}")
            legend(panel)
        return Drawing(svg_of(figure), "by how much cameras stand otherwise than said, with 1 σ")


def _words(name: str) -> str:
    """Return a field's name with its unit behind a comma."""
    field, _, more = name.partition(",")
    for ending, unit in (("_dn", "DN"), ("_px", "px"), ("_e", "e")):
        if field.endswith(ending):
            field = f"{field.removesuffix(ending)}, {unit}"
    return field.replace("_", " ") + (f" ({more.strip()})" if more else "")


def _three(values: NDArray[np.float64], sigmas: NDArray[np.float64]) -> str:
    return ", ".join(
        " ± ".join(_with_sigma(*pair)) for pair in zip(values.tolist(), sigmas.tolist(), strict=True)
    )


def _with_sigma(value: float, sigma: float) -> tuple[str, str]:
    """Return a value to the second place of its σ, and the σ."""
    if not (math.isfinite(value) and sigma > 0.0 and math.isfinite(sigma)):
        return _number(value), "–"
    places = 1 - math.floor(math.log10(sigma))
    if abs(value) >= 1e6 or places > 7:
        return _number(value), f"{sigma:.2g}"
    return f"{value:.{max(places, 0)}f}", f"{sigma:.{max(places, 0)}f}"


def _pull(moved: float, sigma: float) -> str:
    return f"{moved / sigma:+.1f}" if sigma > 0.0 and math.isfinite(moved) else "–"


def _number(value: float) -> str:
    return "–" if not math.isfinite(value) else f"{value:.6g}"
