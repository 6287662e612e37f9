"""Frames that hold no source: lamps, sheen, sun patches, blinds, structure, bad pixels. All that is told is false."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

import perception
from tests.hard_frames.scores import BACKGROUND_E, CELL_PX, EXPOSURE_S, POINT, Array, cell_centres
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, expose, random


def bad_pixels(
    stuck: int, hot: int, frames: int = 4, estimator: str = "robust", first: int = 0
) -> dict[str, Any]:
    """Pixels stuck at full scale and hot ones of 500 to 30 000 e⁻, and nothing else."""
    camera = replace(POINT, bit_depth=12, saturation_dn=4095)
    alarms = 0
    for index in range(first, first + frames):
        generator = random(7, index)
        mean_e = np.full((camera.height_px, camera.width_px), BACKGROUND_E)
        places = generator.choice(mean_e.size, stuck + hot, replace=False)
        mean_e.flat[places[:stuck]] = 1e6
        mean_e.flat[places[stuck:]] = 10.0 ** generator.uniform(2.7, 4.5, hot)
        frame = expose(mean_e, camera, random(8, index), EXPOSURE_S)
        alarms += len(perception.detect(frame, camera, estimator))
    return {
        "frames": frames, "false_alarms": alarms, "false_alarms_per_frame": alarms / frames,
        "pixels_per_frame": stuck + hot,
    }  # fmt: skip


def lamps(
    frames: int = 4,
    estimator: str = "robust",
    first: int = 0,
    source_radius_m: float = 1e-6,
    per_frame: int = 49,
) -> dict[str, Any]:
    """Evenly bright rectangles and ovals of 6 to 50 px, a third of them clipped, and nothing else.

    Counted apart are those that are as bright as a source within a quarter, and as round within a fifth.
    """
    camera = replace(POINT, bit_depth=12, saturation_dn=4095, source_radius_m=source_radius_m)
    parts = 8
    within = (np.arange(parts * CELL_PX) + 0.5) / parts - 0.5 * CELL_PX  # from a cell's middle
    alarms = count = like_sources = 0
    ball_e = math.inf
    if source_radius_m > 1e-3:
        ball_e = FLUX_PER_S_AT_1_M * EXPOSURE_S / (math.pi * (camera.fx_px * source_radius_m) ** 2)
    for index in range(first, first + frames):
        alike: list[tuple[float, float]] = []
        generator = random(12, index)
        mean_e = np.full((camera.height_px, camera.width_px), BACKGROUND_E)
        for cell, (u, v) in enumerate(cell_centres(1)):
            half_u, half_v = 0.5 * 10.0 ** generator.uniform(0.8, 1.7, 2)
            level_e = 10.0 ** generator.uniform(2.0, 4.2)
            du, dv = generator.uniform(-0.5, 0.5, 2)
            is_oval = generator.random() < 0.5
            if (cell - index) % (49 // per_frame):
                continue
            x, y = (within - du) / half_u, (within[:, None] - dv) / half_v
            inside = np.hypot(x, y) < 1.0 if is_oval else np.maximum(abs(x), abs(y)) < 1.0
            covered = inside.reshape(CELL_PX, parts, CELL_PX, parts).mean(axis=(1, 3))  # no stairs
            top, left = round(v + 0.5) - CELL_PX // 2, round(u + 0.5) - CELL_PX // 2
            mean_e[top : top + CELL_PX, left : left + CELL_PX] += level_e * covered
            count += 1
            cosine2 = 1.0 / (1.0 + ((u - camera.cx_px) ** 2 + (v - camera.cy_px) ** 2) / camera.fx_px**2)
            of_ball, round_as = level_e / (ball_e * cosine2**2), half_u / half_v
            if is_oval and 1.0 / 1.25 < of_ball < 1.25 and 1.0 / 1.2 < round_as < 1.2:
                alike.append((u, v))
        frame = expose(gaussian_filter(mean_e, camera.psf_sigma_px), camera, random(13, index), EXPOSURE_S)
        found = perception.detect(frame, camera, estimator)
        near = [any(math.hypot(one.u_px - u, one.v_px - v) < 2.0 for u, v in alike) for one in found]
        like_sources += sum(near)
        alarms += len(found) - sum(near)
    return {
        "frames": frames, "lamps": count, "reported": alarms, "reported_share": alarms / count,
        "reported_as_round_and_bright_as_sources": like_sources,
    }  # fmt: skip


def _covered(inside_px: Array) -> Array:
    """Return what share of pixels is lit, by how far their middles lie within an edge: without stairs."""
    return np.clip(inside_px + 0.5, 0.0, 1.0)


def empty(
    kind: str, frames: int = 4, estimator: str = "robust", first: int = 0, times: float = 1.0
) -> dict[str, Any]:
    """Frames that hold no source: sheen, sun patches, blinds, or texture of 3 to 20 %, 4 to 30 px.

    With more `times` the light most of them clip, where sources are balls of 1 cm.
    """
    alarms = 0
    camera = POINT
    if times != 1.0:
        camera = replace(POINT, bit_depth=12, saturation_dn=4095, source_radius_m=0.01)
    size = (POINT.height_px, POINT.width_px)
    rows, columns = np.indices(size, dtype=np.float64)
    for index in range(first, first + frames):
        generator = random(16, len(kind), index)
        mean_e = np.full(size, 10.0 ** generator.uniform(1.0, 3.0))
        if kind == "texture":
            hills = gaussian_filter(
                generator.normal(size=size), 10.0 ** generator.uniform(0.6, 1.48), mode="wrap"
            )
            mean_e *= np.maximum(1.0 + 10.0 ** generator.uniform(-1.52, -0.7) * hills / hills.std(), 0.05)
        for _ in range(12):
            u, v = generator.random(2) * size[::-1]
            turn, level = generator.uniform(0.0, math.pi), 10.0 ** generator.uniform(2.0, 3.7)
            x = (columns - u) * math.cos(turn) + (rows - v) * math.sin(turn)
            y = (rows - v) * math.cos(turn) - (columns - u) * math.sin(turn)
            if kind == "sheen":  # a glossy lobe, 3 to 30 px wide and longer than wide
                width = 10.0 ** generator.uniform(0.5, 1.5)
                mean_e += (
                    level / (1.0 + (x / width) ** 2 + (y / (width * generator.uniform(1.0, 4.0))) ** 2) ** 1.5
                )
            if kind == "sun patches":
                half_x, half_y = 10.0 ** generator.uniform(0.7, 2.0, 2)
                mean_e += (
                    level
                    * _covered(half_x - abs(x))
                    * _covered((half_y - abs(y + 0.3 * x)) / math.hypot(1.0, 0.3))
                )
        if kind == "blinds":
            turn, period_px = generator.uniform(-0.3, 0.3), generator.uniform(6.0, 25.0)
            phase = (rows + turn * columns) / period_px % 1.0
            inside_px = (0.25 - abs((phase + 0.25) % 1.0 - 0.5)) * period_px / math.hypot(1.0, turn)
            level = 10.0 ** generator.uniform(2.0, 3.5)
            mean_e += level * _covered(inside_px) * _covered(200.0 - abs(columns - 280))
        mean_e = gaussian_filter(times * mean_e, camera.psf_sigma_px)
        frame = expose(mean_e, camera, random(17, len(kind), index), EXPOSURE_S)
        alarms += len(perception.detect(frame, camera, estimator))
    return {"frames": frames, "false_alarms": alarms, "false_alarms_per_frame": alarms / frames}
