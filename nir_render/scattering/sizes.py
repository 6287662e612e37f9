"""How many droplets there are of each size, and nodes at which to sum over them."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEGLIGIBLE = 1e-9  # of the largest share of all cross-sections, below which sizes are left out


@dataclass(frozen=True)
class ModifiedGamma:
    """n(r) ∝ r^power · exp(−slope · r): Deirmendjian's distribution, with exponents of fog."""

    power: float
    slope_per_m: float

    def log_density(self, radius_m: Array) -> Array:
        """Return ln n(r) of one droplet in all, n in 1/m."""
        scale = (self.power + 1.0) * math.log(self.slope_per_m) - math.lgamma(self.power + 1.0)
        return np.asarray(scale + self.power * np.log(radius_m) - self.slope_per_m * radius_m)

    def mean_volume_m3(self) -> float:
        """Return the volume of a droplet in the mean."""
        a = self.power
        return 4.0 / 3.0 * math.pi * (a + 1.0) * (a + 2.0) * (a + 3.0) / self.slope_per_m**3

    @property
    def evenly_in_log(self) -> bool:
        """Tell whether sizes span so many decades that nodes go by their logarithm."""
        return False

    def widest_m(self) -> tuple[float, float]:
        """Return radii beyond which there is surely nothing that counts."""
        mode = (self.power + 2.0) / self.slope_per_m
        return 1e-4 * mode, mode * (1.0 + 60.0 / math.sqrt(self.power + 2.0))


@dataclass(frozen=True)
class Lognormal:
    """dN/d ln r is a bell about the `median_m` of all particles; `spread` is its geometric σ."""

    median_m: float
    spread: float

    def log_density(self, radius_m: Array) -> Array:
        """Return ln n(r) of one particle in all, n in 1/m."""
        width = math.log(self.spread)
        off = np.log(radius_m / self.median_m) / width
        return np.asarray(-0.5 * off**2 - np.log(radius_m * width * math.sqrt(2.0 * math.pi)))

    def mean_volume_m3(self) -> float:
        """Return the volume of a particle in the mean."""
        return 4.0 / 3.0 * math.pi * self.median_m**3 * math.exp(4.5 * math.log(self.spread) ** 2)

    @property
    def evenly_in_log(self) -> bool:
        """Tell whether sizes span so many decades that nodes go by their logarithm."""
        return True

    def widest_m(self) -> tuple[float, float]:
        """Return radii beyond which there is surely nothing that counts."""
        # r² weighs the bell about ln r = ln median + 2 σ², r⁶, which small particles scatter by, about 6 σ².
        width = math.log(self.spread)
        return self.median_m * math.exp(-8.0 * width), self.median_m * math.exp(6.0 * width**2 + 8.0 * width)


Sizes = ModifiedGamma | Lognormal


def size_nodes(sizes: Sizes, count: int) -> tuple[Array, Array]:
    """Return radii, and how many of one droplet in all each stands for, shape (count,).

    Midpoints of even steps: of what vanishes at both ends they make sums as good as any. Only sizes that
    count in the sum of all cross-sections (π r²) are covered: what they stand for is below 1 in all.
    """
    low_m, high_m = sizes.widest_m()
    tried_m = np.geomspace(low_m, high_m, 20_000)
    share = sizes.log_density(tried_m) + 3.0 * np.log(tried_m)  # of r² dr, evenly in ln r
    covered_m = tried_m[share > share.max() + math.log(_NEGLIGIBLE)]
    place = (np.arange(count) + 0.5) / count
    if sizes.evenly_in_log:
        whole = math.log(covered_m[-1] / covered_m[0])
        radius_m = covered_m[0] * np.exp(whole * place)
        width_m = whole / count * radius_m
    else:
        radius_m = covered_m[0] + (covered_m[-1] - covered_m[0]) * place
        width_m = np.full(count, (covered_m[-1] - covered_m[0]) / count)
    return radius_m, np.exp(sizes.log_density(radius_m)) * width_m
