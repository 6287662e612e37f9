"""What frames with the cap on say, black level, read noise, offsets; and what dark pixels of others do."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.files.fields import RecordingError
from perception.types import Calibration, RawFrame

LEAST_FRAMES = 2
"""One shows what is dark, two how much that changes from frame to frame."""

_ROUNDING_DN2 = 1.0 / 12.0
_DEFECT_SIGMAS = 6.0
_MOST_CLIPPED = 1e-3
_DRIFT_PROBABILITY = 1e-3
_LIGHT_SIGMAS = 8.0
_BLOCKS = 8
_DARK_SIGMAS = 3.0
_LEAST_LEVEL_SIGMA_DN = 0.3  # of a mean of counts that are rounded, and clipped at 0


@dataclass(frozen=True, eq=False)
class DarkCalibration:
    """What dark frames told of a camera.

    Attributes
    ----------
    calibration
        As it was, but for black level, read noise and the pixels' offsets; its DSNU is what these leave.
    offset_e, offset_sigma_e
        Offset of each pixel from the mean, shape (rows, columns), as the frames and the spread of all offsets
        make it likeliest, and the standard deviation of each. The calibration has them in whole counts.
    black_level_dn, black_level_sigma_dn
        The mean count of all pixels that are no defects.
    read_noise_e, read_noise_sigma_e
        From frame to frame, without what rounding to whole counts adds; dark current's own noise is in it.
    dsnu_e, dsnu_sigma_e
        Standard deviation of the offsets, and its σ, as if each pixel's were drawn by itself.
    frames, defects
        How many frames, and how many pixels that stand out by more than six σ.
    drift
        By how much the means of frames scatter, over what noise alone makes of them.
    """

    calibration: Calibration
    offset_e: NDArray[np.float32]
    offset_sigma_e: float
    black_level_dn: float
    black_level_sigma_dn: float
    read_noise_e: float
    read_noise_sigma_e: float
    dsnu_e: float
    dsnu_sigma_e: float
    frames: int
    defects: int
    drift: float


def calibrate_dark(frames: Iterable[RawFrame], calibration: Calibration) -> DarkCalibration:
    """Learn black level, read noise and the pixels' offsets from frames that no light fell on.

    The black level is the mean count over pixels and frames. Its σ is that of the temporal noise, widened
    where the frames' own means scatter by more: a black level that drifts is known no better than that. The
    read noise is the root of the mean variance of a pixel over time, less 1/12 DN² of rounding (EMVA 1288
    release 4.0, section 6.5). An offset is that of its row, of its column, and what the pixel departs from
    both; each is a mean, drawn towards 0 by w = σ_s² / (σ_s² + σ_n²), σ_s the spread of the true ones, σ_n
    the noise of that mean: of all estimates, the one of least mean square error, and its σ is σ_s √(1 − w).
    Rows and columns are known far better than pixels, and what the offsets leave is white. Defects have none.

    Parameters
    ----------
    frames
        At least two, all of one gain.
    calibration
        Of the camera: its system gain is taken as known.

    Raises
    ------
    RecordingError
        There are too few, their gains differ, they are not dark, or their counts are cut off at 0.
    """
    camera, stack = calibration.camera, _Stack.of(frames, calibration)
    if stack.frames < LEAST_FRAMES:
        raise RecordingError(
            f"{camera}: {stack.frames} dark frame, wanted {LEAST_FRAMES} or more (16 are good): take them "
            "with the cap on, at one exposure and gain"
        )
    mean_dn, variance_dn2 = stack.mean_dn, stack.variance_dn2
    kept = _no_defects(mean_dn, variance_dn2)
    noise_dn2, pixels = float(variance_dn2[kept].mean()), int(kept.sum())
    _check_dark(mean_dn, noise_dn2 / stack.frames, kept, stack, camera)
    black_dn = float(mean_dn[kept].mean())
    white_dn2 = noise_dn2 / (pixels * stack.frames)
    drift = _drift(stack.frame_means_dn, noise_dn2 / pixels)
    # Rounding a count to whole numbers shifts the mean by up to e^(−2π²σ²)/π where noise does not blur it.
    rounding_dn = math.exp(-2.0 * math.pi**2 * noise_dn2) / math.pi
    black_sigma_dn = math.hypot(drift * math.sqrt(white_dn2), rounding_dn / math.sqrt(2.0))
    gain = calibration.system_gain_dn_per_e * stack.gain
    freedom = pixels * (stack.frames - 1)
    read_e = math.sqrt(max(noise_dn2 - _ROUNDING_DN2, 0.0)) / gain
    read_sigma_e = math.sqrt(0.5 / freedom) * noise_dn2 / (gain**2 * read_e) if read_e > 0.0 else 0.0
    of_mean_dn2 = noise_dn2 / stack.frames
    offset_dn, spread_dn2, left_dn2 = _offsets(mean_dn - black_dn, kept, of_mean_dn2)
    sigma = {**calibration.sigma, "black_level_dn": black_sigma_dn, "read_noise_e": read_sigma_e}
    sigma.pop("dsnu_e", None)
    dsnu_e = math.sqrt(spread_dn2) / gain
    dsnu_sigma_e = (spread_dn2 + of_mean_dn2) * math.sqrt(0.5 / pixels) / (gain**2 * max(dsnu_e, 1e-12))
    return DarkCalibration(
        calibration=replace(
            calibration,
            black_level_dn=black_dn,
            read_noise_e=read_e,
            dsnu_e=math.sqrt(left_dn2 + _ROUNDING_DN2 / stack.gain**2) / gain,
            offset_dn=np.rint(offset_dn / stack.gain).astype(np.int16),
            sigma=sigma,
        ),
        offset_e=(offset_dn / gain).astype(np.float32),
        offset_sigma_e=math.sqrt(left_dn2) / gain,
        black_level_dn=black_dn,
        black_level_sigma_dn=black_sigma_dn,
        read_noise_e=read_e,
        read_noise_sigma_e=read_sigma_e,
        dsnu_e=dsnu_e,
        dsnu_sigma_e=dsnu_sigma_e,
        frames=stack.frames,
        defects=int(kept.size - pixels),
        drift=drift,
    )


@dataclass(frozen=True, eq=False)
class _Stack:
    """The sums over dark frames: pixels' means and variances over time, the means of frames."""

    mean_dn: NDArray[np.float64]
    variance_dn2: NDArray[np.float64]
    frame_means_dn: NDArray[np.float64]
    gain: float
    at_zero: float

    @property
    def frames(self) -> int:
        return len(self.frame_means_dn)

    @staticmethod
    def of(frames: Iterable[RawFrame], calibration: Calibration) -> "_Stack":
        shape = (calibration.height_px, calibration.width_px)
        total, squares = np.zeros(shape), np.zeros(shape)
        means, gains, at_zero = [], [], 0
        for frame in frames:
            # Counts less some of their size: squares of 16 bits over thousands of frames keep their digits.
            counts = frame.data_dn - calibration.black_level_dn
            total += counts
            squares += counts**2
            means.append(float(frame.data_dn.mean()))
            gains.append(frame.gain)
            at_zero += int((frame.data_dn == 0).sum())
        if len(set(gains)) > 1:
            shown = ", ".join(f"{gain:g}" for gain in sorted(set(gains)))
            raise RecordingError(
                f"{calibration.camera}: its dark frames have the gains {shown}; take them, or label them as "
                "dark, at one gain"
            )
        count = max(len(means), 1)
        variance = (squares - total**2 / count) / max(count - 1, 1)
        return _Stack(
            total / count + calibration.black_level_dn,
            np.maximum(variance, 0.0),
            np.array(means),
            gains[0] if gains else 1.0,
            at_zero / (count * total.size),
        )


