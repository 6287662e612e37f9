"""Blobs become clusters: what is measured by one fit, with a window around it and first guesses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.discs.nodes import smoothing_px
from perception.model.flare import PixelBox
from perception.model.lens import stretch
from perception.model.ranging import angular_radius_rad, exposure_towards, flux_e_of
from perception.model.sensor import clip_level_e
from perception.robust.problem import Window
from perception.robust.search.blobs import MAX_IMAGE_RADIUS_PX, Blob, is_large, near_groups
from perception.robust.search.cutout import cut, light_of
from perception.robust.search.frame import excess_at
from perception.robust.search.prepare import MOST_STRUCTURED_PX, PreparedFrame

Array = NDArray[np.float64]

NEAR_PX = 3
"""Blobs so near to each other are measured by one fit."""

MOST_BLOBS = 8
"""Blobs in larger groups are measured one by one, each with the nearest that lie in its window."""

_CROWD_NEIGHBOURS = 3
_TOUCHING_PX = 4
_KEPT_PX = 2

LEAST_RANGE_M = 0.03
"""Nothing is taken for a source that would stand nearer to the lens."""

_MOST_EVEN_PX = 193  # of a group's window on even ground

# Few sizes of windows, as what texture looks like is reckoned once for each.
_SIDES_PX = (17, 21, 25, 29, 35, 41, 49, 57, 65, 81, 97, 113, MOST_STRUCTURED_PX, 161, _MOST_EVEN_PX)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A blob with what must be known of it before it is measured.

    Attributes
    ----------
    blob
        The flare's pixels.
    clipped_px
        How many of them are clipped.
    u_px, v_px
        Centroid of the blob, weighted by what exceeds the background (`cutout.light_of`).
    flux_e
        Sum of what exceeds the background in the blob.
    at_one_metre_e
        Flux of a source one metre away in that direction; NaN where no range can be had.
    image_radius_px
        Radius that the image of a source of this flux would have; 0 where no range can be had.
    """

    blob: Blob
    clipped_px: int
    u_px: float
    v_px: float
    flux_e: float
    at_one_metre_e: float
    image_radius_px: float

    @property
    def is_clipped(self) -> bool:
        """Whether any pixel is clipped."""
        return self.clipped_px > 0

    @property
    def is_too_large(self) -> bool:
        """Whether its image is larger than is fitted."""
        clipped_disc_px = math.sqrt(self.clipped_px / math.pi)
        return is_large(self.blob) or max(self.image_radius_px, clipped_disc_px) > MAX_IMAGE_RADIUS_PX

    @property
    def is_beyond_fit(self) -> bool:
        """Whether it is too large to be looked at closely, or no range can be had to say its size."""
        return self.is_too_large or not self.at_one_metre_e > 0.0

    def log_range(self, flux_e: float) -> float:
        """Logarithm of the range of a source of that flux; where no range can be had, of flux 1 at 1 m."""
        at_one_metre_e = self.at_one_metre_e if self.at_one_metre_e > 0.0 else 1.0
        return 0.5 * math.log(at_one_metre_e / flux_e)


def candidates(blobs: Sequence[Blob], prepared: PreparedFrame) -> list[Candidate]:
    """Look at blobs: their centroids and fluxes, and how large sources of these fluxes would look."""
    if not blobs:
        return []
    frame, calibration = prepared.frame, prepared.calibration
    width = prepared.shape[1]
    of_blobs = [blob.places(width) for blob in blobs]
    places, ends = np.concatenate(of_blobs), np.cumsum([len(each) for each in of_blobs]).tolist()
    excess_e, counts_dn = excess_at(prepared.pixels, places), prepared.pixels.data_dn.ravel()[places]
    light = [
        light_of(
            excess_e[first:end], counts_dn[first:end], places[first:end],
            prepared.bad_at, width, prepared.clipped_dn,
        )
        for first, end in zip([0, *ends], ends, strict=False)
    ]  # fmt: skip
    u_px, v_px, flux_e = np.array([each[:3] for each in light]).T
    direction = direction_camera(np.column_stack([u_px, v_px]), calibration)
    exposed_s = exposure_towards(direction, frame.exposure_s, frame.gain, calibration)
    at_one_metre_e = flux_e_of(exposed_s, frame.gain, calibration)
    ranged = (at_one_metre_e > 0.0) & (flux_e > 0.0)
    range_m = np.sqrt(np.where(ranged, at_one_metre_e / np.where(flux_e > 0.0, flux_e, 1.0), 1.0))
    angle_rad = angular_radius_rad(range_m, calibration.source_radius_m)
    radius_px = stretch(direction, calibration) * np.tan(angle_rad)
    rows = zip(blobs, light, at_one_metre_e.tolist(), np.where(ranged, radius_px, 0.0).tolist(), strict=True)
    return [
        Candidate(blob, clipped_px, u, v, flux, at_one_metre, radius)
        for blob, (u, v, flux, clipped_px), at_one_metre, radius in rows
    ]


def is_extended(candidate: Candidate, prepared: PreparedFrame) -> bool:
    """Whether a blob is far larger than a source of its flux: a lit wall's edge, a window, a lamp tube.

    Flux tells the range, range the size. The area above half of the maximum (which the PSF's faint tail does
    not reach) may be four times what a source would cover, so that flares that overlap are kept. Clipped
    blobs are never called extended, for neither their flux nor their half maximum is known.
    """
    if candidate.is_clipped:
        return False
    half_area = int(np.count_nonzero(candidate.blob.bright_half))
    # Half maximum of a Gaussian filtered with itself lies at √(2 ln 2) · √2 σ = 1.67 σ.
    smooth_px = smoothing_px(prepared.calibration)
    return half_area > 4.0 * math.pi * (candidate.image_radius_px + 1.67 * smooth_px) ** 2 + 8.0


