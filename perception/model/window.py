"""What windows of a frame are expected to hold, and how that changes with all that is not known.

λ = Σ_k F_k S(u_k, v_k, ρ_k) + B + Σ_m c_m φ_m: sources, each with the image S of a uniform sphere, on a
background B with structure. Range sets flux *and* size: with l the logarithm of the range that the flux alone
says, F = F₁ e^(-2l), F₁ the flux at one metre, and ρ = (r / 1 m) e^(-l + σ_t a). The slack a, a priori normal
with variance 1, is by how much the size may disagree with the flux: σ_t² = (σ_K / 2K)² + (σ_r / r)², so a
source whose flux is not to be trusted is ranged by its size. The width of the point spread is free within its
own σ: σ_psf e^(σ_w w). These priors enter as `precision` does for the structure's amplitudes c. A flare that
moves by m during the exposure, evenly, is drawn out along a line: the mean of S(u + s m) over s from -½ to ½,
u its place in the middle of the exposure. As a camera turns, what rests does so, too: m is then beside that.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera, turn_slopes_px
from perception.model.discs.rows import disc_rows
from perception.model.flare import is_before
from perception.model.layout import Known, Sources
from perception.model.lens import stretch
from perception.model.ranging import (
    LEAST_LEFT,
    angular_radius_rad,
    covered_px_at_1_m,
    exposure_towards,
    flux_e_of,
)
from perception.types import Calibration

Array = NDArray[np.float64]

SPEED_M_PER_S = 0.7
"""Of one robot past another, standard deviation across the line of sight, per axis: 0.5 m/s each."""

TURN_RAD_PER_S = 0.5
"""Of the observer about itself, standard deviation per axis."""

MOTION_PX = 8.0
"""Standard deviation of each part of a motion in fits and bounds: hardly any prior; `motion_cost` has it."""

MOST_MOTION_PX = 10.0
"""What seems to move farther during an exposure is the edge of something, and no flare."""

_OTHERWISE = 1e-8  # how often robots are not as slow: a blow, a machine that is far quicker


@dataclass(frozen=True, eq=False)
class Turn:
    """How far a camera turns during an exposure; forwards and backwards look the same.

    Attributes
    ----------
    rotation_rad, covariance_rad2
        The rotation about its axes, and how well it is known, shape (3,) and (3, 3).
    """

    rotation_rad: Array
    covariance_rad2: Array


@dataclass(frozen=True)
class Camera:
    """A camera at one exposure and gain, and how well what ranges depend on is known.

    Attributes
    ----------
    calibration
        Of the camera.
    exposure_s, gain
        Of the frame.
    motion_px
        How far flares may move during the exposure, the standard deviation of each part of it; 0: none does.
    turn
        How it turns during the exposure; None: not at all.
    """

    calibration: Calibration
    exposure_s: float
    gain: float
    motion_px: float = 0.0
    turn: Turn | None = None

    @property
    def moving(self) -> "Camera":
        """The camera of flares that may move."""
        return replace(self, motion_px=MOTION_PX)

    @property
    def flux_spread(self) -> float:
        """σ_K / K: also that of the robots' own flux."""
        sigma = self.calibration.sigma.get("range_constant_dn_m2_per_s", 0.0)
        return _share(sigma, self.calibration.range_constant_dn_m2_per_s)

    @property
    def radius_spread(self) -> float:
        """σ_r / r of the sources."""
        return _share(self.calibration.sigma.get("source_radius_m", 0.0), self.calibration.source_radius_m)

    @property
    def tie_spread(self) -> float:
        """σ_t: how far the logarithms of a range by flux and of one by size may lie apart."""
        return math.hypot(0.5 * self.flux_spread, self.radius_spread)

    @property
    def lean(self) -> float:
        """By how much of the slack between them a range follows size and not flux: σ_φ²/σ_t, σ_φ = σ_K/2K."""
        return (0.5 * self.flux_spread) ** 2 / self.tie_spread if self.tie_spread > 0.0 else 0.0

    @property
    def width_spread(self) -> float:
        """σ_w: relative standard deviation of the point spread's width."""
        return _share(self.calibration.sigma.get("psf_sigma_px", 0.0), self.calibration.psf_sigma_px)

    @property
    def radius_m(self) -> float:
        """Radius of the sources, 0 where it is not known."""
        radius_m = self.calibration.source_radius_m
        return radius_m if math.isfinite(radius_m) else 0.0

    def hidden_px_at_1_m(self, places_px: Array) -> Array | None:
        """Return of how many pixels' background a source would take away from one metre, at each place.

        Shape (n, 2) → (n,); None where sources hide nothing.
        """
        hiding = self.calibration.hidden_background
        return hiding * covered_px_at_1_m(places_px, self.calibration) if hiding else None

    def swept_px(self, places_px: Array) -> Array | None:
        """Return how far each place, shape (n, 2), is swept over the image as the camera turns."""
        if self.turn is None:
            return None
        return np.asarray(turn_slopes_px(places_px, self.calibration) @ self.turn.rotation_rad)

    def known(self, clip_e: float) -> Known:
        """Return what compiled loops are told of the camera, and at how many electrons a pixel clips."""
        calibration = self.calibration
        tie_spread = self.tie_spread if self.radius_m > 0.0 else 0.0
        width_px, prnu = float(calibration.psf_sigma_px), float(calibration.prnu)
        width_spread, motion_px = float(self.width_spread), float(self.motion_px)
        return Known(width_px, float(tie_spread), width_spread, motion_px, float(clip_e), prnu)

    def log_range(
        self, photometric: Array, slack: Array | None, covariance: Array
    ) -> tuple[Array, Array, Array]:
        """Return the logarithms of sources' ranges, their standard deviations, and the common part of these.

        What was assumed of flux and radius is told apart by their spreads: of the slack found, flux is to
        blame for σ_φ²/σ_t parts, σ_φ = σ_K/2K; what that leaves open of the flux is part of σ. The common
        part is what comes of K, flux and radius alone: it is the same each time that a source is measured.

        Parameters
        ----------
        photometric, slack
            l and a of each source, any shape; no slack where the model has none.
        covariance
            Of (l, a), or of l alone, shape (..., 2, 2) or (..., 1, 1).
        """
        by_flux = 0.5 * self.flux_spread
        if slack is None:
            common = np.full(np.shape(photometric), by_flux)
            return photometric, np.sqrt(covariance[..., 0, 0] + by_flux**2), common
        lean = self.lean
        left_open = (by_flux * self.radius_spread / self.tie_spread) ** 2
        variance = (
            covariance[..., 0, 0] - 2.0 * lean * covariance[..., 0, 1] + lean**2 * covariance[..., 1, 1]
        )
        # A fit with priors answers an error a of what it assumed by −C P a; the prior precision of a is 1.
        answer = covariance[..., 0, 1] - lean * covariance[..., 1, 1]
        sigma = np.sqrt(variance + left_open)
        return photometric - lean * slack, sigma, np.minimum(np.sqrt(answer**2 + left_open), sigma)