def _offsets(
    above_dn: NDArray[np.float64], kept: NDArray[np.bool_], noise_dn2: float
) -> tuple[NDArray[np.float64], float, float]:
    """Return offsets of pixels, the variance of the true ones, and that of what the offsets leave of them."""
    left_dn = np.where(kept, above_dn, 0.0)
    lines: list[NDArray[np.float64]] = []
    for axis in (1, 0):
        count = np.maximum(kept.sum(axis=axis, keepdims=True), 1)
        lines.append(left_dn.sum(axis=axis, keepdims=True) / count)
    for line in lines:
        left_dn = np.where(kept, left_dn - line, 0.0)
    of_pixels_dn2 = float(np.mean(left_dn[kept] ** 2))
    spread_dn2 = max(of_pixels_dn2 - noise_dn2, 0.0)
    trust = spread_dn2 / max(of_pixels_dn2, 1e-300)
    offset_dn, unknown_dn2 = trust * left_dn, spread_dn2 * (1.0 - trust)
    for line in lines:
        seen_dn2 = float(np.var(line))
        of_line_dn2 = max(seen_dn2 - noise_dn2 * line.size / left_dn.size, 0.0)
        trust = of_line_dn2 / max(seen_dn2, 1e-300)
        offset_dn = np.where(kept, offset_dn + trust * line, 0.0)
        spread_dn2 += of_line_dn2
        unknown_dn2 += of_line_dn2 * (1.0 - trust)
    return offset_dn, spread_dn2, unknown_dn2


