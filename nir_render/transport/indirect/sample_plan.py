"""How many samples each pixel of the film needs, so that render noise stays a known share of the sensor's.

A pilot of few samples in few pixels, thrown away afterwards and drawn with random numbers of its own, tells
the variance that one sample brings to the electrons of a pixel. The counts follow from it alone, and not from
the samples that they weigh: so the render stays unbiased.

The need of a pixel is the count that brings its render variance to a share of shot and read variance. A
pilot's variance, from 8 batches, is itself noisy, and where rare paths carry the light most of its values are
too small; its mean is right. So needs are means over 5 × 5 pixels of the pilot, and taken a tenth larger.

In fog light of many turns is averaged over blocks (`averaging`): sums are made of blocks around then, too,
and of their noise little is left. A pixel that is rendered one by one has no averages.

- The frame's count is the median of the needs of the pixels that light reaches, at least 8. Each pixel gets
  its own need, up to 4 times the frame's count: more than half of all pixels then keep the target, and most
  of the rest too.
- No pixel of the film should look like a flare by render noise: each gets what brings, as far as a pilot can
  tell, the σ of the sum over it, scale × scale sensor pixels of the same noise, to half of the sensor's. All
  together may bring the samples of the frame to 4 times what they are without; where that is not enough the
  neediest pixels are cut, but none below 16 times the frame's count.
- Every flare's aperture gets what brings the sum over it to the target, two standard errors of the pilot on
  top: there the pilot has all blocks that the sum is made of, as light is often brightest beside a
  flare, and the pixels that are rendered one by one. What each counts in the sum is known from how blocks
  are enlarged.

Counts are powers of two from 8 to 4096.

A light serves many frames. The plan is for one in which every source that blinks is fully lit, at the longest
of a bracket's exposures. In a frame in which the brightest are dark, the share that the others' render noise
has can be larger; `render_noise` tells it frame by frame.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nir_render.camera.by_spectrum import group_emitters, group_fluxes
from nir_render.camera.mean_frame import electron_rates, fully_lit_frame
from nir_render.camera.optics.apertures import aperture_weights, flare_apertures
from nir_render.camera.render_noise import temporal_variance_e2, variance_by_spectrum
from nir_render.camera.timing.drive import drive_of
from nir_render.camera.timing.exposure_control import setting_for
from nir_render.light.averages import Averages
from nir_render.light.enlarge import Enlargement
from nir_render.light.light import Indirect, Light
from nir_render.scene.documents.camera import Camera
from nir_render.scene.snapshot import Snapshot

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

LEAST_SAMPLES, MOST_SAMPLES = 8, 4096
_CAUTION, _CAUTIOUS_ERRORS = 1.1, 2.0
_NEIGHBOURS = 5
_FLARE_LIKE_SHARE = 0.25  # of temporal variance: half of its σ
_RISE, _FLARE_LIKE_RISE = 4, 16  # times the frame's count
_BUDGET = 4  # times the samples of a frame without care for pixels that look like flares
_BLOCKS_OF_A_FLARE = 400
_MOST_WANTED = 2.0**40
_MOST_IMAGES = 32
_SLIGHT = 1e-3  # what counts less in a sum than this, the largest being 1, is not cared for


def samples_map(
    pilot: Light, flares: Light, snapshot: Snapshot, noise_share: float, shape: tuple[int, int]
) -> NDArray[np.int64]:
    """Return the samples for each pixel of the film, and those wanted without bounds, (2, rows, columns).

    Parameters
    ----------
    pilot
        The camera's light with `groups.pilot` as its indirect part.
    flares
        The same with `sharpen.flare_pilot` as its indirect part.
    noise_share
        Render variance over temporal variance to reach.
    shape
        Rows and columns of the film.
    """
    assert pilot.indirect is not None  # without indirect light nothing is sampled
    camera = snapshot.camera(pilot.camera).camera
    # The pixels of a pilot are no neighbours: nothing is averaged in its frame.
    plain = replace(pilot, indirect=replace(pilot.indirect, multiple=None))
    rates = electron_rates(plain, snapshot, _lit_together(pilot, snapshot))
    exposure_s = planned_exposure_s(camera, float(fully_lit_frame(rates, 1.0).electrons.max()))
    sensor_e2 = temporal_variance_e2(fully_lit_frame(rates, exposure_s))
    ratio = _share_of_one_sample(pilot, snapshot, exposure_s, sensor_e2, shape)
    need, scale = ratio / noise_share, camera.sensor.rows // shape[0]
    frame = max(float(np.median(need[need > 0.0])) if (need > 0.0).any() else 0.0, LEAST_SAMPLES)
    flare_like = scale**2 * ratio / _FLARE_LIKE_SHARE
    of_flares = _needs_of_flares(flares, snapshot, exposure_s, sensor_e2, noise_share, shape)
    given = _within_budget(np.minimum(need, _RISE * frame), flare_like, _FLARE_LIKE_RISE * frame)
    given = np.clip(np.maximum(given, of_flares), LEAST_SAMPLES, MOST_SAMPLES)
    wanted = np.clip(np.maximum(np.maximum(need, flare_like), of_flares), LEAST_SAMPLES, _MOST_WANTED)
    return np.asarray(2 ** np.ceil(np.log2([given, wanted])), dtype=np.int64)


def _lit_together(light: Light, snapshot: Snapshot) -> range:
    """Return the groups that may share an image where all are fully lit: all, if their drives are many.

    Only the sum of images is used here. Of few drives it is that of the frames to be, to the last bit.
    """
    drives = {drive_of(emitter) for emitter in group_emitters(light, snapshot)}
    return range(len(light.groups) if len(drives) > _MOST_IMAGES else 0)


def _within_budget(need: Array, flare_like: Array, least_bound: float) -> Array:
    """Return the larger of two needs, the second cut by the loosest bound that keeps the budget."""
    budget = _BUDGET * np.maximum(need, LEAST_SAMPLES).mean()
    bound = float(MOST_SAMPLES)
    while bound > least_bound:
        if np.maximum(np.maximum(need, np.minimum(flare_like, bound)), LEAST_SAMPLES).mean() <= budget:
            break
        bound /= 2.0
    return np.maximum(need, np.minimum(flare_like, max(bound, least_bound)))


def flare_pixels(light: Light, camera: Camera) -> Numbers:
    """Return the numbers of the sensor's pixels in flares' apertures, one aperture after the other, (n,)."""
    places = [aperture.pixels() for aperture in flare_apertures(light, camera)]
    numbers = [row * camera.sensor.columns + column for row, column in places]
    return np.concatenate([np.empty(0, dtype=np.int64), *numbers])


def flare_blocks(
    light: Light, camera: Camera, scale: int, enlargement: Enlargement, around: Averages | None = None
) -> Numbers:
    """Return the numbers of the film's pixels that sums over flares' apertures are made of, shape (n,).

    Of a large aperture they are an even part. `around` is how light is averaged, if it is.
    """
    chosen = [np.empty(0, dtype=np.int64)]
    apertures = flare_apertures(light, camera)
    even = np.ones((enlargement.rows, enlargement.columns))
    of_blocks, _ = aperture_weights(apertures, even, scale, enlargement)
    if around is not None:
        of_blocks = csr_array(abs(of_blocks) + abs(of_blocks @ around.matrix))
    for row in range(len(apertures)):
        part = slice(*of_blocks.indptr[row : row + 2])
        blocks = np.sort(of_blocks.indices[part][_counted(of_blocks.data[part])]).astype(np.int64)
        chosen.append(blocks[:: max(-(-blocks.size // _BLOCKS_OF_A_FLARE), 1)])
    return np.unique(np.concatenate(chosen))


def _share_of_one_sample(
    pilot: Light, snapshot: Snapshot, exposure_s: float, sensor_e2: Array, shape: tuple[int, int]
) -> Array:
    """Return the variance of one sample over that of the sensor, shape of the film; never seen is 0.

    Where light is averaged it is that of one sample in this block and in all around.
    """
    assert pilot.indirect is not None
    multiple = pilot.indirect.multiple
    known = pilot, snapshot, exposure_s, sensor_e2, shape
    ratio = _share_of(*known, pilot.indirect.variance)
    if multiple is not None:
        own, squares = multiple.averages.own, multiple.averages.squares
        ratio += (squares - 1.0) * _share_of(*known, multiple.variance)
        ratio += 2.0 * (own - 1.0) * _share_of(*known, multiple.covariance)
    return np.maximum(ratio, 0.0) * (pilot.indirect.samples * _CAUTION)


def _share_of(
    pilot: Light,
    snapshot: Snapshot,
    exposure_s: float,
    sensor_e2: Array,
    shape: tuple[int, int],
    of_groups: NDArray[np.float32],
) -> Array:
    """Return a variance of the pilot's pixels over that of the sensor, mean over neighbours, on the film."""
    assert pilot.indirect is not None
    parts = pilot.indirect.variance.shape[-1:-3:-1]
    noise_e2: Array = np.zeros(parts[::-1])
    for electrons, variance in _of_spectra(pilot, snapshot, exposure_s, of_groups):
        pilot_electrons: Array = np.asarray(
            cv2.resize(electrons, parts, interpolation=cv2.INTER_AREA), dtype=np.float64
        )
        noise_e2 += pilot_electrons**2 * variance
    shares = noise_e2 * cv2.resize(1.0 / sensor_e2, parts, interpolation=cv2.INTER_AREA)
    means = cv2.blur(shares, (_NEIGHBOURS, _NEIGHBOURS), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(means, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float64)


def _needs_of_flares(
    flares: Light,
    snapshot: Snapshot,
    exposure_s: float,
    sensor_e2: Array,
    noise_share: float,
    shape: tuple[int, int],
) -> Array:
    """Return the counts that bring the sums over flares' apertures to the target, shape of the film.

    Within an aperture they go with d, what a block counts in the sum. One sample brings v c²; with λ d of
    them the variance of the sum is Σ v c² / (λ d): so λ is the sum of v c² / d over the variance wanted.
    """
    assert flares.indirect is not None
    assert flares.indirect.edges is not None
    camera = snapshot.camera(flares.camera).camera
    scale, edges = flares.indirect.scale, flares.indirect.edges
    enlargement, apertures = edges.enlargement, flare_apertures(flares, camera)
    need = np.zeros(shape[0] * shape[1])
    in_block = _blocks_under(enlargement.patch.astype(np.int64), scale, enlargement)
    multiple = flares.indirect.multiple
    around = None if multiple is None else multiple.averages
    of_blocks, of_patch = aperture_weights(apertures, np.ones_like(sensor_e2), scale, enlargement)
    spread = of_blocks if around is None else csr_array(of_blocks @ around.matrix)
    block = np.union1d(np.union1d(of_blocks.indices, spread.indices), in_block)  # all that any sum is made of
    under = np.searchsorted(block, in_block)
    fold = csr_array((np.ones(len(under)), (np.arange(len(under)), under)), shape=(len(under), len(block)))

    def squared(of_blocks: csr_array, of_patch: csr_array) -> tuple[list[csr_array], csr_array]:
        """Return squares of weights: of blocks, of averages and both where there are any, of the patch."""
        some = of_blocks[:, block]
        pairs = [(some, some)]
        if around is not None:
            averaged = csr_array(of_blocks @ around.matrix)[:, block]
            pairs += [(averaged, averaged), (some, averaged)]
        return [one.multiply(other).tocsr() for one, other in pairs], of_patch.multiply(of_patch).tocsr()

    counts, alone = squared(of_blocks, of_patch)
    size = np.sqrt((sum(counts[1:2], counts[0]) + alone @ fold).toarray())
    known = flare_blocks(flares, camera, scale, enlargement, around)
    sampled = np.isin(block, known)
    brought_e2, brought_alone_e2 = (np.zeros(size.shape) for _ in range(2))
    variances = _parts_of(flares.indirect)
    spectra = [_of_spectra(flares, snapshot, exposure_s, one) for one in variances]
    patches = _of_spectra(flares, snapshot, exposure_s, edges.variance)
    for of_parts, (_, variance_alone) in zip(zip(*spectra, strict=True), patches, strict=True):
        electrons = of_parts[0][0]
        counts, alone = squared(*aperture_weights(apertures, electrons, scale, enlargement))
        for count, (_, variance) in zip(counts, of_parts, strict=True):
            of_block = np.zeros(len(block))
            of_block[sampled] = variance.ravel()[np.isin(known, block)]
            brought_e2 += count.toarray() * of_block
        brought_alone_e2 += (alone.multiply(variance_alone.ravel()[None])).tocsr() @ fold
    brought_e2 = np.maximum(brought_e2, 0.0)
    for row, aperture in enumerate(apertures):
        used = _counted(size[row])
        sampled_size = size[row, used[sampled[used]]].sum()
        whole = size[row, used].sum() / sampled_size if sampled_size > 0.0 else 0.0
        block_noise_e2 = brought_e2[row, used] * whole + brought_alone_e2[row, used]
        block_noise_e2 *= flares.indirect.samples / size[row, used]
        # What one block brings is known to about itself; few that bring all of it tell little.
        per_size = block_noise_e2.sum() + _CAUTIOUS_ERRORS * float(np.linalg.norm(block_noise_e2))
        per_size /= noise_share * aperture.sum(sensor_e2)
        need[block[used]] = np.maximum(need[block[used]], per_size * size[row, used])
    return need.reshape(shape)


def _parts_of(light: Indirect) -> list[NDArray[np.float32]]:
    """Return the variance that counts by each kind of squares of weights: of blocks, of averages, of both."""
    multiple = light.multiple
    if multiple is None:
        return [light.variance]
    of_rest = light.variance - multiple.variance - 2.0 * multiple.covariance
    return [of_rest, multiple.variance, 2.0 * multiple.covariance]


def _counted(weights: Array) -> Numbers:
    """Return the places of weights that count."""
    size = np.abs(weights)
    return np.flatnonzero(size > _SLIGHT * size.max(initial=0.0))


def _blocks_under(pixels: Numbers, scale: int, enlargement: Enlargement) -> Numbers:
    row, column = np.divmod(pixels, enlargement.columns)
    return np.asarray((row // scale) * (enlargement.columns // scale) + column // scale)


def _of_spectra(
    light: Light, snapshot: Snapshot, exposure_s: float, variance: NDArray[np.float32]
) -> list[tuple[Array, Array]]:
    """Return electrons per radiance, shape (rows, columns), and the variance of each spectrum's radiance."""
    squares = group_fluxes(light, snapshot) ** 2
    return variance_by_spectrum(light, snapshot, exposure_s, variance, squares)


def planned_exposure_s(camera: Camera, brightest_e_per_s: float) -> float:
    """Return the exposure to plan for: the camera's own, a bracket's longest, an automatic one as it settles.

    The latter but for noise in its brightest pixel.
    """
    if camera.auto_exposure is not None:
        return setting_for(camera, camera.auto_exposure, brightest_e_per_s).exposure_s
    return max(camera.bracket or (camera.exposure_s,))
