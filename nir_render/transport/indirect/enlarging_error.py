"""How far light that was rendered in blocks is off the full render: measured in some pixels of a frame."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nir_render.camera.beams import electrons_per_radiance
from nir_render.camera.by_spectrum import blocks_by_spectrum, by_spectrum, group_fluxes
from nir_render.camera.mean_frame import MeanFrame
from nir_render.camera.render_noise import temporal_variance_e2
from nir_render.light.enlarge import Enlargement, weights_of
from nir_render.randomness import generator

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_PIXELS_PER_BLOCK = 0.003
_LEAST_PIXELS, _MOST_PIXELS = 256, 1024
_SAMPLES_FACTOR, _LEAST_SAMPLES, _MOST_SAMPLES = 8, 256, 1024


@dataclass(frozen=True, eq=False)
class UpsamplingError:
    """What enlarging adds to a frame.

    Attributes
    ----------
    share
        Mean square of the error that enlarging brings into a pixel, before the lens blurs it (which only
        lowers it), over the mean temporal variance, shot plus read noise, of the frame. Without bias by
        render noise: so a share near nothing can come out slightly negative.
    standard_error
        Of the share.
    largest
        The largest square of an error in one of these pixels, over the temporal variance of that pixel; the
        noise of measuring it is in it.
    pixels
        In how many pixels it was measured.
    """

    share: float
    standard_error: float
    largest: float
    pixels: int


def upsampling_error(
    mean: MeanFrame, pixels: int | None = None, samples: int | None = None
) -> UpsamplingError | str:
    """Render some pixels of a frame's light, and the blocks that these are made of, and compare.

    Pixels are drawn by how much error is to be expected of them: a third evenly over the frame, the others
    where the electrons of the blocks that a pixel is made of differ, and where they change other than
    linearly (Hansen and Hurwitz: each square counts by one over its pixel's probability). Pixels that the
    light holds one by one are right. All is rendered twice, and the square of an error is the product of two
    differences that are independent of each other: noise has the expectation 0. Sources count as they are
    driven in the frame.

    Parameters
    ----------
    pixels
        How many; without, 0.3 % of the blocks, at least 256 and at most 1024.
    samples
        In each, a power of two; without, 8 times those of the light, 256 at least and 1024 at most.

    Returns
    -------
    The reason where there is nothing to measure.
    """
    light, camera = mean.light, mean.camera
    indirect = light.indirect
    sensor_e2 = temporal_variance_e2(mean).ravel()
    if indirect is None:
        return "no indirect light"
    if indirect.scale == 1:
        return "rendered at full resolution"
    if indirect.edges is None:
        return "edges are not known without LLVM"
    if camera.sensor.read_noise_e == 0.0 and not mean.electrons.any():
        return "a dark frame of a sensor without noise"
    fluxes = group_fluxes(light, mean.rates.snapshot) * mean.levels
    if not fluxes.any():
        return "nothing shines in the frame"
    blocks = int(np.prod(indirect.radiance_per_w.shape[2:]))
    if pixels is None:
        pixels = int(np.clip(_PIXELS_PER_BLOCK * blocks, _LEAST_PIXELS, _MOST_PIXELS))
    if samples is None:
        samples = 2 ** int(np.ceil(np.log2(_SAMPLES_FACTOR * indirect.samples)))
        samples = int(np.clip(samples, _LEAST_SAMPLES, _MOST_SAMPLES))
    enlargement = indirect.edges.enlargement
    chance = _chances(mean, fluxes, enlargement)
    drawn = _drawn(chance, pixels, generator(light.seed, "upsampling", light.camera, 0))
    chosen, times = np.unique(drawn, return_counts=True)
    square_e2 = _squares(mean, fluxes, chosen, samples)
    each = np.repeat(square_e2 / (chance[chosen] * len(chance)), times) / float(sensor_e2.mean())
    return UpsamplingError(
        share=float(each.mean()),
        # One from each part: neighbours differ by more than the scatter within a part (Wolter 2007, 8.2).
        standard_error=float(np.mean(np.diff(each) ** 2) / (2.0 * len(each))) ** 0.5,
        largest=float((square_e2 / sensor_e2[chosen]).max()),
        pixels=len(chosen),
    )


def _chances(mean: MeanFrame, fluxes: Array, enlargement: Enlargement) -> Array:
    """Return the probability with which each pixel is drawn, those of the patch never, shape (n,)."""
    light = mean.light
    assert light.indirect is not None
    blocks_e = np.zeros(light.indirect.radiance_per_w.shape[2:])
    even = np.ones((enlargement.rows, enlargement.columns))
    for part in blocks_by_spectrum(light, light.indirect, mean.rates.snapshot, fluxes):
        per_radiance = electrons_per_radiance(mean.camera, part.emitter, mean.exposure_s, part.node)
        size = blocks_e.shape[::-1]
        blocks_e += part.values * cv2.resize(per_radiance, size, interpolation=cv2.INTER_AREA)
    # By size and by its square: that errors go with these is a guess.
    change, bend = _change(blocks_e, enlargement), _bend(blocks_e, enlargement)
    chance = np.zeros(even.size)
    for cue, weight in ((even.ravel(), 2.0), (change, 1.0), (change**2, 1.0), (bend, 1.0), (bend**2, 1.0)):
        cue[enlargement.patch] = 0.0
        if cue.sum() > 0.0:
            chance += weight * cue / cue.sum()
    return np.asarray(chance / max(float(chance.sum()), 1e-300))


def _change(image: Array, enlargement: Enlargement) -> Array:
    """Return by how much the blocks differ that each pixel is made of, of its own surface alone, (n,)."""
    size = (enlargement.columns, enlargement.rows)
    mean, square = (cv2.resize(one, size, interpolation=cv2.INTER_LINEAR) for one in (image, image**2))
    variance = (square - mean**2).ravel()
    weights = enlargement.matrix(image.size)
    middle, share = weights @ image.ravel(), abs(weights)
    variance[enlargement.pixels] = share @ image.ravel() ** 2 - 2.0 * middle * (share @ image.ravel())
    variance[enlargement.pixels] += middle**2 * share.sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _bend(image: Array, enlargement: Enlargement) -> Array:
    """Return the largest second difference, along an axis, of each pixel's block and its neighbours, (n,)."""
    padded = np.pad(image, 1, mode="edge")
    middle = 2.0 * image
    down = np.abs(padded[:-2, 1:-1] + padded[2:, 1:-1] - middle)
    across = np.abs(padded[1:-1, :-2] + padded[1:-1, 2:] - middle)
    bend = cv2.dilate(np.maximum(down, across), np.ones((3, 3)))
    size = (enlargement.columns, enlargement.rows)
    return np.asarray(cv2.resize(bend, size, interpolation=cv2.INTER_NEAREST), dtype=np.float64).ravel()


def _drawn(chance: Array, count: int, random: np.random.Generator) -> Numbers:
    """Return pixels by their probability, one from each of as many parts of equal probability."""
    places = (np.arange(count) + random.random(count)) / count
    total = np.cumsum(chance)
    return np.asarray(np.searchsorted(total, places * total[-1], side="right"), dtype=np.int64)


def _squares(mean: MeanFrame, fluxes: Array, pixels: Numbers, samples: int) -> Array:
    """Return the squares of the errors of pixels in electrons, noise of expectation 0, shape (pixels,)."""
    from nir_render.transport.indirect.groups import rays_of  # Mitsuba loads only where light is rendered
    from nir_render.transport.indirect.guide import group_power
    from nir_render.transport.indirect.sharpen import MULTIPLE, rendered_again

    light, camera, snapshot = mean.light, mean.camera, mean.rates.snapshot
    assert light.indirect is not None
    assert light.indirect.edges is not None
    scale = light.indirect.scale
    weights = weights_of(pixels, scale, light.indirect.edges.enlargement)
    made_of = {scale: weights}
    if light.indirect.multiple is not None:
        made_of[MULTIPLE] = csr_array(weights @ light.indirect.multiple.averages.matrix)
    used = {kind: np.unique(one.nonzero()[1]).astype(np.int64) for kind, one in made_of.items()}
    made_of = {kind: csr_array(one[:, used[kind]]) for kind, one in made_of.items()}
    rays = rays_of(camera, snapshot.camera(light.camera).pose)
    power = group_power(snapshot, camera)
    wanted = {1: pixels, scale: used[scale]}
    renders = rendered_again(
        snapshot, rays, light.seed, power, wanted, samples, light.wavelengths_m, used.get(MULTIPLE)
    )
    square_e2 = np.ones(len(pixels))
    for radiance_per_w in renders:
        error_e = np.zeros(len(pixels))
        for kind, radiance in radiance_per_w.items():
            for part in by_spectrum(light, snapshot, radiance, fluxes):
                response = electrons_per_radiance(camera, part.emitter, mean.exposure_s, part.node)
                values = -part.values if kind == 1 else made_of[kind] @ part.values
                error_e += response.ravel()[pixels] * values
        square_e2 *= error_e
    return square_e2
