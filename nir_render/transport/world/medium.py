"""Fog as numbers: a medium in a box, whose faces may be infinitely far, of one density or one over height."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.scattering.optics import ANGLE_RAD
from nir_render.scene.documents.fog import HenyeyGreenstein, TabulatedPhase
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.world.fog_depth import HeightProfile, height_profile
from nir_render.transport.world.phase import PhaseTable, henyey_greenstein, phase_table, tabulated


@dataclass(frozen=True, eq=False)
class Medium:
    """A fog: extinction, share of it that is scattering, the box it fills, and its phase function.

    `profile` is its density over height, relatively; None where that is the same everywhere.
    """

    extinction_per_m: float
    albedo: float
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    phase: PhaseTable
    profile: HeightProfile | None = None

    def densest_per_m(self, low_m: float, high_m: float) -> float:
        """Return the largest extinction between two heights."""
        if self.profile is None:
            return self.extinction_per_m
        ends = self.profile.at(np.clip(np.array([low_m, high_m]), *self.profile.height_m[[0, -1]]))
        within = (self.profile.height_m > low_m) & (self.profile.height_m < high_m)
        return self.extinction_per_m * float(np.append(ends, self.profile.density[within]).max())

    def mean_extinction_per_m(self, low_m: float = -np.inf, high_m: float = np.inf) -> float:
        """Return the mean extinction between two heights, at most those of the profile."""
        if self.profile is None:
            return self.extinction_per_m
        ends_m = np.clip(np.array([low_m, high_m]), self.profile.height_m[0], self.profile.height_m[-1])
        return self.extinction_per_m * float(self.profile.mean(ends_m[:1], ends_m[1:])[0])


def medium(snapshot: Snapshot) -> Medium | None:
    """Return the fog of a scene, None where the air is clear."""
    fog = snapshot.fog
    if fog is None or fog.extinction_per_m == 0.0:
        return None
    low_m, high_m = fog.region_m()
    phase = fog.phase
    if isinstance(phase, HenyeyGreenstein):
        function = henyey_greenstein(phase.g)
    elif isinstance(phase, TabulatedPhase):
        angle_rad, value = np.array(phase.points).T
        function = tabulated(angle_rad, value)
    else:
        assert fog.droplets is not None  # their document sees to it
        function = tabulated(ANGLE_RAD, fog.droplets.optics.phase_per_sr)
    return Medium(fog.extinction_per_m, fog.albedo, low_m, high_m, phase_table(function), height_profile(fog))
