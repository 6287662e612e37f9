"""How far light that was rendered in blocks is off the full render: measured in some pixels of a frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.enlarge import interpolated_variance
from nir_render.camera.exposure import diffuse_electrons
from nir_render.expected import by_spectrum, diffuse_image, expected, fluxes
from nir_render.randomness import generator
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose
from nir_render.transport.light import Edges, Indirect, Light

Array = NDArray[np.float64]

_MOST_PIXELS = 4096
_RENDER_SHARE = 0.08  # of the pixels of the film: what the check may cost beside the render
_LEAST_SAMPLES = 8


@dataclass(frozen=True, eq=False)
class UpsamplingError:
    """What enlarging adds to a frame.

    Attributes
    ----------
    share
        Mean square of the error that enlarging brings into a pixel, before the lens blurs it (which only
        lowers it), over the mean shot variance of the frame. Noise of both renders is taken out, so that a
        share of nothing can come out slightly negative.
    standard_error
        Of the share.
    pixels
        In how many pixels it was measured.
    """

    share: float
    standard_error: float
    pixels: int


def upsampling_error(
    light: Light, scene: Scene, exposure_s: float, pixels: int | None = None, samples: int | None = None
) -> UpsamplingError | None:
    """Render some pixels of a light one by one and compare them with the enlarged light.

    Half of the pixels are drawn from those beside edges, half from the others, each half spread evenly over
    the frame. From the square of each difference go the variances of both sides. Pixels that the light holds
    one by one are right.

    Parameters
    ----------
    pixels
        How many; without, 8 % of the pixels of the film, at most 4096.
    samples
        In each, a power of two; without, as many as the light has.

    Returns
    -------
    None where nothing was enlarged.
    """
    indirect = light.indirect
    if indirect is None or indirect.scale == 1:
        return None
    edges = indirect.edges
    if pixels is None:
        pixels = int(np.clip(_RENDER_SHARE * indirect.radiance_per_w[0, 0].size, 2, _MOST_PIXELS))
    mean = expected(light, scene, exposure_s)
    shot_e2 = float(mean.electrons.mean())
    if shot_e2 <= 0.0:
        return None
    random = generator(light.seed, "upsampling", light.camera, 0)
    total, variance, measured = 0.0, 0.0, 0
    strata = _strata(edges, mean.electrons.size)
    for stratum in strata:
        chosen = _spread(stratum, pixels // len(strata), random)
        square_e2 = _squares(light, indirect, scene, exposure_s, chosen, samples)
        share = len(stratum) / mean.electrons.size
        total += share * float(square_e2.mean())
        variance += share**2 * float(square_e2.var()) / len(chosen)
        measured += len(chosen)
    return UpsamplingError(total / shot_e2, variance**0.5 / shot_e2, measured)


def _strata(edges: Edges | None, count: int) -> list[NDArray[np.int64]]:
    """Return the numbers of pixels beside edges, and of the others; patches belong to neither."""
    if edges is None:
        return [np.arange(count)]
    others = np.ones(count, dtype=bool)
    others[edges.enlargement.pixels] = others[edges.enlargement.patch] = False
    strata = (edges.enlargement.pixels.astype(np.int64), np.flatnonzero(others))
    return [stratum for stratum in strata if len(stratum)]


def _spread(stratum: NDArray[np.int64], count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Return so many of a list, one from each of as many equal parts."""
    count = max(min(count, len(stratum)), 1)
    return stratum[((np.arange(count) + random.random(count)) * (len(stratum) / count)).astype(np.int64)]


def _squares(
    light: Light,
    indirect: Indirect,
    scene: Scene,
    exposure_s: float,
    pixels: NDArray[np.int64],
    samples: int | None,
) -> Array:
    """Return the squares of the error of pixels in electrons, noise taken out, shape (pixels,)."""
    from nir_render.transport.sharpen import one_by_one  # Mitsuba loads only where light is rendered

    robot, camera = scene.camera(light.camera)
    flux = fluxes(light, scene)
    count = max(indirect.samples if samples is None else samples, _LEAST_SAMPLES)
    full, noise = one_by_one(scene, camera, camera_pose(robot, camera, light.time_s), light, pixels, count)
    enlarged_e = diffuse_image(light, indirect, scene, flux, exposure_s).ravel()[pixels]
    full_e, noise_e2 = np.zeros(len(pixels)), _enlarged_variance(light, indirect, scene, exposure_s, pixels)
    means, variances = by_spectrum(light, scene, full, flux), by_spectrum(light, scene, noise, flux**2)
    for (emitter, radiance), (_, of_mean) in zip(means, variances, strict=True):
        per_radiance = _factor(camera, emitter, exposure_s, pixels)
        full_e += per_radiance * radiance
        noise_e2 += per_radiance**2 * of_mean
    return (enlarged_e - full_e) ** 2 - noise_e2
