"""What a goniometer has counted, and the radiant intensity that follows from it."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nir_render.randomness import generator

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

REACH_RAD = math.radians(85.0)  # of the paper's Exp. 2
_FLAT = 0.05
_DRAWS = 500  # by which it is told how much noise alone would vary


@dataclass(frozen=True, eq=False)
class Goniogram:
    """Photons by where they went: cells around nodes at even polar angles 0 … π and azimuths from 0 on.

    Attributes
    ----------
    near
        Counted where they pass the sphere of radius `distance_m`, shape (n_polar, n_azimuth).
    far
        Counted by their direction, as from afar, of the same shape.
    left, in_cover, in_board, lost
        How many left, were taken by cover and board, or were given up after a million steps: all together
        they are `photons`.
    """

    near: Counts
    far: Counts
    distance_m: float
    left: int
    in_cover: int
    in_board: int
    lost: int

    @property
    def photons(self) -> int:
        """How many were sent."""
        return self.left + self.in_cover + self.in_board + self.lost

    @cached_property
    def polar_rad(self) -> Array:
        """Polar angles of the nodes, shape (n_polar,)."""
        return np.linspace(0.0, np.pi, len(self.near))

    @cached_property
    def azimuth_rad(self) -> Array:
        """Azimuths of the nodes, shape (n_azimuth,)."""
        columns = self.near.shape[1]
        return np.asarray(2.0 * np.pi * np.arange(columns) / columns)

    @cached_property
    def intensity_per_sr(self) -> Array:
        """Radiant intensity over the flux of the dies, as measured at the distance, shape of `near`.

        That is E d²/Φ of the irradiance E across the ray. Each is the mean of its cell. At the poles all
        azimuths are one direction, of a small cell: where the two rings beside it differ by less than 5 %, so
        that lobes are far wider than them, the value there is that of an even parabola through all three.
        """
        return self._at_poles(self._per_sr(self.near), squared=False)

    @cached_property
    def far_per_sr(self) -> Array:
        """The same from afar."""
        return self._at_poles(self._per_sr(self.far), squared=False)

    @cached_property
    def sigma_per_sr(self) -> Array:
        """The standard error of `intensity_per_sr`: what lands in a cell is binomial."""
        caught = self.near / self.photons
        cells = np.sqrt(caught * (1.0 - caught) / self.photons) / self._solid_angle_sr[:, None]
        return np.asarray(np.sqrt(self._at_poles(cells**2, squared=True)))

    def _at_poles(self, cells: Array, squared: bool) -> Array:
        """Return values of cells with those at the poles put in; of variances too, by the squared weights."""
        values, rings = cells.copy(), self._per_sr(self.near).mean(axis=1)
        means = cells.mean(axis=1) / (cells.shape[1] if squared else 1)
        for near_pole in ([0, 1, 2], [-1, -2, -3]):
            _, first, second = rings[near_pole]
            weights = np.array([1.0, 0.0, 0.0])
            if abs(first - second) < _FLAT * second:
                weights = _parabola_weights(self._solid_angle_sr[near_pole])
            values[near_pole[0]] = (weights**2 if squared else weights) @ means[near_pole]
        return values

    @property
    def difference_from_afar(self) -> float:
        """The root mean square over the sphere of what the distance changes, over the mean intensity."""
        square = (self.far_per_sr - self.intensity_per_sr) ** 2
        mean_square = float((square * self._solid_angle_sr[:, None]).sum()) / (4.0 * np.pi)
        mean = self.left / self.photons / (4.0 * np.pi)
        return float(np.sqrt(mean_square)) / mean if mean > 0.0 else 0.0

    def _per_sr(self, counts: Counts) -> Array:
        return np.asarray(counts / self.photons / self._solid_angle_sr[:, None])

    @cached_property
    def _solid_angle_sr(self) -> Array:
        """Solid angle of a cell of each row, shape (n_polar,)."""
        half_rad = 0.5 * np.pi / (len(self.near) - 1)
        upper_rad = np.maximum(self.polar_rad - half_rad, 0.0)
        lower_rad = np.minimum(self.polar_rad + half_rad, np.pi)
        ring_sr = 2.0 * np.pi * (np.cos(upper_rad) - np.cos(lower_rad))
        return np.asarray(ring_sr / self.near.shape[1])


@dataclass(frozen=True)
class Variation:
    """By how much a source varies over the turn of the paper's Exp. 2: in one plane, to ±`reach_rad`.

    `peak_to_peak` is (max − min)/max, as one says that a bare LED varies by more than 40 %; `plus_minus` is
    (max − min)/(max + min), the ± about the middle between the two; `about_mean` is the largest difference
    from the mean over the turn, over that mean. `edge` is the least intensity at ±`reach_rad` over that on
    the axis. `sigma` is the mean standard error of the values, over their mean: noise adds some of it to all
    three. `noise_alone` is the `peak_to_peak` that it would make of a source that does not vary at all.
    """

    reach_rad: float
    peak_to_peak: float
    plus_minus: float
    about_mean: float
    edge: float
    sigma: float
    noise_alone: float


def turned(gram: Goniogram, values: Array) -> tuple[Array, Array]:
    """Return values in the plane of azimuths 0 and π, by the angle from −π to π to which a source is turned.

    Both have shape (2 n_polar − 1,).
    """
    opposite = values[:, values.shape[1] // 2]  # of one column that one
    angle_rad = np.concatenate([-gram.polar_rad[:0:-1], gram.polar_rad])
    return angle_rad, np.concatenate([opposite[:0:-1], values[:, 0]])


def variation(gram: Goniogram, reach_rad: float = REACH_RAD) -> Variation:
    """Return by how much intensity varies over ±`reach_rad`, whose ends are interpolated between nodes."""
    angle_rad, intensity = turned(gram, gram.intensity_per_sr)
    _, sigma = turned(gram, gram.sigma_per_sr)
    within = np.abs(angle_rad) < reach_rad - 1e-9
    ends = np.interp([-reach_rad, reach_rad], angle_rad, intensity)
    over = np.concatenate([ends[:1], intensity[within], ends[1:]])
    noise = np.concatenate(
        [np.interp([-reach_rad], angle_rad, sigma), sigma[within], np.interp([reach_rad], angle_rad, sigma)]
    )
    mean, least, most = float(over.mean()), float(over.min()), float(over.max())
    if most <= 0.0:
        return Variation(reach_rad, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    axis = float(intensity[len(intensity) // 2])
    return Variation(
        reach_rad,
        (most - least) / most,
        (most - least) / (most + least),
        max(most - mean, mean - least) / mean,
        float(ends.min()) / axis if axis > 0.0 else 0.0,
        float(noise.mean()) / mean,
        _varies_by_noise(gram, mean, reach_rad),
    )


def _varies_by_noise(gram: Goniogram, mean: float, reach_rad: float) -> float:
    """Return the mean `peak_to_peak` of even intensity with the noise of the cells, over draws."""
    draws = generator(1, "goniometer noise", "", 0).standard_normal((_DRAWS, *gram.near.shape))
    angle_rad, _ = turned(gram, gram.intensity_per_sr)
    within = np.abs(angle_rad) < reach_rad + 1e-9
    over = [turned(gram, mean + gram.sigma_per_sr * one)[1][within] for one in draws]
    return float(np.mean([(one.max() - one.min()) / one.max() for one in over]))


def _parabola_weights(solid_angle_sr: Array) -> Array:
    """Return the weights of a pole's cell and the two rings beside it in the parabola's value at the pole.

    a + b θ² by least squares, where a cell counts by its solid angle, as its variance goes with the inverse.
    """
    square = np.array([0.0, 1.0, 4.0])
    moments = [float((solid_angle_sr * square**power).sum()) for power in range(3)]
    spread = moments[0] * moments[2] - moments[1] ** 2
    return np.asarray(solid_angle_sr * (moments[2] - square * moments[1]) / spread)
