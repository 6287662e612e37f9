"""Light that fog scatters forward: the halo about a flare, and the fit of flares beside it.

Droplets larger than the wavelength turn much of the light by less than a degree. It arrives beside the
source's image and within it: a fit that does not know of it takes a part for the source's own.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.flare import PixelBox
from perception.model.fog import extinction_sigma_per_m, forward_sigma, may_be_in_fog, range_in_fog_m
from perception.model.layout import any_of
from perception.model.window import Camera
from perception.robust.problem import Window
from perception.robust.solve import Solution, solve
from perception.types import Calibration, ForwardLight

Array = NDArray[np.float64]

_ROUNDS = 3
_SETTLED = 0.2  # of a flux's σ
_RING_SIGMAS, _STEP_SIGMAS = 0.5, 0.25
_STEPS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def fit_beside_forward_light(best: list[Solution | None], camera: Camera) -> None:
    """Replace solutions by those of windows in which the flares' halos by fog are known light.

    How bright a halo is follows from the flare's flux and the range at which fog leaves so much of it; the
    flux is smaller where the halo is known: so it is done until fluxes stay. What is not known of extinction
    and forward light is structure. Nothing is changed where the calibration knows of no forward light.
    """
    calibration = camera.calibration
    if not (calibration.forward_light and may_be_in_fog(calibration)):
        return
    going = {index: one for index, one in enumerate(best) if one is not None and bool(one.ranged.all())}
    for _ in range(_ROUNDS):
        problems = [one.again(_with_halos(one, camera)) for one in going.values()]
        again = dict(zip(going, solve(problems, camera), strict=True))
        moved = {}
        for index, now in again.items():
            if now is None:
                continue
            best[index] = now
            if np.any(np.abs(now.flux_e - going[index].flux_e) > _SETTLED * now.flux_sigma_e):
                moved[index] = now
        going = moved
        if not going:
            return


def _with_halos(solution: Solution, camera: Camera) -> Window:
    """Return a solution's window with the halos of its flares, and those alone, as known light."""
    calibration, window = camera.calibration, solution.window
    ranges_m = range_in_fog_m(np.exp(solution.log_photometric_range), calibration.extinction_per_m)
    unsure_per_m = extinction_sigma_per_m(calibration)
    # Where no fog is the likeliest, halos of as much as there may be are structure alone.
    known = calibration.extinction_per_m > 0.0
    per_m = calibration.extinction_per_m if known else unsure_per_m
    depths = per_m * ranges_m
    halos = [
        halos_e(
            float(solution.u_px[k]), float(solution.v_px[k]), float(solution.flux_e[k]),
            float(solution.image_radius_px[k]), float(depths[k]), window.box, calibration,
        )
        for k in range(solution.count)
    ]  # fmt: skip
    halo, *kinds = np.sum(halos, axis=0)
    sigma = math.hypot(unsure_per_m / per_m, forward_sigma(calibration))
    columns = np.array([*([sigma * halo] if sigma > 0.0 else []), *kinds]).reshape(-1, halo.size)
    unsure = any_of(columns, np.eye(len(columns))) if len(columns) else None
    return replace(window, known_e=halo if known else None, unsure=unsure)


def forward_shares(lights: tuple[ForwardLight, ...], depth: float) -> tuple[Array, Array]:
    """Return the light within angles over what comes straight, at an optical depth; the angles.

    Between tabulated depths the share per depth is interpolated, and held beyond them. After the shares stand
    those of each kind that the fog may be of, less them, over the root of how many kinds there are: the sum
    of their squares is the variance of the shares.

    Parameters
    ----------
    lights
        At least one, by rising depth.

    Returns
    -------
    Shares, shape (1 + kinds, n), and angles in rad, shape (n,); the first of both is 0.
    """
    depths, rates, angle_rad = _rates(lights)
    after = int(np.clip(np.searchsorted(depths, depth), 1, max(len(depths) - 1, 1)))
    before, after = after - 1, min(after, len(depths) - 1)
    apart = depths[after] - depths[before]
    part = np.clip((depth - depths[before]) / apart, 0.0, 1.0) if apart > 0.0 else 0.0
    return depth * (rates[before] + part * (rates[after] - rates[before])), angle_rad


