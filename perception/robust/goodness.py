"""How well flares explain what is seen of them: what a fit leaves over, in numbers."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, UNUSABLE
from perception.model.likelihood.products import LEAST_PIVOT, add_information

Array = NDArray[np.float64]

MODEL_ERROR = 0.05
"""How far, relative to the flares' own light, point spread and source may be off before a fit is bad."""

MISFIT_PROBABILITY = 1e-6

FEWEST_PIXELS = 16
DISC_PX = 2
REACHED_SIGMAS = 0.1
LEAST_KNOWN = 1e-3
_NOISE_SIGMAS = 4.0


@dataclass(frozen=True)
class LeftOver:
    """What a fit leaves over, allowing for an imperfect model.

    Over the whole window a bad core drowns in good background; without ε, `MODEL_ERROR`, a bright flare shows
    every per cent by which the real PSF, the pixels' gains or the source differ from the model. A clipped
    pixel that should clip says nothing, and does not count.

    Attributes
    ----------
    chi2, pixels
        Sum of (x - λ)² / (λ + σ² + (ε F S)²) over the pixels where F·S exceeds their noise, and their number.
    residual2_e2, flares2_e2
        Σ residual² and Σ flares² over these pixels.
    seen_chi2, seen_pixels
        The same χ² where F·S exceeds noise and model error, over pixels that are not clipped.
    peak_sigmas, peak
        Greatest value of the residual matched to the image of a point, in units of its noise, model error
        counted in, and the row and column of the window where it is.
    noise_chi2
        As `chi2`, against noise alone.
    around_chi2, around_pixels, around_excess_e2
        χ² against noise alone over the pixels that the flares do not reach, their number, and the mean of
        residual² - variance there.
    """

    chi2: float
    pixels: int
    residual2_e2: float
    flares2_e2: float
    seen_chi2: float
    seen_pixels: int
    peak_sigmas: float
    peak: tuple[int, int]
    around_chi2: float
    around_pixels: int
    around_excess_e2: float
    noise_chi2: float

    @cached_property
    def is_good(self) -> bool:
        """Whether chance alone may leave so much on the flares."""
        return self.may_be_good(0.0)

    @property
    def is_nothing(self) -> bool:
        """Whether chance alone may leave so much, on the flares and around them."""
        return self.is_good and self.structure_e == 0.0

    def may_be_good(self, less_chi2: float) -> bool:
        """Tell whether chance alone may leave so much were χ² less by that."""
        return self.pixels == 0 or is_likely(self.pixels, self.chi2 - less_chi2)

    @property
    def widens_range(self) -> float:
        """How many times as wide as by noise a range's σ is to be; 1 where what is left over may be noise.

        What is wrong with the model (a lens, a size, how a source shines) hides along the range about as much
        as it shows across it: of discs whose limb is darker by a third, whose size, flux or lens are off by 1
        to 10 %, ranges are off by .3 to 1.8 times the root of χ² beyond n, in standard deviations. Of their
        places, which such errors leave alone, that is not so. Noise passes four standard deviations of χ².
        """
        beyond = self.noise_chi2 - self.pixels - _NOISE_SIGMAS * math.sqrt(2.0 * self.pixels)
        return math.sqrt(1.0 + max(beyond, 0.0))

    @property
    def share(self) -> float:
        """Root of Σ residual² over Σ flares²."""
        return math.sqrt(self.residual2_e2 / max(self.flares2_e2, 1e-300))

    @cached_property
    def structure_e(self) -> float:
        """Standard deviation of what lies around the flares beside noise; 0 where that is noise alone.

        By χ² of the pixels that the flares do not reach: noise passes once in a million.
        """
        if self.around_pixels < FEWEST_PIXELS or is_likely(self.around_pixels, self.around_chi2):
            return 0.0
        return math.sqrt(max(self.around_excess_e2, 0.0))


def is_likely(degrees: int, chi2: float) -> bool:
    """Tell whether χ² is at least as large by chance more often than `MISFIT_PROBABILITY`."""
    # Three standard deviations are passed more often than that by any χ².
    if chi2 < degrees + 3.0 * math.sqrt(2.0 * degrees):
        return True
    from scipy.special import chdtrc

    return bool(chdtrc(degrees, chi2) >= MISFIT_PROBABILITY)


def left_over(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array,
    floor_e2: float, prnu: float, psf_sigma_px: float,
) -> LeftOver:  # fmt: skip
    """Reckon what a fit leaves over.

    Parameters
    ----------
    image_e, state, expected_e, flares_e
        Of a window, shape (rows, columns): what is seen, what each pixel is (`model.layout`), λ, and the
        flares' part of it.
    floor_e2, prnu
        Variance of a dark pixel, and relative spread of the pixels' responses.
    psf_sigma_px
        Width of the point spread.
    """
    smooth_px = math.hypot(psf_sigma_px, math.sqrt(1.0 / 12.0))
    numbers = _reckoned(image_e, state, expected_e, flares_e, floor_e2, prnu, smooth_px)
    return LeftOver(*numbers[:7], (numbers[7], numbers[8]), *numbers[9:])


