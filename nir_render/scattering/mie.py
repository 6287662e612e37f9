"""Mie theory for many spheres: what a cloud of them takes from light, absorbs, and throws where.

The coefficients a_n and b_n of each size are miepython's; the sums over n, angles and sizes are made here, as
products of matrices. Symbols are those of Bohren & Huffman (Absorption and Scattering of Light by Small
Particles, 1983, chapter 4).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.scattering.sizes import Sizes, size_nodes

Array = NDArray[np.float64]

NODES = 600
"""Sizes that stand for a distribution: σ, g and the ratio of σ come out to 0.2 %."""

_AT_ONCE = 40  # sizes
_LARGEST_X = 30_000.0  # 2π r / λ: drops of 4 mm radius at 940 nm; beyond them it lasts hours


@dataclass(frozen=True, eq=False)
class Cloud:
    """What spheres of a distribution do to light of one wavelength, for one sphere in the mean.

    Attributes
    ----------
    extinction_m2, scattering_m2
        Mean cross-sections.
    asymmetry
        Mean cosine of the scattered light.
    phase_per_sr
        The phase function at the angles asked for, of unpolarised light, integral 1; shape (angles,).
    """

    extinction_m2: float
    scattering_m2: float
    asymmetry: float
    phase_per_sr: Array


def cloud_of(
    sizes: Sizes, index: complex, wavelength_m: float, angle_rad: Array, nodes: int = NODES
) -> Cloud:
    """Return what a cloud of spheres of some sizes does to light.

    Parameters
    ----------
    index
        n − ik of the spheres, relative to air.
    angle_rad
        Angles of turning at which the phase function is wanted, shape (angles,); may be empty.
    nodes
        Sizes that stand for all.

    Raises
    ------
    InputError
        The spheres are so large that the sums would last hours.
    """
    from miepython import coefficients  # half a second

    radius_m, number = size_nodes(sizes, nodes)
    x = 2.0 * math.pi * radius_m / wavelength_m
    if x[-1] > _LARGEST_X:
        most_mm = 1e3 * _LARGEST_X * wavelength_m / (2.0 * math.pi)
        raise InputError(
            f"droplets of {1e3 * radius_m[-1]:.3g} mm in radius count here; wanted at most {most_mm:.3g} mm, "
            "for Mie theory's sums; check numbers and units"
        )
    found = [np.asarray(coefficients(index, float(one))) for one in x]
    pi, tau = _angular(max(one.shape[1] for one in found), np.cos(angle_rad))
    extinction, scattering, forward = 0.0, 0.0, 0.0
    intensity = np.zeros(len(angle_rad))
    for first in range(0, len(x), _AT_ONCE):
        some = found[first : first + _AT_ONCE]
        terms = max(one.shape[1] for one in some)
        a, b = (np.stack([_padded(one[row], terms) for one in some], axis=1) for row in range(2))
        weight = number[first : first + _AT_ONCE]
        n = np.arange(1.0, terms + 1.0)[:, None]
        # Of each sphere, over 2π/k²: equations (4.61) and (4.62), and Q_sca⟨cos θ⟩ after (4.62).
        extinction += float(weight @ ((2.0 * n + 1.0) * (a + b).real).sum(axis=0))
        scattering += float(weight @ ((2.0 * n + 1.0) * (abs(a) ** 2 + abs(b) ** 2)).sum(axis=0))
        pairs = n[:-1] * (n[:-1] + 2.0) / (n[:-1] + 1.0)
        next_to = (a[:-1] * a[1:].conj() + b[:-1] * b[1:].conj()).real
        each = (2.0 * n + 1.0) / (n * (n + 1.0))
        forward += 2.0 * float(
            weight @ ((pairs * next_to).sum(axis=0) + (each * (a * b.conj()).real).sum(axis=0))
        )
        # Equation (4.74), as S₁ ± S₂, of which either needs half the products.
        for side, mixed in ((pi[:, :terms] + tau[:, :terms], a + b), (pi[:, :terms] - tau[:, :terms], a - b)):
            waves = side @ np.hstack([(each * mixed).real, (each * mixed).imag])
            intensity += 0.25 * waves**2 @ np.tile(weight, 2)
    area_m2 = wavelength_m**2 / (2.0 * math.pi)  # 2π/k²
    return Cloud(
        extinction_m2=area_m2 * extinction,
        scattering_m2=area_m2 * scattering,
        asymmetry=forward / scattering,
        phase_per_sr=intensity / (2.0 * math.pi * scattering),
    )


def _padded(values: NDArray[np.complex128], length: int) -> NDArray[np.complex128]:
    return np.pad(values, (0, length - len(values)))


def _angular(terms: int, cosine: Array) -> tuple[Array, Array]:
    """Return π_n and τ_n by their recurrence (4.47), shape (angles, terms) each."""
    pi, tau = (np.zeros((terms + 1, len(cosine))) for _ in range(2))
    pi[1], tau[1] = 1.0, cosine
    for n in range(2, terms + 1):
        pi[n] = ((2 * n - 1) * cosine * pi[n - 1] - n * pi[n - 2]) / (n - 1)
        tau[n] = n * cosine * pi[n] - (n + 1) * pi[n - 1]
    return np.ascontiguousarray(pi[1:].T), np.ascontiguousarray(tau[1:].T)
