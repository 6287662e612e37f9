"""Samples of pixels, walked in batches: mean radiance and its variance."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.begin import Film
from nir_render.transport.indirect.kernel.draws import lane_draws
from nir_render.transport.indirect.kernel.paths import walk
from nir_render.transport.indirect.kernel.tables import DeviceScene

BATCHES = 8
_NOTHING = 1e-28  # 1/(m² sr)²

Means = list[NDArray[np.float32]]


def sample_means(
    built: DeviceScene, film: Film, seed: int, groups: int, samples: int, narrow: float | None = None
) -> Means:
    """Return radiance per unit of each group in some pixels, and its variance, (groups × nodes, pixels).

    The samples make up to 8 batches, independent of each other; the variance is that of their mean. With
    `narrow`, as in `kernel.tables.DeviceScene`, there are three more arrays: mean and variance of the light
    that was turned twice or more, which is in the others too, and the covariance of this mean and the rest's.

    No contribution is so large that sums of them are not finite. Where one is not, the machine went wrong
    (seen once: a single block of a film that other runs render right), and the same samples are walked again.

    Raises
    ------
    InputError
        They are not finite the second time either.
    """
    for _ in range(2):
        means = _sample_means(built, film, seed, groups, samples, narrow)
        if all(np.isfinite(array).all() for array in means):
            return means
        wrong = sum(int((~np.isfinite(array)).sum()) for array in means)
        text = "indirect light came back not finite in %d of its values; the same samples are walked again"
        logging.getLogger(__name__).warning(text, wrong)
    raise InputError(
        f"indirect light is not finite in {wrong} of its values, rendered twice: a body or source may be "
        "degenerate; if none is, ask nir-render doctor whether this machine renders right"
    )


def _sample_means(
    built: DeviceScene, film: Film, seed: int, groups: int, samples: int, narrow: float | None
) -> Means:
    batches = min(BATCHES, samples)
    pixels, lanes = film.pixel_count, film.pixel_count * batches
    lane = dr.arange(mi.UInt32, lanes)
    pixel = dr.gather(mi.UInt32, film.index, lane % film.pixels)
    draw = lane_draws(pixel, lane // film.pixels, seed, dr.opaque(mi.UInt32, samples // batches))
    if narrow is not None:
        built = replace(built, narrow=dr.opaque(mi.Float, narrow))
    sums = walk(built, film, pixel, draw, lanes, groups, dr.opaque(mi.UInt32, built.max_depth))
    layers = groups * built.node_count
    place = dr.arange(mi.UInt32, layers * pixels)
    layer = place // film.pixels
    first = layer * dr.opaque(mi.UInt32, lanes) + (place - layer * film.pixels)
    of_part = dr.opaque(mi.UInt32, layers * lanes)

    def of_batches(part: int) -> list[Any]:
        """Return the mean of each batch: of all light, or of that turned once at most, and of the rest."""
        return [
            dr.gather(mi.Float, sums, first + batch * film.pixels + part * of_part) / mi.Float(draw.samples)
            for batch in range(batches)
        ]

    def covariance(ones: list[Any], others: list[Any]) -> Any:
        """Return that of two means, from their batches'."""
        one, other = mean_of(ones), mean_of(others)
        products = ((a - one) * (b - other) for a, b in zip(ones, others, strict=True))
        return sum(products, mi.Float(0)) / max(batches * (batches - 1), 1)

    def mean_of(ones: list[Any]) -> Any:
        return sum(ones[1:], ones[0]) / batches

    means = of_batches(0)
    found = []
    if narrow is not None:
        few, many = means, of_batches(1)
        means = [one + other for one, other in zip(few, many, strict=True)]
        found = [mean_of(many), covariance(many, many), covariance(few, many)]
    mean = mean_of(means)
    square = sum((dr.square(batch_mean - mean) for batch_mean in means), mi.Float(0))
    # Squares of rounding errors are nothing either (see `paths`).
    variance = dr.select(square > _NOTHING, square, 0.0) / max(batches * (batches - 1), 1)
    found = [mean, variance, *found]
    dr.eval(found)
    return [np.array(one).reshape(layers, pixels) for one in found]