@compiled
def residual_e(image_e: Array, state: NDArray[np.uint8], expected_e: Array) -> Array:
    """Return what a fit leaves over in each pixel: 0 where unusable, or clipped as is expected."""
    left = image_e - expected_e
    for row in range(left.shape[0]):
        for column in range(left.shape[1]):
            if state[row, column] == UNUSABLE or (state[row, column] == CLIPPED and left[row, column] < 0.0):
                left[row, column] = 0.0
    return left


@compiled
def noise_e2(expected_e: float, floor_e2: float, prnu: float) -> float:
    """Return a pixel's variance, as `sensor.pixel_variance_e2`."""
    lit = max(expected_e, 0.0)
    return lit + (prnu * lit) ** 2 + floor_e2


@compiled
def _reckoned(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array,
    floor_e2: float, prnu: float, smooth_px: float,
) -> tuple[float, int, float, float, float, int, float, int, int, float, int, float, float]:  # fmt: skip
    rows, columns = image_e.shape
    residual, weight = residual_e(image_e, state, expected_e), np.zeros((rows, columns))
    reached, noise = np.zeros((rows, columns), dtype=np.bool_), np.empty((rows, columns))
    chi2, pixels, residual2, flares2, seen_chi2, seen_pixels, noise_chi2 = 0.0, 0, 0.0, 0.0, 0.0, 0, 0.0
    for row in range(rows):
        for column in range(columns):
            flare, left = flares_e[row, column], residual[row, column]
            noise[row, column] = noise_e2(expected_e[row, column], floor_e2, prnu)
            variance = noise[row, column] + (MODEL_ERROR * flare) ** 2
            reached[row, column] = flare > 0.0 and flare * flare > REACHED_SIGMAS**2 * noise[row, column]
            if state[row, column] == UNUSABLE:
                continue
            weight[row, column] = 1.0 / variance
            if (
                flare * flare > noise[row, column]
                and flare > 0.0
                and not (state[row, column] == CLIPPED and left == 0.0)
            ):
                chi2 += left * left / variance
                noise_chi2 += left * left / noise[row, column]
                residual2 += left * left
                flares2 += flare * flare
                pixels += 1
            if state[row, column] == SEEN and flare > 0.0 and flare * flare > variance:
                seen_chi2 += left * left / variance
                seen_pixels += 1
    around_chi2, around_pixels, around_excess = 0.0, 0, 0.0
    near = _grown(reached, DISC_PX)
    for row in range(rows):
        for column in range(columns):
            if not near[row, column] and state[row, column] == SEEN:
                left2 = residual[row, column] ** 2
                around_chi2 += left2 / noise[row, column]
                around_excess += left2 - noise[row, column]
                around_pixels += 1
    around_excess /= max(around_pixels, 1)
    peak, at = _matched_peak(residual * weight, weight, smooth_px)
    return (
        chi2, pixels, residual2, flares2, seen_chi2, seen_pixels, peak, at // columns, at % columns,
        around_chi2, around_pixels, around_excess, noise_chi2,
    )  # fmt: skip