def _share(sigma: float, value: float) -> float:
    return sigma / value if value > 0.0 and math.isfinite(sigma) else 0.0


def lay_out(
    camera: Camera,
    u_px: Array,
    v_px: Array,
    log_range: Array,
    hidden_e: Array | None = None,
    moved_px: Array | None = None,
    finer: Array | None = None,
    most_radius_px: Array | None = None,
) -> tuple[Sources, NDArray[np.bool_]]:
    """Lay sources out, all of them at once, in strips where their images are known in these.

    Parameters
    ----------
    camera
        The camera, at the frame's exposure and gain.
    u_px, v_px, log_range
        Places, and the logarithm of the range that each size stands for, shape (sources,).
    hidden_e
        What each would take away of the background from one metre, shape (sources,): so much its flux lacks.
        By default nothing.
    moved_px
        How far each moves at most during the exposure, shape (sources,), beside what the camera's turn makes
        it. By default nothing does.
    finer
        As for `disc_rows`.
    most_radius_px
        The radius of the largest image that is wanted, shape (sources,), as the lens stretches it most in its
        middle. By default any is.

    Returns
    -------
    The sources, and which of them have an image that is wanted; the others are laid out as points on the
    axis.
    """
    calibration = camera.calibration
    direction = direction_camera(np.column_stack([u_px, v_px]), calibration)
    log_flux = log_flux_at_1_m(camera, direction, hidden_e)
    radius_rad = angular_radius_rad(np.exp(log_range), camera.radius_m)
    imaged = is_before(direction, radius_rad)
    if most_radius_px is not None:
        imaged &= ~(np.tan(radius_rad) * stretch(direction, calibration) > most_radius_px)
    if not imaged.all():
        u_px, v_px = np.where(imaged, u_px, calibration.cx_px), np.where(imaged, v_px, calibration.cy_px)
        direction = np.where(imaged[:, None], direction, (0.0, 0.0, 1.0))
        radius_rad = np.where(imaged, radius_rad, 0.0)
    swept_px = camera.swept_px(np.column_stack([u_px, v_px]))
    if swept_px is not None:
        swept = np.hypot(*swept_px.T)
        moved_px = swept if moved_px is None else swept + moved_px
    nodes = disc_rows(u_px, v_px, direction, radius_rad, calibration, moved_px, finer)
    return Sources.of(nodes, np.ascontiguousarray(log_range), log_flux, swept_px), imaged


