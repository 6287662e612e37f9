"""What is seen of sources, as the search for poses reckons with it."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.model.fog import may_be_in_fog, size_alone
from perception.model.ranging import constant_spread
from perception.rig.extinction import clear_air_ranges_m
from perception.rig.frame_sets import Exposed
from perception.rig.moving import OneTime
from perception.rig.rays import UNKNOWN_RANGE
from perception.rig.sightings import CAMERAS_MOST, CAMERAS_SHARE, LEAST_NOISE, UNCLAIMED_RANGE
from perception.types import Calibration, Detection, Layout

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SIZE_TELLS = 0.1
"""Size is heard by itself where it tells more than this of what flux does."""

UNTOLD_RAD = 1.0
"""σ of angles where nothing is told of them."""

MERGED_PX, MERGED_RANGE = 0.7, 0.15
"""What a flare that does not look like one source may be off by at least, and its range relatively: two that
overlap are a pixel or two apart, and seem up to a seventh too near, or one of them too far."""

MOST_SIGMAS, MOST_FACTOR = 4.0, 0.7
"""How far ranges by flux may be from those that are stated, in σ of the range constant and beyond: ln 2."""

_SAME_M = 1e-6


class Sights(NamedTuple):
    """Sightings of sources, n of them: those of detections first, then what sizes say by themselves.

    Where the range constant is not known well, a range leans on a flare's size, and its flux is as good as
    unused. But the fluxes of one robot's sources tell each other's ranges, whatever the constant: there flux
    and size are two sightings, of which the size's says nothing of the direction.

    Attributes
    ----------
    origin_m
        Camera centres, shape (n, 3).
    axes
        Left, up and along each bearing, as rows, shape (n, 3, 3).
    log_range
        Logarithm of the range (m) by the range constant, NaN where it is not known, shape (n,).
    by_flux
        The share of that range which comes of flux and not of size, shape (n,).
    own
        Covariance of left, up (rad) and logarithm of range, by noise of each sighting, shape (n, 3, 3).
    shared
        What errors of one σ that sightings share do to them, shape (n, 3, errors).
    constant
        What the error of the range constant does to the logarithms, at one σ, shape (n,).
    size
        For each detection which sighting is that of its size, −1 where there is none, shape (detections,).
    """

    origin_m: Array
    axes: Array
    log_range: Array
    by_flux: Array
    own: Array
    shared: Array
    constant: Array
    size: Indices


class Carried(NamedTuple):
    """A layout: places in body axes, shape (s, 3), logarithms of the fluxes, shape (s,), and their σ."""

    place_m: Array
    log_flux: Array
    flux_sigma_common: float
    flux_sigma_own: float


def carried(layout: Layout) -> Carried:
    """Return a layout as the search for poses reckons with it."""
    return Carried(
        np.array(layout.places_body_m),
        np.log(np.array(layout.relative_flux)),
        layout.flux_sigma_common,
        layout.flux_sigma_own,
    )


@lru_cache(maxsize=64)
def symmetries(layout: Layout) -> tuple[tuple[float, tuple[int, ...]], ...]:
    """Return the turns (rad) about z under which a layout is the same, and what takes whose place in each.

    A robot that heads by such a turn farther, each of its sources taken for the one whose place it takes,
    looks just alike. No turn at all is left out.
    """
    places_m, flux = np.array(layout.places_body_m), layout.relative_flux
    from_axis_m = np.hypot(places_m[:, 0], places_m[:, 1])
    first = int(np.argmax(from_axis_m))
    found = []
    for to in range(len(flux)):
        turn_rad = math.atan2(places_m[first, 1], places_m[first, 0])
        turn_rad -= math.atan2(places_m[to, 1], places_m[to, 0])
        cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
        turned_m = places_m @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        apart_m = np.linalg.norm(turned_m[:, None] - places_m, axis=2)
        onto = tuple(np.argmin(apart_m, axis=1).tolist())
        same = to != first and len(set(onto)) == len(flux) and float(apart_m.min(axis=1).max()) < _SAME_M
        if same and all(flux[k] == flux[n] for k, n in enumerate(onto)):
            # What stood at k now stands at onto[k]: taken for it, the robot heads by as much less.
            found.append((-turn_rad, onto))
    return tuple(found)


def sights_of(
    known: OneTime,
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
) -> Sights:
    """Return what the detections of each frame say, with the errors that they share told from their own."""
    found = known.sightings
    rays, n = found.rays, len(found.keys)
    hits = [hit for each in detections for hit in each]
    names = list(dict.fromkeys(hit.camera for hit in hits))
    camera = np.array([names.index(hit.camera) for hit in hits])
    sigmas = [calibrations[name].sigma for name in names]
    turned_rad = np.array([sigma.get("rotation_body_camera", 0.0) for sigma in sigmas])[camera]
    moved_m = np.array([sigma.get("position_body_m", 0.0) for sigma in sigmas])[camera]
    constant = np.array([constant_spread(calibrations[name]) for name in names])[camera]
    sigma_m, common_m = np.array([(hit.range_sigma_m, hit.range_sigma_common_m) for hit in hits]).T
    ranged = np.isfinite(rays.range_m)
    claimed = ranged & np.isfinite(sigma_m)
    at_m = np.where(ranged, rays.range_m, 1.0)
    common = np.where(claimed, np.nan_to_num(common_m) / at_m, 0.0)
    noise2 = np.maximum(np.where(claimed, sigma_m / at_m, 0.0) ** 2 - common**2, LEAST_NOISE**2)
    # The share of a range that comes of flux: its answer to an error of K over that of K/F alone.
    by_flux = np.ones(n)
    stated = claimed & (constant > 0.0)
    by_flux[stated] = np.minimum(1.0, 2.0 * common[stated] / constant[stated])
    log_range = np.log(rays.range_m)
    by_size = _by_size(frames, detections, calibrations, np.where(claimed, constant, np.nan))
    sized = np.flatnonzero(np.isfinite(by_size.log_size))
    log_range[sized], by_flux[sized] = by_size.log_flux[sized], 1.0
    common[sized] = 0.5 * constant[sized]
    noise2[sized] = np.maximum(by_size.flux_noise[sized] ** 2, LEAST_NOISE**2)
    of_camera2 = np.minimum(CAMERAS_SHARE * common**2, CAMERAS_MOST**2)
    noise2 += found.together.noise**2 - rays.noise**2  # where the observer moved between its cameras
    noise2[found.merged] += MERGED_RANGE**2
    per_px = np.array([1.0 / calibrations[name].fx_px for name in names])[camera]
    own_rad2 = (MERGED_PX * per_px * found.merged) ** 2 - found.mounting_rad2
    own = np.zeros((n + len(sized), 3, 3))
    own[:n, :2, :2] = found.together.angular_rad2 + own_rad2[:, None, None] * np.eye(2)
    own[:n, 2, 2] = np.where(claimed, noise2, np.where(ranged, UNCLAIMED_RANGE**2, UNKNOWN_RANGE**2))
    own[n:, 0, 0] = own[n:, 1, 1] = UNTOLD_RAD**2
    own[n:, 2, 2] = by_size.size_noise[sized] ** 2
    of_one = np.zeros((n, 3, 7))
    of_one[:, :2, :3] = turned_rad[:, None, None] * np.cross(rays.axes[:, 2:], rays.axes[:, :2])
    of_one[:, :, 3:6] = (moved_m / at_m)[:, None, None] * rays.axes
    of_one[:, 2, 6] = np.sqrt(of_camera2)
    shared = np.zeros((n + len(sized), 3, len(names), 7))
    shared[np.arange(n), :, camera] = of_one
    size, none = np.full(n, -1, dtype=np.int64), np.zeros(len(sized))
    size[sized] = n + np.arange(len(sized))
    return Sights(
        np.concatenate([rays.origin_m, rays.origin_m[sized]]),
        np.concatenate([rays.axes, rays.axes[sized]]),
        np.concatenate([log_range, by_size.log_size[sized]]),
        np.concatenate([by_flux, none]),
        own,
        shared.reshape(n + len(sized), 3, -1),
        np.concatenate([np.sqrt(common**2 - of_camera2), none]),
        size,
    )


class _BySize(NamedTuple):
    """Logarithms of ranges by flux and by size, and the σ of either but for that of the range constant.

    NaN where size is not to be heard by itself; shape (detections,) each.
    """

    log_flux: Array
    flux_noise: Array
    log_size: Array
    size_noise: Array


def _by_size(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    constant_sigma: Array,
) -> _BySize:
    """Part what flux says of ranges from what size says; in fog other means tell that (`extinction`)."""
    parts = []
    for frame, found in zip(frames, detections, strict=True):
        if not found:
            continue
        calibration, nothing = calibrations[frame.camera], np.full(len(found), np.nan)
        if may_be_in_fog(calibration) or not constant_spread(calibration) > 0.0:
            parts.append(np.array([nothing] * 4))
            continue
        told = [
            (hit.range_m, hit.range_sigma_m, hit.flux_dn, hit.flux_sigma_dn, hit.saturated) for hit in found
        ]
        range_m, sigma_m, flux_dn, flux_sigma_dn, saturated = np.array(told, dtype=np.float64).T
        by_flux_m = clear_air_ranges_m(found, frame, calibration)
        usable = np.isfinite(by_flux_m + sigma_m) & (sigma_m > 0.0) & (range_m > 0.0) & (saturated == 0.0)
        # Who has fluxes of a scale of their own says nothing by them.
        constant = constant_spread(calibration)
        ratio = np.where(usable, by_flux_m, 1.0) / np.where(usable, range_m, 1.0)
        usable &= abs(np.log(ratio)) < MOST_SIGMAS * 0.5 * constant + MOST_FACTOR
        share = np.where(usable, flux_sigma_dn, 1.0) / np.where(usable, flux_dn, 1.0)
        range_m, sigma_m, by_flux_m = (np.where(usable, each, 1.0) for each in (range_m, sigma_m, by_flux_m))
        size_m, size_sigma_m = size_alone(range_m, sigma_m, by_flux_m, share, constant, SIZE_TELLS)
        size_m = np.where(usable, size_m, np.nan)
        parts.append(np.array([np.log(by_flux_m), 0.5 * share, np.log(size_m), size_sigma_m / size_m]))
    log_flux, flux_noise, log_size, size_noise = np.concatenate([np.empty((4, 0)), *parts], axis=1)
    return _BySize(log_flux, flux_noise, np.where(np.isfinite(constant_sigma), log_size, np.nan), size_noise)