@compiled
def _grown(mask: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Return a mask grown by so many steps up, down, to the left and to the right."""
    rows, columns = mask.shape
    width = columns + 1  # a column between, which is left out
    size = rows * width
    padded = np.zeros(size + 2 * width, dtype=np.uint8)
    for row in range(rows):
        padded[(row + 1) * width :][:columns] = mask[row]
    grown = padded.copy()
    for _ in range(steps):
        middle, above, below = padded[width:], padded, padded[2 * width :]
        left, right, into = padded[width - 1 :], padded[width + 1 :], grown[width:]
        for at in range(size):
            into[at] = middle[at] | above[at] | below[at] | left[at] | right[at]
        for row in range(rows):
            into[row * width + columns] = 0
        padded, grown = grown, padded
    return padded[width:][:size].reshape(rows, width)[:, :columns] > 0


@compiled
def _smoothed(image: Array, kernel: Array) -> Array:
    """Correlate an image with a symmetric kernel along both axes, zero beyond its ends.

    Rows lie one after another with zeros between, and above and below: so each step is one long loop.
    """
    rows, columns = image.shape
    half = len(kernel) // 2
    width = columns + half
    first, size = half * width + half, rows * width
    padded, along, both = np.zeros(size + 2 * first), np.zeros(size + 2 * first), np.empty(size)
    for row in range(rows):
        padded[first + row * width :][:columns] = image[row]
    _correlate(padded, kernel, first, 1, along[first:][:size])
    _correlate(along, kernel, first, width, both)
    return both.reshape(rows, width)[:, :columns].copy()


@compiled
def _correlate(padded: Array, kernel: Array, first: int, step: int, into: Array) -> None:
    """Weigh values so many steps apart, about the `first` and those after it."""
    half = len(kernel) // 2
    middle, weight = padded[first:], kernel[half]
    for at in range(len(into)):
        into[at] = weight * middle[at]
    for beside in range(1, half + 1):
        before, after = padded[first - beside * step :], padded[first + beside * step :]
        weight = kernel[half + beside]
        for at in range(len(into)):
            into[at] += weight * (before[at] + after[at])


@compiled
def _matched_peak(weighted: Array, weight: Array, smooth_px: float) -> tuple[float, int]:
    """Return the greatest value of a weighted residual matched to a point's image over its noise, and where.

    Where hardly any pixel counts nothing is known.
    """
    half = math.ceil(5.0 * smooth_px)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / smooth_px) ** 2)
    matched, power = _smoothed(weighted, kernel).ravel(), _smoothed(weight, kernel**2).ravel()
    least = LEAST_KNOWN * power.max()
    best2, at = 0.0, 0
    for pixel in range(len(matched)):
        if power[pixel] > least and matched[pixel] > 0.0 and matched[pixel] ** 2 > best2 * power[pixel]:
            best2, at = matched[pixel] ** 2 / power[pixel], pixel
    return math.sqrt(best2), at


@compiled
def drawn_out(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array, floor_e2: float, prnu: float
) -> tuple[float, float, float, float]:
    """Tell by how much longer than wide an image is than its fit, as one does that moves while exposed.

    A motion m adds to a flare's light F S the part ∂ᵢ∂ⱼ(F S) mᵢ mⱼ / 24, to first order, of which what is the
    same all around is left out, as a wrong size or point spread makes it; so are place, flux and ground.
    The arguments are as for `left_over`.

    Returns
    -------
    χ² of two degrees of freedom, the motion along u and v in pixels that the residual asks for, and what any
    other explanation of the pixels that stand out can gain: χ² beyond n − 3 √(2n), which of the true one is
    less once in a thousand.
    """
    rows, columns = image_e.shape
    parts, stands_out, chi2 = np.zeros((8, rows, columns)), 0, 0.0
    for row in range(1, rows - 1):
        of_row, weight, line = parts[:, row], parts[0, row], flares_e[row]
        above, below = flares_e[row - 1], flares_e[row + 1]
        for column in range(1, columns - 1):
            noise = math.sqrt(noise_e2(expected_e[row, column], floor_e2, prnu))
            weight[column] = 1.0 / noise if state[row, column] == SEEN else 0.0
        for column in range(1, columns - 1):
            by_uu = line[column + 1] - 2.0 * line[column] + line[column - 1]
            by_vv = below[column] - 2.0 * line[column] + above[column]
            by_uv = below[column + 1] + above[column - 1] - below[column - 1] - above[column + 1]
            of_row[1, column] = weight[column] * line[column]
            of_row[2, column] = weight[column] * (line[column + 1] - line[column - 1])
            of_row[3, column] = weight[column] * (below[column] - above[column])
            of_row[4, column] = weight[column] * (by_uu + by_vv)
            of_row[5, column] = weight[column] * (by_uu - by_vv)
            of_row[6, column] = weight[column] * 0.25 * by_uv
        for column in range(1, columns - 1):
            if weight[column] > 0.0:
                of_row[7, column] = weight[column] * (image_e[row, column] - expected_e[row, column])
                if of_row[1, column] > 1.0:
                    stands_out += 1
                    chi2 += of_row[7, column] ** 2
    most_gain = chi2 - stands_out + 3.0 * math.sqrt(2.0 * stands_out)
    # Gram and Schmidt's shares of each part in those after it follow from the sums of products alone.
    shown, sums, even = np.zeros(7), np.zeros((8, 8)), np.ones(rows * columns)
    add_information(parts.reshape(8, -1), even, sums)
    powers = np.diag(sums).copy()
    for one in range(7):
        power = sums[one, one]
        if not power > LEAST_PIVOT * powers[one]:
            return 0.0, 0.0, 0.0, most_gain
        for other in range(one + 1, 8):
            share = sums[one, other] / power
            if other == 7:
                shown[one] = share * math.sqrt(power)
            if one == 5 and other == 6:
                mixed = share
            for beyond in range(other, 8):
                sums[other, beyond] -= share * sums[one, beyond]
        if one == 5:
            power_5 = power
    across = shown[6] / math.sqrt(power)
    along = shown[5] / math.sqrt(power_5) - mixed * across
    # Of m = |m| (cos φ, sin φ): along = |m|² cos 2φ / 48, across = |m|² sin 2φ / 24.
    turn, length2 = 0.5 * math.atan2(24.0 * across, 48.0 * along), math.hypot(48.0 * along, 24.0 * across)
    length = math.sqrt(length2)
    seen = shown[5] ** 2 + shown[6] ** 2
    return seen, length * math.cos(turn), length * math.sin(turn), most_gain
