"""How bright the sky is over directions: the fifteen skies of CIE S 011/E:2003 (ISO 15469:2004).

L(Z, χ) ∝ f(χ) φ(Z) with the zenith angle Z and the angle χ from the sun,

    φ = 1 + a exp(b / cos Z),    f = 1 + c (exp(d χ) − exp(d π/2)) + e cos² χ.

They are skies as the eye sees them: towards the infrared there is less blue sky beside the sun's aureole, and
more contrast than here. Below the horizon nothing shines.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.geometry import legendre

Array = NDArray[np.float64]

_PARAMETERS = (
    (4.0, -0.70, 0.0, -1.0, 0.00),
    (4.0, -0.70, 2.0, -1.5, 0.15),
    (1.1, -0.80, 0.0, -1.0, 0.00),
    (1.1, -0.80, 2.0, -1.5, 0.15),
    (0.0, -1.00, 0.0, -1.0, 0.00),
    (0.0, -1.00, 2.0, -1.5, 0.15),
    (0.0, -1.00, 5.0, -2.5, 0.30),
    (0.0, -1.00, 10.0, -3.0, 0.45),
    (-1.0, -0.55, 2.0, -1.5, 0.15),
    (-1.0, -0.55, 5.0, -2.5, 0.30),
    (-1.0, -0.55, 10.0, -3.0, 0.45),
    (-1.0, -0.32, 10.0, -3.0, 0.45),
    (-1.0, -0.32, 16.0, -3.0, 0.30),
    (-1.0, -0.15, 16.0, -3.0, 0.30),
    (-1.0, -0.15, 24.0, -2.8, 0.15),
)
_HEIGHTS, _TURNS = 400, 720  # of the quadrature over the sky


@dataclass(frozen=True)
class CieSky:
    """A sky under a sun: `a` … `e` of its type, the unit vector towards the sun, and what makes it unit.

    `unit` over π is the radiance of f φ = 1 where the sky brings 1 W/m² to a horizontal plane.
    """

    a: float
    b: float
    c: float
    d: float
    e: float
    to_sun: tuple[float, float, float]
    unit: float

    def relative(self, direction: Array) -> Array:
        """Return the radiance in unit directions, shape (…, 3), over that of an even sky as strong."""
        cosine = direction[..., 2]
        shape = _shape((self.a, self.b, self.c, self.d, self.e), cosine, direction @ np.array(self.to_sun))
        return np.where(cosine > 0.0, self.unit * shape, 0.0)


def cie_sky(number: int, to_sun: tuple[float, float, float]) -> CieSky:
    """Return a sky, 1 … 15, under a sun in the direction of a unit vector."""
    parameters = _PARAMETERS[number - 1]
    nodes, weights = legendre(_HEIGHTS)
    cosine, weight = 0.5 * (nodes + 1.0), 0.5 * weights
    sine = np.sqrt(1.0 - cosine**2)
    turn = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    flat = to_sun[0] * np.cos(turn) + to_sun[1] * np.sin(turn)
    shape = _shape(parameters, cosine[:, None], sine[:, None] * flat + cosine[:, None] * to_sun[2])
    on_plane = 2.0 * np.pi * float((weight * cosine) @ shape.mean(axis=1))
    return CieSky(*parameters, to_sun=to_sun, unit=np.pi / on_plane)


def _shape(parameters: tuple[float, ...], cosine: Array, sun_cosine: Array) -> Array:
    a, b, c, d, e = parameters
    from_sun_rad = np.arccos(np.clip(sun_cosine, -1.0, 1.0))
    gradation = 1.0 + a * np.exp(b / np.maximum(cosine, 1e-6))
    scattered = 1.0 + c * (np.exp(d * from_sun_rad) - np.exp(0.5 * np.pi * d)) + e * sun_cosine**2
    return np.asarray(gradation * scattered)
