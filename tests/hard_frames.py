"""Frames that are hard to read, and what an estimator makes of them: `python -m tests.hard_frames [ROW ...]`.

Prints one JSON object for each row: how many flares were found, how many detections are of nothing, errors of
place and flux over the bound that a lone flare or a pair of known number would have, and how true the claimed
sigmas are. The photons come from `tests.unit.perception.simulation`, which shares no code with `perception`;
pairs have a bound of their own here, from numerical derivatives of that simulator.

What counts as found: detections and flares are paired one to one, nearest first, within half the distance of the
pair, and within 1 px elsewhere. What is left over of the detections are false alarms.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist
from scipy.special import erf

import perception
from perception.types import Calibration, Detection, RawFrame
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, calibration, expected_e, expose, random

Array = NDArray[np.float64]

EXPOSURE_S = 1e-3
CELL_PX = 64
CELLS = 9
POINT = replace(
    calibration(
        width_px=CELLS * CELL_PX, height_px=CELLS * CELL_PX, cx_px=0.5 * CELLS * CELL_PX, cy_px=0.5 * CELLS * CELL_PX,
        source_radius_m=1e-6, read_noise_e=4.6, bit_depth=16, saturation_dn=65535, sigma={},
    )
)  # fmt: skip
"""A camera whose dark pixels have 4.6² + 1/(12·0.74²) ≈ 21.3 e⁻², 24 with 2.7 e⁻ of background; sources are points."""

BACKGROUND_E = 2.7
BRIGHT_E = 1.3e4
HALOGEN_E_PER_S_LUX = 93.9
"""Electrons a second, pixel and lux of the preset camera before walls that halogen lights."""


@dataclass(frozen=True)
class Flare:
    """A flare as it is: place and flux."""

    u_px: float
    v_px: float
    flux_e: float

    def source(self, camera: Calibration) -> tuple[float, float, float]:
        """Return place and range of a source that has this flux."""
        x, y = (self.u_px - camera.cx_px) / camera.fx_px, (self.v_px - camera.cy_px) / camera.fy_px
        cosine = 1.0 / math.sqrt(1.0 + x * x + y * y)
        return self.u_px, self.v_px, math.sqrt(FLUX_PER_S_AT_1_M * EXPOSURE_S * cosine / self.flux_e)


@dataclass(frozen=True, eq=False)
class Scored:
    """A frame's flares in the order given, the detection of each or None, and the detections of nothing."""

    flares: Sequence[Flare]
    hits: Sequence[Detection | None]
    false_alarms: Sequence[Detection]


def frame_of(
    flares: Sequence[Flare], camera: Calibration, background_e: float | Array, *key: int
) -> RawFrame:
    """Return a frame of flares on a background."""
    mean_e = expected_e(camera, [flare.source(camera) for flare in flares], EXPOSURE_S) + background_e
    return expose(mean_e, camera, random(*key), EXPOSURE_S)


def score(flares: Sequence[Flare], found: Sequence[Detection], within_px: float) -> Scored:
    """Pair flares and detections one to one, nearest first, within a distance."""
    hits: list[Detection | None] = [None] * len(flares)
    left = set(range(len(found)))
    if flares and found:
        apart = cdist([(f.u_px, f.v_px) for f in flares], [(d.u_px, d.v_px) for d in found])
        for flat in np.argsort(apart, axis=None):
            i, j = divmod(int(flat), len(found))
            if not apart[i, j] <= within_px:
                break
            if hits[i] is None and j in left:
                hits[i] = found[j]
                left.remove(j)
    return Scored(flares, hits, [found[j] for j in sorted(left)])


def cell_centres(inner: int = 0) -> Iterator[tuple[float, float]]:
    """Yield the centres of cells, row by row, `inner` of them left out at each edge."""
    for row in range(inner, CELLS - inner):
        for column in range(inner, CELLS - inner):
            yield (column + 0.5) * CELL_PX - 0.5, (row + 0.5) * CELL_PX - 0.5


# --- bounds ---


