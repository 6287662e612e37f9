"""What a kind of droplets does to light at 940 nm, beside its extinction at 550 nm, where eyes see.

That of the presets stands in tables, data/droplets/tables, which tools/droplet_tables.py writes; that of
others is computed, in a second or some, once in a process.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from nir_render.scattering.mie import MOST_X, NODES, cloud_of
from nir_render.scattering.sizes import Sizes

Array = NDArray[np.float64]

BAND_M, VISIBLE_M = 940e-9, 550e-9
_INTERVALS = 1024
ANGLE_RAD: Array = np.pi * (np.arange(_INTERVALS + 1) / _INTERVALS) ** 2
"""Angles of phase functions, dense about 0: 76 of them within 1 degree."""

_FIGURES = ("extinction_m2", "visible_m2", "absorbed_share", "asymmetry", "volume_m3")


@dataclass(frozen=True)
class Particles:
    """A kind of droplets: sizes, and n − ik relative to air at 940 and at 550 nm."""

    sizes: Sizes
    index: complex
    index_550: complex


@dataclass(frozen=True, eq=False)
class Optics:
    """What droplets do to light, for one droplet in the mean.

    Attributes
    ----------
    name
        Of the preset that these are; empty where they are none.
    extinction_m2, visible_m2
        Cross-section at 940 nm, and at 550 nm.
    absorbed_share
        1 − albedo, at 940 nm.
    asymmetry
        Mean cosine of the scattered light.
    volume_m3
        Of a droplet.
    phase_per_sr
        The phase function at `ANGLE_RAD`, integral 1, shape (1025,).
    """

    name: str
    extinction_m2: float
    visible_m2: float
    absorbed_share: float
    asymmetry: float
    volume_m3: float
    phase_per_sr: Array

    @property
    def ratio(self) -> float:
        """σ(940 nm) / σ(550 nm)."""
        return self.extinction_m2 / self.visible_m2


@lru_cache(maxsize=64)
def optics_of(particles: Particles) -> Optics:
    """Return what droplets do to light: by a preset's table, or computed."""
    known = _tables().get(_line(particles))
    return computed(particles) if known is None else known


def computed(particles: Particles, nodes: int = NODES, most_x: float = MOST_X) -> Optics:
    """Return what droplets do to light, by Mie theory at so many sizes, none larger than `most_x`."""
    here = cloud_of(particles.sizes, particles.index, BAND_M, ANGLE_RAD, nodes, most_x)
    there = cloud_of(particles.sizes, particles.index_550, VISIBLE_M, np.zeros(0), nodes, 2.0 * most_x)
    # Rounding may bring the albedo of what absorbs nothing above 1.
    absorbed = max(1.0 - here.scattering_m2 / here.extinction_m2, 0.0)
    return Optics(
        name="",
        extinction_m2=here.extinction_m2,
        visible_m2=there.extinction_m2,
        absorbed_share=absorbed,
        asymmetry=here.asymmetry,
        volume_m3=particles.sizes.mean_volume_m3(),
        phase_per_sr=here.phase_per_sr,
    )


def mean_cosine(angle_rad: Array, value: Array) -> float:
    """Return the mean cosine of a phase function that is linear in the angle between points, of any scale."""
    fine = np.linspace(0.0, 1.0, 65)
    steps = np.unique((angle_rad[:-1, None] + np.diff(angle_rad)[:, None] * fine).ravel())
    scattered = np.interp(steps, angle_rad, value) * np.sin(steps)
    return float(np.trapezoid(scattered * np.cos(steps), steps) / np.trapezoid(scattered, steps))


def table_text(particles: Particles, optics: Optics) -> str:
    """Return a preset's table as it is written; a scene may name such a file as its phase function."""
    lines = [f"# {_line(particles)}"]
    lines += [f"# {name} {getattr(optics, name):.9g}" for name in _FIGURES]
    lines += ["angle_deg,value"]
    degrees = 180.0 * (np.arange(_INTERVALS + 1) / _INTERVALS) ** 2
    pairs = zip(degrees, optics.phase_per_sr, strict=True)
    return "\n".join([*lines, *(f"{angle:.9g},{value:.7g}" for angle, value in pairs), ""])


def _line(particles: Particles) -> str:
    """Return what tells droplets from others, as a line of text."""
    sizes = " ".join(f"{key}={value:.9g}" for key, value in sorted(vars(particles.sizes).items()))
    kind = type(particles.sizes).__name__
    index = f"index={particles.index:.9g} index_550={particles.index_550:.9g}"
    return f"{kind} {sizes} {index}"


@cache
def _tables() -> dict[str, Optics]:
    """Return the tables of the presets, by the line that says what they are of."""
    folder = resources.files("nir_render").joinpath("data", "droplets", "tables")
    known = {}
    for entry in sorted(folder.iterdir(), key=lambda one: one.name):
        if entry.name.endswith(".csv"):
            lines = entry.read_text(encoding="utf-8").splitlines()
            figures = dict(line[2:].split() for line in lines[1 : 1 + len(_FIGURES)])
            values = np.array([float(line.partition(",")[2]) for line in lines[2 + len(_FIGURES) :]])
            numbers = {name: float(figures[name]) for name in _FIGURES}
            known[lines[0][2:]] = Optics(name=entry.name.removesuffix(".csv"), phase_per_sr=values, **numbers)
    return known
