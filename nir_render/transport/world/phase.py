"""How fog turns light: the phase function as a table that can be read, and drawn from, exactly.

A droplet of fog throws a third of the light within a few degrees of its way; the table's angles therefore
crowd towards 0. Between two of them the phase function is, by definition here, linear in 1 − cos θ, in which
solid angle is even; so its integral over the sphere, and the drawing of angles, are exact for the table.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError

Array = NDArray[np.float64]

CELLS = 1024


@dataclass(frozen=True, eq=False)
class PhaseTable:
    """A phase function on angles π (i / CELLS)², i = 0 … CELLS; all arrays have shape (CELLS + 1,).

    Attributes
    ----------
    angle_rad
        The angles of turning; 0 is straight on.
    versine
        1 − cos of them.
    density_per_sr
        The phase function; its integral over the sphere is 1.
    cumulative
        Share of the light that turns by at most each angle.
    arc
        ∫ of the phase function over the angle itself, from 0, in rad/sr: what a straight ray past a source
        scatters towards the eye (Kulla & Fajardo 2012: the inverse square cancels against the angle's rate).
    halo
        Cumulated share of the shine of the fog around a light, against the angle off it: a ray that passes it
        at an angle θ collects what is left of `arc` beyond θ, over sin θ.
    """

    angle_rad: Array
    versine: Array
    density_per_sr: Array
    cumulative: Array
    arc: Array
    halo: Array


def phase_table(phase_function: Callable[[Array], Array]) -> PhaseTable:
    """Return the table of a phase function of any scale.

    Parameters
    ----------
    phase_function
        Relative scattered intensity against the angle of turning in rad, shape (n,) → (n,), not negative.

    Raises
    ------
    InputError
        The function is so narrow that it falls between the table's angles.
    """
    angle_rad = np.pi * (np.arange(CELLS + 1) / CELLS) ** 2
    versine = 2.0 * np.sin(0.5 * angle_rad) ** 2
    density = np.asarray(phase_function(angle_rad), dtype=np.float64)
    shares = np.pi * (density[1:] + density[:-1]) * np.diff(versine)  # 2π ∫ p d(1 − cos θ), trapezoids
    if not shares.sum() > 0.0:
        raise InputError("a phase function is 0 but in a range too narrow to scatter; widen it to 1 deg")
    density = density / shares.sum()
    shares = shares / shares.sum()
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(angle_rad))])
    # A tenth evenly, so that no direction is left out.
    shine = (arc[-1] - 0.5 * (arc[1:] + arc[:-1])) * np.diff(angle_rad)
    shine = 0.9 * shine / shine.sum() + 0.1 * np.diff(angle_rad) / np.pi
    return PhaseTable(
        angle_rad=angle_rad,
        versine=versine,
        density_per_sr=density,
        cumulative=np.concatenate([[0.0], np.cumsum(shares)]),
        arc=arc,
        halo=np.concatenate([[0.0], np.cumsum(shine)]),
    )


def henyey_greenstein(asymmetry: float) -> Callable[[Array], Array]:
    """Return Henyey & Greenstein's phase function (1941), (1 − g²) / (4π (1 + g² − 2 g cos θ)^1.5)."""

    def density_per_sr(angle_rad: Array) -> Array:
        # 1 + g² − 2 g cos θ = (1 − g)² + 2 g (1 − cos θ), which keeps its digits where g is near 1.
        spread = (1.0 - asymmetry) ** 2 + 4.0 * asymmetry * np.sin(0.5 * angle_rad) ** 2
        return np.asarray((1.0 - asymmetry**2) / (4.0 * np.pi * spread**1.5))

    return density_per_sr


def tabulated(angle_rad: Array, value: Array) -> Callable[[Array], Array]:
    """Return the phase function that is linear between the points of a table, shape (n,) each."""

    def relative(at_rad: Array) -> Array:
        return np.interp(at_rad, angle_rad, value)

    return relative
