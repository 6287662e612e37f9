"""Frames of flares that are hard to read: pairs, clipped ones, faint ones, crowds, on structure and in bright rooms."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

import perception
from tests.hard_frames.scores import (
    BACKGROUND_E,
    BRIGHT_E,
    CELLS,
    EXPOSURE_S,
    POINT,
    Flare,
    cell_centres,
    counts,
    frame_of,
    lone_sigmas,
    pair_sigmas,
    rms,
    score,
    share_of,
)
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, random

HALOGEN_E_PER_S_LUX = 93.9
"""Electrons a second, pixel and lux of the preset camera before walls that halogen lights."""


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
        **counts(scored),
        "both": share_of(both),
        "faint_found": share_of([hit is not None for each in scored for hit in each.hits[1::2]]),
        "rmse_over_bound_u_v_flux": rms(over_bound),
        "pull_rms_u_v": rms(pulls),
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
    return counts(scored)


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
        **counts(scored),
        "rmse_over_bound_u_v_range": rms(over_bound),
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
        **counts(scored),
        "only_a_bound": share_of([not math.isfinite(hit.range_sigma_m) for _, hit in hits]),
        "range_rmse_share": rms(errors),
        "pull_rms": rms(pulls),
        "greatest_pull": round(float(np.max(np.abs(pulls), initial=0.0)), 2),
    }


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
    return {**counts(scored), "pull_rms_u_v": rms(pulls)}


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
    return {**counts(scored), "background_e": round(background_e, 1)}


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
    return counts(scored)


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
    return {**counts(scored), "ms_per_frame": round(float(np.median(spent_ms)), 1)}
