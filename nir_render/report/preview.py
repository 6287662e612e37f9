"""`preview.png`: frames as a person would want to see them, with truth and detections drawn in."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from nir_render.evaluate.metrics import FrameKey, Score
from perception.picture import tone_map
from perception.types import Calibration, RawFrame

Item = TypeVar("Item")

_WHOLE_IN, _CLOSE_IN = 5.0, 2.3
_WHOLE_FRAMES = 2
_CLOSE_UPS = 10
_CLOSE_UP_HALF_PX = 14
_TRUTH_COLOUR = "#4cc9f0"
_ESTIMATORS = {"paper": ("s", "#ff9f1c"), "robust": ("+", "#70e000")}
_OTHER = ("x", "#f72585")
_GROUND, _INK = "#101418", "#e6e8ea"


def preview_png(
    keys: Sequence[FrameKey],
    scores: Sequence[Score],
    estimators: Sequence[str],
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
    title: str,
) -> bytes:
    """Draw a sheet: whole frames on top, close-ups of sources with their ranges below.

    Parameters
    ----------
    keys
        Camera and index of all frames, at least one, in the order they were taken.
    scores
        All scores of the run.
    estimators
        Names of those that were scored.
    load
        Reads one frame; only the frames that are drawn are read.
    calibrations
        By camera.
    title
        A line above it all.

    Returns
    -------
    A PNG file.
    """
    wholes = _spread(keys, _WHOLE_FRAMES)
    closes = _spread(scores, _CLOSE_UPS)
    frames = {key: load(key) for key in dict.fromkeys([*wholes, *map(_key_of, closes)])}
    rows = min(2, len(closes))
    columns = -(-len(closes) // 2)
    heights_in = [0.77 * _WHOLE_IN, rows * _CLOSE_IN] if closes else [0.77 * _WHOLE_IN]
    width_in = max(len(wholes) * _WHOLE_IN, 0.8 * columns * _CLOSE_IN)
    style = {"font.family": "DejaVu Sans", "text.color": _INK, "font.size": 8.5}
    with mpl.rc_context(style):  # type: ignore[arg-type]
        figure = Figure((width_in, 0.6 + sum(heights_in)), dpi=130, facecolor=_GROUND, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=11, fontweight="bold")
        parts = figure.subfigures(len(heights_in), 1, height_ratios=heights_in, squeeze=False)[:, 0]
        for part in parts:
            part.set_facecolor(_GROUND)
        for axes, key in zip(parts[0].subplots(1, len(wholes), squeeze=False)[0], wholes, strict=True):
            _draw_whole(axes, frames[key], [s for s in scores if _key_of(s) == key], calibrations[key[0]])
        if closes:
            grid = parts[1].subplots(rows, columns, squeeze=False).ravel()
            for axes in grid[len(closes) :]:
                axes.axis("off")
            for axes, score in zip(grid, closes, strict=False):
                calibration = calibrations[score.truth.camera]
                _draw_close(axes, frames[_key_of(score)], score, estimators, calibration)
            _draw_key(parts[1], estimators)
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _key_of(score: Score) -> FrameKey:
    return score.truth.camera, score.truth.index


def _draw_whole(axes: Axes, frame: RawFrame, scores: Sequence[Score], calibration: Calibration) -> None:
    _show(axes, frame, calibration)
    for score in scores:
        truth = score.truth
        axes.add_patch(Circle((truth.u_px, truth.v_px), 22, fill=False, color=_TRUTH_COLOUR, linewidth=1.0))
        axes.annotate(
            f"{truth.robot}  {truth.range_m:.2f} m", (truth.u_px, truth.v_px), (26, 0), color=_TRUTH_COLOUR,
            textcoords="offset points", va="center",
        )  # fmt: skip
        for name, detection in score.detections.items():
            marker, colour = _ESTIMATORS.get(name, _OTHER)
            axes.plot(
                detection.u_px, detection.v_px, marker, color=colour, markersize=7, fillstyle="none", mew=0.9
            )
    exposure = f"{frame.exposure_s * 1e3:.3g} ms"
    axes.set_title(f"{frame.camera}   frame {frame.index}   {frame.time_s:.2f} s   {exposure}", fontsize=9)


def _draw_close(
    axes: Axes, frame: RawFrame, score: Score, estimators: Sequence[str], calibration: Calibration
) -> None:
    truth = score.truth
    _show(axes, frame, calibration)
    axes.set_xlim(truth.u_px - _CLOSE_UP_HALF_PX, truth.u_px + _CLOSE_UP_HALF_PX)
    axes.set_ylim(truth.v_px + _CLOSE_UP_HALF_PX, truth.v_px - _CLOSE_UP_HALF_PX)
    radius_px = (
        calibration.fx_px * calibration.source_radius_m / max(truth.depth_z_m, calibration.source_radius_m)
    )
    axes.add_patch(
        Circle((truth.u_px, truth.v_px), radius_px, fill=False, color=_TRUTH_COLOUR, linewidth=1.0)
    )
    said = [f"true {truth.range_m:.3f} m"]
    for name in estimators:
        detection = score.detections.get(name)
        if detection is None:
            said.append(f"{name} not found")
            continue
        marker, colour = _ESTIMATORS.get(name, _OTHER)
        axes.plot(
            detection.u_px, detection.v_px, marker, color=colour, markersize=11, fillstyle="none", mew=1.2
        )
        said.append(f"{name} {detection.range_m:.3f} m")
    axes.set_title("\n".join(said), fontsize=7.5, loc="left")


def _draw_key(part: SubFigure, names: Sequence[str]) -> None:
    handles = [
        Line2D([], [], color=_TRUTH_COLOUR, marker="o", fillstyle="none", linestyle="none", label="truth")
    ]
    for name in names:
        marker, colour = _ESTIMATORS.get(name, _OTHER)
        handles.append(
            Line2D([], [], color=colour, marker=marker, fillstyle="none", linestyle="none", label=name)
        )
    part.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _show(axes: Axes, frame: RawFrame, calibration: Calibration) -> None:
    full_scale_dn = float(calibration.saturation_dn)
    picture = tone_map(frame.data_dn, frame.black_level_dn, full_scale_dn)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#3a4046")


def _spread(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` items, evenly spread, first and last among them."""
    if len(items) <= count:
        return list(items)
    return [items[round(index * (len(items) - 1) / (count - 1))] for index in range(count)]
