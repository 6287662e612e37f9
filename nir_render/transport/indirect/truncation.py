"""What paths longer than the longest allowed would bring: the share of light that a render leaves out.

Some pixels are rendered twice, by the same random numbers: as they are, and with paths that may go on four
times as far. Both walks are the same up to the last vertex of the shorter; what is still alive there goes on
in the other, and the difference is what it brings.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.by_spectrum import group_emitters, group_fluxes
from nir_render.camera.mean_frame import MeanFrame
from nir_render.camera.optics.response import response

_LONGER, _LONGEST = 4, 512
_PIXELS, _SAMPLES = 1200, 128


@dataclass(frozen=True, eq=False)
class Truncation:
    """What is left out.

    Attributes
    ----------
    max_depth
        The longest path, in stretches.
    share
        Share of the indirect light of a frame in which all that blinks is fully lit, in electrons, roughly.
    standard_error
        Of it, from the scatter over pixels.
    of_groups
        The share of each group's own light, by its name; 0 where it brings none.
    """

    max_depth: int
    share: float
    standard_error: float
    of_groups: dict[str, float]


def truncation(mean: MeanFrame) -> Truncation | str:
    """Return what a frame's light leaves out; the reason where there is nothing to measure."""
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.indirect import groups  # Mitsuba loads only where light is rendered
    from nir_render.transport.indirect.guide import group_power

    light, camera, snapshot = mean.light, mean.camera, mean.rates.snapshot
    if light.indirect is None:
        return "no indirect light"
    if not backend().vectorised:
        return "not known without LLVM"
    rays = groups.rays_of(camera, snapshot.camera(light.camera).pose)
    built = groups.world_on_device(snapshot, group_power(snapshot, camera))
    scale = light.indirect.scale
    rows, columns = groups.film_shape(rays, scale)
    step = max(int((rows * columns / _PIXELS) ** 0.5), 1)
    row, column = (groups.middles(count, step) for count in (rows, columns))
    pixels = (row[:, None] * columns + column).ravel()
    key = groups.light_seed(light.seed, "truncation", light.camera)
    longer = replace(built, max_depth=min(_LONGER * built.max_depth, _LONGEST))
    whole, kept = (
        groups.render_pixels(snapshot, one, rays, key, pixels, np.full(pixels.size, _SAMPLES), scale)[0][:, 0]
        for one in (longer, built)
    )
    responses = [float(response(camera, one)(0.0)) for one in group_emitters(light, snapshot)]
    weights = group_fluxes(light, snapshot) * np.array(responses)
    return _shares(light.groups, built.max_depth, weights, whole, kept)


def _shares(
    names: tuple[str, ...],
    max_depth: int,
    weights: NDArray[np.float64],
    whole: NDArray[np.float32],
    kept: NDArray[np.float32],
) -> Truncation:
    """Return the shares left out, of radiances with long paths and without, shape (groups, pixels)."""
    everything = whole.astype(np.float64)
    left = everything - kept
    sums, left_sums = everything.sum(axis=1), left.sum(axis=1)
    of_groups = np.where(sums > 0.0, left_sums / np.where(sums > 0.0, sums, 1.0), 0.0)
    total = max(float(weights @ sums), 1e-300)
    share = float(weights @ left_sums) / total
    # Of a ratio: from what each pixel leaves out beyond that share of its light.
    scatter = weights @ left - share * (weights @ everything)
    return Truncation(
        max_depth,
        share,
        float(np.sqrt((scatter**2).sum())) / total,
        dict(zip(names, map(float, of_groups), strict=True)),
    )
