"""`report.html` of a recording without truth: frames, what was found in them, ranges with their σ."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from matplotlib import rc_context

from nir_render.report.drawing import Drawing, legend, sheet, svg_of
from nir_render.report.parts import Table, data_uri, render_page
from nir_render.report.pictures import (
    MOST_CAMERAS,
    Image,
    Line,
    Mark,
    cameras_of,
    labels_of,
    png_uri,
    spread,
    whole_picture,
)
from nir_render.report.plots import causes_plot
from nir_render.report.recording_checks import ShapesSeen, darkness_warnings, shape_warnings, shapes_seen
from nir_render.report.style import MATPLOTLIB, look
from nir_render.report.wording import counted, metres, share
from perception.causes import DetectionCauses
from perception.rig.overlap import finest, overlap_warnings
from perception.types import Calibration, Detection, FrameKey, RawFrame
from perception.types.picture import tone_map

_WHOLES = 4
_CHECKED = 8  # frames of a camera that are held against its calibration
_CLOSE_UPS = 10
_CLOSE_UP_HALF_PX = 14
_WHOLE_WIDTH_PX = 720
_MOST_ROWS, _MOST_LABELS = 600, 40
_FLAGS = ("saturated", "merged", "ghost")

Found = Mapping[str, Mapping[FrameKey, Sequence[Detection]]]
"""Detections by estimator and frame."""


@dataclass(frozen=True)
class SeenFrame:
    """A whole frame and what was found in it; `unit_px` is a hundredth of its width."""

    camera: str
    index: int
    caption: str
    image: Image
    unit_px: float
    marks: tuple[Mark, ...]
    labels: tuple[tuple[float, float, str, str], ...]


@dataclass(frozen=True)
class SeenFlare:
    """The surroundings of a detection, and what each estimator says of what is there."""

    box: str
    image: Image
    marks: tuple[Mark, ...]
    lines: tuple[Line, ...]
    frame: str


def recording_html(
    *,
    keys: Sequence[FrameKey],
    found: Found,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
    folder_name: str,
    files: Sequence[str],
    causes: Mapping[str, Sequence[DetectionCauses]] = MappingProxyType({}),
) -> str:
    """Write the page.

    Parameters
    ----------
    keys
        Camera and index of all frames, in the order they were taken.
    found
        The detections, by estimator and frame.
    load
        Reads one frame; only those that are shown or looked into are read.
    calibrations
        By camera.
    folder_name
        The title.
    files
        Names of files that lie beside the page, to link to.
    causes
        By estimator, what ranges' σ are made of, where that was asked for.

    Returns
    -------
    An HTML document. Whatever comes from the folder is escaped in it.
    """
    names, cameras = list(found), cameras_of(keys)
    warnings, seen = _warnings(keys, found, load, calibrations)
    listed = _listed(found) or found
    return render_page(
        "report/recording_page.html",
        title=folder_name,
        subtitle=[
            f"{counted(len(keys), 'frame')} of {counted(len(cameras), 'camera')}",
            f"estimators: {', '.join(names) or 'none'}",
            "a recording without truth",
        ],
        names=names,
        warnings=warnings,
        numbers=_numbers(keys, found, seen),
        wholes=[
            _whole(load(key), calibrations[key[0]], {name: found[name].get(key, ()) for name in names}, names)
            for key in _shown(keys, found)
        ],
        closes=_closes(found, load, calibrations),
        plot=_range_plot(found),
        rows=_rows(keys, listed),
        more=max(0, _count(listed) - _MOST_ROWS),
        without_paper="paper" in found and "paper" not in listed,
        cameras=_cameras(cameras[:MOST_CAMERAS], calibrations),
        files=list(files),
        causes=Drawing(causes_plot(causes), "σ of ranges by cause, against range")
        if any(causes.values())
        else None,
    )


def _listed(found: Found) -> Found:
    """Return what is listed: all but what paper found, where it has no range constant."""
    return {
        name: frames
        for name, frames in found.items()
        if name != "paper" or any(math.isfinite(one.range_m) for listed in frames.values() for one in listed)
    }


def _count(found: Found) -> int:
    return sum(len(listed) for frames in found.values() for listed in frames.values())


def _warnings(
    keys: Sequence[FrameKey],
    found: Found,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
) -> tuple[list[str], dict[str, ShapesSeen]]:
    """Return where frames contradict the calibration, and by estimator the shapes seen by all cameras."""
    warnings = list(_overlap_warnings(keys, found, calibrations))
    shapes: dict[str, list[ShapesSeen]] = {name: [] for name in found}
    for camera in cameras_of(keys):
        looked = spread([key for key in keys if key[0] == camera], _CHECKED)
        frames = [load(key) for key in looked]
        warnings += darkness_warnings(frames, calibrations[camera])
        for name, by_frame in found.items():
            seen = shapes_seen(frames, [by_frame.get(key, ()) for key in looked], calibrations[camera])
            shapes[name].append(seen)
            if name != "paper":  # it tells no merged flare from others
                warnings += shape_warnings(camera, name, seen, calibrations[camera])
    for name, by_frame in found.items():
        if not any(by_frame.values()):
            warnings.append(
                f"{name} found nothing in any frame: too faint, or exposure_s and the calibration are off"
            )
    return warnings, {name: _together(listed) for name, listed in shapes.items()}


def _overlap_warnings(
    keys: Sequence[FrameKey], found: Found, calibrations: Mapping[str, Calibration]
) -> Iterator[str]:
    """Yield where what a robot's cameras see contradicts how they stand; frames of one index are a set."""
    name = finest(list(found))
    if name is None:
        return
    sets: dict[int, dict[str, Sequence[Detection]]] = {}
    for camera, index in keys:
        sets.setdefault(index, {})[camera] = found[name].get((camera, index), ())
    yield from overlap_warnings(sets.values(), calibrations)