def pair_sigmas(first: Flare, second: Flare, camera: Calibration, background_e: float) -> Array:
    """Return the Cramér–Rao sigmas of (u, v, ln F) of two points, seven parameters free; shape (2, 3).

    The image of a point is a Gaussian over pixels, ½ erf differences; derivatives are differences too.
    """
    left, top = (round(0.5 * (a + b)) - 20 for a, b in ((first.u_px, second.u_px), (first.v_px, second.v_px)))

    def image(values: Array) -> Array:
        total = np.zeros((41, 41))
        for u, v, log_flux in values.reshape(2, 3):
            shares = [
                0.5
                * np.diff(erf((np.arange(42) - 0.5 + start - at) / (math.sqrt(2.0) * camera.psf_sigma_px)))
                for start, at in ((top, v), (left, u))
            ]
            total += math.exp(log_flux) * np.outer(*shares)
        return total.ravel()

    place = np.array([[flare.u_px, flare.v_px, math.log(flare.flux_e)] for flare in (first, second)]).ravel()
    slopes = [(image(place + step) - image(place - step)) / 2e-3 for step in 1e-3 * np.eye(6)]
    jacobian = np.stack([*slopes, np.ones(41 * 41)])
    rounding_e2 = 1.0 / (12.0 * camera.system_gain_dn_per_e**2)
    variance = image(place) + background_e + camera.read_noise_e**2 + rounding_e2
    information = (jacobian / variance) @ jacobian.T
    return np.sqrt(np.diagonal(np.linalg.inv(information)))[:6].reshape(2, 3)


# --- rows ---


def pairs(apart_px: float, ratio: float = 1.0, frames: int = 4, estimator: str = "robust") -> dict[str, Any]:
    """Two flares at a distance, in any direction, one `ratio` times as bright as the other."""
    random_number = random(1, round(1000 * apart_px), round(1000 * ratio))
    scored, both, pulls, over_bound = [], [], [], []
    for index in range(frames):
        couples = []
        for u, v in cell_centres():
            turn, du, dv = random_number.random(3) * (2.0 * math.pi, 1.0, 1.0)
            x, y = 0.5 * apart_px * math.cos(turn), 0.5 * apart_px * math.sin(turn)
            couples += [
                Flare(u + du - x, v + dv - y, BRIGHT_E),
                Flare(u + du + x, v + dv + y, BRIGHT_E / ratio),
            ]
        frame = frame_of(couples, POINT, BACKGROUND_E, 2, index, round(1000 * apart_px), round(1000 * ratio))
        result = score(couples, perception.detect(frame, POINT, estimator), 0.5 * apart_px)
        scored.append(result)
        for k in range(0, len(couples), 2):
            hits = result.hits[k : k + 2]
            both.append(all(hit is not None for hit in hits))
            if not both[-1]:
                continue
            sigmas = pair_sigmas(couples[k], couples[k + 1], POINT, BACKGROUND_E)
            for flare, hit, sigma in zip(couples[k : k + 2], hits, sigmas, strict=True):
                assert hit is not None
                flux_e = hit.flux_dn / POINT.system_gain_dn_per_e
                errors = (
                    hit.u_px - flare.u_px,
                    hit.v_px - flare.v_px,
                    math.log(max(flux_e, 1.0) / flare.flux_e),
                )
                over_bound.append(np.array(errors) / sigma)
                pulls.append([errors[0] / hit.u_sigma_px, errors[1] / hit.v_sigma_px])
    return {
        **_counts(scored),
        "both": _share(both),
        "faint_found": _share([hit is not None for each in scored for hit in each.hits[1::2]]),
        "rmse_over_bound_u_v_flux": _rms(over_bound),
        "pull_rms_u_v": _rms(pulls),
    }


def lone(frames: int = 6, estimator: str = "robust", kernel: float = 1.0) -> dict[str, Any]:
    """Flares alone, through a point spread so many times as wide as calibrated: how often one is told as two."""
    scored, imaging = [], replace(POINT, psf_sigma_px=kernel * POINT.psf_sigma_px)
    for index in range(frames):
        places = random(3, index).random((CELLS * CELLS, 3))
        flares = [
            Flare(u + du, v + dv, 10.0 ** (3.0 + 2.0 * share))
            for (u, v), (du, dv, share) in zip(cell_centres(), places, strict=True)
        ]
        frame = frame_of(flares, imaging, BACKGROUND_E, 4, index)
        scored.append(score(flares, perception.detect(frame, POINT, estimator), 1.0))
    return _counts(scored)