def log_flux_at_1_m(camera: Camera, direction: Array, hidden_e: Array | None = None) -> Array:
    """Return ln F₁ in electrons of sources in directions, shape (n, 3) → (n,); 0 where there is no range.

    Less `hidden_e`, what each would take away of the background from one metre.
    """
    exposed_s = exposure_towards(direction, camera.exposure_s, camera.gain, camera.calibration)
    at_1_m_e = flux_e_of(exposed_s, camera.gain, camera.calibration)
    if hidden_e is not None:
        at_1_m_e = np.maximum(at_1_m_e - hidden_e, LEAST_LEFT * at_1_m_e)
    return np.log(np.where(at_1_m_e > 0.0, at_1_m_e, 1.0))


def motion_cost(motion_px: Array, log_range: Array, covariance_px2: Array, camera: Camera) -> float:
    """Return what it costs a priori that flares move so far: −2 ln (2π p) of each, summed.

    Each part of a motion is normal, of the standard deviation f t √(ω² + (v/d)²) of robots at ordinary
    speeds, t the exposure; once in 10⁸ it may be anything up to 10 px. m and −m are the same. That it
    may move never speaks for a flare: the density is at most that of the estimate itself.

    Parameters
    ----------
    motion_px
        How far flares move along u and v, shape (flares, 2).
    log_range
        Logarithms of their ranges, shape (flares,).
    covariance_px2
        Of their motions, shape (flares, 2, 2).
    camera
        The camera, at the frame's exposure.
    """
    price = motion_price(np.hypot(*motion_px.T), log_range, camera)
    least = np.log(np.linalg.det(covariance_px2))
    return float(np.maximum(price, least).sum())


def motion_price(length_px: Array, log_range: Array, camera: Camera) -> Array:
    """Return −2 ln (2π p) of motions so far, at such ranges, as for `motion_cost`; shape (flares,)."""
    usual, otherwise = _motion_prior(length_px, log_range, camera)
    return np.asarray(-2.0 * np.log(2.0 * math.pi * (usual + otherwise)))


def is_usual_motion(length_px: Array, log_range: Array, camera: Camera) -> NDArray[np.bool_]:
    """Tell which motions are those of robots at ordinary speeds, rather than of anything else."""
    usual, otherwise = _motion_prior(length_px, log_range, camera)
    return np.asarray(usual > otherwise)


def usual_motion_px(log_range: Array, camera: Camera, turn_rad_per_s: float) -> Array:
    """Return the standard deviation of each part of motions at ordinary speeds, and of such a turn.

    At ranges of these logarithms, shape (flares,).
    """
    calibration = camera.calibration
    focal_px = math.sqrt(calibration.fx_px * calibration.fy_px)
    rad_per_s = np.hypot(turn_rad_per_s, SPEED_M_PER_S * np.exp(-log_range))
    return np.asarray(focal_px * camera.exposure_s * rad_per_s)


def _motion_prior(length_px: Array, log_range: Array, camera: Camera) -> tuple[Array, float]:
    """Return the densities of motions at ordinary speeds, shape (flares,), and of any others."""
    turn_rad_per_s = TURN_RAD_PER_S if camera.turn is None else 0.0
    sigma2_px2 = usual_motion_px(log_range, camera, turn_rad_per_s) ** 2
    usual = np.exp(-0.5 * length_px**2 / sigma2_px2) / (math.pi * sigma2_px2)
    return (1.0 - _OTHERWISE) * usual, _OTHERWISE / (0.5 * math.pi * MOST_MOTION_PX**2)