def _together(listed: Sequence[ShapesSeen]) -> ShapesSeen:
    widths = [one.psf_sigma_px for one in listed if math.isfinite(one.psf_sigma_px)]
    width_px = float(np.median(widths)) if widths else math.nan
    return ShapesSeen(sum(one.flares for one in listed), sum(one.merged for one in listed), width_px)


def _numbers(keys: Sequence[FrameKey], found: Found, seen: Mapping[str, ShapesSeen]) -> Table:
    headings = (
        "estimator", "detections", "per frame", "with a range", "nearest", "median", "farthest",
        "median σ / range", "saturated", "merged", "ghosts", "PSF of bright flares",
    )  # fmt: skip
    rows = []
    for name, by_frame in found.items():
        flares = [flare for listed in by_frame.values() for flare in listed]
        ranges_m = sorted(flare.range_m for flare in flares if math.isfinite(flare.range_m))
        shares = [flare.range_sigma_m / flare.range_m for flare in flares if _is_ranged(flare)]
        ends = (ranges_m[0], float(np.median(ranges_m)), ranges_m[-1]) if ranges_m else (None, None, None)
        width_px = seen[name].psf_sigma_px
        rows.append([
            name, str(len(flares)), f"{len(flares) / len(keys):.2f}", str(len(ranges_m)), *map(metres, ends),
            share(float(np.median(shares))) if shares else "–",
            *(str(sum(getattr(flare, flag) for flare in flares)) for flag in _FLAGS),
            f"{width_px:.2f} px" if math.isfinite(width_px) else "–",
        ])  # fmt: skip
    return Table(headings, rows)


def _is_ranged(flare: Detection) -> bool:
    return math.isfinite(flare.range_m) and math.isfinite(flare.range_sigma_m) and flare.range_m > 0.0


def _shown(keys: Sequence[FrameKey], found: Found) -> list[FrameKey]:
    """Return of several cameras the frame with the most detections each; of one, frames spread over time."""
    cameras = cameras_of(keys)
    if len(cameras) == 1:
        return spread(keys, _WHOLES)
    return [
        max(
            (key for key in keys if key[0] == camera),
            key=lambda key: sum(len(by_frame.get(key, ())) for by_frame in found.values()),
        )
        for camera in cameras[:MOST_CAMERAS]
    ]


def _whole(
    frame: RawFrame, calibration: Calibration, found: Mapping[str, Sequence[Detection]], names: Sequence[str]
) -> SeenFrame:
    rows, columns = frame.data_dn.shape
    grey = whole_picture(frame, calibration, max(1, round(columns / _WHOLE_WIDTH_PX)))
    done, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    unit_px = columns / 100.0
    labelled = next((name for name in ("robust", *names) if name in names), "")
    said = [(one.u_px, one.v_px, _range_text(one)) for one in found.get(labelled, ())[:_MOST_LABELS]]
    return SeenFrame(
        camera=frame.camera,
        index=frame.index,
        caption=f"frame {frame.index} · {frame.time_s:.2f} s · exposed {frame.exposure_s * 1e3:.3g} ms · "
        + ", ".join(f"{name} {len(listed)}" for name, listed in found.items()),
        image=Image(data_uri(jpeg.tobytes(), "image/jpeg"), -0.5, -0.5, columns, rows),
        unit_px=unit_px,
        marks=tuple(_mark(name, one, 1.8 * unit_px) for name, listed in found.items() for one in listed),
        labels=tuple(labels_of(said, columns, rows)),
    )


def _closes(
    found: Found, load: Callable[[FrameKey], RawFrame], calibrations: Mapping[str, Calibration]
) -> list[SeenFlare]:
    """Show what was found from near to far, by robust where it looked."""
    names = list(found)
    chosen = next((name for name in ("robust", *names) if name in found), None)
    flares = [] if chosen is None else [one for listed in found[chosen].values() for one in listed]
    flares.sort(key=lambda one: (math.isnan(one.range_m), one.range_m))
    return [
        _close(one, load((one.camera, one.index)), calibrations[one.camera], found)
        for one in spread(flares, _CLOSE_UPS)
    ]


