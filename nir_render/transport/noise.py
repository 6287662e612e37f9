"""How many samples each pixel of the film needs, so that render noise stays a known share of the sensor's.

A pilot of few samples in few pixels, thrown away afterwards and drawn with random numbers of its own, tells
the variance that one sample brings to the electrons of a pixel. The counts follow from it alone, and not from
the samples that they weigh: so the render stays unbiased.

The need of a pixel is the count that brings its render variance to a share of shot and read variance. A
pilot's variance, from 8 batches, is itself noisy, and where rare paths carry the light most of its values are
too small; its mean is right. So needs are means over 5 × 5 pixels of the pilot, and taken a tenth larger.

- The frame's count is the median of the needs, at least 8. Each pixel gets its own need, up to 4 times the
  frame's count: more than half of all pixels then keep the target, and most of the rest too.
- No pixel of the film may look like a flare by render noise: each gets what brings the σ of the sum over it,
  scale × scale sensor pixels of the same noise, to half of the sensor's, up to 16 times the frame's count.
- Every flare's aperture gets what brings the sum over it to the target; there the pilot has all pixels, as
  light is often brightest beside a flare.

Counts are powers of two from 8 to 4096.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.camera.apertures import Aperture
from nir_render.camera.exposure import diffuse_electrons
from nir_render.camera.sensor import saturation_dn
from nir_render.expected import by_spectrum, expected, flare_apertures, fluxes, render_variance_e2
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.transport.light import Light

Array = NDArray[np.float64]

LEAST_SAMPLES, MOST_SAMPLES = 8, 4096
_CAUTION = 1.1
_NEIGHBOURS = 5
_FLARE_LIKE_SHARE = 0.25  # of temporal variance: half of its σ
_RISE, _FLARE_LIKE_RISE = 4, 16  # times the frame's count
_PIXELS_OF_A_FLARE = 400
_TINY_E2 = 1e-12


def samples_map(
    pilot: Light, flares: Light, scene: Scene, noise_share: float, shape: tuple[int, int]
) -> NDArray[np.int64]:
    """Return the samples for each pixel of the film.

    Parameters
    ----------
    pilot
        The camera's light with `groups.pilot` as its indirect part.
    flares
        The same with `flare_pixels` as its indirect part, shape (group, node, 1, pixel).
    noise_share
        Render variance over temporal variance to reach.
    shape
        Rows and columns of the film.
    """
    assert pilot.indirect is not None  # noqa: S101 (without indirect light nothing is sampled)
    _, camera = scene.camera(pilot.camera)
    at_one_second = expected(pilot, scene, 1.0)
    exposure_s = settled_exposure_s(camera, float(at_one_second.electrons.max()))
    temporal_e2 = at_one_second.electrons * exposure_s + camera.sensor.read_noise_e**2 + _TINY_E2
    noise_e2 = render_variance_e2(pilot, scene, exposure_s) * (pilot.indirect.samples * _CAUTION)
    parts = pilot.indirect.variance.shape[-1:-3:-1]
    ratio = cv2.resize(noise_e2 / temporal_e2, parts, interpolation=cv2.INTER_AREA)
    ratio = cv2.blur(ratio, (_NEIGHBOURS, _NEIGHBOURS), borderType=cv2.BORDER_REPLICATE)
    ratio = np.asarray(cv2.resize(ratio, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float64)
    need = ratio / noise_share
    frame = max(float(np.median(need)), LEAST_SAMPLES)
    scale = camera.sensor.rows // shape[0]
    flare_like = np.minimum(scale**2 * ratio / _FLARE_LIKE_SHARE, _FLARE_LIKE_RISE * frame)
    need = np.maximum(np.minimum(need, _RISE * frame), flare_like).ravel()
    known = flare_pixels(pilot, camera, shape)
    noise_in_flares_e2 = np.full(need.size, np.nan)
    noise_in_flares_e2[known] = _CAUTION * _noise_of_one_sample_e2(flares, scene, exposure_s, known, shape)
    for aperture in flare_apertures(pilot, camera):
        pixel, of_it = _film_pixels(aperture, camera, shape)
        told = ~np.isnan(noise_in_flares_e2[pixel])
        # What one pixel of the film brings to the sum goes with how many of its sensor pixels lie in it.
        of_sum_e2 = (of_it**2).sum() * np.average(noise_in_flares_e2[pixel[told]], weights=of_it[told] ** 2)
        need[pixel] = np.maximum(need[pixel], of_sum_e2 / (noise_share * aperture.sum(temporal_e2)))
    counts = 2 ** np.ceil(np.log2(np.clip(need, LEAST_SAMPLES, MOST_SAMPLES)))
    return np.asarray(counts, dtype=np.int64).reshape(shape)


def flare_pixels(light: Light, camera: Camera, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the numbers, row by row, of pixels of the film in flares' apertures, shape (n,).

    Of a large aperture they are an even part.
    """
    chosen = [np.empty(0, dtype=np.int64)]
    for aperture in flare_apertures(light, camera):
        pixel, _ = _film_pixels(aperture, camera, shape)
        chosen.append(pixel[:: -(-pixel.size // _PIXELS_OF_A_FLARE)])
    return np.unique(np.concatenate(chosen))


def _film_pixels(
    aperture: Aperture, camera: Camera, shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the numbers of film pixels under an aperture, and how many sensor pixels each has there."""
    scale = camera.sensor.rows // shape[0]
    row, column = aperture.pixels()
    return np.unique(row // scale * shape[1] + column // scale, return_counts=True)


def _noise_of_one_sample_e2(
    light: Light, scene: Scene, exposure_s: float, pixels: NDArray[np.int64], shape: tuple[int, int]
) -> Array:
    """Return the variance, in e² of one sensor pixel, of one sample in some pixels of the film, (n,)."""
    assert light.indirect is not None  # noqa: S101
    _, camera = scene.camera(light.camera)
    even = np.ones((camera.sensor.rows, camera.sensor.columns))
    noise_e2 = np.zeros(pixels.size)
    for emitter, variance in by_spectrum(light, scene, light.indirect.variance, fluxes(light, scene) ** 2):
        per_radiance = diffuse_electrons(camera, even, emitter, exposure_s)
        of_film = cv2.resize(per_radiance, shape[::-1], interpolation=cv2.INTER_AREA).ravel()
        noise_e2 += of_film[pixels] ** 2 * variance.ravel()
    return noise_e2 * light.indirect.samples


def settled_exposure_s(camera: Camera, brightest_e_per_s: float) -> float:
    """Return a camera's exposure; an automatic one's as it settles, but for noise in its brightest pixel."""
    control, sensor = camera.auto_exposure, camera.sensor
    if control is None:
        return camera.exposure_s
    range_e = (saturation_dn(sensor) - sensor.black_level_dn) / sensor.system_gain_dn_per_e
    wanted_s = control.target * range_e / max(brightest_e_per_s, 1e-300)
    return float(np.clip(wanted_s, control.shortest_s, control.longest_s))
