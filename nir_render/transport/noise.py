"""How many samples each pixel of the film needs, so that render noise stays a known share of the sensor's.

A pilot of few samples in few pixels, thrown away afterwards and drawn with random numbers of its own, tells
the variance that one sample brings to the electrons of a pixel. The counts follow from it alone, and not from
the samples that they weigh: so the render stays unbiased.

The need of a pixel is the count that brings its render variance to a share of shot and read variance. A
pilot's variance, from 8 batches, is itself noisy, and where rare paths carry the light most of its values are
too small; its mean is right. So needs are means over 5 × 5 pixels of the pilot, and taken a tenth larger.

- The frame's count is the median of the needs, at least 8. Each pixel gets its own need, up to 4 times the
  frame's count: more than half of all pixels then keep the target, and most of the rest too.
- No pixel may look like a flare by render noise: each gets what brings its σ to half of the sensor's, up to
  16 times the frame's count.
- Every flare's aperture gets what brings the sum over it to the target.

Counts are powers of two from 8 to 4096.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.camera.sensor import saturation_dn
from nir_render.expected import aperture_shares, expected, flare_apertures, render_variance_e2
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.transport.light import Light

Array = NDArray[np.float64]

LEAST_SAMPLES, MOST_SAMPLES = 8, 4096
_CAUTION = 1.1
_NEIGHBOURS = 5
_FLARE_LIKE_SHARE = 0.25  # of temporal variance: half of its σ
_RISE, _FLARE_LIKE_RISE = 4, 16  # times the frame's count
_TINY_E2 = 1e-12


def samples_map(pilot: Light, scene: Scene, noise_share: float, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the samples for each pixel of the film.

    Parameters
    ----------
    pilot
        The camera's light with `groups.pilot` as its indirect part.
    noise_share
        Render variance over temporal variance to reach.
    shape
        Rows and columns of the film.
    """
    if pilot.indirect is None:
        return np.full(shape, LEAST_SAMPLES)
    _, camera = scene.camera(pilot.camera)
    at_one_second = expected(pilot, scene, 1.0)
    exposure_s = settled_exposure_s(camera, float(at_one_second.electrons.max()))
    temporal_e2 = at_one_second.electrons * exposure_s + camera.sensor.read_noise_e**2 + _TINY_E2
    of_one_sample = pilot.indirect.samples * _CAUTION
    noise_e2 = render_variance_e2(pilot, scene, exposure_s) * of_one_sample
    parts = pilot.indirect.variance.shape[-1:-3:-1]
    ratio = cv2.resize(noise_e2 / temporal_e2, parts, interpolation=cv2.INTER_AREA)
    ratio = cv2.blur(ratio, (_NEIGHBOURS, _NEIGHBOURS), borderType=cv2.BORDER_REPLICATE)
    ratio = np.asarray(cv2.resize(ratio, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float64)
    need = ratio / noise_share
    frame = max(float(np.median(need)), LEAST_SAMPLES)
    flare_like = np.minimum(ratio / _FLARE_LIKE_SHARE, _FLARE_LIKE_RISE * frame)
    need = np.maximum(np.minimum(need, _RISE * frame), flare_like)
    scale = camera.sensor.rows // shape[0]
    apertures = flare_apertures(pilot, camera)
    shares = aperture_shares(apertures, noise_e2, temporal_e2, scale)
    for aperture, share in zip(apertures, shares, strict=True):
        rows, columns = (
            slice(axis.start // scale, -(-axis.stop // scale)) for axis in (aperture.rows, aperture.columns)
        )
        need[rows, columns] = np.maximum(need[rows, columns], share / noise_share)
    return np.asarray(2 ** np.ceil(np.log2(np.clip(need, LEAST_SAMPLES, MOST_SAMPLES))), dtype=np.int64)


def settled_exposure_s(camera: Camera, brightest_e_per_s: float) -> float:
    """Return a camera's exposure; an automatic one's as it settles, but for noise in its brightest pixel."""
    control, sensor = camera.auto_exposure, camera.sensor
    if control is None:
        return camera.exposure_s
    range_e = (saturation_dn(sensor) - sensor.black_level_dn) / sensor.system_gain_dn_per_e
    wanted_s = control.target * range_e / max(brightest_e_per_s, 1e-300)
    return float(np.clip(wanted_s, control.shortest_s, control.longest_s))
