"""From a raw frame to what the robust detector looks at: background, filtered image, bad and lit pixels."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.layout import Structure
from perception.model.sensor import clip_level_e, electrons, gain_dn_per_e, noise_floor_e2, saturation_dn
from perception.robust.search.background import (
    as_wide,
    background_mesh_e,
    resized,
    scatter_places,
    scatter_ratio,
    spread_mesh,
)
from perception.robust.search.cutout import grounds_at
from perception.robust.search.frame import (
    Pixels,
    above,
    between,
    exceeding,
    filtered,
    ground_at,
    neighbours,
    without,
)
from perception.robust.search.limit import limit_mesh_of, point_filter
from perception.robust.search.near import brightness_mesh_e, near_sources
from perception.robust.search.structure import autocorrelation, structure_of
from perception.types import Calibration, RawFrame

MOST_STRUCTURED_PX = 129
"""Larger windows are fitted on an even background."""

_BAD_SIGMAS = 5.0
_CLIPPED_FILTERED = 0.9  # of what clips, above the background
_CLIPPED_NOISES = 8.0  # by so many σ it must stand out
_SMOOTHING_REACH = 4


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """A frame with all that is found out about it as a whole.

    Attributes
    ----------
    frame, calibration
        Where it comes from.
    pixels
        Counts and background, for loops over pixels.
    mesh_e
        Smooth local background in cells.
    kernel
        One axis of the matched filter of what exceeds the background.
    lit_at, lit_e
        Pixels above the detection limit, as indices in the frame, in order, and the filtered image there.
    floor_e2
        Variance of a dark pixel.
    texture_e
        Standard deviation of the background's structure, on the mesh's rows as `pixels.ground_e`; 0 where the
        background is even, None where it is so everywhere.
    bad_at
        Pixels that are stuck or hot, as indices, in order; the filter takes them to be as the background.
    """

    frame: RawFrame
    calibration: Calibration
    pixels: Pixels
    mesh_e: NDArray[np.float32]
    kernel: NDArray[np.float32]
    lit_at: NDArray[np.int64]
    lit_e: NDArray[np.float32]
    floor_e2: float
    texture_e: NDArray[np.float32] | None
    bad_at: NDArray[np.int64]

    @cached_property
    def clipped_dn(self) -> int:
        """Count from which on a pixel is clipped."""
        return saturation_dn(self.calibration, self.frame.gain)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frame."""
        return self.calibration.height_px, self.calibration.width_px

    @cached_property
    def filtered_noise(self) -> float:
        """Noise of the filtered image relative to that of a pixel, √Σh²."""
        return float(np.sum(self.kernel**2))

    @cached_property
    def lit(self) -> NDArray[np.bool_]:
        """Mask of the pixels above the detection limit."""
        return _mask(self.lit_at, self.shape)

    @cached_property
    def bad(self) -> NDArray[np.bool_]:
        """Mask of the pixels that are stuck or hot."""
        return _mask(self.bad_at, self.shape)

    @cached_property
    def excess_e(self) -> NDArray[np.float32]:
        """Electrons above the background; none where a pixel is bad."""
        excess_e = electrons(self.frame, self.calibration) - spread_mesh(self.mesh_e, self.calibration)
        excess_e.ravel()[self.bad_at] = 0.0
        return excess_e

    def background_e(self, u_px: float, v_px: float) -> float:
        """Return the background at the pixel nearest to a place."""
        return ground_at(self.pixels, *self._nearest(u_px, v_px))

    def backgrounds_e(self, places_px: Iterable[tuple[float, float]]) -> list[float]:
        """Return the background at the pixel nearest to each of some places (u, v)."""
        nearest = [self._nearest(u_px, v_px) for u_px, v_px in places_px]
        rows, columns = np.array(nearest, dtype=np.int64).reshape(-1, 2).T.copy()
        return [float(each) for each in grounds_at(self.pixels, rows, columns)]

    def structure_at(self, u_px: float, v_px: float, side_px: int) -> tuple[Structure | None, float]:
        """Return what may lie on the background of a window around a place, and its standard deviation."""
        if self.texture_e is None:
            return None, 0.0
        sigma_e = ground_at(self.pixels._replace(ground_e=self.texture_e), *self._nearest(u_px, v_px))
        if sigma_e == 0.0 or side_px > MOST_STRUCTURED_PX:
            return None, sigma_e
        return structure_of(self._autocorrelation, side_px, sigma_e), sigma_e

    def is_structured(self, box: PixelBox) -> bool:
        """Tell whether the background has structure anywhere in a box inside the frame."""
        if self.texture_e is None:
            return False
        first, _, _ = between(box.top, self.shape[0], len(self.texture_e))
        _, last, _ = between(box.top + box.height - 1, self.shape[0], len(self.texture_e))
        return bool((self.texture_e[first : last + 1, box.left : box.left + box.width] > 0.0).any())

    @cached_property
    def _autocorrelation(self) -> tuple[float, ...]:
        assert self.texture_e is not None
        noise_e = np.sqrt(np.maximum(self.mesh_e, 0.0) + np.float32(self.floor_e2))
        size = (self.calibration.width_px, self.calibration.height_px)
        return autocorrelation(
            self.excess_e, resized(self.texture_e, *size), spread_mesh(noise_e, self.calibration)
        )

    def _nearest(self, u_px: float, v_px: float) -> tuple[int, int]:
        rows, columns = self.shape
        return min(max(round(v_px), 0), rows - 1), min(max(round(u_px), 0), columns - 1)

    @cached_property
    def _brightness_mesh_e(self) -> NDArray[np.float64]:
        return brightness_mesh_e(self.frame, self.calibration, self.mesh_e.shape)

    def brightness_e(self, u_px: float, v_px: float) -> float:
        """Return how bright about a place pixels are that the image of a source covers."""
        (row, column), (rows, columns) = self._nearest(u_px, v_px), self.shape
        mesh_e = self._brightness_mesh_e
        return float(mesh_e[row * len(mesh_e) // rows, column * mesh_e.shape[1] // columns])

    def clipped_in(self, box: PixelBox) -> NDArray[np.bool_]:
        """Mark the pixels of a box inside the frame that light has clipped: bad ones do not count."""
        clipped = self.pixels.data_dn[box.slices] >= self.clipped_dn
        if clipped.any() and len(self.bad_at):
            clipped &= ~self.bad[box.slices]
        return clipped

    def clipped_columns(self, box: PixelBox) -> NDArray[np.bool_]:
        """Tell in which columns of a box, which may leave the frame, a pixel is clipped and not bad."""
        part = box.inside(self.shape)
        spilled = np.zeros(box.width, dtype=bool)
        spilled[part.seen_from(box).slices[1]] = self.clipped_in(part).any(axis=0)
        return spilled

    def lit_in(self, box: PixelBox) -> NDArray[np.bool_]:
        """Return `lit` in a box that may reach beyond the frame."""
        part, lit = box.inside(self.shape), np.zeros((box.height, box.width), dtype=bool)
        lit[part.seen_from(box).slices] = self.lit[part.slices]
        return lit


def _mask(places: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = np.zeros(shape, dtype=bool)
    mask.ravel()[places] = True
    return mask


def prepare(frame: RawFrame, calibration: Calibration) -> PreparedFrame:
    """Filter a frame and mark what is no noise.

    Parameters
    ----------
    frame
        A raw frame that matches its calibration.
    calibration
        Its camera's calibration.

    Returns
    -------
    PreparedFrame
    """
    floor_e2 = noise_floor_e2(calibration, frame.gain)
    kernel, narrow, filtered_noise = point_filter(calibration.psf_sigma_px)
    # Compiled loops know arrays that may be written and lie in order; others would be compiled for anew.
    frame = replace(frame, data_dn=np.require(frame.data_dn, requirements=("C", "W")))
    mesh_e = background_mesh_e(frame, calibration)
    pixels = Pixels(
        frame.data_dn,
        float(frame.black_level_dn),
        1.0 / gain_dn_per_e(frame, calibration),
        as_wide(mesh_e, calibration),
    )
    noise_mesh_e = filtered_noise * np.sqrt(np.maximum(mesh_e, 0.0) + floor_e2).astype(np.float32)
    limit_mesh_e = limit_mesh_of(mesh_e, floor_e2, kernel)
    limit_e = as_wide(limit_mesh_e, calibration)
    rows, columns = scatter_places(frame.data_dn.shape)
    sample_of = np.full(calibration.height_px, -1)
    sample_of[rows.ravel()] = np.arange(rows.size)
    lit_at, lit_e, samples = exceeding(pixels, narrow, limit_e, sample_of, columns.ravel())
    clipped_mesh_e = _CLIPPED_FILTERED * (
        clip_level_e(calibration, frame.black_level_dn, frame.gain) - mesh_e
    )
    clipped_mesh_e[~(clipped_mesh_e > _CLIPPED_NOISES * noise_mesh_e)] = np.inf
    ratio = scatter_ratio(samples, noise_mesh_e, clipped_mesh_e)
    of_sources = None
    if (ratio > 1.0).any():
        clips_e = clip_level_e(calibration, frame.black_level_dn, frame.gain) - mesh_e
        of_source_e = brightness_mesh_e(frame, calibration, mesh_e.shape)
        # Ground that is bright itself may be so here and there.
        least_e = np.maximum(_CLIPPED_NOISES * noise_mesh_e, mesh_e)
        found = near_sources(lit_at, lit_e, of_source_e, clips_e, least_e, calibration)
        if found is not None:
            of_sources, many = found
            is_left_out = of_sources[np.ix_(rows.ravel(), columns.ravel())]
            samples = np.where(is_left_out, np.float32(np.inf), samples)
            ratio = np.where(many, scatter_ratio(samples, noise_mesh_e, clipped_mesh_e), ratio)
    structured = bool((ratio > 1.0).any())
    if structured:
        limit_e = as_wide(limit_mesh_e * ratio, calibration)
        lit_at, lit_e = _above(lit_at, lit_e, limit_e, calibration)
    bad_at = bad_pixels(pixels, lit_at, floor_e2, kernel, along_rows=frame.line_time_s > 0.0)
    if len(bad_at):
        without(lit_at, lit_e, pixels, narrow, bad_at)
        lit_at, lit_e = _above(lit_at, lit_e, limit_e, calibration)
    prepared = PreparedFrame(
        frame=frame,
        calibration=calibration,
        pixels=pixels,
        mesh_e=mesh_e,
        kernel=narrow,
        lit_at=lit_at,
        lit_e=lit_e,
        floor_e2=floor_e2,
        texture_e=None,
        bad_at=bad_at,
    )
    if not structured:
        return prepared
    more_at, more_e = _local_contrast(prepared, limit_mesh_e, noise_mesh_e, ratio, of_sources)
    lit_at, first = np.unique(np.concatenate([lit_at, more_at]), return_index=True)
    sigma_mesh_e = noise_mesh_e * np.sqrt(ratio**2 - np.float32(1.0))
    return replace(
        prepared,
        lit_at=lit_at,
        lit_e=np.concatenate([lit_e, more_e])[first],
        texture_e=as_wide(sigma_mesh_e, calibration),
    )


def _above(
    places: NDArray[np.int64],
    values: NDArray[np.float32],
    limit_e: NDArray[np.float32],
    calibration: Calibration,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    kept = above(places, values, limit_e, calibration.height_px)
    return places[kept], values[kept]


def bad_pixels(
    pixels: Pixels,
    places: NDArray[np.int64],
    floor_e2: float,
    kernel: NDArray[np.float64],
    *,
    along_rows: bool = False,
) -> NDArray[np.int64]:
    """Find pixels that are stuck or hot: far brighter, beside their neighbours, than light could make them.

    Around a point in the middle of a pixel its eight neighbours hold `least` times its light together, around
    any other image more. A pixel whose neighbours hold less than half of that, and by 5 σ, is none of light,
    whether it stands alone or beside another.

    Parameters
    ----------
    pixels
        The frame.
    places
        Where to look, as indices in the frame.
    floor_e2
        Variance of a dark pixel.
    kernel
        Image of a point along one axis, of odd length.
    along_rows
        Look at the neighbours in the same row alone: behind a rolling shutter the rows of a flare may be lit
        at different times.

    Returns
    -------
    Those that are.
    """
    middle = len(kernel) // 2
    in_line = float(kernel[middle - 1 : middle + 2].sum() / kernel[middle])
    least = in_line - 1.0 if along_rows else in_line**2 - 1.0
    own, around, variance = neighbours(pixels, places, floor_e2, along_rows)
    is_bad = around + _BAD_SIGMAS * np.sqrt(variance) < 0.5 * least * own
    return np.asarray(places[is_bad], dtype=np.int64)


def _local_contrast(
    prepared: PreparedFrame,
    limit_mesh_e: NDArray[np.float32],
    noise_mesh_e: NDArray[np.float32],
    ratio: NDArray[np.float32],
    of_sources: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Find what stands out of its close surroundings where the background has structure.

    A point on a hill that is wider than the point spread does so though the hill is as bright as the point.
    Returns the pixels, and the filtered image there.
    """
    import cv2

    calibration = prepared.calibration
    kernel, _, of_point = point_filter(calibration.psf_sigma_px)
    side = 2 * len(kernel) - 1
    widened = cv2.dilate((ratio > 1.0).astype(np.uint8), np.ones((3, 3), np.uint8))
    structured = np.asarray(widened).reshape(ratio.shape) > 0
    # Only where it matters, and as far around as the scatter's smoothing reaches.
    cells = [
        slice(max(0, int(at.min()) - _SMOOTHING_REACH), int(at.max()) + _SMOOTHING_REACH + 1)
        for at in np.nonzero(structured)
    ]
    (top, bottom), (left, right) = (
        (max(0, part.start * length // count - side), min(length, part.stop * length // count + 1 + side))
        for part, length, count in zip(cells, prepared.shape, ratio.shape, strict=True)
    )
    part_e = filtered(
        prepared.pixels, prepared.kernel, prepared.bad_at, (top, left, bottom - top, right - left)
    )
    contrast_e = part_e - cv2.blur(part_e, (side, side))
    padded = np.pad(kernel, side // 2)
    mean = np.convolve(kernel, np.full(side, 1.0 / side))
    of_noise = math.sqrt(float(np.sum((np.outer(padded, padded) - np.outer(mean, mean)) ** 2)))
    share = np.float32(of_noise / of_point)
    rows, columns = (each[part] for each, part in zip(scatter_places(prepared.shape), cells, strict=True))
    samples = contrast_e[np.ix_(rows.ravel() - top, columns.ravel() - left)]
    if of_sources is not None:
        samples[of_sources[np.ix_(rows.ravel(), columns.ravel())]] = np.inf
    more = np.ones_like(ratio)
    noise_e = noise_mesh_e[tuple(cells)] * share
    more[tuple(cells)] = scatter_ratio(samples, noise_e, np.full_like(noise_e, np.inf))
    # Cells of even ground have no limit here.
    limit_e = np.where(structured, limit_mesh_e * share * more, np.float32(1e9))
    within = np.arange(top, bottom)[:, None] * calibration.width_px + np.arange(left, right)
    kept = above(within.ravel(), contrast_e.ravel(), as_wide(limit_e, calibration), calibration.height_px)
    return within.ravel()[kept], part_e.ravel()[kept]
