"""Crowds of near sources, nearer ones before farther ones: identical spheres show the union of their discs."""

import math
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

import perception
from perception.types import Calibration, Detection
from tests.hard_frames.scores import BACKGROUND_E, POINT, Array, paired, rms
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, expose, random

RADIUS_M = 0.01
NEAREST_M, FARTHEST_M = 0.4, 3.0
MARGIN_PX = 50
MOSTLY_HIDDEN = 0.4  # share of a disc: of those of which less is seen nothing is asked

Place = tuple[float, float, float]

_FINE = 8


def near_crowd(
    number: int, exposure_s: float, frames: int = 2, estimator: str = "robust", first: int = 0
) -> dict[str, Any]:
    """Balls of 1 cm at .4 to 3 m, anywhere in a frame of 1280 × 960, none of which touches another."""
    camera = replace(
        POINT, width_px=1280, height_px=960, cx_px=639.5, cy_px=479.5, source_radius_m=RADIUS_M,
        bit_depth=12, saturation_dn=4095,
    )  # fmt: skip
    asked = lost = hidden = false_alarms = bounds = beyond = 0
    spent_ms, pulls = [], []
    for index in range(first, first + frames):
        balls = _apart(number, camera, random(25, number, index))
        mean_e_per_s, seen = union_of_discs(balls, camera)
        frame = expose(mean_e_per_s * exposure_s + BACKGROUND_E, camera, random(26, index), exposure_s)
        started = time.perf_counter()
        found = perception.detect(frame, camera, estimator)
        spent_ms.append(1e3 * (time.perf_counter() - started))
        hits = _paired(balls, list(found), camera)
        false_alarms += len(found) - sum(hit is not None for hit in hits)
        for (_, _, range_m), share, hit in zip(balls, seen.tolist(), hits, strict=True):
            asked, hidden = asked + (share >= MOSTLY_HIDDEN), hidden + (share < MOSTLY_HIDDEN)
            if hit is None:
                lost += share >= MOSTLY_HIDDEN
            elif math.isfinite(hit.range_sigma_m):
                pulls.append((hit.range_m - range_m) / hit.range_sigma_m)
                beyond += abs(pulls[-1]) > 5.0
            else:
                bounds += 1
    return {
        "frames": frames, "balls": asked, "lost": lost, "mostly_hidden": hidden, "false_alarms": false_alarms,
        "only_bounds": bounds, "pull_rms": rms(pulls), "beyond_5_sigma": beyond,
        "ms_per_frame": round(float(np.median(spent_ms)), 1),
    }  # fmt: skip


def _apart(number: int, camera: Calibration, generator: np.random.Generator) -> list[Place]:
    """Return places (u, v, range) of spheres that do not touch."""
    places: list[Place] = []
    middles: list[Array] = []
    while len(places) < number:
        a, b, c = generator.random(3).tolist()
        u = MARGIN_PX + (camera.width_px - 2 * MARGIN_PX) * a
        v = MARGIN_PX + (camera.height_px - 2 * MARGIN_PX) * b
        range_m = NEAREST_M * (FARTHEST_M / NEAREST_M) ** c
        middle = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
        middle *= range_m / np.linalg.norm(middle)
        if all(np.linalg.norm(middle - other) > 2.1 * RADIUS_M for other in middles):
            places.append((u, v, range_m))
            middles.append(middle)
    return places


def union_of_discs(balls: list[Place], camera: Calibration) -> tuple[Array, Array]:
    """Return the mean frame a second, and what share of each ball is seen: by brute force, farther ones first."""
    height, width = camera.height_px * _FINE, camera.width_px * _FINE
    lit = np.zeros((height, width), dtype=np.float32)
    owner = np.full((height, width), -1, dtype=np.int16)
    whole = np.zeros(len(balls))
    for k in sorted(range(len(balls)), key=lambda k: -balls[k][2]):
        u, v, range_m = balls[k]
        middle = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
        middle /= np.linalg.norm(middle)
        reach_px = 1.3 * camera.fx_px * RADIUS_M / range_m / middle[2] ** 2 + 3.0
        top, bottom = (
            min(max(math.floor((v + 0.5 + way) * _FINE), 0), height) for way in (-reach_px, reach_px)
        )
        left, right = (
            min(max(math.floor((u + 0.5 + way) * _FINE), 0), width) for way in (-reach_px, reach_px)
        )
        x = ((np.arange(left, right) + 0.5) / _FINE - 0.5 - camera.cx_px) / camera.fx_px
        y = ((np.arange(top, bottom) + 0.5) / _FINE - 0.5 - camera.cy_px)[:, None] / camera.fy_px
        depth = (x * middle[0] + y * middle[1] + middle[2]) / np.sqrt(x**2 + y**2 + 1.0)
        depth -= math.sqrt(1.0 - (RADIUS_M / range_m) ** 2)
        down, across = np.gradient(depth)
        covered = np.clip(0.5 + depth / (abs(down) + abs(across)).clip(1e-300), 0.0, 1.0)
        here = np.s_[top:bottom, left:right]
        lit[here] = np.maximum(lit[here], covered)
        owner[here][covered > 0.5] = k
        whole[k] = np.count_nonzero(covered > 0.5)
    seen = np.bincount(owner[owner >= 0], minlength=len(balls)) / whole
    x = ((np.arange(width) + 0.5) / _FINE - 0.5 - camera.cx_px) / camera.fx_px
    y = ((np.arange(height) + 0.5) / _FINE - 0.5 - camera.cy_px)[:, None] / camera.fy_px
    lit /= ((x**2 + y**2 + 1.0) ** 2).astype(np.float32)  # cos⁴ θ
    lit *= np.float32(FLUX_PER_S_AT_1_M / (math.pi * RADIUS_M**2) / (camera.fx_px * _FINE) ** 2)
    blurred = np.asarray(cv2.GaussianBlur(lit, (0, 0), camera.psf_sigma_px * _FINE))
    summed = blurred.reshape(camera.height_px, _FINE, camera.width_px, _FINE).sum(axis=(1, 3))
    return summed.astype(np.float64), seen


def _paired(balls: list[Place], found: list[Detection], camera: Calibration) -> list[Detection | None]:
    """Pair balls and detections one to one, nearest first, within a pixel or half of a radius."""
    if not found:
        return [None] * len(balls)
    u_px, v_px, range_m = np.array(balls).T
    within_px = np.maximum(1.0, 0.5 * camera.fx_px * RADIUS_M / range_m)
    told = np.array([(one.u_px, one.v_px) for one in found])
    apart_px = np.hypot(told[:, 0] - u_px[:, None], told[:, 1] - v_px[:, None])
    return paired(apart_px / within_px[:, None], found, 1.0)