def brightest(found: Sequence[Candidate], most: int) -> list[Candidate]:
    """Return the candidates of the greatest flux, in the order in which they are."""
    if len(found) <= most:
        return list(found)
    kept = np.sort(np.argsort([each.flux_e for each in found], kind="stable")[-most:])
    return [found[index] for index in kept]


@dataclass(frozen=True, eq=False)
class Cluster:
    """Candidates that are measured by one fit, and the window that holds them.

    `wanted` says which of them: the others are there because their light is.
    """

    members: Sequence[Candidate]
    wanted: Sequence[int]
    window: Window
    background_e: float

    @property
    def is_in_crowd(self) -> bool:
        """Whether it is a part of a larger group."""
        return len(self.wanted) < len(self.members)

    @cached_property
    def is_beyond_fit(self) -> bool:
        """Whether any member is."""
        return any(member.is_beyond_fit for member in self.members)

    @cached_property
    def is_clipped(self) -> bool:
        """Whether any member is."""
        return any(member.is_clipped for member in self.members)


def clusters(
    members: Sequence[Candidate],
    prepared: PreparedFrame,
    apart: bool = False,
    measured: Sequence[Candidate] = (),
    within_px: int = _TOUCHING_PX,
) -> list[Cluster]:
    """Group candidates that lie side by side, unless `apart`, and cut their windows out of the frame.

    The pixels of what is `measured` already are left out of the windows, and so is other light that does not
    come `within_px` of a flare.
    """
    blobs = [member.blob for member in members]
    chosen: list[tuple[list[int], list[int]]] = []
    most_px = MOST_STRUCTURED_PX if prepared.texture_e is not None else _MOST_EVEN_PX
    for group in [[k] for k in range(len(blobs))] if apart else near_groups(blobs, NEAR_PX):
        if len(group) == 1 or (
            len(group) <= MOST_BLOBS and _window_box([members[k] for k in group], prepared).height <= most_px
        ):
            chosen.append((group, list(range(len(group)))))
            continue
        places = np.array([(members[k].u_px, members[k].v_px) for k in group])
        for at, _ in enumerate(group):
            apart_px = np.abs(places - places[at]).max(axis=1)
            box = _window_box([members[group[at]]], prepared)
            nearest = np.argsort(apart_px, kind="stable")[: 1 + _CROWD_NEIGHBOURS]
            within = [int(k) for k in nearest if apart_px[k] < 0.5 * box.height]
            chosen.append(([group[k] for k in within], [within.index(at)]))
    owner = np.full(len(prepared.lit_at), -1)
    if blobs:
        lit = [*blobs, *(candidate.blob for candidate in measured)]
        of_blobs = [blob.places(prepared.calibration.width_px) for blob in lit]
        of = np.repeat(np.arange(len(lit)), [len(each) for each in of_blobs])
        owner[np.searchsorted(prepared.lit_at, np.concatenate(of_blobs))] = of
    grounds_e = prepared.backgrounds_e(
        (members[group[0]].u_px, members[group[0]].v_px) for group, _ in chosen
    )
    return [
        _cluster([members[k] for k in group], group, wanted, owner, ground_e, within_px, prepared)
        for (group, wanted), ground_e in zip(chosen, grounds_e, strict=True)
    ]


def _cluster(
    members: Sequence[Candidate],
    indices: Sequence[int],
    wanted: Sequence[int],
    owner: NDArray[np.int64],
    background_e: float,
    within_px: int,
    prepared: PreparedFrame,
) -> Cluster:
    frame, calibration = prepared.frame, prepared.calibration
    # In a crowd the window is that of the one that is wanted.
    about = members if len(wanted) == len(members) else [members[k] for k in wanted]
    box = _window_box(about, prepared)
    image_e, state = cut(
        *prepared.pixels[:3], prepared.lit_at, owner, prepared.bad_at,
        box.corner_and_size, np.array(indices), prepared.clipped_dn,
        within_px, _KEPT_PX,
    )  # fmt: skip
    structure, sigma_e = prepared.structure_at(members[0].u_px, members[0].v_px, box.height)
    window = Window(
        box=box,
        image_e=image_e,
        state=state,
        floor_e2=prepared.floor_e2,
        clip_e=clip_level_e(calibration, frame.black_level_dn, frame.gain),
        prnu=float(calibration.prnu),
        structure=structure,
        structure_e=sigma_e,
    )
    return Cluster(members, wanted, window, background_e)


def _window_box(members: Sequence[Candidate], prepared: PreparedFrame) -> PixelBox:
    """Return the smallest of the sizes that holds the blobs, the PSF around them, and a rim of background."""
    margin = math.ceil(4.0 * prepared.calibration.psf_sigma_px) + 4
    boxes = [member.blob.box for member in members]
    top, left = min(b.top for b in boxes), min(b.left for b in boxes)
    bottom, right = max(b.top + b.height for b in boxes), max(b.left + b.width for b in boxes)
    least = max(bottom - top, right - left) + 2 * margin
    side = next((side for side in _SIDES_PX if side >= least), least)
    return PixelBox((top + bottom - side) // 2, (left + right - side) // 2, side, side)
