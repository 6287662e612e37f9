"""How much noise the Monte Carlo render adds to a frame, beside the sensor's own.

Both are variances in e² per pixel: that of the render as it measured it itself, from batches, and the
temporal variance of the sensor, shot plus read noise. The lens's blur is left out where a pixel is spoken of:
it moves render noise to neighbours, and by averaging only lowers it; `share_behind_lens` has it. Pixels that
saturate count with the shot noise that they would have without. Sources count as each row of pixels sees
them driven.

What a render says of itself is its own estimate: paths so rare that no sample found them are not in it.
"""

from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.beams import blur, diffuse_electrons
from nir_render.camera.by_spectrum import by_spectrum, group_fluxes
from nir_render.camera.mean_frame import MeanFrame, Rates
from nir_render.camera.optics.apertures import Aperture, aperture_weights, flare_apertures
from nir_render.camera.sensor.read_out import dark_variance_e2
from nir_render.light.enlarge import enlarge, enlarge_variance, without_edges
from nir_render.light.light import Light
from nir_render.randomness import generator
from nir_render.scene.snapshot import Snapshot

Array = NDArray[np.float64]

_TINY_E2 = 1e-12  # a noiseless sensor in the dark has no noise to compare with
_NEARLY_ALL = 0.99
_PIXELS_DRAWN = 2_000_000
_MOST_DRAWS = 64


@dataclass(frozen=True)
class RenderNoise:
    """Variance of the render over the sensor's temporal variance.

    Attributes
    ----------
    median_share
        Median over the pixels that indirect light reaches, which are those with noise; 0 where there is none.
    mean_share
        Sum of the render's variance over that of the sensor's, over the same pixels: what rare paths bring
        is in the mean before it is in the median.
    share_behind_lens
        `mean_share` of the frame as the sensor sees it, behind the lens's blur: by so much the variance of
        frames from independent renders is above that of frames which share one light.
    share_of_99_percent, largest_share
        What 99 % of these pixels keep, and the largest of all.
    aperture_share
        The same of the sum over a flare's aperture, the largest of all flares; 0 where none is seen.
    reached
        These pixels' share of the frame.
    """

    median_share: float = 0.0
    mean_share: float = 0.0
    share_behind_lens: float = 0.0
    share_of_99_percent: float = 0.0
    largest_share: float = 0.0
    aperture_share: float = 0.0
    reached: float = 0.0

    def keeps(self, target_share: float) -> bool:
        """Tell whether a target is kept in the median pixel and in every flare's aperture."""
        return max(self.median_share, self.aperture_share) <= target_share


def render_noise(mean: MeanFrame) -> RenderNoise:
    """Return the render's noise in a frame."""
    if mean.light.indirect is None:
        return RenderNoise()
    apertures = flare_apertures(mean.light, mean.camera)
    per_s2 = _variance_per_s2(mean.rates)
    # Light is linear in the exposure, and in what the row of pixels collects of each drive.
    squares_s2 = (mean.profiles * mean.exposure_s) ** 2
    noise_e2 = np.einsum("dr,drc->rc", squares_s2, per_s2.of_pixels_e2)
    sensor_e2 = temporal_variance_e2(mean)
    reached = noise_e2 > 0.0
    if not reached.any():
        return RenderNoise()
    share = noise_e2[reached] / sensor_e2[reached]
    of_apertures = [
        float(_mean_over_rows(one, squares_s2) @ noise) / one.sum(sensor_e2)
        for noise, one in zip(per_s2.of_apertures_e2.T, apertures, strict=True)
    ]
    return RenderNoise(
        median_share=float(np.median(share)),
        mean_share=float(noise_e2[reached].sum() / sensor_e2[reached].sum()),
        share_behind_lens=float((squares_s2 * per_s2.behind_lens_e2).sum() / sensor_e2.sum()),
        share_of_99_percent=float(np.quantile(share, _NEARLY_ALL)),
        largest_share=float(share.max()),
        aperture_share=max(of_apertures, default=0.0),
        reached=float(reached.mean()),
    )


