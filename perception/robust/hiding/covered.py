"""How much of sources others hide, and how far ranges may be off because of what nobody sees of them."""

import math

import numpy as np

from perception.robust.overlap.pairs import LEAST_RADIUS_PX
from perception.robust.solve import Solution

_GAP_PX = 2.0  # between images: of what is hidden none is seen
_LEAST_HIDDEN = 0.2  # of a disc: of which more is seen is as large as it seems
_BULGE_SEEN = 1.0 / 3.0  # place and size take up most of it
_CHI2_OF_BULGE = 320.0


def shows_its_size(pile: Solution, near: int, far: int) -> bool:
    """Tell whether so much is seen of the farther one's limb that it can be no larger one, most of it hidden.

    Beyond the chord at which it is cut off one as large as the nearer bulges by less: χ² of that, of pixels
    along the limb, as bright as it is.
    """
    near_px, far_px = pile.radius_at_rest_px[[near, far]].tolist()
    apart_px = math.hypot(pile.u_px[near] - pile.u_px[far], pile.v_px[near] - pile.v_px[far])
    if apart_px > near_px + far_px + _GAP_PX:
        return True
    if far_px < LEAST_RADIUS_PX or pile.count > pile.by_outline:
        return False
    if hidden_share(pile, near, far) < _LEAST_HIDDEN:
        return True
    height_px = min(apart_px + far_px - near_px, 2.0 * far_px)
    if not height_px > 0.0 or not near_px > far_px:
        return False
    half_px = far_px if height_px > far_px else math.sqrt(height_px * (2.0 * far_px - height_px))
    bulge_px = height_px - (near_px - math.sqrt(near_px**2 - half_px**2))
    chi2 = 4.0 * half_px * float(pile.flares_e.max()) * (_BULGE_SEEN * bulge_px) ** 2
    return bool(chi2 > _CHI2_OF_BULGE)


def hidden_log_range(solution: Solution, index: int) -> float:
    """Return how far a flare's ln range may be off because sources hide parts of each other.

    What is fitted are whole discs, which shine through each other. Where they overlap so much of a source's
    light may lack, or be another's. And one that seems farther than another, within two radii of which it
    lies, may be as near as that, most of it hidden behind it. Eclipses are fitted as they are.
    """
    if solution.is_eclipse or solution.count == 1:
        return 0.0
    apart_px = np.hypot(solution.u_px - solution.u_px[index], solution.v_px - solution.v_px[index])
    others_px = solution.radius_at_rest_px
    nearer = [
        k
        for k in np.flatnonzero(apart_px < 2.0 * others_px).tolist()
        if k != index and not shows_its_size(solution, k, index)
    ]
    farther = solution.log_range[index] - solution.log_range[nearer]
    hidden = sum(hidden_share(solution, k, index) for k in range(solution.count) if k != index)
    return max(float(farther.max(initial=0.0)), 0.5 * hidden)


def hidden_share(solution: Solution, near: int, far: int) -> float:
    """Return about how much of a flare's disc another one covers: what a half plane at their mean edge does.

    Of two discs of unlike size the chord of the smaller one is meant.
    """
    apart_px = math.hypot(solution.u_px[near] - solution.u_px[far], solution.v_px[near] - solution.v_px[far])
    near_px, far_px = solution.radius_at_rest_px[[near, far]]
    depth = min(max(float(near_px + far_px - apart_px) / (2.0 * max(float(far_px), 1e-9)), 0.0), 1.0)
    middle = 1.0 - 2.0 * depth
    return (math.acos(middle) - middle * 2.0 * math.sqrt(depth - depth**2)) / math.pi
