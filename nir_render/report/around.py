"""What a rig measures around itself: a table, and a picture from above of one set."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, Wedge
from matplotlib.ticker import MaxNLocator

from nir_render.evaluate.sets import SetEvaluation, SetScore, Stand
from nir_render.report.drawing import Drawing, legend, sheet, svg_of
from nir_render.report.parts import Table
from nir_render.report.style import INK, LIMIT, MATPLOTLIB, TRUTH, look
from nir_render.report.wording import counted, metres, share
from perception.rig.frame_sets import robot_of
from perception.types import Measurement, MirrorPlane

_SIGMAS = 3.0
_MARGIN = 1.15
_POINTER, _TRUE_POINTER = 0.11, 0.2  # lengths of headings, of the picture's half
_ODDS_SHOWN = 0.01
_ONE_ROBOT_M = 0.4


@dataclass(frozen=True)
class Around:
    """The section of a page: what the sets are, their numbers, and the picture."""

    sentence: str
    numbers: Table
    headings: Table | None
    picture: Drawing | None


def around_section(around: SetEvaluation | None) -> Around | None:
    """Return the section about a run's sets; None where nothing was measured."""
    if around is None or not around.sets:
        return None
    cameras = max(len({camera for camera, _ in keys}) for keys in around.sets)
    sentence = (
        f"{counted(len(around.sets), 'set')} of frames, of up to {counted(cameras, 'camera')} of one robot "
        "at once: every source counts once, and a mirror image is to be told from a robot."
    )
    return Around(sentence, _numbers(around.summary), _headings(around.summary), _picture(around))


def _numbers(summary: Mapping[str, Mapping[str, Any]]) -> Table:
    headings = [
        "estimator", "recall", "seen twice", "false alarms per set", "images told",
        "robots called images", "place RMSE", "range RMSE", "NEES (1 is honest)",
    ]  # fmt: skip
    rows = []
    for name, numbers in summary.items():
        alarms, nees = numbers["set_false_alarms_per_set"], numbers["set_nees"]
        rows.append([
            name, share(numbers["set_recall"]), str(numbers["set_split"]),
            "–" if alarms is None else f"{alarms:.3f}",
            f"{numbers['set_ghosts_told']} of {numbers['set_ghosts_visible']}",
            str(numbers["set_robots_called_ghosts"]), metres(numbers["set_position_rmse_m"]),
            metres(numbers["set_range_rmse_m"]), "–" if nees is None else f"{nees:.2f}",
        ])  # fmt: skip
    return Table(headings, rows)


def _headings(summary: Mapping[str, Mapping[str, Any]]) -> Table | None:
    """Return how well robots of several sources were told; None where no layout was known."""
    rows = [
        [
            name, str(numbers["set_robots_told"]), str(numbers["set_robots_mixed"]),
            _or_dash(numbers["set_heading_rms_deg"], "°"), _or_dash(numbers["set_heading_nees"], ""),
            str(numbers["set_heading_wrong"]), str(numbers["set_heading_unsaid"]),
        ]
        for name, numbers in summary.items()
        if "set_robots_told" in numbers
    ]  # fmt: skip
    headings = [
        "estimator", "robots told", "of flares of several", "heading RMS", "NEES (1 is honest)",
        "best heading wrong", "true one not named",
    ]  # fmt: skip
    return Table(headings, rows) if rows else None


def _or_dash(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.2f}{unit}"


def _picture(around: SetEvaluation) -> Drawing | None:
    """Draw the set that shows most; None where none shows anything."""
    if not around.scores:
        return None
    counts = np.bincount([score.number for score in around.scores])
    number = int(np.argmax(counts))
    scores = [score for score in around.scores if score.number == number]
    robot = robot_of(around.sets[number][0][0])
    names = list(around.summary)
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(7.4)
        axes = figure.subplots()
        reach_m = _MARGIN * max(0.5, *(float(np.abs(score.position_body_m[:2]).max()) for score in scores))
        for name in names:
            for _, plane in (each for each in around.mirrors.get(name, ()) if each[0] == number):
                _draw_mirror(axes, plane, reach_m, name)
            said = [score.measurements[name] for score in scores if name in score.measurements]
            said += [alarm for at, alarm in around.false_alarms[name] if at == number]
            _draw_measured(axes, said, name, names)
            stands = [each for each in around.stands.get(name, ()) if each.number == number]
            _draw_headings(axes, stands, reach_m, look(name, names).colour, name)
        _draw_true_headings(axes, around, number, reach_m)
        _draw_truth(axes, scores)
        axes.plot(0.0, 0.0, "^", color=INK, markersize=9, label=f"{robot}, looking up the page")
        axes.set_xlim(-reach_m, reach_m)
        axes.set_ylim(-reach_m, reach_m)
        axes.set_aspect("equal")
        axes.xaxis.set_major_locator(MaxNLocator(nbins=12, steps=[1, 2, 5, 10]))
        axes.set_xlabel("to the right, m")
        axes.set_ylabel("ahead, m")
        legend(axes)
        svg = svg_of(figure)
    return Drawing(
        svg, "the surroundings of a rig from above: truth, what was measured, mirror images, mirrors"
    )


def _page(position_body_m: Any) -> tuple[float, float]:
    """Return where a place stands on the page, or a direction points: ahead is up, left is left."""
    return -float(position_body_m[1]), float(position_body_m[0])


