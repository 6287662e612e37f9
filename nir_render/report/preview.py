"""`preview.png`: frames as a person would want to see them, with truth and detections drawn in."""

import io
from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from nir_render.evaluate.match import image_radius_px
from nir_render.evaluate.metrics import Score
from nir_render.report.pictures import key_of, spread, whole_picture
from nir_render.report.style import GROUND, LINE, MATPLOTLIB, TRUTH, look
from perception.types import Calibration, FrameKey, RawFrame
from perception.types.picture import tone_map

_WHOLE_IN, _CLOSE_IN = 5.0, 2.3
_WHOLE_CAMERAS = 4
_BLOCK_PX = 4
_CLOSE_UPS = 10
_CLOSE_UP_HALF_PX = 14


def preview_png(
    keys: Sequence[FrameKey],
    scores: Sequence[Score],
    ghosts: Sequence[Score],
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
    ghosts
        Those of the sources' mirror images.
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
    wholes = _wholes(keys)
    closes = spread(scores, _CLOSE_UPS)
    frames = {key: load(key) for key in dict.fromkeys([*wholes, *map(key_of, closes)])}
    rows = min(2, len(closes))
    columns = -(-len(closes) // 2)
    whole_columns = min(2, len(wholes))
    whole_rows = -(-len(wholes) // 2)
    heights_in = [0.77 * _WHOLE_IN * whole_rows, rows * _CLOSE_IN][: 2 if closes else 1]
    width_in = max(whole_columns * _WHOLE_IN, 0.8 * columns * _CLOSE_IN)
    with mpl.rc_context(MATPLOTLIB | {"font.size": 8.5, "axes.grid": False}):
        figure = Figure((width_in, 0.6 + sum(heights_in)), dpi=130, facecolor=GROUND, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, fontsize=11, fontweight="bold")
        parts = figure.subfigures(len(heights_in), 1, height_ratios=heights_in, squeeze=False)[:, 0]
        for part in parts:
            part.set_facecolor(GROUND)
        whole_axes = parts[0].subplots(whole_rows, whole_columns, squeeze=False).ravel()
        for axes in whole_axes[len(wholes) :]:
            axes.axis("off")
        for axes, key in zip(whole_axes, wholes, strict=False):
            own = [score for score in (*scores, *ghosts) if key_of(score) == key]
            _draw_whole(axes, frames[key], own, estimators, calibrations[key[0]])
        if closes:
            grid = parts[1].subplots(rows, columns, squeeze=False).ravel()
            for axes in grid[len(closes) :]:
                axes.axis("off")
            for axes, score in zip(grid, closes, strict=False):
                calibration = calibrations[score.truth.camera]
                _draw_close(axes, frames[key_of(score)], score, estimators, calibration)
            _draw_key(parts[1], estimators)
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _wholes(keys: Sequence[FrameKey]) -> list[FrameKey]:
    """Return the frames to show whole: the first of up to four cameras, or the first and last of one."""
    first = {camera: (camera, index) for camera, index in reversed(keys)}
    if len(first) > 1:
        return [first[camera] for camera in dict.fromkeys(camera for camera, _ in keys)][:_WHOLE_CAMERAS]
    return spread(keys, 2)


def _draw_whole(
    axes: Axes,
    frame: RawFrame,
    scores: Sequence[Score],
    estimators: Sequence[str],
    calibration: Calibration,
) -> None:
    rows, columns = frame.data_dn.shape
    picture = whole_picture(frame, calibration, _BLOCK_PX)
    extent = (-0.5, columns - 0.5, rows - 0.5, -0.5)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="bilinear", extent=extent)
    _bare(axes)
    for place, score in enumerate(sorted(scores, key=lambda score: score.truth.u_px)):
        truth = score.truth
        line, prefix = ("-", "") if truth.ghost_of is None else (":", "ghost of ")
        axes.add_patch(
            Circle((truth.u_px, truth.v_px), 22, fill=False, color=TRUTH, linewidth=1.0, linestyle=line)
        )
        # Above the flare, at one of three heights in turn, so that neighbours' names do not cover each other.
        axes.annotate(
            f"{prefix}{truth.robot}  {truth.range_m:.2f} m", (truth.u_px, truth.v_px),
            (0, 13 + 11 * (place % 3)), color=TRUTH, textcoords="offset points", ha="center",
        )  # fmt: skip
        for name, detection in score.detections.items():
            marker, colour = look(name, estimators)
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
    radius_px = image_radius_px(truth, calibration)
    axes.add_patch(Circle((truth.u_px, truth.v_px), radius_px, fill=False, color=TRUTH, linewidth=1.0))
    said = [f"true {truth.range_m:.3f} m"]
    for name in estimators:
        detection = score.detections.get(name)
        if detection is None:
            said.append(f"{name} not found")
            continue
        marker, colour = look(name, estimators)
        axes.plot(
            detection.u_px, detection.v_px, marker, color=colour, markersize=11, fillstyle="none", mew=1.2
        )
        said.append(f"{name} {detection.range_m:.3f} m")
    axes.set_title("\n".join(said), fontsize=7.5, loc="left")


def _draw_key(part: SubFigure, names: Sequence[str]) -> None:
    handles = [Line2D([], [], color=TRUTH, marker="o", fillstyle="none", linestyle="none", label="truth")]
    for name in names:
        marker, colour = look(name, names)
        handles.append(
            Line2D([], [], color=colour, marker=marker, fillstyle="none", linestyle="none", label=name)
        )
    part.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _show(axes: Axes, frame: RawFrame, calibration: Calibration) -> None:
    full_scale_dn = float(calibration.saturation_dn)
    picture = tone_map(frame.data_dn, frame.black_level_dn, full_scale_dn)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    _bare(axes)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(LINE)
