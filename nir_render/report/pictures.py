"""Frames within a page: a grey picture, and over it, as SVG, truth and what each estimator found."""

import base64
from collections.abc import Callable, Mapping, Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.match import image_radius_px
from nir_render.evaluate.metrics import Evaluation, FrameKey, Score
from nir_render.report.frames import cameras_of, key_of, spread, whole_picture
from nir_render.report.style import BAD, TRUTH, look
from nir_render.report.wording import counted, metres
from perception.picture import tone_map
from perception.types import Calibration, Detection, RawFrame

MOST_CAMERAS = 8
_CLOSE_UPS = 10
_CLOSE_UP_HALF_PX = 14
_WHOLE_WIDTH_PX = 720
"""About the width at which a frame stands in the page, for screens of double density: it bounds the size."""


def whole_figures(
    keys: Sequence[FrameKey],
    result: Evaluation,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
) -> str:
    """Show of each camera, of eight at most, the frame with the most sources that count and false alarms.

    Of one camera alone, the first frame and the last.
    """
    cameras = cameras_of(keys)
    chosen = spread(keys, 2) if len(cameras) == 1 else [_fullest(keys, result, c) for c in cameras]
    names = list(result.summary["estimators"])
    figures = []
    for key in chosen[:MOST_CAMERAS]:
        frame, calibration = load(key), calibrations[key[0]]
        scores = [score for score in (*result.scores, *result.ghosts) if key_of(score) == key]
        false_alarms = {
            name: [found for found in alarms if (found.camera, found.index) == key]
            for name, alarms in result.false_alarms.items()
        }
        figures.append(_whole(frame, calibration, scores, false_alarms, names))
    return "\n".join(figures)


def close_up_figures(
    result: Evaluation, load: Callable[[FrameKey], RawFrame], calibrations: Mapping[str, Calibration]
) -> str:
    """Show close-ups of sources that count, from the nearest to the farthest, with what was said of them."""
    counting = sorted(
        (score for score in result.scores if score.countable), key=lambda score: score.truth.range_m
    )
    names = list(result.summary["estimators"])
    return "\n".join(
        _close_up(load(key_of(score)), calibrations[score.truth.camera], score, names)
        for score in spread(counting, _CLOSE_UPS)
    )


def marker_svg(name: str, names: Sequence[str], x: float, y: float, size: float) -> str:
    """Draw an estimator's mark around a place."""
    marker, colour = look(name, names)
    h = 0.5 * size
    shapes = {
        "s": f"M{x - h:.2f} {y - h:.2f}h{size:.2f}v{size:.2f}h{-size:.2f}z",
        "+": f"M{x - h:.2f} {y:.2f}h{size:.2f}M{x:.2f} {y - h:.2f}v{size:.2f}",
        "x": f"M{x - h:.2f} {y - h:.2f}l{size:.2f} {size:.2f}m{-size:.2f} 0l{size:.2f} {-size:.2f}",
        "D": f"M{x:.2f} {y - h:.2f}l{h:.2f} {h:.2f}l{-h:.2f} {h:.2f}l{-h:.2f} {-h:.2f}z",
        "^": f"M{x:.2f} {y - h:.2f}l{h:.2f} {size:.2f}h{-size:.2f}z",
        "v": f"M{x:.2f} {y + h:.2f}l{h:.2f} {-size:.2f}h{-size:.2f}z",
    }
    return f'<path d="{shapes[marker]}" stroke="{colour}" class="mark"/>'


def _whole(
    frame: RawFrame,
    calibration: Calibration,
    scores: Sequence[Score],
    false_alarms: Mapping[str, Sequence[Detection]],
    names: Sequence[str],
) -> str:
    rows, columns = frame.data_dn.shape
    block_px = max(1, round(columns / _WHOLE_WIDTH_PX))
    # Everything is drawn in units of the frame's pixels; marks grow with the frame so that they can be seen.
    unit = columns / 100.0
    parts = [_image(whole_picture(frame, calibration, block_px), ".jpg", -0.5, -0.5, columns, rows)]
    for score in scores:
        truth = score.truth
        u, v = truth.u_px, truth.v_px
        radius = max(1.6 * unit, 1.2 * image_radius_px(truth, calibration))
        faint = "" if score.countable else ' stroke-dasharray="3 3"'
        hint, label = _named(score)
        to_the_left = u > 0.82 * columns
        x = u - 1.4 * radius if to_the_left else u + 1.4 * radius
        parts.append(
            f'<g><title>{escape(hint)}</title><circle cx="{u:.2f}" cy="{v:.2f}" r="{radius:.2f}" '
            f'stroke="{TRUTH}" class="mark"{faint}/>'
            f'<text x="{x:.2f}" y="{v - 0.8 * unit:.2f}" font-size="{2.3 * unit:.2f}" fill="{TRUTH}" '
            f'text-anchor="{"end" if to_the_left else "start"}">'
            f"{escape(label)}</text></g>"
        )
        for name, said in score.detections.items():
            parts.append(_said_mark(name, names, said, 1.8 * unit))
    for name, alarms in false_alarms.items():
        for said in alarms:
            parts.append(_said_mark(name, names, said, 1.8 * unit, "false alarm, "))
            parts.append(
                f'<circle cx="{said.u_px:.2f}" cy="{said.v_px:.2f}" r="{2.2 * unit:.2f}" '
                f'stroke="{BAD}" class="mark" stroke-dasharray="2 2"/>'
            )
    alarms_here = sum(map(len, false_alarms.values()))
    said_of_alarms = f" · {counted(alarms_here, 'false alarm')}" if alarms_here else ""
    box = f"-0.5 -0.5 {columns} {rows}"
    return (
        f'<figure><svg viewBox="{box}" role="img" aria-label="frame {frame.index} of {escape(frame.camera)}">'
        f"{''.join(parts)}</svg>"
        f"<figcaption><b>{escape(frame.camera)}</b> frame {frame.index} · {frame.time_s:.2f} s · exposed "
        f"{frame.exposure_s * 1e3:.3g} ms{said_of_alarms}</figcaption></figure>"
    )


