"""Light of a uniform sphere scattered once in fog that fills all space, by quadrature."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PhaseFunction = Callable[[Array], Array]


def henyey_greenstein(g: float) -> PhaseFunction:
    """p(cos θ) = (1 − g²) / (4π (1 + g² − 2 g cos θ)^3/2) in 1/sr; cos θ = 1 is forward."""
    return lambda cosine: (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)


def tabulated(angle_rad: Array, value: Array) -> PhaseFunction:
    """A table of the scattering angle, linear in the angle between entries, normalised to 1 over the sphere.

    ∫ (a + b θ) sin θ dθ = [b sin θ − (a + b θ) cos θ] between two entries.
    """
    slope = np.diff(value) / np.diff(angle_rad)
    upper = slope * np.sin(angle_rad[1:]) - value[1:] * np.cos(angle_rad[1:])
    lower = slope * np.sin(angle_rad[:-1]) - value[:-1] * np.cos(angle_rad[:-1])
    total = 2.0 * np.pi * float((upper - lower).sum())
    return lambda cosine: np.interp(np.arccos(np.clip(cosine, -1.0, 1.0)), angle_rad, value / total)


def single_scatter_per_w(
    directions: Array,
    source_m: Array,
    radius_m: float,
    extinction_per_m: float,
    albedo: float,
    phase: PhaseFunction,
    *,
    steps: int = 512,
    rings: int = 3,
) -> Array:
    """Return the radiance that one watt of a sphere sends by one scattering to the origin, in 1/(m² sr).

    Along the ray, at the angle φ seen from the source's foot point on it (distance s = s₀ + h tan φ, so that
    the measure ds/d² becomes dφ/h), fog scatters L_s ∫ p dΩ over the cone that the sphere fills,
    L_s = 1/(4π² r²); on either leg it takes exp(−σ s). Gauss–Legendre in φ and over the cone. Rays end on the
    sphere, else nowhere.

    Parameters
    ----------
    directions
        Unit vectors of the rays, shape (n, 3), none of which points to the sphere's very centre.
    source_m
        The sphere's centre from the origin, shape (3,).
    steps, rings
        Nodes along the ray and across the cone; near the sphere, which fills half the sky there, 24 rings.
    """
    nodes, weights = np.polynomial.legendre.leggauss(steps)
    along_m = directions @ source_m
    beside_m = np.linalg.norm(np.cross(directions, source_m), axis=-1)
    start = -np.arctan2(along_m, beside_m)
    front_m = np.sqrt(np.maximum(radius_m**2 - beside_m**2, 0.0))
    end = np.where(beside_m < radius_m, -np.arctan2(front_m, beside_m), 0.5 * np.pi)
    half = 0.5 * (end - start)
    angle = start[:, None] + half[:, None] * (nodes + 1.0)  # (n, steps)
    distance_m = beside_m[:, None] / np.cos(angle)
    path_m = along_m[:, None] + beside_m[:, None] * np.tan(angle)
    toward = -np.sin(angle)  # cosine between the ray and the way from the point to the source
    versines, shares = np.polynomial.legendre.leggauss(rings)
    spokes = np.cos(np.pi * (np.arange(2 * rings) + 0.5) / (2 * rings))  # half a turn; the other mirrors it
    sine2 = np.minimum((radius_m / distance_m) ** 2, 1.0)
    versine_max = sine2 / (1.0 + np.sqrt(1.0 - sine2))
    scattered = np.zeros_like(distance_m)
    for versine, share in zip(versines, shares, strict=True):
        v = 0.5 * (versine + 1.0) * versine_max
        cos_cone, sin_cone = 1.0 - v, np.sqrt(v * (2.0 - v))
        chord_m = np.sqrt(np.maximum(radius_m**2 - (distance_m * sin_cone) ** 2, 0.0))
        aside = sin_cone * np.sqrt(1.0 - toward**2)
        mean_phase = np.mean([phase(cos_cone * toward + spoke * aside) for spoke in spokes], axis=0)
        scattered += 0.5 * share * mean_phase * np.exp(-extinction_per_m * (distance_m * cos_cone - chord_m))
    fluence_per_w = 2.0 * np.pi * versine_max / (4.0 * np.pi**2 * radius_m**2)  # L_s Ω
    integrand = fluence_per_w * scattered * np.exp(-extinction_per_m * path_m) * distance_m**2
    total: Array = albedo * extinction_per_m * half / beside_m * (integrand @ weights)
    return total
