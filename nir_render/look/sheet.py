"""The sheet: a scene's bodies in grey, and drawn over them robots, what cameras see, lamps, sun and fog."""

import io
import math
from collections.abc import Sequence
from typing import Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from nir_render.camera.optics.lens import corner_directions
from nir_render.geometry import rectangle_frame
from nir_render.look.outlooks import from_above, from_outside, interest_m
from nir_render.report.style import FAINT, GROUND, INK, MATPLOTLIB, PANEL, TRUTH
from nir_render.report.wording import metres
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.backend.variant import backend
from nir_render.transport.outside import Outlook, bodies_of, grey_picture

Array = NDArray[np.float64]
Dash = Literal["-", "--"]

LAMP, BEACON, FRUSTUM, FOG = "#ffd166", "#ff9f1c", "#70e000", "#b392f0"
_DPI = 130
_NAMED = 40  # robots, at most, that are named
_SHOWN = 0.8  # of white, at most, so that what is drawn over bodies is seen


def look_png(scene: Scene, time_s: float = 0.0) -> bytes:
    """Draw a scene at a time from outside and from above.

    Raises
    ------
    InputError
        The scene cannot be built.
    """
    snapshot = scene.at(time_s)
    bodies = bodies_of(snapshot)
    box_m = interest_m(snapshot, bodies.bounds_m)
    shrink = 1 if backend().vectorised else 6
    above = from_above(box_m, 1200 // shrink)
    outside = from_outside(box_m, 1600 // shrink, 1200 // shrink)
    cameras = scene.cameras()
    with mpl.rc_context(MATPLOTLIB | {"font.size": 8.5, "axes.grid": False}):
        figure = Figure((14.5, 6.2), dpi=_DPI, facecolor=GROUND, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(_title(scene, snapshot), fontsize=11, fontweight="bold")
        left, right = figure.subplots(1, 2, width_ratios=(1.33, 1.0))
        for axes, outlook in ((left, outside), (right, above)):
            _draw(axes, grey_picture(bodies, outlook), outlook, snapshot, cameras, box_m)
        _metres_along(right, above)
        figure.legend(
            handles=_key(snapshot), loc="outside lower center", ncols=6, frameon=False, labelcolor=INK
        )
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def _title(scene: Scene, snapshot: Snapshot) -> str:
    parts = [scene.document.name or "scene", f"{snapshot.time_s:g} s"]
    fog = snapshot.fog
    if fog is not None and fog.extinction_per_m > 0.0:
        where = "" if fog.top_m is None else f" below {metres(fog.top_m)}"
        by_height = "" if fog.profile is None else "up to "
        parts.append(f"fog of {by_height}{fog.densest_per_m():.3g} /m{where}")
    if snapshot.sun is not None:
        parts.append(
            f"sun {math.degrees(snapshot.sun.elevation_rad):.0f}° high from "
            f"{math.degrees(snapshot.sun.azimuth_rad):.0f}°"
        )
    return "   ".join(parts)


def _draw(
    axes: Axes, grey: Array, outlook: Outlook, snapshot: Snapshot, cameras: Sequence[str], box_m: Array
) -> None:
    height, width = grey.shape
    shown = np.where(np.isnan(grey), 0.0, 0.08 + _SHOWN * np.sqrt(np.nan_to_num(grey)))
    rgb = np.where(np.isnan(grey)[..., None], mpl.colors.to_rgb(PANEL), shown[..., None])
    axes.imshow(rgb, interpolation="antialiased")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    reach_m = 0.18 * float(np.linalg.norm((box_m[1] - box_m[0])[:2]))
    for name in cameras:
        _draw_frustum(axes, outlook, snapshot, name, reach_m)
    for lamp in snapshot.lamps.values():
        frame = rectangle_frame(lamp.normal, lamp.size_m, 0.0)
        corners_m = np.array(lamp.center_m) + [
            u * frame[:, 0] + v * frame[:, 1] for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))
        ]
        _line(axes, outlook, corners_m, LAMP, 1.6)
    if snapshot.fog is not None and snapshot.fog.extinction_per_m > 0.0:
        _draw_fog(axes, outlook, snapshot, box_m)
    if snapshot.sun is not None:
        _draw_sun(axes, outlook, np.array(snapshot.sun.direction), box_m)
    for name, placed in snapshot.sources.items():
        own = name in snapshot.carried_sources
        if own:
            below_m = snapshot.robots[name.split(".")[0]].pose.position_m
            _line(axes, outlook, np.stack([below_m, placed.pose.position_m]), TRUTH, 0.6)
        _dot(axes, outlook, placed.pose.position_m, TRUTH if own else BEACON, 4.0 if own else 5.5)
    for name, robot in snapshot.robots.items():
        ahead_m = robot.pose.position_m + 0.25 * reach_m * robot.pose.rotation[:, 0]
        _line(axes, outlook, np.stack([robot.pose.position_m, ahead_m]), TRUTH, 1.2)
        if len(snapshot.robots) <= _NAMED:
            place, depth = outlook.project_px(robot.pose.position_m)
            if depth > 0.0:
                axes.annotate(
                    name,
                    (float(place[0]), float(place[1])),
                    (5, 5),
                    textcoords="offset points",
                    color=TRUTH,
                    fontsize=8,
                    clip_on=True,
                )


def _draw_frustum(axes: Axes, outlook: Outlook, snapshot: Snapshot, name: str, reach_m: float) -> None:
    """Draw what a camera sees as a pyramid: its edges, and its rim at `reach_m`."""
    placed = snapshot.camera(name)
    corners = corner_directions(placed.camera)
    rim = np.concatenate([corners[0], corners[1:, -1], corners[-1, -2::-1], corners[-2::-1, 0]])
    rim = rim[np.linspace(0, len(rim) - 1, 81).astype(int)]
    rim_m = (
        placed.pose.position_m
        + reach_m * (rim / np.linalg.norm(rim, axis=1, keepdims=True)) @ placed.pose.rotation.T
    )
    _line(axes, outlook, rim_m, FRUSTUM, 0.8)
    for at in (0, 20, 40, 60):
        _line(axes, outlook, np.stack([placed.pose.position_m, rim_m[at]]), FRUSTUM, 0.8)


def _draw_fog(axes: Axes, outlook: Outlook, snapshot: Snapshot, box_m: Array) -> None:
    """Draw the box that fog fills, as far as it is within the picture's own box."""
    assert snapshot.fog is not None
    low_m, high_m = snapshot.fog.region_m()
    ends = np.stack([np.maximum(low_m, box_m[0]), np.minimum(high_m, box_m[1])])
    corner = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1)  # shape (2, 2, 2, 3)
    for axis in range(3):
        for edge_m in np.moveaxis(corner, axis, 2).reshape(-1, 2, 3):
            _line(axes, outlook, edge_m, FOG, 0.9, "--")


