"""What a robot may know of fog beyond that there is some: how thick it is, and of which droplets.

Then its calibration tells what the fog scatters forward about a flare, to the droplets that it takes it to be
of; where it does not know these, to all that fog is usually of, with what these differ by.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from nir_render.errors import InputError
from nir_render.scattering.forward import scattered_forward
from nir_render.scattering.optics import ANGLE_RAD
from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from perception.types import Calibration, ForwardLight

USUAL = ("advection_heavy", "advection_moderate", "radiation_heavy", "radiation_moderate")
"""The droplets of which fog may be where a robot does not know them."""

_EXACT_PER_M = 1e-6
_DEPTHS = (0.25, 0.5, 1.0, 2.0, 4.0)
_ANGLES_DEG = (0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0)
_ANGLES_RAD = tuple(math.radians(angle_deg) for angle_deg in _ANGLES_DEG)


def knowing_fog(
    known: Calibration,
    world: Scene | Snapshot,
    droplets: tuple[str, ...] = USUAL,
    extinction_sigma_per_m: float = _EXACT_PER_M,
) -> Calibration:
    """Return a calibration of a robot that knows the extinction of the scene's fog.

    Of fog that varies over height that is the mean over the heights of robots' sources, and what it varies by
    over these counts in its σ.

    Parameters
    ----------
    known
        The calibration without that knowledge, as `calibration` gives it.
    world
        Whose fog it is.
    droplets
        Presets of `data/droplets`: what it takes the fog to be of, one of these.
    extinction_sigma_per_m
        How well it knows the extinction.

    Raises
    ------
    InputError
        The scene has no fog, or no droplets of such a name are known.
    """
    snapshot = world.at(0.0) if isinstance(world, Scene) else world
    fog = snapshot.fog
    if fog is None or fog.extinction_per_m == 0.0:
        raise InputError("there is no fog to know of; give the scene one, such as fog: {visibility: 50 m}")
    if not droplets:
        raise InputError("droplets: none is named; name one of those that the fog may be of, or more")
    mean_per_m, spread_per_m = extinction_among_robots_per_m(snapshot)
    return replace(
        known,
        extinction_per_m=mean_per_m,
        forward_light=forward_light(droplets),
        sigma={**known.sigma, "extinction_per_m": math.hypot(extinction_sigma_per_m, spread_per_m)},
    )


def extinction_among_robots_per_m(snapshot: Snapshot) -> tuple[float, float]:
    """Return the extinction of a scene's fog at the heights of robots' sources: mean and standard deviation.

    0 in clear air.
    """
    fog = snapshot.fog
    if fog is None:
        return 0.0, 0.0
    heights_m = [placed.pose.position_m[2] for placed in snapshot.carried_sources.values()]
    if fog.profile is None or not heights_m:
        return fog.extinction_per_m, 0.0
    densities = np.interp(heights_m, *np.array(fog.profile).T)
    return fog.extinction_per_m * float(densities.mean()), fog.extinction_per_m * float(densities.std())


def forward_light(droplets: tuple[str, ...]) -> tuple[ForwardLight, ...]:
    """Return what fog of one of some droplets scatters forward: their mean, and by what each of them differs.

    Raises
    ------
    InputError
        No droplets of such a name are known.
    """
    tables = np.stack([_shares(name) for name in droplets])
    mean = tables.mean(axis=0)
    apart = tables - mean if len(tables) > 1 else tables[:0]
    return tuple(
        ForwardLight(
            depth,
            _ANGLES_RAD,
            tuple(float(share) for share in mean[k]),
            deviations=tuple(float(share) for share in apart[:, k].ravel()),
        )
        for k, depth in enumerate(_DEPTHS)
    )


@lru_cache(maxsize=32)
def _shares(name: str) -> NDArray[np.float64]:
    """Return the forward light of a preset's droplets, shape (depths, angles)."""
    try:
        optics = Droplets.model_validate(name).optics
    except ValidationError as error:
        raise InputError(f"droplets {name!r}: {error.errors()[0]['msg']}") from error
    albedo = 1.0 - optics.absorbed_share
    return scattered_forward(ANGLE_RAD, optics.phase_per_sr, albedo, np.array(_ANGLES_RAD), np.array(_DEPTHS))