def _mean_over_rows(aperture: Aperture, of_rows: Array) -> Array:
    """Return means over an aperture's pixels of what rows have, shape (drives, rows); shape (drives,)."""
    return np.asarray(np.average(of_rows[:, aperture.rows], axis=1, weights=aperture.inside.sum(axis=1)))


@dataclass(frozen=True, eq=False)
class _Variance:
    """What rendering adds to an exposure of one second of each drive, fully lit.

    To each pixel, shape (drives, rows, columns); to the sums over apertures, shape (drives, apertures);
    behind the lens to the sums of the squares over rows of pixels, shape (drives, rows).
    """

    of_pixels_e2: NDArray[np.float32]
    of_apertures_e2: Array
    behind_lens_e2: Array


def _variance_per_s2(rates: Rates) -> _Variance:
    """Return the variance of rates, kept with them."""
    kept: _Variance | None = rates.kept.get("render_variance")
    if kept is None:
        kept = rates.kept["render_variance"] = _variance_of(rates)
    return kept


def _variance_of(rates: Rates) -> _Variance:
    light, snapshot = rates.light, rates.snapshot
    apertures = flare_apertures(light, rates.camera)
    levels = [np.where(rates.drive == number, 1.0, 0.0) for number in range(len(rates.drives))]
    if rates.between:
        ends = [(weight**2, one, _variance_per_s2(one)) for weight, one in rates.between]
        of_apertures = [
            sum(
                square * aperture_variances_e2(one.light, one.snapshot, 1.0, apertures, of_drive)
                for square, one, _ in ends
            )
            for of_drive in levels
        ]
        return _Variance(
            np.sum([np.float32(square) * one.of_pixels_e2 for square, _, one in ends], axis=0),
            np.stack([np.asarray(of_drive) for of_drive in of_apertures]),
            np.sum([square * one.behind_lens_e2 for square, _, one in ends], axis=0),
        )
    return _Variance(
        np.stack(
            [render_variance_e2(light, snapshot, 1.0, of_drive).astype(np.float32) for of_drive in levels]
        ),
        np.stack([aperture_variances_e2(light, snapshot, 1.0, apertures, of_drive) for of_drive in levels]),
        np.stack([_behind_lens_e2(light, snapshot, of_drive) for of_drive in levels]),
    )


def variance_behind_lens_e2(rates: Rates) -> Array:
    """Return the variance per s² that rendering adds behind the lens, fully lit, shape (drives, rows).

    It is the sum over each row of pixels.
    """
    return _variance_per_s2(rates).behind_lens_e2


def _behind_lens_e2(light: Light, snapshot: Snapshot, levels: Array) -> Array:
    """Return the variance per s² behind the lens's blur, summed over each row of pixels, shape (rows,).

    Noise of the variance that the render states is drawn, block by block, and goes the way of light: it is
    enlarged, weighted with the response, blurred. Its mean square has the expectation of that variance,
    whatever enlarging and blur mix; of 2 million pixels drawn it is off by about 1 %.
    """
    camera = snapshot.camera(light.camera).camera
    rows, columns = camera.sensor.rows, camera.sensor.columns
    edges = None if light.indirect is None else light.indirect.edges
    enlargement = None if edges is None else edges.enlargement
    draws = int(np.clip(np.ceil(_PIXELS_DRAWN / (rows * columns)), 1, _MOST_DRAWS))
    random = generator(light.seed, "render_noise", light.camera, 0)
    total_e2 = np.zeros(rows)
    for _ in range(draws):
        noise_e = np.zeros((rows, columns))
        for factor, variance, patch in _variances(light, snapshot, 1.0, levels):
            of_blocks = np.sqrt(variance) * random.standard_normal(variance.shape)
            of_patch = None if patch is None else np.sqrt(patch) * random.standard_normal(patch.shape)
            noise_e += factor * enlarge(of_blocks, rows, columns, enlargement, of_patch)
        total_e2 += (blur(camera, noise_e) ** 2).sum(axis=1)
    return total_e2 / draws


def temporal_variance_e2(mean: MeanFrame) -> Array:
    """Return the sensor's shot and dark variance per pixel, shape (rows, columns)."""
    return mean.electrons + dark_variance_e2(mean.camera.sensor, mean.exposure_s) + _TINY_E2