def _no_defects(mean_dn: NDArray[np.float64], variance_dn2: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the pixels whose mean does not stand out: hot and stuck ones do."""
    middle = float(np.median(mean_dn))
    scatter = 1.4826 * float(np.median(np.abs(mean_dn - middle)))
    least = math.sqrt(float(np.median(variance_dn2)) + _ROUNDING_DN2)
    return np.asarray(np.abs(mean_dn - middle) <= _DEFECT_SIGMAS * max(scatter, 0.2 * least))


def _check_dark(
    mean_dn: NDArray[np.float64],
    of_mean_dn2: float,
    kept: NDArray[np.bool_],
    stack: _Stack,
    camera: str,
) -> None:
    if stack.at_zero > _MOST_CLIPPED:
        raise RecordingError(
            f"{camera}: {stack.at_zero:.1%} of its dark pixels read 0: the black level is cut off, and noise "
            "with it; raise the sensor's black level (offset, pedestal) and record again"
        )
    # Light that leaks in is smooth; what is fixed about pixels, rows and columns is not.
    filled = np.where(kept, mean_dn, np.median(mean_dn))
    rows, columns = (np.array_split(np.arange(size), _BLOCKS) for size in filled.shape)
    blocks = np.array([[filled[np.ix_(row, column)].mean() for column in columns] for row in rows])
    lines_dn2 = (
        float(np.var(filled.mean(axis=0))) * _BLOCKS / filled.shape[1]
        + float(np.var(filled.mean(axis=1))) * _BLOCKS / filled.shape[0]
    )
    pixels = filled.size / _BLOCKS**2
    sigma_dn = math.sqrt(lines_dn2 + (float(np.var(filled)) + of_mean_dn2) / pixels)
    uneven_dn = float(blocks.max() - blocks.min())
    if uneven_dn > _LIGHT_SIGMAS * sigma_dn and uneven_dn > 1.0:
        raise RecordingError(
            f"{camera}: its dark frames are brighter by {uneven_dn:.2g} DN in one part than in another: "
            "light comes in, or frames of something else are labelled dark; put the cap on, check `kind`"
        )


def _drift(frame_means_dn: NDArray[np.float64], variance_dn2: float) -> float:
    """Return by what to widen the σ of a mean of frames: 1 where they scatter by no more than noise does."""
    from scipy.special import chdtrc

    freedom = len(frame_means_dn) - 1
    chi2 = float(((frame_means_dn - frame_means_dn.mean()) ** 2).sum()) / max(variance_dn2, 1e-300)
    return math.sqrt(chi2 / freedom) if float(chdtrc(freedom, chi2)) < _DRIFT_PROBABILITY else 1.0


@dataclass(frozen=True)
class Darkness:
    """The mean count of dark pixels and its σ, and their noise from frame to frame, all in counts."""

    level_dn: float
    level_sigma_dn: float
    noise_dn: float


def darkness(frames: Sequence[NDArray[np.uint16]]) -> Darkness:
    """Measure dark level and noise in frames that are mostly dark.

    The level is the mean count of the pixels within three σ of the median; the noise is that of the
    differences of neighbouring frames there, without what rounding to whole counts adds; of one frame alone,
    the scatter over its pixels.

    Parameters
    ----------
    frames
        Counts of one camera, at least one frame, each of shape (rows, columns).
    """
    levels, squares = [], []
    inside = np.empty(0, dtype=bool)
    for number, frame in enumerate(frames):
        counts = frame.astype(np.float64)
        middle = float(np.median(counts))
        # Of whole counts the median deviation is one too, up to half a count too low.
        scatter = 1.4826 * (float(np.median(np.abs(counts - middle))) + 0.5)
        here = np.abs(counts - middle) <= _DARK_SIGMAS * scatter
        levels.append(float(counts[here].mean()))
        if number:
            change = (counts - frames[number - 1])[inside & here]
            squares.append(0.5 * float(np.var(change)) if change.size else 0.0)
        inside = here
    if not squares:
        squares = [float(np.var(frames[0].astype(np.float64)[inside]))]
    noise_dn = math.sqrt(max(float(np.median(squares)) - _ROUNDING_DN2, 0.0))
    return Darkness(
        float(np.mean(levels)), math.hypot(float(np.std(levels)), _LEAST_LEVEL_SIGMA_DN), noise_dn
    )