def _named(score: Score) -> tuple[str, str]:
    """Return what is told of a source or ghost when pointed at, and what stands beside it."""
    truth = score.truth
    if truth.ghost_of is not None:
        return f"mirror image of {truth.ghost_of}, {truth.range_m:.3f} m away", f"ghost of {truth.robot}"
    hint = f"{truth.robot}.{truth.source}, true range {truth.range_m:.3f} m"
    faint = "" if score.countable else " (too faint or hidden to count)"
    return hint + faint, f"{truth.robot} {metres(truth.range_m)}"


def _close_up(frame: RawFrame, calibration: Calibration, score: Score, names: Sequence[str]) -> str:
    truth = score.truth
    radius = image_radius_px(truth, calibration)
    half = max(_CLOSE_UP_HALF_PX, round(1.5 * radius))
    left, top = round(truth.u_px) - half, round(truth.v_px) - half
    rows, columns = frame.data_dn.shape
    right, bottom = min(columns, left + 2 * half + 1), min(rows, top + 2 * half + 1)
    left, top = max(0, left), max(0, top)
    crop = tone_map(
        frame.data_dn[top:bottom, left:right], frame.black_level_dn, float(calibration.saturation_dn)
    )
    place = f'cx="{truth.u_px:.2f}" cy="{truth.v_px:.2f}" r="{radius:.2f}"'
    parts = [
        _image(crop, ".png", left - 0.5, top - 0.5, right - left, bottom - top),
        f'<circle {place} class="mark" stroke="{TRUTH}"/>',
    ]
    lines = [f'<span style="color:{TRUTH}">true {truth.range_m:.3f} m</span>']
    for name in names:
        said = score.detections.get(name)
        heard = "not found" if said is None else f"{said.range_m:.3f} m".replace("nan m", "no range")
        lines.append(f'<span style="color:{look(name, names).colour}">{escape(name)} {heard}</span>')
        if said is not None:
            parts.append(_said_mark(name, names, said, 0.22 * half))
    box = f"{truth.u_px - half:.2f} {truth.v_px - half:.2f} {2 * half} {2 * half}"
    return (
        f'<figure><svg viewBox="{box}" class="pixels" role="img" aria-label="close-up of a source">'
        f"{''.join(parts)}</svg><figcaption>{'<br>'.join(lines)}<br>"
        f'<span class="faint">{escape(truth.camera)} {truth.index}</span></figcaption></figure>'
    )


def _said_mark(name: str, names: Sequence[str], said: Detection, size: float, prefix: str = "") -> str:
    hint = f"{prefix}{name}: {said.range_m:.3f} m at ({said.u_px:.2f}, {said.v_px:.2f}) px"
    return f"<g><title>{escape(hint)}</title>{marker_svg(name, names, said.u_px, said.v_px, size)}</g>"


def _fullest(keys: Sequence[FrameKey], result: Evaluation, camera: str) -> FrameKey:
    """Return the camera's frame with the most sources that count and false alarms; the first among equals."""
    count = {key: 0 for key in keys if key[0] == camera}
    told = [key_of(score) for score in result.scores if score.countable]
    told += [(said.camera, said.index) for alarms in result.false_alarms.values() for said in alarms]
    for key in told:
        if key in count:
            count[key] += 1
    return max(count, key=lambda key: count[key])


def _image(picture: NDArray[np.uint8], kind: str, x: float, y: float, width: float, height: float) -> str:
    options = [cv2.IMWRITE_JPEG_QUALITY, 85] if kind == ".jpg" else []
    done, buffer = cv2.imencode(kind, picture, options)
    if not done:
        raise RuntimeError(f"OpenCV could not encode a picture as {kind}")
    mime = {".jpg": "image/jpeg", ".png": "image/png"}[kind]
    data = base64.b64encode(buffer.tobytes()).decode()
    return (
        f'<image x="{x}" y="{y}" width="{width}" height="{height}" preserveAspectRatio="none" '
        f'href="data:{mime};base64,{data}"/>'
    )
