"""Light that fog throws forward, about where a source is seen: how much within each angle, by optical depth.

A small source at a distance d, seen through fog of extinction σ: what is scattered once by a small angle θ,
at the share x of the way from the source, arrives at the angle x θ off it. So of the light that arrives
straight, at an optical depth τ = σ d, the halo

    h(α) = (ω/α) ∫_α^∞ p(θ) dθ  per sr and per τ

(ω the albedo, p the phase function) goes with its Hankel transform Q(ν) = 2π ∫ h(α) J₀(2π ν α) α dα, and all
that is scattered forward, any number of times, with exp(τ Q) − 1: the small-angle approximation of radiative
transfer (Wells, J. Opt. Soc. Am. 59, 686, 1969; Zege, Ivanov & Katsev, Image Transfer Through a Scattering
Medium, 1991).
It does not depend on d but by τ.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

Array = NDArray[np.float64]

WIDEST_RAD = 0.5
"""Turns by more count as lost: what they bring beside a flare is even."""

_MOST_FREQUENCY, _FREQUENCIES = 1200.0, 1500  # in cycles per rad: 0.05 degrees
_ANGLES = 3000


def scattered_once(angle_rad: Array, phase_per_sr: Array, albedo: float, within_rad: Array) -> Array:
    """Return the halo of light scattered once within angles of arrival, over straight light and τ.

    ∫_0^ψ h 2π α dα = 2π ω (∫_0^ψ p θ dθ + ψ ∫_ψ p dθ).

    Parameters
    ----------
    angle_rad, phase_per_sr
        The phase function, linear between points, integral 1 over the sphere, shape (n,) each.
    albedo
        Share of the light lost that is scattered.
    within_rad
        ψ, any shape.
    """
    angle, phase = _fine(angle_rad, phase_per_sr)
    steps = np.diff(angle)
    beyond = np.concatenate([[0.0], np.cumsum(0.5 * (phase[1:] + phase[:-1]) * steps)])
    beyond = beyond[-1] - beyond
    moment = phase * angle
    below = np.concatenate([[0.0], np.cumsum(0.5 * (moment[1:] + moment[:-1]) * steps)])
    within = np.asarray(within_rad, dtype=np.float64)
    share = np.interp(within, angle, below) + within * np.interp(within, angle, beyond)
    return np.asarray(2.0 * np.pi * albedo * share)


def scattered_forward(
    angle_rad: Array, phase_per_sr: Array, albedo: float, within_rad: Array, depths: Array
) -> Array:
    """Return the halo of light scattered any number of times within angles, over straight light.

    Parameters
    ----------
    angle_rad, phase_per_sr, albedo
        As for `scattered_once`.
    within_rad
        ψ, shape (n,).
    depths
        Optical depths τ, shape (m,).

    Returns
    -------
    ∫_0^ψ of the halo, over straight light, shape (m, n).
    """
    angle, phase = _fine(angle_rad, phase_per_sr)
    steps = np.diff(angle)
    beyond = np.concatenate([[0.0], np.cumsum(0.5 * (phase[1:] + phase[:-1]) * steps)])
    beyond = beyond[-1] - beyond
    # Dense where low: Q falls as 1/ν beyond the width of the peak.
    frequency = _MOST_FREQUENCY * np.linspace(0.0, 1.0, _FREQUENCIES) ** 2
    waves = [np.trapezoid(beyond * j0(2.0 * np.pi * nu * angle), angle) for nu in frequency]
    transform = 2.0 * np.pi * albedo * np.array(waves)
    once = scattered_once(angle_rad, phase_per_sr, albedo, within_rad)
    within = np.asarray(within_rad, dtype=np.float64)[:, None]
    kernel = 2.0 * np.pi * within * j1(2.0 * np.pi * frequency * within)
    shares = []
    for depth in np.asarray(depths, dtype=np.float64):
        more = np.expm1(depth * transform) - depth * transform  # twice and more; once is known in closed form
        shares.append(depth * once + np.trapezoid(more * kernel, frequency, axis=1))
    return np.array(shares)


def _fine(angle_rad: Array, phase_per_sr: Array) -> tuple[Array, Array]:
    """Return a phase function at many angles up to the widest."""
    angle = WIDEST_RAD * np.linspace(0.0, 1.0, _ANGLES) ** 2
    return angle, np.interp(angle, angle_rad, phase_per_sr)
