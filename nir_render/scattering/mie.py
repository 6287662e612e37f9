"""Mie theory for many spheres: what a cloud of them takes from light, absorbs, and throws where.

All spheres are summed at once, over n, angles and sizes, as products of matrices; a test holds the
coefficients against miepython's, which takes spheres one by one and a hundred times as long. Symbols and
equations are those of Bohren & Huffman (Absorption and Scattering of Light by Small Particles, 1983,
chapter 4).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.scattering.sizes import Sizes, size_nodes

Array = NDArray[np.float64]
Waves = NDArray[np.complex128]

NODES = 2400
"""Sizes that stand for a distribution: σ, g and the ratio of σ come out to 0.1 %, light back to 0.5 %."""

MOST_X = 2000.0
"""2π r / λ of the largest spheres, 0.3 mm in radius at 940 nm: a scene with them loads within seconds."""

_AT_ONCE = 250  # sizes


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
    sizes: Sizes,
    index: complex,
    wavelength_m: float,
    angle_rad: Array,
    nodes: int = NODES,
    most_x: float = MOST_X,
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
    most_x
        2π r / λ beyond which spheres are refused.

    Raises
    ------
    InputError
        The spheres are so large that the sums would last hours.
    """
    radius_m, number = size_nodes(sizes, nodes)
    x = 2.0 * math.pi * radius_m / wavelength_m
    if x[-1] > most_x:
        most_mm = 1e3 * most_x * wavelength_m / (2.0 * math.pi)
        raise InputError(
            f"droplets of {1e3 * radius_m[-1]:.3g} mm in radius count here; wanted at most {most_mm:.3g} mm, "
            "for Mie theory's sums; check numbers and units"
        )
    pi, tau = _angular(_terms(x[-1]), np.cos(angle_rad))
    extinction, scattering, forward = 0.0, 0.0, 0.0
    intensity = np.zeros(len(angle_rad))
    for first in range(0, len(x), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        a, b = coefficients(index, x[some])
        weight, terms = number[some], len(a)
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


def coefficients(index: complex, x: Array) -> tuple[Waves, Waves]:
    """Return a_n and b_n of spheres, equation (4.88) in the book's signs, shape (terms, spheres) each.

    Parameters
    ----------
    index
        n − ik.
    x
        2π r / λ, increasing, shape (spheres,). Where terms vanish (Wiscombe 1980) they are 0.
    """
    index = index.conjugate()  # the book's time dependence makes it n + ik
    y, terms = index * x, _terms(x[-1])
    last = np.array([_terms(one) for one in x])
    derivative = np.zeros((terms + 1, len(x)), dtype=np.complex128)
    running: Waves = np.zeros(len(x), dtype=np.complex128)
    # Downwards, (4.89), from where nothing is left of what it starts with: errors shrink beyond |y| alone.
    furthest = float(abs(y).max())
    for n in range(max(terms, int(furthest + 8.0 * math.cbrt(furthest))) + 16, 0, -1):
        running = np.asarray(n / y - 1.0 / (running + n / y), dtype=np.complex128)
        if n <= terms + 1:
            derivative[n - 1] = running
    a, b = (np.zeros((terms, len(x)), dtype=np.complex128) for _ in range(2))
    psi_before, psi = np.cos(x), np.sin(x)
    xi_before, xi = psi_before + 1j * psi, psi - 1j * psi_before
    for n in range(1, terms + 1):
        # Small spheres' terms have ended, and their recurrences rest: they would overflow.
        on = n <= last
        psi_before, psi = psi, np.where(on, (2 * n - 1) / x * psi - psi_before, psi)
        xi_before, xi = xi, np.where(on, (2 * n - 1) / x * xi - xi_before, xi)
        for row, factor in ((a, derivative[n] / index + n / x), (b, derivative[n] * index + n / x)):
            row[n - 1] = np.where(on, (factor * psi - psi_before) / (factor * xi - xi_before), 0.0)
    return a, b


def _terms(x: float) -> int:
    return int(x + 4.05 * math.cbrt(x) + 2.0)


def _angular(terms: int, cosine: Array) -> tuple[Array, Array]:
    """Return π_n and τ_n by their recurrence (4.47), shape (angles, terms) each."""
    pi, tau = (np.zeros((terms + 1, len(cosine))) for _ in range(2))
    pi[1], tau[1] = 1.0, cosine
    for n in range(2, terms + 1):
        pi[n] = ((2 * n - 1) * cosine * pi[n - 1] - n * pi[n - 2]) / (n - 1)
        tau[n] = n * cosine * pi[n] - (n + 1) * pi[n - 1]
    return np.ascontiguousarray(pi[1:].T), np.ascontiguousarray(tau[1:].T)
