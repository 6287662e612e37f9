"""Mie's sums as Bohren and Huffman print them (1983, appendix A), for many spheres at once: a second program."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def sphere_sums(index: complex, x: Array, cosine: Array) -> tuple[Array, Array, Array, Array]:
    """Return Q_ext, Q_sca, Q_sca g, shape (sizes,), and (|S₁|² + |S₂|²)/2, shape (sizes, angles); index n + ik.

    ψ and χ by upward recurrence, the logarithmic derivative D downwards from far above; each sphere's sum stops at
    x + 4 x^⅓ + 2.
    """
    last = np.floor(x + 4.0 * np.cbrt(x) + 2.0).astype(int)
    terms = int(last.max())
    y = index * x
    log_derivative = np.zeros((terms + 1, len(x)), dtype=complex)
    running = np.zeros(len(x), dtype=complex)
    for n in range(int(max(terms, abs(y).max())) + 16, 0, -1):
        running = n / y - 1.0 / (running + n / y)
        if n - 1 <= terms:
            log_derivative[n - 1] = running
    psi_before, psi = np.cos(x), np.sin(x)
    chi_before, chi = -np.sin(x), np.cos(x)
    extinction, scattering, forward = (np.zeros(len(x)) for _ in range(3))
    s1, s2 = (np.zeros((len(x), len(cosine)), dtype=complex) for _ in range(2))
    pi_before, pi = np.zeros(len(cosine)), np.ones(len(cosine))
    a_before = b_before = np.zeros(len(x), dtype=complex)
    for n in range(1, terms + 1):
        on = n <= last
        # Beyond its last term a sphere's recurrences rest: they would overflow.
        psi_before, psi = psi, np.where(on, (2 * n - 1) * psi / x - psi_before, psi)
        chi_before, chi = chi, np.where(on, (2 * n - 1) * chi / x - chi_before, chi)
        xi, xi_before = psi - 1j * chi, psi_before - 1j * chi_before
        for_a, for_b = log_derivative[n] / index + n / x, log_derivative[n] * index + n / x
        a = np.where(on, (for_a * psi - psi_before) / (for_a * xi - xi_before), 0.0)
        b = np.where(on, (for_b * psi - psi_before) / (for_b * xi - xi_before), 0.0)
        extinction += (2 * n + 1) * (a + b).real
        scattering += (2 * n + 1) * (abs(a) ** 2 + abs(b) ** 2)
        forward += (2 * n + 1) / (n * (n + 1)) * (a * b.conj()).real
        if n > 1:
            forward += (n - 1) * (n + 1) / n * (a_before * a.conj() + b_before * b.conj()).real
        tau = n * cosine * pi - (n + 1) * pi_before
        share = (2 * n + 1) / (n * (n + 1))
        s1 += share * (np.outer(a, pi) + np.outer(b, tau))
        s2 += share * (np.outer(a, tau) + np.outer(b, pi))
        pi_before, pi = pi, ((2 * n + 1) * cosine * pi - (n + 1) * pi_before) / n
        a_before, b_before = a, b
    over = 2.0 / x**2
    return over * extinction, over * scattering, 2.0 * over * forward, 0.5 * (abs(s1) ** 2 + abs(s2) ** 2)


def fog_sums(
    power: float,
    slope_per_um: float,
    index: complex,
    wavelength_um: float,
    edges_deg: Array,
    sizes: int = 400,
) -> tuple[float, float, float, Array]:
    """Return σ of one droplet in µm², 1 − albedo, g, and the shares that are scattered between angles.

    Midpoints evenly in r up to where 1e-8 of the cross-section is left; Gauss–Legendre in cos θ between the edges.
    """
    high_um = (power + 2.0 + 8.0 * math.sqrt(power + 3.0) + 12.0) / slope_per_um
    radius_um = high_um * (np.arange(sizes) + 0.5) / sizes
    number = radius_um**power * np.exp(-slope_per_um * radius_um)
    number /= math.gamma(power + 1.0) / slope_per_um ** (power + 1.0) * sizes / high_um
    kept = number * radius_um**2 > 1e-8 * (number * radius_um**2).max()
    radius_um, number = radius_um[kept], number[kept]
    nodes, weights = np.polynomial.legendre.leggauss(40)
    edges = np.cos(np.radians(edges_deg))
    half = 0.5 * (edges[:-1] - edges[1:])
    cosine = (edges[1:, None] + half[:, None] * (nodes + 1.0)).ravel()
    q_ext, q_sca, q_forward, intensity = sphere_sums(index, 2.0 * math.pi * radius_um / wavelength_um, cosine)
    area = number * math.pi * radius_um**2
    extinction, scattering = float(area @ q_ext), float(area @ q_sca)
    wave = 2.0 * math.pi / wavelength_um
    per_sr = (number @ intensity).reshape(len(half), -1) / (wave**2 * scattering)
    shares = 2.0 * math.pi * half * (per_sr @ weights)
    return extinction, 1.0 - scattering / extinction, float(area @ q_forward) / scattering, shares