def _draw_sun(axes: Axes, outlook: Outlook, towards: Array, box_m: Array) -> None:
    """Draw the way of the sun's light into the box, ending where it begins to be inside."""
    middle_m, half_m = box_m.mean(axis=0), 0.5 * (box_m[1] - box_m[0])
    with np.errstate(divide="ignore"):
        leaves = float(np.min(half_m / np.abs(towards)))
    ends_m = middle_m + np.outer([leaves, 0.5 * leaves], towards)
    (start, end), depth = outlook.project_px(ends_m)
    if (depth > 0.0).all():
        arrow = {"arrowstyle": "-|>", "color": LAMP, "linewidth": 1.6}
        axes.annotate("", end, start, arrowprops=arrow)
        axes.annotate("sun", start, (4, -10), textcoords="offset points", color=LAMP, clip_on=True)


def _line(
    axes: Axes, outlook: Outlook, points_m: Array, colour: str, width: float, style: Dash = "-"
) -> None:
    place, depth = outlook.project_px(points_m)
    place = np.where(depth[:, None] > 0.0, place, np.nan)
    axes.plot(place[:, 0], place[:, 1], style, color=colour, linewidth=width, alpha=0.9)


def _dot(axes: Axes, outlook: Outlook, point_m: Array, colour: str, size: float) -> None:
    place, depth = outlook.project_px(point_m)
    if depth > 0.0:
        axes.plot(*place, "o", color=colour, markersize=size, markeredgecolor=GROUND, markeredgewidth=0.6)


def _metres_along(axes: Axes, outlook: Outlook) -> None:
    """Write x and y in metres at the sides of a picture from above."""
    span_m = outlook.per_px * max(outlook.width_px, outlook.height_px)
    step_m = next(
        step * decade
        for decade in 10.0 ** np.arange(-2.0, 6.0)
        for step in (1.0, 2.0, 5.0)
        if step * decade >= span_m / 9.0
    )
    for axis, size_px in ((0, outlook.width_px), (1, outlook.height_px)):
        half_m = 0.5 * outlook.per_px * size_px
        middle_m = float(outlook.position_m[axis])
        first, last = math.ceil((middle_m - half_m) / step_m), math.floor((middle_m + half_m) / step_m)
        ticks_m = step_m * np.arange(first, last + 1)
        offset_px = (ticks_m - middle_m) / outlook.per_px * (1.0 if axis == 0 else -1.0)
        labels = [f"{tick:g}" for tick in ticks_m]
        (axes.set_xticks if axis == 0 else axes.set_yticks)(offset_px + 0.5 * (size_px - 1), labels)
    axes.set_xlabel("x in m, from above")
    axes.set_ylabel("y in m")


def _key(snapshot: Snapshot) -> list[Line2D]:
    def dot(colour: str, label: str) -> Line2D:
        return Line2D([], [], color=colour, marker="o", linestyle="none", markersize=5, label=label)

    def line(colour: str, label: str, style: Dash = "-") -> Line2D:
        return Line2D([], [], color=colour, linestyle=style, label=label)

    shown = [dot(TRUTH, "a robot's source, and where it heads"), line(FRUSTUM, "what a camera sees")]
    shown += [line(LAMP, "lamp")] if snapshot.lamps else []
    shown += [dot(BEACON, "beacon")] if snapshot.beacons else []
    fog = snapshot.fog is not None and snapshot.fog.extinction_per_m > 0.0
    shown += [line(FOG, "fog", "--")] if fog else []
    grey = Line2D([], [], color=FAINT, marker="s", linestyle="none", markersize=7)
    grey.set_label("grey: what bodies reflect at 940 nm")
    return [*shown, grey]
