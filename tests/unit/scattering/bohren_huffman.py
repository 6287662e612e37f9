"""Mie's sums as Bohren and Huffman print them (1983, appendix A), for many spheres at once: a second program."""

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
    for n in range(int(max(terms, 1.1 * abs(y).max())) + 60, 0, -1):
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
