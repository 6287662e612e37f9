"""The curve of growth of a disc that is blurred and clips: its flux follows from the light within a circle.

Photometry corrects by it what lies outside of apertures (Howell, PASP 101, 616, 1989). A disc of uniform
brightness, blurred by a Gaussian, is as bright at a place as is the chance that a normal variate about that
place falls into it: Φ of both half chords, averaged over the chords. With lengths in units of the blur, s the
half chord, y how far outside of its end,

    ∫ (s + y') Q(y') dy' from y on = s (φ(y) − y Q(y)) + ½ (y φ(y) + (1 − y²) Q(y))

is what a chord adds to the light beyond a radius s + y, so that chords have to be summed, but no radii.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]

_CHORDS = 8  # on each side of the middle, to 5 σ: 1e-6 of the brightness
_FARTHEST = 5.0
_ENOUGH, _LEAST_SLOPE = 1e-4, 0.1
_MOST_STEPS = 30
_SQRT_HALF, _SQRT_2_PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi)


@compiled
def whole_fluxes(
    light_e: Array, area_px2: Array, brightness_e: Array, clip_e: Array, smooth_px: float
) -> Array:
    """Return the fluxes of discs of which so much light lies within circles of such areas.

    Parameters
    ----------
    light_e, area_px2
        What is seen of each within its circle, clipped, and the circle's area.
    brightness_e
        Of a pixel that the disc covers.
    clip_e
        What pixels show at most above the background; infinite where none clips.
    smooth_px
        Width of the Gaussian.

    Returns
    -------
    Shape (n, 2): flux in electrons, and the area that clips. NaN where no disc shows so much light.
    """
    fluxes = np.full((len(light_e), 2), np.nan)
    px2 = smooth_px * smooth_px
    for index in range(len(light_e)):
        if not (light_e[index] > 0.0 and brightness_e[index] > 0.0 and clip_e[index] > 0.0):
            continue
        bright, clip, light = brightness_e[index] * px2, clip_e[index] * px2, light_e[index]
        within = math.sqrt(area_px2[index] / (math.pi * px2))
        # A disc is as large as if all of it were seen; not larger than what clips, nor brighter than a point.
        low = 0.5 * math.log(light / (math.pi * bright))
        high = low + math.log(10.0)
        log_radius, clipped_at = low, 0.0
        if clip < math.inf:
            of_point = min(light / (2.0 * math.pi * clip) - 1.0, 700.0) + math.log(2.0 * clip / bright)
            high = max(0.5 * min(math.log(light / (math.pi * clip)), of_point), low)
            log_radius = high
        low, high = low - 0.1, high + 0.5
        off, slope = math.inf, 2.0
        for _ in range(_MOST_STEPS):  # secants between bounds
            before_at, before = log_radius, off
            if before < math.inf:
                log_radius -= off / slope
                if not low < log_radius < high:
                    log_radius = 0.5 * (low + high)
            seen, clipped_at = _light(math.exp(log_radius), bright, clip, within)
            off = math.log(seen / light)
            if abs(off) < _ENOUGH:
                fluxes[index, 0] = bright * math.pi * math.exp(2.0 * log_radius)
                fluxes[index, 1] = math.pi * clipped_at * clipped_at * px2
                break
            low, high = (log_radius, high) if off < 0.0 else (low, log_radius)
            if before < math.inf:
                slope = max((off - before) / (log_radius - before_at), _LEAST_SLOPE)
    return fluxes


@compiled
def _light(radius: float, bright: float, clip: float, within: float) -> tuple[float, float]:
    """Return the light of a disc within a circle, and within which radius it clips, in units of the blur."""
    halves, weights = _chords(radius)
    clipped_at, share = 0.0, clip / bright
    if share < -math.expm1(-0.5 * radius * radius):
        clipped_at = max(radius, 1.0)
        # ln of the brightness is concave: from beyond, Newton's steps fall short.
        for _ in range(_MOST_STEPS):
            at, slope = _brightness(halves, weights, clipped_at)
            step = math.log(at / share) * at / slope
            clipped_at = max(clipped_at - step, 0.5 * clipped_at)
            if abs(step) < _ENOUGH:
                break
    beyond = _light_beyond(halves, weights, max(within, clipped_at))
    light = bright * (_light_beyond(halves, weights, clipped_at) - beyond)
    if clipped_at > 0.0:
        light += math.pi * min(clipped_at, within) ** 2 * clip
    return light, clipped_at


@compiled
def _chords(radius: float) -> tuple[Array, Array]:
    """Return half the lengths of a disc's chords, and how often a normal variate lies on each."""
    halves, weights = np.empty(_CHORDS), np.empty(_CHORDS)
    step = math.asin(min(_FARTHEST / radius, 1.0)) / _CHORDS
    for chord in range(_CHORDS):
        angle = (chord + 0.5) * step
        off = radius * math.sin(angle)
        halves[chord] = radius * math.cos(angle)
        weights[chord] = 2.0 * step * halves[chord] * math.exp(-0.5 * off * off) / _SQRT_2_PI
    return halves, weights


@compiled
def _brightness(halves: Array, weights: Array, at: float) -> tuple[float, float]:
    """Return how bright a blurred disc is so far from its middle, and by how much that changes outwards."""
    brightness = slope = 0.0
    for chord in range(_CHORDS):
        half, weight = halves[chord], weights[chord]
        brightness += weight * (_beyond(at - half) - _beyond(at + half))
        slope += weight * (math.exp(-0.5 * (at + half) ** 2) - math.exp(-0.5 * (at - half) ** 2)) / _SQRT_2_PI
    return brightness, slope


@compiled
def _light_beyond(halves: Array, weights: Array, at: float) -> float:
    """Return how much light of a blurred disc of brightness 1 lies beyond a radius."""
    light = 0.0
    for chord in range(_CHORDS):
        half, weight = halves[chord], weights[chord]
        light += weight * (_of_chord(half, at) - _of_chord(-half, at))
    return 2.0 * math.pi * light


@compiled
def _of_chord(half: float, at: float) -> float:
    y = at - half
    tail, density = _beyond(y), math.exp(-0.5 * y * y) / _SQRT_2_PI
    return half * (density - y * tail) + 0.5 * (y * density + (1.0 - y * y) * tail)


@compiled
def _beyond(y: float) -> float:
    return 0.5 * math.erfc(y * _SQRT_HALF)
