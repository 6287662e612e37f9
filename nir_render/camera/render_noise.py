"""How much noise the Monte Carlo render adds to a frame, beside the sensor's own.

Both are variances in e² per pixel: that of the render as it measured it itself, from batches, and the
temporal variance of the sensor, shot plus read noise. The lens's blur is left out where a pixel is spoken of:
it moves render noise to neighbours, and by averaging only lowers it; `share_behind_lens` has it. Pixels that
saturate count with the shot noise that they would have without. Sources count as each row of pixels sees
them driven.

What a render says of itself is its own estimate: paths so rare that no sample found them are not in it.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.beams import blur, electrons_per_radiance
from nir_render.camera.by_spectrum import by_spectrum, group_fluxes
from nir_render.camera.mean_frame import MeanFrame, Rates
from nir_render.camera.optics.apertures import Aperture, aperture_weights, flare_apertures
from nir_render.camera.sensor.read_out import dark_variance_e2
from nir_render.light.averages import BlockVariance
from nir_render.light.enlarge import ALL_ROWS, Enlargement, enlarge, enlarge_variance, without_edges
from nir_render.light.light import Light
from nir_render.randomness import generator
from nir_render.scene.documents.camera import Camera
from nir_render.scene.snapshot import Snapshot

Array = NDArray[np.float64]
_Parts = list[tuple[Array, BlockVariance, Array | None]]

_TINY_E2 = 1e-12  # a noiseless sensor in the dark has no noise to compare with
_NEARLY_ALL = 0.99
_PIXELS_DRAWN = 2_000_000
_MOST_DRAWS = 64
_ROW_STEP, _LEAST_PIXELS = 7, 1000  # of a median that is only to be told


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
    frame = _Frame.of(mean)
    if frame is None:
        return RenderNoise()
    share, reached = frame.share, frame.reached
    behind_lens_e2 = (frame.squares_s2 * variance_behind_lens_e2(mean.rates)).sum()
    return RenderNoise(
        median_share=_median(share),
        mean_share=float(frame.noise_e2[reached].sum() / frame.sensor_e2[reached].sum()),
        share_behind_lens=float(behind_lens_e2 / frame.sensor_e2.sum()),
        share_of_99_percent=float(np.quantile(share, _NEARLY_ALL)),
        largest_share=float(share.max()),
        aperture_share=frame.aperture_share(),
        reached=float(reached.mean()),
    )


def share_of_target(mean: MeanFrame) -> float:
    """Return an estimate of what `render.noise` bounds: the larger of the median's and the apertures' share.

    The median is that of every seventh row, a tenth of the work of `render_noise`, whose own is within some
    percent of it. They lie at all places within blocks, as pixels near a block's centre have more of its
    noise. Where few of their pixels have any, all rows are looked at.
    """
    if mean.light.indirect is None:
        return 0.0
    step = _ROW_STEP
    while math.gcd(step, mean.light.indirect.scale) > 1:
        step += 1
    frame = _Frame.of(mean, slice(step // 2, None, step))
    if frame is None or np.count_nonzero(frame.reached) < _LEAST_PIXELS:
        frame = _Frame.of(mean)
    return 0.0 if frame is None else max(_median(frame.share), frame.aperture_share())


@dataclass(frozen=True, eq=False)
class _Frame:
    """Variances of rendering and of the sensor in a frame, and where rendering has any.

    `noise_e2` and `reached` are of the chosen rows, `sensor_e2` of all, shape (rows, columns).
    """

    mean: MeanFrame
    chosen: slice
    noise_e2: Array
    sensor_e2: Array
    reached: NDArray[np.bool_]
    squares_s2: Array

    @classmethod
    def of(cls, mean: MeanFrame, chosen: slice = ALL_ROWS) -> "_Frame | None":
        """Return those of a frame; None where rendering has no noise."""
        if mean.light.indirect is None:
            return None
        # Light is linear in the exposure, and in what the row of pixels collects of each drive.
        squares_s2 = (mean.profiles * mean.exposure_s) ** 2
        of_pixels_e2 = _variance_per_s2(mean.rates, chosen).of_pixels_e2
        noise_e2 = np.einsum("dr,drc->rc", squares_s2[:, chosen], of_pixels_e2)
        reached = noise_e2 > 0.0
        if not reached.any():
            return None
        return cls(mean, chosen, noise_e2, temporal_variance_e2(mean), reached, squares_s2)

    @cached_property
    def share(self) -> Array:
        """The share of pixels with noise, shape (pixels,)."""
        share: Array = self.noise_e2 / self.sensor_e2[self.chosen]
        return share.ravel() if self.reached.all() else share[self.reached]

    def aperture_share(self) -> float:
        """Return the largest share of the sum over a flare's aperture."""
        of_apertures_e2 = _variance_per_s2(self.mean.rates, self.chosen).of_apertures_e2
        apertures = flare_apertures(self.mean.light, self.mean.camera)
        shares = [
            float(_mean_over_rows(one, self.squares_s2) @ noise) / one.sum(self.sensor_e2)
            for noise, one in zip(of_apertures_e2.T, apertures, strict=True)
        ]
        return max(shares, default=0.0)


