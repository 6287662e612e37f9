"""First guesses of flares: by their light, and where that is clipped or cut, by more than is seen of it."""

import math
from statistics import NormalDist

import numpy as np

from perception.model.discs.nodes import smoothing_px
from perception.robust.clusters import Candidate, Cluster
from perception.robust.problem import Start
from perception.robust.search.blobs import half_axes_px
from perception.robust.search.prepare import PreparedFrame

_FAR_OFF_PX = 1.5  # of a blob's brightest pixel from the middle of its light
_CLIPPED_FACTORS = (1.0, 4.0, 16.0, 64.0)
_CUT_FACTORS = (1.0, 2.0, 4.0)
_LEAST_DISC_PX2 = 50  # of what is clipped, from which on its longer axis tells a disc's size
_MOST_SHARE = 1.0 - 1e-9
_SMALL_DISC = 0.7  # of the width that blurs it


def guesses(cluster: Cluster, prepared: PreparedFrame) -> list[list[Start]]:
    """Return sets of first guesses, the best of which is to be followed.

    Of a clipped flare, and of one that the frame's edge cuts, the part seen may be a small part of the flux;
    but no source is larger than what is seen of it. Where the middle of a lone blob's light is far from its
    brightest pixel, a flare there may stand beside something else.
    """
    cut = any(member.blob.box.touches_border(prepared.shape) for member in cluster.members)
    factors = _CLIPPED_FACTORS if cluster.is_clipped else _CUT_FACTORS if cut else (1.0,)
    if len(cluster.members) == 1 and cluster.is_clipped:
        factors = tuple(
            sorted({*factors, *_factor_by_outline(cluster.members[0], cluster.window.clip_e, prepared)})
        )
    floor_e = least_flux_e(prepared)
    sets: list[list[Start]] = []
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
    if len(sets) == 1 and len(cluster.members) == 1:
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


def _factor_by_outline(member: Candidate, clip_e: float, prepared: PreparedFrame) -> tuple[float, ...]:
    """Return how many times as bright a clipped flare is if it is a disc whose image clips so far out."""
    brightness_e = prepared.brightness_e(member.u_px, member.v_px)
    clipped = prepared.clipped_in(member.blob.box) & member.blob.pixels
    clipped_px2 = np.count_nonzero(clipped)
    if not (clipped_px2 and member.image_radius_px > 0.0 and clip_e < brightness_e < math.inf):
        return ()
    at_px = math.sqrt(clipped_px2 / math.pi)
    if clipped_px2 >= _LEAST_DISC_PX2:
        at_px = half_axes_px(clipped)[1]
    radius_px = _blurred_radius_px(at_px, clip_e / brightness_e, smoothing_px(prepared.calibration))
    return (max((radius_px / member.image_radius_px) ** 2, 1.0),)


def _blurred_radius_px(at_px: float, share: float, smooth_px: float) -> float:
    """Return the radius of a disc that, blurred by a Gaussian, is so bright at a place, relative to itself.

    There χ'², of two degrees of freedom and a noncentrality of (place / width)², is below (radius / width)²
    with this probability: by Sankaran's approximation (Biometrika 50, 199, 1963), of a small one by its flux.
    """
    away = (at_px / smooth_px) ** 2
    of_point = math.sqrt(2.0 * share) * math.exp(min(0.25 * away, 50.0))
    if of_point < _SMALL_DISC:
        wider = 1.0 + 0.25 * of_point**2  # as its own radius widens it
        return smooth_px * math.sqrt(2.0 * share * wider) * math.exp(0.25 * away / wider)
    h = 1.0 - 2.0 / 3.0 * (2.0 + away) * (2.0 + 3.0 * away) / (2.0 + 2.0 * away) ** 2
    p, m = (2.0 + 2.0 * away) / (2.0 + away) ** 2, (h - 1.0) * (1.0 - 3.0 * h)
    mean = 1.0 + h * p * (h - 1.0 - 0.5 * (2.0 - h) * m * p)
    sigma = h * math.sqrt(2.0 * p) * (1.0 + 0.5 * m * p)
    root = max(mean + NormalDist().inv_cdf(min(share, _MOST_SHARE)) * sigma, 0.0)
    return smooth_px * max(math.sqrt((2.0 + away) * root ** (1.0 / h)), _SMALL_DISC)