@lru_cache(maxsize=32)
def _rates(lights: tuple[ForwardLight, ...]) -> tuple[Array, Array, Array]:
    """Return tabulated depths, `forward_shares` per depth, shape (depths, 1 + kinds, n), and the angles."""
    angle_rad = np.unique(np.concatenate([[0.0], *(light.angle_rad for light in lights)]))
    rates = np.array(
        [
            [np.interp(angle_rad, [0.0, *one.angle_rad], [0.0, *row]) / one.depth for row in _rows(one)]
            for one in lights
        ]
    )
    return np.array([one.depth for one in lights]), rates, angle_rad


def _rows(light: ForwardLight) -> list[Array]:
    """Return the shares within angles, and after them the scaled deviations of each kind."""
    share = np.array(light.share)
    kinds = np.array(light.deviations).reshape(-1, len(share))
    return [share, *(kinds / math.sqrt(max(len(kinds), 1)))]


def halos_e(
    u_px: float, v_px: float, flux_e: float, image_radius_px: float, depth: float,
    box: PixelBox, calibration: Calibration,
) -> Array:  # fmt: skip
    """Return the electrons that fog brings forward about a flare into a window, and what may differ of them.

    Between angles of the table the light lies evenly over the angle, as a halo of 1/α does; what blurs it,
    point spread, pixel, and the source's own image, counts as one Gaussian, round in directions.

    Parameters
    ----------
    u_px, v_px, flux_e, image_radius_px
        The flare: its place, what comes straight of it, and the radius of its image.
    depth
        Optical depth of the way from it.
    box
        The window.
    calibration
        With `forward_light`.

    Returns
    -------
    Shape (1 + kinds, height, width), as `forward_shares`.
    """
    shares, angle_rad = forward_shares(calibration.forward_light, depth)
    rows, columns = np.mgrid[box.top : box.top + box.height, box.left : box.left + box.width]
    own = np.array([[u_px, v_px]]) + _STEPS
    places = np.concatenate([own, np.stack([columns.ravel(), rows.ravel()], axis=1)])
    near, direction = np.split(direction_camera(places, calibration), [len(own)])
    px_per_rad, middle = _pixel_sr(near) ** -0.5, near[0]
    chord = np.minimum(np.linalg.norm(direction - middle, axis=1), 2.0)
    # Beyond a fisheye's image circle pixels see no direction.
    seen = np.isfinite(chord)
    images = np.zeros((len(shares), len(direction)))
    if math.isfinite(px_per_rad) and seen.any():
        off_px = px_per_rad * 2.0 * np.arcsin(0.5 * chord[seen])
        sigma_px = np.sqrt(calibration.psf_sigma_px**2 + 1.0 / 12.0 + 0.25 * image_radius_px**2)
        profiles, at_px = _blurred(shares, px_per_rad * angle_rad, float(sigma_px), float(off_px.max()))
        for image, profile in zip(images, profiles, strict=True):
            image[seen] = flux_e * np.interp(off_px, at_px, profile)
    return images.reshape(-1, box.height, box.width)


def _pixel_sr(near: Array) -> float:
    """Return the area of a pixel in directions, of those at `_STEPS` from its place; NaN where none is."""
    middle, right, below, left, above = near
    # Right at the edge of the image circle the neighbours on one side alone have directions.
    aside = right - middle if np.isfinite(right[0]) else middle - left
    down = below - middle if np.isfinite(below[0]) else middle - above
    return math.sqrt(max(float((aside @ aside) * (down @ down) - (aside @ down) ** 2), 0.0))


def _blurred(shares: Array, angle_px: Array, sigma_px: float, most_px: float) -> tuple[Array, Array]:
    """Return lights per square pixel against the distance, rings of each spread by a Gaussian; the distances.

    A ring of radius a and light m gives m exp(−(ρ² + a²)/2σ²) I₀(ρ a/σ²) / 2πσ² at the distance ρ.
    """
    from scipy.special import i0e

    most_ring_px = min(float(angle_px[-1]), most_px + 6.0 * sigma_px)
    edges = np.linspace(0.0, most_ring_px, max(int(most_ring_px / (_RING_SIGMAS * sigma_px)), 1) + 1)
    light = np.array([np.diff(np.interp(edges, angle_px, share)) for share in shares])
    ring = 0.5 * (edges[1:] + edges[:-1])
    at = np.arange(0.0, most_px + _STEP_SIGMAS * sigma_px, _STEP_SIGMAS * sigma_px)
    variance = sigma_px**2
    spread = np.exp(-0.5 * (at[:, None] - ring) ** 2 / variance) * i0e(at[:, None] * ring / variance)
    return light @ spread.T / (2.0 * np.pi * variance), at