def _median(values: Array) -> float:
    """Return the median; NumPy's own looks for two places of the order at once, in eight times as long."""
    above = len(values) // 2
    ordered = np.partition(values, above)
    middle = float(ordered[above])
    return middle if len(values) % 2 else 0.5 * (float(ordered[:above].max()) + middle)


def _mean_over_rows(aperture: Aperture, of_rows: Array) -> Array:
    """Return means over an aperture's pixels of what rows have, shape (drives, rows); shape (drives,)."""
    return np.asarray(np.average(of_rows[:, aperture.rows], axis=1, weights=aperture.inside.sum(axis=1)))


@dataclass(frozen=True, eq=False)
class _Variance:
    """What rendering adds to an exposure of one second of each drive, fully lit.

    To each pixel of some rows, shape (drives, rows, columns); to the sums over apertures, shape
    (drives, apertures).
    """

    of_pixels_e2: NDArray[np.float32]
    of_apertures_e2: Array


def _variance_per_s2(rates: Rates, chosen: slice) -> _Variance:
    """Return the variance of rates in chosen rows, kept with them."""
    name = f"render_variance {chosen}"
    kept: _Variance | None = rates.kept.get(name)
    if kept is None:
        kept = rates.kept[name] = _variance_of(rates, chosen)
    return kept


def _variance_of(rates: Rates, chosen: slice) -> _Variance:
    light, apertures = rates.light, flare_apertures(rates.light, rates.camera)
    if rates.between:
        between = [
            sum(
                weight**2 * aperture_variances_e2(one.light, one.snapshot, 1.0, apertures, of_drive)
                for weight, one in rates.between
            )
            for of_drive in _levels(rates)
        ]
        return _Variance(
            np.sum(
                [
                    np.float32(weight**2) * _variance_per_s2(one, chosen).of_pixels_e2
                    for weight, one in rates.between
                ],
                axis=0,
            ),
            np.stack([np.asarray(of_drive) for of_drive in between]),
        )
    of_pixels, of_apertures = [], []
    for of_drive in _levels(rates):  # one at a time: each is as large as some frames
        parts = _variances(light, rates.snapshot, 1.0, of_drive)
        of_pixels.append(_of_pixels_e2(light, rates.camera, parts, chosen).astype(np.float32))
        of_apertures.append(_of_apertures_e2(light, rates.camera, parts, apertures))
    return _Variance(np.stack(of_pixels), np.stack(of_apertures))


def _levels(rates: Rates) -> list[Array]:
    """Return of each drive which groups have it, shape (groups,)."""
    return [np.where(rates.drive == number, 1.0, 0.0) for number in range(len(rates.drives))]


def variance_behind_lens_e2(rates: Rates) -> Array:
    """Return the variance per s² that rendering adds behind the lens, fully lit, shape (drives, rows).

    It is the sum over each row of pixels, and kept with the rates.
    """
    kept: Array | None = rates.kept.get("render_variance_behind_lens")
    if kept is None:
        if rates.between:
            ends = [weight**2 * variance_behind_lens_e2(one) for weight, one in rates.between]
            kept = np.asarray(np.sum(ends, axis=0))
        else:
            parts = (_variances(rates.light, rates.snapshot, 1.0, of_drive) for of_drive in _levels(rates))
            kept = np.stack([_behind_lens_e2(rates.light, rates.camera, own) for own in parts])
        rates.kept["render_variance_behind_lens"] = kept
    return kept


def _behind_lens_e2(light: Light, camera: Camera, parts: _Parts) -> Array:
    """Return the variance per s² behind the lens's blur, summed over each row of pixels, shape (rows,).

    Noise of the variance that the render states is drawn, block by block, and goes the way of light: it is
    enlarged, weighted with the response, blurred. Its mean square has the expectation of that variance,
    whatever enlarging and blur mix; of 2 million pixels drawn it is off by about 1 %.
    """
    rows, columns = camera.sensor.rows, camera.sensor.columns
    enlargement = _enlargement(light)
    draws = int(np.clip(np.ceil(_PIXELS_DRAWN / (rows * columns)), 1, _MOST_DRAWS))
    random = generator(light.seed, "render_noise", light.camera, 0)
    total_e2 = np.zeros(rows)
    for _ in range(draws):
        noise_e = np.zeros((rows, columns))
        for factor, variance, patch in parts:
            of_blocks = variance.drawn(random)
            of_patch = None if patch is None else np.sqrt(patch) * random.standard_normal(patch.shape)
            noise_e += factor * enlarge(of_blocks, rows, columns, enlargement, of_patch)
        total_e2 += (blur(camera, noise_e) ** 2).sum(axis=1)
    return total_e2 / draws


