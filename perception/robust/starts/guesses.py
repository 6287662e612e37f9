"""First guesses of flares: by their light, and where that is clipped or cut, by more than is seen of it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from perception.model.discs.nodes import smoothing_px
from perception.model.ranging import brightness_e
from perception.robust.clusters import Cluster
from perception.robust.problem import Start
from perception.robust.search.prepare import PreparedFrame
from perception.robust.starts.curve_of_growth import whole_fluxes

_FAR_OFF_PX = 1.5  # of a blob's brightest pixel from the middle of its light
_CLIPPED_FACTORS = (1.0, 4.0, 16.0, 64.0)
_CUT_FACTORS = (1.0, 2.0, 4.0)
_OUTLINE_PX, _OUTLINE_SHARE = 0.3, 0.05  # of the radius within which a disc clips
_OF_POINT = 1e6  # as bright as its flux in so small a part of a pixel
_BESIDE_PX = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
_OF_FLANK = 0.6  # by how much the flank counts: .5 to .75 where the disc is 10 to 1.5 times what clips


class _Disc(NamedTuple):
    """A lone disc as the light seen of it tells, and whether as much of it clips as is seen to."""

    u_px: float
    v_px: float
    flux_e: float
    is_sure: bool


def guesses(found: Sequence[Cluster], prepared: PreparedFrame) -> list[list[list[Start]]]:
    """Return each cluster's sets of first guesses, from the faintest on: the best is to be followed."""
    discs = _lone_discs(found, prepared)
    return [_of_cluster(cluster, disc, prepared) for cluster, disc in zip(found, discs, strict=True)]


def more_guesses(found: Sequence[Cluster], prepared: PreparedFrame) -> list[list[list[Start]]]:
    """Return sets of first guesses of clusters where those of `guesses` lead nowhere."""
    return [_of_cluster(cluster, None, prepared) for cluster in found]


def _of_cluster(cluster: Cluster, disc: _Disc | None, prepared: PreparedFrame) -> list[list[Start]]:
    """Return sets of first guesses of a cluster, which may be a lone disc.

    Of a clipped flare, and of one that the frame's edge cuts, the part seen may be a small part of the flux;
    but no source is larger than what is seen of it. Where the middle of a lone blob's light is far from its
    brightest pixel, a flare there may stand beside something else.
    """
    cut = any(member.blob.box.touches_border(prepared.shape) for member in cluster.members)
    factors: tuple[float, ...] = _CLIPPED_FACTORS if cluster.is_clipped else _CUT_FACTORS if cut else (1.0,)
    floor_e = least_flux_e(prepared)
    sets: list[list[Start]] = []
    if disc is not None:
        flux_e = max(disc.flux_e, floor_e)
        if disc.is_sure:
            sets.append([(disc.u_px, disc.v_px, cluster.members[0].log_range(flux_e))])
            factors = ()
        else:
            factors = tuple(sorted({*factors, flux_e / max(cluster.members[0].flux_e, floor_e)}))
    for factor in factors:
        starts: list[Start] = []
        for member in cluster.members:
            flux_e = max(member.flux_e, floor_e)
            times = factor if member.is_clipped or not cluster.is_clipped else 1.0
            if member.image_radius_px > 0.0:
                most = (
                    (max(member.blob.box.height, member.blob.box.width) + 2.0) / member.image_radius_px
                ) ** 2
                times = min(times, max(most, 1.0))
            starts.append((member.u_px, member.v_px, member.log_range(times * flux_e)))
        if starts not in sets:
            sets.append(starts)
    if len(sets) == 1 and len(cluster.members) == 1 and not cluster.is_clipped:
        (member,), smooth_px = cluster.members, smoothing_px(prepared.calibration)
        box, filtered_e = member.blob.box, member.blob.filtered_e
        row, column = divmod(int(np.argmax(filtered_e)), box.width)
        u_px, v_px = float(box.left + column), float(box.top + row)
        if math.hypot(u_px - member.u_px, v_px - member.v_px) > max(_FAR_OFF_PX, member.image_radius_px):
            # Filtered with its own width, a point's image has this share of its light in its brightest pixel.
            flux_e = 4.0 * math.pi * smooth_px**2 * member.blob.peak_e
            sets.append([(u_px, v_px, member.log_range(max(flux_e, floor_e)))])
    return sets


def least_flux_e(prepared: PreparedFrame) -> float:
    """Return the least flux that first guesses begin with."""
    return 3.0 * math.sqrt(prepared.floor_e2)


def _lone_discs(found: Sequence[Cluster], prepared: PreparedFrame) -> list[_Disc | None]:
    """Return what the light of lone blobs tells of discs; None where it tells nothing."""
    discs: list[_Disc | None] = [None] * len(found)
    lone = {
        index: cluster.members[0]
        for index, cluster in enumerate(found)
        if len(cluster.members) == 1 and not cluster.members[0].blob.box.touches_border(prepared.shape)
    }
    if not lone:
        return discs
    frame, calibration, smooth_px = prepared.frame, prepared.calibration, smoothing_px(prepared.calibration)
    place_px = np.array([(one.u_px, one.v_px) for one in lone.values()])
    clipped_px = np.sqrt([one.clipped_px / math.pi for one in lone.values()])
    light_e, area_px2, radius_px = np.array(
        [(one.flux_e, one.blob.area_px, one.image_radius_px) for one in lone.values()]
    ).T
    clip_e = np.array([found[index].window.clip_e - found[index].background_e for index in lone])
    around_px = np.concatenate([place_px + beside_px for beside_px in _BESIDE_PX])
    bright_e = brightness_e(around_px, frame.exposure_s, frame.gain, calibration).reshape(3, -1)
    flux_e, told_px2 = whole_fluxes(
        light_e, area_px2, np.minimum(bright_e[0], _OF_POINT * light_e),
        np.where(clipped_px > 0.0, clip_e, math.inf), smooth_px,
    ).T  # fmt: skip
    told_px = np.sqrt(told_px2 / math.pi)
    is_sure = abs(told_px - clipped_px) < _OUTLINE_PX + _OUTLINE_SHARE * told_px
    with np.errstate(invalid="ignore", divide="ignore"):
        # The middle of a disc's outline lies where less light falls, that of all of its light at its place.
        # Of its flank more is bright where more light falls.
        radius_px = radius_px * np.sqrt(flux_e / light_e)
        shift_px = radius_px * (0.25 * radius_px - _OF_FLANK * smooth_px) * np.log(bright_e[1:] / bright_e[0])
    place_px += np.where((clipped_px > 0.0) & np.isfinite(shift_px), shift_px, 0.0).T
    rows = zip(lone, place_px.tolist(), flux_e.tolist(), is_sure.tolist(), strict=True)
    for index, (u_px, v_px), one_e, as_seen in rows:
        if not math.isnan(one_e):
            discs[index] = _Disc(u_px, v_px, one_e, as_seen)
    return discs