def render_variance_e2(
    light: Light, snapshot: Snapshot, exposure_s: float, levels: Array | None = None
) -> Array:
    """Return the variance per pixel that rendering adds, the blur's averaging left out, (rows, columns).

    `levels` is what a frame collects of each group, relative to full drive, shape (groups,); None: all.

    All groups share one pass. Each time a path asks for light it asks for that of one group, and the others
    get nothing: their covariances are about zero, or slightly below. Variances are added: the variance of the
    sum was 0.93 to 1.0 times the sum of variances.
    """
    camera = snapshot.camera(light.camera).camera
    rows, columns = camera.sensor.rows, camera.sensor.columns
    total = np.zeros((rows, columns))
    edges = None if light.indirect is None else light.indirect.edges
    enlargement = None if edges is None else edges.enlargement
    for factor, variance, patch in _variances(light, snapshot, exposure_s, levels):
        total += factor**2 * enlarge_variance(variance, rows, columns, enlargement, patch)
    return total


def aperture_variances_e2(
    light: Light,
    snapshot: Snapshot,
    exposure_s: float,
    apertures: list[Aperture],
    levels: Array | None = None,
) -> Array:
    """Return the variance that rendering adds to the sum over each aperture, shape (apertures,).

    Pixels of one block share its noise: `aperture_weights` says how much of it comes into the sum. `levels`
    is that of `render_variance_e2`.
    """
    camera = snapshot.camera(light.camera).camera
    total = np.zeros(len(apertures))
    if light.indirect is None or not apertures:
        return total
    edges = light.indirect.edges
    sensor = camera.sensor
    enlargement = without_edges(sensor.rows, sensor.columns) if edges is None else edges.enlargement
    for factor, variance, patch in _variances(light, snapshot, exposure_s, levels):
        of_blocks, of_patch = aperture_weights(apertures, factor, light.indirect.scale, enlargement)
        total += of_blocks.multiply(of_blocks) @ variance.ravel()
        if patch is not None:
            total += of_patch.multiply(of_patch) @ patch
    return total


def variance_by_spectrum(
    light: Light, snapshot: Snapshot, exposure_s: float, variance: NDArray[np.float32], squares: Array
) -> list[tuple[Array, Array]]:
    """Return electrons per radiance, shape (rows, columns), and variances, by spectrum and wavelength node.

    The variance of the electrons is the sum of factor² × variance over the list.

    Parameters
    ----------
    variance
        Of the radiance of each group, shape (group, node, …).
    squares
        Of what each group counts, shape (groups,).
    """
    camera = snapshot.camera(light.camera).camera
    even = np.ones((camera.sensor.rows, camera.sensor.columns))
    parts = by_spectrum(light, snapshot, variance, squares)
    factors = [diffuse_electrons(camera, even, part.emitter, exposure_s, part.node) for part in parts]
    if len(light.nodes) > 1:
        # Nodes are carried along the same paths, so that their noise goes together: (Σ f σ)², which is at
        # most Σ f · Σ f σ², and just that where σ is the same at all nodes.
        step = len(light.nodes)
        totals = [np.sum(factors[begin : begin + step], axis=0) for begin in range(0, len(parts), step)]
        factors = [np.sqrt(factor * totals[row // step]) for row, factor in enumerate(factors)]
    return [(factor, part.values) for factor, part in zip(factors, parts, strict=True)]


def _variances(
    light: Light, snapshot: Snapshot, exposure_s: float, levels: Array | None
) -> list[tuple[Array, Array, Array | None]]:
    """Return, by spectrum, electrons per radiance (rows, columns), variances of blocks and of the patch."""
    if light.indirect is None:
        return []
    squares = (group_fluxes(light, snapshot) * (1.0 if levels is None else levels)) ** 2
    edges = light.indirect.edges
    parts = variance_by_spectrum(light, snapshot, exposure_s, light.indirect.variance, squares)
    patches = [] if edges is None else by_spectrum(light, snapshot, edges.variance, squares)
    return [
        (factor, variance, None if patch is None else patch.values)
        for (factor, variance), patch in zip_longest(parts, patches)
    ]
