"""How far light that was rendered in blocks is off the full render: measured in some pixels of a frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nir_render.camera.enlarge import Enlargement, weights_of
from nir_render.camera.exposure import diffuse_electrons
from nir_render.expected import by_spectrum, fluxes
from nir_render.randomness import generator
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose
from nir_render.transport.light import Light

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_PIXELS_PER_BLOCK = 0.003
_LEAST_PIXELS, _MOST_PIXELS = 128, 512
_SAMPLES_FACTOR, _MOST_SAMPLES = 8, 1024


@dataclass(frozen=True, eq=False)
class UpsamplingError:
    """What enlarging adds to a frame.

    Attributes
    ----------
    share
        Mean square of the error that enlarging brings into a pixel, before the lens blurs it (which only
        lowers it), over the mean shot variance of the frame. Without bias by render noise: so a share near
        nothing can come out slightly negative.
    standard_error
        Of the share.
    pixels
        In how many pixels it was measured.
    """

    share: float
    standard_error: float
    pixels: int


def upsampling_error(
    light: Light,
    scene: Scene,
    exposure_s: float,
    mean_e: float,
    pixels: int | None = None,
    samples: int | None = None,
) -> UpsamplingError | None:
    """Render some pixels of a light, and the blocks that these are made of, and compare.

    Half of the pixels are drawn from those beside edges, half from the others, each half spread evenly over
    the frame. Pixels that the light holds one by one are right. All is rendered twice, and the square of an
    error is the product of two differences that are independent of each other: noise has the expectation 0.

    Parameters
    ----------
    mean_e
        Mean electrons of the frame, which is its mean shot variance.
    pixels
        How many; without, 0.3 % of the blocks, at least 128 and at most 512.
    samples
        In each, a power of two; without, 8 times those of the light, at most 1024.

    Returns
    -------
    None where nothing was enlarged, the edges are not known, or the frame is dark.
    """
    indirect = light.indirect
    if indirect is None or indirect.edges is None or mean_e <= 0.0:
        return None
    blocks = indirect.radiance_per_w[0, 0].size
    if pixels is None:
        pixels = int(np.clip(_PIXELS_PER_BLOCK * blocks, _LEAST_PIXELS, _MOST_PIXELS))
    if samples is None:
        samples = min(2 ** int(np.ceil(np.log2(_SAMPLES_FACTOR * indirect.samples))), _MOST_SAMPLES)
    how = indirect.edges.enlargement
    strata = _strata(how, blocks * indirect.scale**2)
    random = generator(light.seed, "upsampling", light.camera, 0)
    chosen = [_spread(stratum, pixels // len(strata), random) for stratum in strata]
    square_e2 = _squares(light, indirect.scale, how, scene, exposure_s, np.concatenate(chosen), samples)
    total = variance = 0.0
    for stratum, part in zip(
        strata, np.split(square_e2, np.cumsum(list(map(len, chosen)))[:-1]), strict=True
    ):
        share = len(stratum) / (blocks * indirect.scale**2)
        total += share * float(part.mean())
        variance += share**2 * float(part.var()) / len(part)
    return UpsamplingError(total / mean_e, variance**0.5 / mean_e, len(square_e2))


def _strata(how: Enlargement, count: int) -> list[Numbers]:
    """Return the numbers of pixels beside edges, and of the others; patches belong to neither."""
    others = np.ones(count, dtype=bool)
    others[how.pixels] = others[how.patch] = False
    return [part for part in (how.pixels.astype(np.int64), np.flatnonzero(others)) if len(part)]


def _spread(stratum: Numbers, count: int, random: np.random.Generator) -> Numbers:
    """Return so many of a list, one from each of as many equal parts."""
    count = max(min(count, len(stratum)), 1)
    return stratum[((np.arange(count) + random.random(count)) * (len(stratum) / count)).astype(np.int64)]


def _squares(
    light: Light,
    scale: int,
    how: Enlargement,
    scene: Scene,
    exposure_s: float,
    pixels: Numbers,
    samples: int,
) -> Array:
    """Return the squares of the errors of pixels in electrons, noise of expectation 0, shape (pixels,)."""
    from nir_render.transport.groups import rays_of  # Mitsuba loads only where light is rendered
    from nir_render.transport.render import group_power
    from nir_render.transport.sharpen import rendered_again

    robot, camera = scene.camera(light.camera)
    sensor = camera.sensor
    weights = weights_of(pixels, scale, how)
    used = np.unique(weights.indices).astype(np.int64)
    weights = csr_array(weights[:, used])
    rays, power = rays_of(camera, camera_pose(robot, camera, light.time_s)), group_power(scene, camera)
    wanted = {1: pixels, scale: used}
    renders = rendered_again(scene, rays, light.time_s, light.seed, power, wanted, samples)
    flux, image = fluxes(light, scene), np.ones((sensor.rows, sensor.columns))
    square_e2 = np.ones(len(pixels))
    for radiance_per_w in renders:
        error_e = np.zeros(len(pixels))
        full = by_spectrum(light, scene, radiance_per_w[1], flux)
        in_blocks = by_spectrum(light, scene, radiance_per_w[scale], flux)
        for (emitter, of_pixels), (_, of_blocks) in zip(full, in_blocks, strict=True):
            per_radiance = diffuse_electrons(camera, image, emitter, exposure_s).ravel()[pixels]
            error_e += per_radiance * (weights @ of_blocks - of_pixels)
        square_e2 *= error_e
    return square_e2