def temporal_variance_e2(mean: MeanFrame) -> Array:
    """Return the sensor's shot and dark variance per pixel, shape (rows, columns)."""
    return mean.electrons + (dark_variance_e2(mean.camera.sensor, mean.exposure_s) + _TINY_E2)


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
    return _of_pixels_e2(light, camera, _variances(light, snapshot, exposure_s, levels))


def _of_pixels_e2(light: Light, camera: Camera, parts: _Parts, chosen: slice = ALL_ROWS) -> Array:
    rows, columns = camera.sensor.rows, camera.sensor.columns
    total, enlargement = np.zeros((len(range(rows)[chosen]), columns)), _enlargement(light)
    for factor, variance, patch in parts:
        of_part = factor[chosen] * enlarge_variance(variance, rows, columns, enlargement, patch, chosen)
        of_part *= factor[chosen]  # in place: images are large
        total += of_part
    return total


def aperture_variances_e2(
    light: Light,
    snapshot: Snapshot,
    exposure_s: float,
    apertures: list[Aperture],
    levels: Array | None = None,
) -> Array:
    """Return the variance that rendering adds to the sum over each aperture, shape (apertures,).

    Pixels of one block share its noise, and blocks what is averaged over them. `levels`
    is that of `render_variance_e2`.
    """
    camera = snapshot.camera(light.camera).camera
    return _of_apertures_e2(light, camera, _variances(light, snapshot, exposure_s, levels), apertures)


def _of_apertures_e2(light: Light, camera: Camera, parts: _Parts, apertures: list[Aperture]) -> Array:
    total = np.zeros(len(apertures))
    if light.indirect is None or not apertures:
        return total
    enlargement = _enlargement(light) or without_edges(camera.sensor.rows, camera.sensor.columns)
    for factor, variance, patch in parts:
        of_blocks, of_patch = aperture_weights(apertures, factor, light.indirect.scale, enlargement)
        total += variance.of_sums(of_blocks)
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
    parts = by_spectrum(light, snapshot, variance, squares)
    factors = [electrons_per_radiance(camera, part.emitter, exposure_s, part.node) for part in parts]
    if len(light.nodes) > 1:
        # Nodes are carried along the same paths, so that their noise goes together: (Σ f σ)², which is at
        # most Σ f · Σ f σ², and just that where σ is the same at all nodes.
        step = len(light.nodes)
        totals = [np.sum(factors[begin : begin + step], axis=0) for begin in range(0, len(parts), step)]
        factors = [np.sqrt(factor * totals[row // step]) for row, factor in enumerate(factors)]
    return [(factor, part.values) for factor, part in zip(factors, parts, strict=True)]


def _enlargement(light: Light) -> Enlargement | None:
    """Return how blocks become pixels along edges; None where they do as everywhere."""
    return (
        None if light.indirect is None or light.indirect.edges is None else light.indirect.edges.enlargement
    )


def _variances(light: Light, snapshot: Snapshot, exposure_s: float, levels: Array | None) -> _Parts:
    """Return, by spectrum, electrons per radiance (rows, columns), variances of blocks and of the patch."""
    if light.indirect is None:
        return []
    squares = (group_fluxes(light, snapshot) * (1.0 if levels is None else levels)) ** 2
    edges, multiple = light.indirect.edges, light.indirect.multiple
    parts = variance_by_spectrum(light, snapshot, exposure_s, light.indirect.variance, squares)
    patches = [] if edges is None else by_spectrum(light, snapshot, edges.variance, squares)
    factors, whole = [factor for factor, _ in parts], [variance for _, variance in parts]
    if multiple is None:
        blocks = [BlockVariance(variance) for variance in whole]
    else:
        averaged, covariances = (
            [part.values for part in by_spectrum(light, snapshot, array, squares)]
            for array in (multiple.variance, multiple.covariance)
        )
        around = multiple.averages
        blocks = [BlockVariance(*one, around) for one in zip(whole, averaged, covariances, strict=True)]
    return [
        (factor, block, None if patch is None else patch.values)
        for factor, block, patch in zip_longest(factors, blocks, patches)
    ]