def lone_sigmas(flare: Flare, camera: Calibration, background_e: float) -> Array:
    """Return the Cramér–Rao sigmas of (u, v, ln F) of a point far from all others, background free too."""
    far = Flare(flare.u_px + 15.0, flare.v_px + 15.0, flare.flux_e)
    return np.asarray(pair_sigmas(flare, far, camera, background_e)[0])


def lone_of(flux_e: float, frames: int = 4, estimator: str = "robust") -> dict[str, Any]:
    """Flares of one flux, anywhere in their pixels: errors of place and range over the bound, and claims."""
    camera = replace(POINT, bit_depth=12, saturation_dn=4095)
    scored, over_bound, pulls, errors = [], [], [], []
    for index in range(frames):
        places = random(18, index, round(flux_e)).random((CELLS * CELLS, 2))
        flares = [
            Flare(u + du, v + dv, flux_e) for (u, v), (du, dv) in zip(cell_centres(), places, strict=True)
        ]
        frame = frame_of(flares, camera, BACKGROUND_E, 19, index, round(flux_e))
        scored.append(score(flares, perception.detect(frame, camera, estimator), 1.0))
        for flare, hit in zip(flares, scored[-1].hits, strict=True):
            if hit is None:
                continue
            true_m = flare.source(camera)[2]
            error = np.array([hit.u_px - flare.u_px, hit.v_px - flare.v_px, hit.range_m / true_m - 1.0])
            errors.append(error)
            over_bound.append(error / (lone_sigmas(flare, camera, BACKGROUND_E) * (1.0, 1.0, 0.5)))
            pulls.append(error / (hit.u_sigma_px, hit.v_sigma_px, hit.range_sigma_m / hit.range_m))
    squares = np.square(np.array(pulls))
    return {
        **_counts(scored),
        "rmse_over_bound_u_v_range": _rms(over_bound),
        "bias_px_px_share": np.mean(errors, axis=0).round(6).tolist(),
        "mean_nees_of_3": round(float(squares.sum(axis=1).mean()), 3),
        "beyond_4_sigma": round(float(np.mean(squares > 16.0)), 6),
    }


def clipped(
    times: float, frames: int = 2, estimator: str = "robust", kernel_sigma: float = 0.0
) -> dict[str, Any]:
    """Points whose peak is so many times full scale; in each frame the kernel is off by what its σ says."""
    width_px = POINT.psf_sigma_px
    sigma = {"psf_sigma_px": kernel_sigma * width_px} if kernel_sigma else {}
    camera = replace(POINT, bit_depth=12, saturation_dn=4095, source_radius_m=1e-6, sigma=sigma)
    full_e = (4095 - camera.black_level_dn) / camera.system_gain_dn_per_e
    flux_e = times * full_e / math.erf(0.5 / (math.sqrt(2.0) * camera.psf_sigma_px)) ** 2
    scored = []
    for index in range(frames):
        places = random(5, index).random((CELLS * CELLS, 2)) - 0.5
        flares = [
            Flare(u + du, v + dv, flux_e) for (u, v), (du, dv) in zip(cell_centres(), places, strict=True)
        ]
        off = random(20, index).normal() * kernel_sigma
        imaging = replace(camera, psf_sigma_px=(1.0 + off) * width_px)
        frame = frame_of(flares, imaging, BACKGROUND_E, 6, index, round(times))
        scored.append(score(flares, perception.detect(frame, camera, estimator), 1.0))
    hits = [(flare, hit) for each in scored for flare, hit in zip(each.flares, each.hits, strict=True) if hit]
    claimed = [(flare, hit) for flare, hit in hits if math.isfinite(hit.range_sigma_m)]
    ranges = [flare.source(camera)[2] for flare, _ in claimed]
    errors = [hit.range_m / true - 1.0 for (_, hit), true in zip(claimed, ranges, strict=True)]
    pulls = [(hit.range_m - true) / hit.range_sigma_m for (_, hit), true in zip(claimed, ranges, strict=True)]
    return {
        **_counts(scored),
        "only_a_bound": _share([not math.isfinite(hit.range_sigma_m) for _, hit in hits]),
        "range_rmse_share": _rms(errors),
        "pull_rms": _rms(pulls),
        "greatest_pull": round(float(np.max(np.abs(pulls), initial=0.0)), 2),
    }


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