def _draw_truth(axes: Axes, scores: Sequence[SetScore]) -> None:
    for is_ghost, label in ((False, "truth"), (True, "truth: mirror image")):
        shown = [score for score in scores if score.is_ghost == is_ghost]
        for k, score in enumerate(shown):
            x, y = _page(score.position_body_m)
            axes.plot(
                x, y, "o", color=TRUTH, fillstyle="none", markersize=9 if is_ghost else 15, linestyle="none",
                markeredgewidth=0.9 if is_ghost else 1.3, alpha=0.7 if is_ghost else 1.0,
                label=label if k == 0 else None,
            )  # fmt: skip
            # Of a robot's several sources the first has its name.
            first = next(one for one in shown if one.truth.robot == score.truth.robot)
            if score is first or np.linalg.norm(score.position_body_m - first.position_body_m) > _ONE_ROBOT_M:
                text = score.truth.robot + ("'" if is_ghost else "")
                axes.annotate(text, (x, y), (9, 9), textcoords="offset points", fontsize=8, color=TRUTH)


def _draw_measured(axes: Axes, said: Sequence[Measurement], name: str, names: Sequence[str]) -> None:
    marker, colour = look(name, names)
    for is_image, label in ((False, name), (True, f"{name}: called a mirror image")):
        shown = [each for each in said if (each.ghost == "yes") == is_image and math.isfinite(each.range_m)]
        if not shown:
            continue
        x, y = zip(*(_page(each.position_body_m) for each in shown), strict=True)
        axes.plot(
            x, y, "." if is_image else marker, color=colour, alpha=0.6 if is_image else 1.0, linestyle="none",
            fillstyle="none" if not is_image else "full", markersize=7, label=label,
        )  # fmt: skip
        for each in shown:
            _draw_ellipse(axes, each, colour)


def _draw_headings(axes: Axes, stands: Sequence[Stand], reach_m: float, colour: str, name: str) -> None:
    """Draw each heading that is said as a wedge of 3 σ, the fainter the less probable."""
    length_m, label = _POINTER * reach_m, f"{name}: heading, with its odds where there are several"
    for each in stands:
        shown = [one for one in each.told.hypotheses if one.odds >= _ODDS_SHOWN]
        for one in shown:
            x, y = _page(one.position_body_m)
            ahead = _page((math.cos(one.heading_rad), math.sin(one.heading_rad)))
            angle_deg = math.degrees(math.atan2(ahead[1], ahead[0]))
            wide_deg = min(_SIGMAS * math.degrees(math.sqrt(one.covariance[3, 3])), 180.0)
            alpha = 0.25 + 0.75 * one.odds
            wedge = Wedge((x, y), length_m, angle_deg - wide_deg, angle_deg + wide_deg)
            wedge.set(facecolor=colour, alpha=0.4 * alpha, linewidth=0.0)
            axes.add_patch(wedge)
            tip = x + length_m * ahead[0], y + length_m * ahead[1]
            axes.plot(
                *zip((x, y), tip, strict=True), "-", color=colour, linewidth=1.2, alpha=alpha, label=label
            )
            label = "_"  # one in the legend
            if len(shown) > 1:
                axes.annotate(
                    f"{100.0 * one.odds:.0f} %", tip, (14.0 * ahead[1], -14.0 * ahead[0]), fontsize=7,
                    color=colour, textcoords="offset points", ha="center", va="center",
                )  # fmt: skip


def _draw_true_headings(axes: Axes, around: SetEvaluation, number: int, reach_m: float) -> None:
    true = {
        each.told.flares: each.true
        for stands in around.stands.values()
        for each in stands
        if each.number == number and each.true is not None
    }
    for k, (place_m, heading_rad) in enumerate(true.values()):
        x, y = _page(place_m)
        ahead = _page((math.cos(heading_rad), math.sin(heading_rad)))
        tip = x + _TRUE_POINTER * reach_m * ahead[0], y + _TRUE_POINTER * reach_m * ahead[1]
        axes.plot(
            *zip((x, y), tip, strict=True), ":", color=TRUTH, linewidth=1.3,
            label="truth: heading" if k == 0 else None,
        )  # fmt: skip


def _draw_ellipse(axes: Axes, measurement: Measurement, colour: str) -> None:
    covariance = measurement.position_covariance_m2
    if not np.isfinite(covariance).all():
        return
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    values, vectors = np.linalg.eigh(turn @ covariance @ turn.T)
    angle_deg = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    long_m, short_m = 2.0 * _SIGMAS * np.sqrt(np.maximum(values[::-1], 0.0))
    axes.add_patch(
        Ellipse(
            _page(measurement.position_body_m),
            long_m,
            short_m,
            angle=angle_deg,
            fill=False,
            edgecolor=colour,
            linewidth=0.8,
            alpha=0.7,
        )
    )


def _draw_mirror(axes: Axes, plane: MirrorPlane, reach_m: float, name: str) -> None:
    normal = np.array(plane.normal_body[:2])
    length = float(np.linalg.norm(normal))
    if length < 0.3:  # floor or ceiling
        return
    foot = normal / length * plane.distance_m / length
    along = np.array([-normal[1], normal[0]]) / length
    ends = [_page(foot + sign * 2.0 * reach_m * along) for sign in (-1.0, 1.0)]
    text = f"{name}: mirror, R {plane.parameter:.2f}"
    if plane.kind != "constant":
        text = f"{name}: glass, index {plane.parameter:.2f}"
    axes.plot(*zip(*ends, strict=True), "--", color=LIMIT, linewidth=1.0, alpha=0.8, label=text)