def _close(flare: Detection, frame: RawFrame, calibration: Calibration, found: Found) -> SeenFlare:
    half = _CLOSE_UP_HALF_PX
    rows, columns = frame.data_dn.shape
    column = min(max(round(flare.u_px), 0), columns - 1)
    row = min(max(round(flare.v_px), 0), rows - 1)
    left, top = max(0, column - half), max(0, row - half)
    crop = frame.data_dn[top : row + half + 1, left : column + half + 1]
    picture = tone_map(crop, frame.black_level_dn, float(calibration.saturation_dn))
    marks, lines = [], []
    for name, by_frame in found.items():
        there = by_frame.get((flare.camera, flare.index), ())
        near = [one for one in there if math.hypot(one.u_px - flare.u_px, one.v_px - flare.v_px) <= half]
        marks += [_mark(name, one, 0.22 * half) for one in near]
        closest = min(
            near, key=lambda one: math.hypot(one.u_px - flare.u_px, one.v_px - flare.v_px), default=None
        )
        said = "not found" if closest is None else f"{_range_text(closest)}{_flags(closest)}"
        lines.append(Line(f"{name} {said}", look(name, list(found)).colour))
    return SeenFlare(
        box=f"{flare.u_px - half:.2f} {flare.v_px - half:.2f} {2 * half} {2 * half}",
        image=Image(png_uri(picture), left - 0.5, top - 0.5, crop.shape[1], crop.shape[0]),
        marks=tuple(marks),
        lines=tuple(lines),
        frame=f"{flare.camera} {flare.index}",
    )


def _mark(name: str, one: Detection, size_px: float) -> Mark:
    hint = f"{name}: {_range_text(one)} at ({one.u_px:.2f}, {one.v_px:.2f}) px{_flags(one)}"
    return Mark(name, one.u_px, one.v_px, size_px, hint)


def _range_text(one: Detection) -> str:
    if not math.isfinite(one.range_m):
        return "no range"
    return f"{one.range_m:.3f} m" if not _is_ranged(one) else f"{one.range_m:.3f} ± {one.range_sigma_m:.3f} m"


def _flags(one: Detection) -> str:
    return "".join(f" ({flag})" for flag in _FLAGS if getattr(one, flag))


def _range_plot(found: Found) -> Drawing | None:
    """Draw ranges with their σ over time; None where nothing was ranged."""
    names = list(found)
    flares = {
        name: [one for listed in by_frame.values() for one in listed if math.isfinite(one.range_m)]
        for name, by_frame in found.items()
    }
    if not any(flares.values()):
        return None
    with rc_context(MATPLOTLIB):
        figure = sheet(3.6)
        axes = figure.subplots()
        for name, listed in flares.items():
            if not listed:
                continue
            shape = look(name, names)
            sigma_m = np.nan_to_num([one.range_sigma_m for one in listed])
            axes.errorbar(
                [one.time_s for one in listed],
                [one.range_m for one in listed],
                yerr=sigma_m,
                fmt=shape.marker,
                color=shape.colour,
                markersize=5,
                fillstyle="none",
                elinewidth=0.8,
                label=name,
            )
        axes.set_xlabel("start of exposure, s")
        axes.set_ylabel("range, m")
        axes.set_ylim(bottom=0.0)
        legend(axes)
        return Drawing(svg_of(figure), "range of each detection, with its σ, over time")


def _rows(keys: Sequence[FrameKey], found: Found) -> Table:
    headings = ("frame", "estimator", "place", "range", "azimuth", "elevation", "flux", "")
    rows: list[list[str]] = []
    for key in keys:
        for name, by_frame in found.items():
            for one in by_frame.get(key, ()):
                if len(rows) == _MOST_ROWS:
                    return Table(headings, rows)
                rows.append([
                    f"{one.camera} {one.index}", name, f"{one.u_px:.2f}, {one.v_px:.2f} px", _range_text(one),
                    *_angles(one), f"{one.flux_dn:.4g} DN", _flags(one).strip(),
                ])  # fmt: skip
    return Table(headings, rows)


def _angles(one: Detection) -> tuple[str, str]:
    x, y, z = one.bearing_body
    if math.isnan(x):
        return "–", "–"
    degrees = math.degrees(math.atan2(y, x)), math.degrees(math.asin(max(-1.0, min(1.0, z))))
    return f"{degrees[0]:+.2f}°".replace("-", "−"), f"{degrees[1]:+.2f}°".replace("-", "−")


_CALIBRATED = (
    "width_px",
    "height_px",
    "fx_px",
    "cx_px",
    "cy_px",
    "psf_sigma_px",
    "system_gain_dn_per_e",
    "read_noise_e",
    "black_level_dn",
    "saturation_dn",
    "bit_depth",
    "range_constant_dn_m2_per_s",
    "source_radius_m",
)


def _cameras(cameras: Sequence[str], calibrations: Mapping[str, Calibration]) -> Table:
    rows = []
    for field in _CALIBRATED:
        cells = []
        for camera in cameras:
            value, sigma = getattr(calibrations[camera], field), calibrations[camera].sigma.get(field)
            cells.append(f"{value:.5g}" + ("" if not sigma else f" ± {sigma:.2g}"))
        rows.append([field, *cells])
    return Table(["calibration", *cameras], rows)