def textured(
    correlation_px: float, share: float = 0.1, frames: int = 4, estimator: str = "robust"
) -> dict[str, Any]:
    """A background of 1000 e⁻ with structure, and flares of SNR about 90 on it."""
    scored = []
    for index in range(frames):
        hills = gaussian_filter(
            random(9, index).normal(size=(POINT.height_px, POINT.width_px)), correlation_px, mode="wrap"
        )
        background_e = 1000.0 * np.maximum(1.0 + share * hills / hills.std(), 0.05)
        places = random(10, index).random((CELLS * CELLS, 2)) - 0.5
        flares = [Flare(u + du, v + dv, 2e4) for (u, v), (du, dv) in zip(cell_centres(), places, strict=True)]
        frame = frame_of(flares, POINT, background_e, 11, index, round(correlation_px))
        scored.append(score(flares, perception.detect(frame, POINT, estimator), 1.0))
    hits = [(flare, hit) for each in scored for flare, hit in zip(each.flares, each.hits, strict=True) if hit]
    pulls = [[(h.u_px - f.u_px) / h.u_sigma_px, (h.v_px - f.v_px) / h.v_sigma_px] for f, h in hits]
    return {**_counts(scored), "pull_rms_u_v": _rms(pulls)}


def lamps(
    frames: int = 4, estimator: str = "robust", first: int = 0, source_radius_m: float = 1e-6
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
        for u, v in cell_centres(1):
            half_u, half_v = 0.5 * 10.0 ** generator.uniform(0.8, 1.7, 2)
            level_e = 10.0 ** generator.uniform(2.0, 4.2)
            du, dv = generator.uniform(-0.5, 0.5, 2)
            x, y = (within - du) / half_u, (within[:, None] - dv) / half_v
            is_oval = generator.random() < 0.5
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


def lit(lux: float, frames: int = 2, estimator: str = "robust") -> dict[str, Any]:
    """Sources 1 to 10 m away in a room lit by halogen lamps alone, the worst there is for so many lux.

    Their light is told by `nir-render explain` of scenes/workshop.yaml, its lamps replaced by halogens.
    """
    background_e = HALOGEN_E_PER_S_LUX * lux * EXPOSURE_S
    scored = []
    for index in range(frames):
        places = random(21, index).random((CELLS * CELLS, 3))
        flares = [
            Flare(u + du, v + dv, FLUX_PER_S_AT_1_M * EXPOSURE_S / (1.0 + 9.0 * share) ** 2)
            for (u, v), (du, dv, share) in zip(cell_centres(), places, strict=True)
        ]
        frame = frame_of(flares, POINT, background_e, 22, index, round(lux))
        scored.append(score(flares, perception.detect(frame, POINT, estimator), 1.0))
    return {**_counts(scored), "background_e": round(background_e, 1)}


def faint(snr: float, frames: int = 2, estimator: str = "robust") -> dict[str, Any]:
    """Points on even ground of 2.7, 30 and 300 e⁻ whose brightest pixel stands out by so many sigmas of its noise."""
    scored = []
    for index in range(frames):
        background_e = (2.7, 30.0, 300.0)[index % 3]
        noise_e2 = background_e + 21.3
        peak_e = 0.5 * (snr**2 + math.sqrt(snr**4 + 4.0 * snr**2 * noise_e2))  # of peak / √(peak + noise²)
        flux_e = peak_e / math.erf(0.5 / (math.sqrt(2.0) * POINT.psf_sigma_px)) ** 2
        places = random(23, index).random((CELLS * CELLS, 2)) - 0.5
        flares = [
            Flare(u + du, v + dv, flux_e) for (u, v), (du, dv) in zip(cell_centres(), places, strict=True)
        ]
        frame = frame_of(flares, POINT, background_e, 24, index)
        scored.append(score(flares, perception.detect(frame, POINT, estimator), 1.0))
    return _counts(scored)


def crowd(number: int, frames: int = 2, estimator: str = "robust") -> dict[str, Any]:
    """Many flares of 2·10³ to 2·10⁵ e⁻ anywhere in a frame of 1280 × 960, and how long each frame takes."""
    camera = replace(POINT, width_px=1280, height_px=960, cx_px=639.5, cy_px=479.5)
    scored, spent_ms = [], []
    for index in range(frames):
        values = random(14, index).random((number, 3))
        flares = [Flare(10.0 + 1260.0 * a, 10.0 + 940.0 * b, 10.0 ** (3.3 + 2.0 * c)) for a, b, c in values]
        frame = frame_of(flares, camera, BACKGROUND_E, 15, index)
        started = time.perf_counter()
        found = perception.detect(frame, camera, estimator)
        spent_ms.append(1e3 * (time.perf_counter() - started))
        scored.append(score(flares, found, 1.0))
    return {**_counts(scored), "ms_per_frame": round(float(np.median(spent_ms)), 1)}


ROWS: dict[str, Callable[..., dict[str, Any]]] = {
    **{f"pair {apart:g} px": lambda apart=apart, **more: pairs(apart, **more) for apart in (1.0, 1.5, 2.0, 3.0, 4.0)},
    "pair 1:5 at 2 px": lambda **more: pairs(2.0, 5.0, **more),
    "pair 1:5 at 4 px": lambda **more: pairs(4.0, 5.0, **more),
    "pair 1:20 at 3 px": lambda **more: pairs(3.0, 20.0, **more),
    "lone": lone,
    "lone, kernel 3 % wider": lambda **more: lone(kernel=1.03, **more),
    "lone, kernel 3 % narrower": lambda **more: lone(kernel=0.97, **more),
    **{f"lone of {flux:g} e": lambda flux=flux, **more: lone_of(flux, **more) for flux in (1e3, 4e3, 1.6e4)},
    **{f"clipped {times} times": lambda times=times, **more: clipped(times, **more) for times in (3, 10, 20, 50)},
    "clipped 50 times, kernel known to 3 %": lambda **more: clipped(50, kernel_sigma=0.03, **more),
    "peak of 8 sigma": lambda **more: faint(8.0, **more),
    **{f"lit by {lux} lux": lambda lux=lux, **more: lit(lux, **more) for lux in (300, 500, 800)},
    "60 stuck pixels": lambda **more: bad_pixels(60, 0, **more),
    "120 hot pixels": lambda **more: bad_pixels(0, 120, **more),
    **{f"texture of {px} px": lambda px=px, **more: textured(px, **more) for px in (4, 6, 15, 30)},
    "lamps": lamps,
    "lamps where sources are balls of 1 cm": lambda **more: lamps(source_radius_m=0.01, **more),
    **{f"empty, {kind}": lambda kind=kind, **more: empty(kind, **more)
       for kind in ("texture", "sheen", "sun patches", "blinds")},
    "empty, sun patches that clip": lambda **more: empty("sun patches", times=5.0, **more),
    "crowd of 300": lambda **more: crowd(300, **more),
}  # fmt: skip


def _counts(scored: Sequence[Scored]) -> dict[str, Any]:
    flares = sum(len(each.flares) for each in scored)
    found = sum(hit is not None for each in scored for hit in each.hits)
    false = sum(len(each.false_alarms) for each in scored)
    return {
        "frames": len(scored), "flares": flares, "recall": round(found / max(flares, 1), 4), "false_alarms": false,
    }  # fmt: skip


def _share(values: Sequence[bool]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None


def _rms(values: Sequence[Any]) -> Any:
    if not values:
        return None
    return np.round(np.sqrt(np.nanmean(np.square(np.array(values, dtype=float)), axis=0)), 4).tolist()


def main() -> None:
    """Print the rows asked for, or all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"any of: {', '.join(ROWS)}")
    parser.add_argument("--estimator", default="robust")
    parser.add_argument("--frames", type=int, help="frames of each row, in place of its own number")
    given = parser.parse_args()
    if unknown := sorted(set(given.rows) - set(ROWS)):
        parser.error(f"no such row: {', '.join(unknown)}; rows are {', '.join(ROWS)}")
    more: dict[str, Any] = {"frames": given.frames} if given.frames else {}
    for name in given.rows or ROWS:
        started = time.perf_counter()
        row = ROWS[name](estimator=given.estimator, **more)
        line = {"row": name, **row, "seconds": round(time.perf_counter() - started, 1)}
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
