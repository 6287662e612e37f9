"""How much noise the Monte Carlo render adds to a frame, beside the sensor's own.

Both are variances in e² per pixel: that of the render as it measured it itself, from batches, and the
temporal variance of the sensor, shot plus read noise. The lens's blur is left out: it moves render noise to
neighbours, and by averaging only lowers it. Pixels that saturate count with the shot noise that they would
have without.

What a render says of itself is its own estimate: paths so rare that no sample found them are not in it.
"""

from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.apertures import Aperture, aperture_weights
from nir_render.camera.enlarge import enlarge_variance, without_edges
from nir_render.camera.exposure import diffuse_electrons
from nir_render.expected import Expected, by_spectrum, flare_apertures, fluxes
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.transport.light import Light

Array = NDArray[np.float64]

_TINY_E2 = 1e-12  # a noiseless sensor in the dark has no noise to compare with
_NEARLY_ALL = 0.99


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
    share_of_99_percent, largest_share
        What 99 % of these pixels keep, and the largest of all.
    aperture_share
        The same of the sum over a flare's aperture, the largest of all flares; 0 where none is seen.
    reached
        These pixels' share of the frame.
    """

    median_share: float = 0.0
    mean_share: float = 0.0
    share_of_99_percent: float = 0.0
    largest_share: float = 0.0
    aperture_share: float = 0.0
    reached: float = 0.0

    def keeps(self, target_share: float) -> bool:
        """Tell whether a target is kept in the median pixel and in every flare's aperture."""
        return max(self.median_share, self.aperture_share) <= target_share


def render_noise(mean: Expected, scene: Scene) -> RenderNoise:
    """Return the render's noise in a frame."""
    _, camera = scene.camera(mean.light.camera)
    if mean.light.indirect is None:
        return RenderNoise()
    noise_e2 = render_variance_e2(mean.light, scene, mean.exposure_s)
    sensor_e2 = temporal_variance_e2(mean, camera)
    reached = noise_e2 > 0.0
    if not reached.any():
        return RenderNoise()
    share = noise_e2[reached] / sensor_e2[reached]
    apertures = flare_apertures(mean.light, camera)
    of_sums_e2 = aperture_variances_e2(mean.light, scene, mean.exposure_s, apertures)
    of_apertures = [noise / one.sum(sensor_e2) for noise, one in zip(of_sums_e2, apertures, strict=True)]
    return RenderNoise(
        median_share=float(np.median(share)),
        mean_share=float(noise_e2[reached].sum() / sensor_e2[reached].sum()),
        share_of_99_percent=float(np.quantile(share, _NEARLY_ALL)),
        largest_share=float(share.max()),
        aperture_share=float(max(of_apertures, default=0.0)),
        reached=float(reached.mean()),
    )


def temporal_variance_e2(mean: Expected, camera: Camera) -> Array:
    """Return the sensor's shot and read variance per pixel, shape (rows, columns)."""
    return mean.electrons + camera.sensor.read_noise_e**2 + _TINY_E2


def render_variance_e2(light: Light, scene: Scene, exposure_s: float) -> Array:
    """Return the variance per pixel that rendering adds, the blur's averaging left out, (rows, columns).

    All groups share one pass. Each time a path asks for light it asks for that of one group, and the others
    get nothing: their covariances are about zero, or slightly below. Variances are added: the variance of the
    sum was 0.93 to 1.0 times the sum of variances.
    """
    _, camera = scene.camera(light.camera)
    rows, columns = camera.sensor.rows, camera.sensor.columns
    total = np.zeros((rows, columns))
    edges = None if light.indirect is None else light.indirect.edges
    how = None if edges is None else edges.enlargement
    for factor, variance, patch in _variances(light, scene, exposure_s):
        total += factor**2 * enlarge_variance(variance, rows, columns, how, patch)
    return total


def aperture_variances_e2(light: Light, scene: Scene, exposure_s: float, apertures: list[Aperture]) -> Array:
    """Return the variance that rendering adds to the sum over each aperture, shape (apertures,).

    Pixels of one block share its noise: `aperture_weights` says how much of it comes into the sum.
    """
    _, camera = scene.camera(light.camera)
    total = np.zeros(len(apertures))
    if light.indirect is None or not apertures:
        return total
    edges = light.indirect.edges
    how = without_edges(camera.sensor.rows, camera.sensor.columns) if edges is None else edges.enlargement
    for factor, variance, patch in _variances(light, scene, exposure_s):
        of_blocks, of_patch = aperture_weights(apertures, factor, light.indirect.scale, how)
        total += of_blocks.multiply(of_blocks) @ variance.ravel()
        if patch is not None:
            total += of_patch.multiply(of_patch) @ patch
    return total


def _variances(light: Light, scene: Scene, exposure_s: float) -> list[tuple[Array, Array, Array | None]]:
    """Return, by spectrum, electrons per radiance (rows, columns), variances of blocks and of the patch."""
    if light.indirect is None:
        return []
    _, camera = scene.camera(light.camera)
    even, squares = np.ones((camera.sensor.rows, camera.sensor.columns)), fluxes(light, scene) ** 2
    edges = light.indirect.edges
    parts = by_spectrum(light, scene, light.indirect.variance, squares)
    patches = [] if edges is None else by_spectrum(light, scene, edges.variance, squares)
    return [
        (diffuse_electrons(camera, even, emitter, exposure_s), variance, patch)
        for (emitter, variance), patch in zip_longest(parts, (patch for _, patch in patches))
    ]
