"""The core of a camera's point spread as its optical transfer function, in closed form.

Its parts are convolved with each other, so that their transfer functions multiply:

    Gaussian   exp(−2π² σ² f²)
    Airy       2/π (arccos ν − ν √(1 − ν²)),  ν = f λ N / pitch  (incoherent, circular pupil; Goodman, ch. 6)
    defocus    2 J₁(π D f) / (π D f)          (a disc of diameter D: geometric optics)
    kernel     the Fourier transform of its samples, up to their Nyquist frequency
    crosstalk  1 − s + s/2 (cos 2π f_x + cos 2π f_y)
    pixel      sinc f_x · sinc f_y

Frequencies are in cycles per pixel. The pupil is taken as circular over the whole field, and defocus and
diffraction as independent: right where the blur circle is far smaller than the Airy disc, or far larger.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from nir_render.camera.optics.focus import blur_circle_px
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.point_spread import MeasuredKernel

_LEFT_OUT = 1e-8  # contrast beyond which a Gaussian counts as none
_LEFT_OUT_OF_KERNEL = 1e-6
_GAUSSIAN_REACH_SIGMAS = 8.0
_AIRY_REACH = 190.0
_SLIGHT_DEFOCUS = 0.5


@dataclass(frozen=True)
class Core:
    """What a point becomes in the image before it meets the pixels.

    Attributes
    ----------
    sigma_px
        Of the Gaussian; 0 for none.
    airy_px
        λ N / pixel pitch: the inverse of the highest frequency that the aperture passes; 0: no diffraction.
    defocus_px
        Diameter of the blur circle.
    kernel
        Measured aberration.
    crosstalk
        Share of the charge that goes to the four neighbours in all.
    """

    sigma_px: float = 0.0
    airy_px: float = 0.0
    defocus_px: float = 0.0
    kernel: MeasuredKernel | None = None
    crosstalk: float = 0.0

    @property
    def gaussian_px(self) -> float | None:
        """The σ of a core that is a Gaussian and no more; else None.

        A blur circle of half of σ or less widens it by its own variance, D²/16: the image is right to 1e-4 of
        the flux.
        """
        if self.airy_px or self.kernel is not None or self.crosstalk:
            return None
        if self.defocus_px > _SLIGHT_DEFOCUS * self.sigma_px:
            return None
        return math.hypot(self.sigma_px, 0.25 * self.defocus_px) if self.defocus_px else self.sigma_px

    @property
    def highest_frequency(self) -> float:
        """The frequency, in cycles per pixel, above which nothing passes along either axis."""
        limits = []
        if self.sigma_px:
            limits.append(math.sqrt(-math.log(_LEFT_OUT) / 2.0) / (math.pi * self.sigma_px))
        if self.airy_px:
            limits.append(1.0 / self.airy_px)
        if self.kernel is not None:
            limits.append(_kernel_limit(self.kernel))
        return min(limits)

    @property
    def reach_px(self) -> float:
        """How far from its centre a point's image counts.

        Beyond a square of this half width lie 2 · 0.9 / (π² 190) < 1e-3 of an Airy pattern's light: its
        encircled energy nears 1 as 2 λ N / (π² r). Of a Gaussian it is 1e-15.
        """
        tail_px = max(_GAUSSIAN_REACH_SIGMAS * self.sigma_px, _AIRY_REACH * self.airy_px)
        half_px = 0.0
        if self.kernel is not None:
            half_px = self.kernel.pitch_px * max(len(self.kernel.values), len(self.kernel.values[0]))
        return tail_px + half_px + 0.5 * self.defocus_px + 2.0


def core_of(camera: Camera, depth_m: float = math.inf) -> Core:
    """Return the core of a camera's point spread for what is at a depth: its distance along the axis."""
    spread = camera.point_spread
    real_m = max(depth_m, 2.0 * camera.lens.focal_length_m)  # nearer than f a lens has no image
    defocus_px = blur_circle_px(camera, real_m, camera.sensor.temperature_k)
    airy_m = 0.0 if spread.diffraction_m is None else spread.diffraction_m * camera.lens.f_number
    return Core(
        sigma_px=spread.sigma_px or 0.0,
        airy_px=airy_m / camera.sensor.pixel_pitch_m,
        defocus_px=defocus_px,
        kernel=spread.kernel,
        crosstalk=spread.crosstalk,
    )


@lru_cache(maxsize=24)
def transfer(core: Core, period_px: int) -> NDArray[np.complex128] | NDArray[np.float64]:
    """Return what a core and the pixel pass of waves that fit a period, up to the highest frequency.

    Returns
    -------
    Shape (2 J + 1, J + 1): frequencies j / period, from −J to J along v and from 0 to J along u. Real but for
    a measured kernel.
    """
    count = math.floor(core.highest_frequency * period_px)
    f = np.arange(count + 1) / period_px
    f_squared = f[:, None] ** 2 + f**2
    quadrant = np.sinc(f) * np.sinc(f[:, None])
    if core.crosstalk:
        wave = np.cos(2.0 * np.pi * f)
        quadrant *= 1.0 - core.crosstalk + 0.5 * core.crosstalk * (wave[:, None] + wave)
    if core.sigma_px:
        quadrant *= np.exp(-2.0 * (np.pi * core.sigma_px) ** 2 * f_squared)
    if core.airy_px:
        quadrant *= _airy(core.airy_px * np.sqrt(f_squared))
    if core.defocus_px:
        quadrant *= _disc(np.pi * core.defocus_px * np.sqrt(f_squared))
    half = np.concatenate([quadrant[:0:-1], quadrant])
    if core.kernel is None:
        return half
    return np.asarray(half * _kernel(core.kernel, np.concatenate([-f[:0:-1], f]), f))


def _airy(nu: NDArray[np.float64]) -> NDArray[np.float64]:
    nu = np.minimum(nu, 1.0)
    return np.asarray(2.0 / np.pi * (np.arccos(nu) - nu * np.sqrt(1.0 - nu**2)))


def _disc(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.divide(2.0 * j1(x), x, out=np.ones_like(x), where=x > 0.0))


def _kernel(
    kernel: MeasuredKernel, v_frequency: NDArray[np.float64], u_frequency: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the Fourier transform of a kernel about its centroid; nothing above its Nyquist frequency."""
    values = np.array(kernel.values)
    values /= values.sum()
    waves = []
    for axis, frequency in enumerate((v_frequency, u_frequency)):
        place_px = kernel.pitch_px * np.arange(values.shape[axis])
        place_px -= values.sum(axis=1 - axis) @ place_px
        passed = np.abs(frequency) <= 0.5 / kernel.pitch_px
        waves.append(np.exp(-2.0j * np.pi * frequency[:, None] * place_px) * passed[:, None])
    return np.asarray(waves[0] @ values @ waves[1].T)


@lru_cache(maxsize=24)
def _kernel_limit(kernel: MeasuredKernel) -> float:
    """Return the frequency above which a kernel passes nothing along either axis."""
    values = np.array(kernel.values)
    sizes = [2 * max(values.shape)] * 2
    passed = np.abs(np.fft.rfft2(values, sizes)) > _LEFT_OUT_OF_KERNEL * values.sum()
    step = 1.0 / (sizes[0] * kernel.pitch_px)
    rows = np.abs(np.fft.fftfreq(sizes[0]) * sizes[0])[passed.any(axis=1)]
    highest = max(float(rows.max()), float(np.flatnonzero(passed.any(axis=0)).max()))
    return float(min((highest + 1.0) * step, 0.5 / kernel.pitch_px))
