"""What windows of a frame are expected to hold, and how that changes with all that is not known.

λ = Σ_k F_k S(u_k, v_k, ρ_k) + B + Σ_m c_m φ_m: sources, each with the image S of a uniform sphere, on a
background B with structure. Range sets flux *and* size: with l the logarithm of the range that the flux alone
says, F = F₁ e^(-2l), F₁ the flux at one metre, and ρ = (r / 1 m) e^(-l + σ_t a). The slack a, a priori normal
with variance 1, is by how much the size may disagree with the flux: σ_t² = (σ_K / 2K)² + (σ_r / r)², so a
source whose flux is not to be trusted is ranged by its size. The width of the point spread is free within its
own σ: σ_psf e^(σ_w w). These priors enter as `precision` does for the structure's amplitudes c.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import DiscNodes, disc_nodes, has_image, images_of_nodes
from perception.model.ranging import angular_radius_rad, flux_at_one_metre_e
from perception.types import Calibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A camera at one exposure and gain, and how well what ranges depend on is known.

    Attributes
    ----------
    calibration
        Of the camera.
    exposure_s, gain
        Of the frame.
    """

    calibration: Calibration
    exposure_s: float
    gain: float

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
    def width_spread(self) -> float:
        """σ_w: relative standard deviation of the point spread's width."""
        return _share(self.calibration.sigma.get("psf_sigma_px", 0.0), self.calibration.psf_sigma_px)

    def log_range(self, photometric: Array, slack: Array | None, covariance: Array) -> tuple[Array, Array]:
        """Return the logarithms of sources' ranges, and their standard deviations.

        What was assumed of flux and radius is told apart by their spreads: of the slack found, flux is to
        blame for σ_φ²/σ_t parts, σ_φ = σ_K/2K; what that leaves open of the flux is part of σ.

        Parameters
        ----------
        photometric, slack
            l and a of each source, any shape; no slack where the model has none.
        covariance
            Of (l, a), or of l alone, shape (..., 2, 2) or (..., 1, 1).
        """
        by_flux = 0.5 * self.flux_spread
        if slack is None:
            return photometric, np.sqrt(covariance[..., 0, 0] + by_flux**2)
        lean = by_flux**2 / self.tie_spread
        left_open = (by_flux * self.radius_spread / self.tie_spread) ** 2
        variance = (
            covariance[..., 0, 0] - 2.0 * lean * covariance[..., 0, 1] + lean**2 * covariance[..., 1, 1]
        )
        return photometric - lean * slack, np.sqrt(variance + left_open)


def _share(sigma: float, value: float) -> float:
    return sigma / value if value > 0.0 and math.isfinite(sigma) else 0.0


@dataclass(frozen=True)
class Layout:
    """Where each unknown of a window stands in its vector.

    For each source u, v, l, and its slack if it has one; then w if the width is not exact, B, and c.
    """

    sources: int
    has_slack: bool
    has_width: bool
    structure: int

    @property
    def per_source(self) -> int:
        """Unknowns of each source."""
        return 4 if self.has_slack else 3

    def of_sources(self, values: Array) -> Array:
        """Return the sources' part of unknowns, a view of shape (windows, sources, unknowns of each)."""
        return values[:, : self.width].reshape(len(values), self.sources, self.per_source)

    @property
    def width(self) -> int:
        """Index of w."""
        return self.sources * self.per_source

    @property
    def background(self) -> int:
        """Index of B."""
        return self.width + self.has_width

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.background + 1 + self.structure


@dataclass(frozen=True, eq=False)
class Structure:
    """What may lie on an even background: columns φ, and the precision of their amplitudes c.

    `columns` has shape (windows, amplitudes, rows, columns), `precision` (windows, amplitudes, amplitudes).
    """

    columns: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class WindowModel:
    """The model of some windows of one size, about a state at which its images were laid out.

    Attributes
    ----------
    camera
        With its priors.
    layout
        Of the unknowns.
    top, left
        First row and column of each window, shape (windows,).
    shape
        Rows and columns of all of them.
    nodes
        Of all sources, window by window, shape (windows · sources, nodes), laid out for ...
    log_range_at
        ... these ranges by size, shape (windows · sources,).
    log_flux_at_1_m
        ln F₁ in electrons, shape (windows, sources); 0 where no range can be had.
    structure
        None on an even background.
    """

    camera: Camera
    layout: Layout
    top: NDArray[np.intp]
    left: NDArray[np.intp]
    shape: tuple[int, int]
    nodes: DiscNodes
    log_range_at: Array
    log_flux_at_1_m: Array
    structure: Structure | None

    @property
    def precision(self) -> Array:
        """Prior precision of the unknowns, shape (windows, unknowns, unknowns)."""
        layout = self.layout
        precision = np.zeros((len(self.top), layout.size, layout.size))
        slack = np.arange(layout.sources) * layout.per_source + 3 if layout.has_slack else np.arange(0)
        precision[:, slack, slack] = 1.0
        if layout.has_width:
            precision[:, layout.width, layout.width] = 1.0
        if self.structure is not None:
            precision[:, -layout.structure :, -layout.structure :] = self.structure.precision
        return precision

    def log_range_by_size(self, values: Array) -> Array:
        """Return ln of the range that each source's size stands for, shape (windows, sources)."""
        own = self.layout.of_sources(values)
        if not self.layout.has_slack:
            return own[..., 2]
        return np.asarray(own[..., 2] - self.camera.tie_spread * own[..., 3])

    def expected_e(self, values: Array) -> tuple[Array, Array]:
        """Return λ and its derivatives.

        Parameters
        ----------
        values
            Unknowns, shape (windows, unknowns).

        Returns
        -------
        λ in electrons, shape (windows, pixels), and its derivatives, shape (windows, unknowns, pixels).
        """
        layout, count = self.layout, len(values)
        of_sources = layout.of_sources(values)
        by_size = self.log_range_by_size(values).ravel()
        calibration = self.camera.calibration
        width_px = np.full(count, calibration.psf_sigma_px)
        if layout.has_width:
            width_px = width_px * np.exp(self.camera.width_spread * values[:, layout.width])
        images = images_of_nodes(
            self.nodes,
            (of_sources[..., 0] - self.left[:, None]).ravel(),
            (of_sources[..., 1] - self.top[:, None]).ravel(),
            np.exp(self.log_range_at - by_size),
            np.repeat(width_px, layout.sources),
            self.shape,
        )
        flux = np.exp(self.log_flux_at_1_m - 2.0 * of_sources[..., 2])[..., None]
        share, by_u, by_v, by_growth, by_spread = (
            each.reshape(count, layout.sources, -1)
            for each in (images.fraction, images.d_du, images.d_dv, images.d_dgrowth, images.d_dspread)
        )
        pixels = share.shape[-1]
        jacobian = np.zeros((count, layout.size, pixels))
        own = jacobian[:, : layout.width].reshape(count, layout.sources, layout.per_source, pixels)
        own[:, :, 0], own[:, :, 1] = flux * by_u, flux * by_v
        own[:, :, 2] = -flux * (2.0 * share + by_growth)
        if layout.has_slack:
            own[:, :, 3] = self.camera.tie_spread * flux * by_growth
        if layout.has_width:
            jacobian[:, layout.width] = self.camera.width_spread * (flux * by_spread).sum(axis=1)
        jacobian[:, layout.background] = 1.0
        expected = (flux * share).sum(axis=1) + values[:, layout.background, None]
        if self.structure is not None:
            columns = self.structure.columns.reshape(count, layout.structure, pixels)
            jacobian[:, -layout.structure :] = columns
            expected += np.einsum("gm,gmp->gp", values[:, -layout.structure :], columns)
        return expected, jacobian


def window_model(
    camera: Camera,
    corners: tuple[NDArray[np.intp], NDArray[np.intp]],
    shape: tuple[int, int],
    sources: tuple[Array, Array, Array],
    structure: Structure | None = None,
) -> tuple[WindowModel, NDArray[np.bool_]]:
    """Lay a model out about places and ranges.

    Parameters
    ----------
    camera
        The camera, at the frame's exposure and gain.
    corners
        First row and first column of each window, shape (windows,).
    shape
        Rows and columns of all windows.
    sources
        u_px, v_px and the logarithm of the range that the size stands for, shape (windows, sources) each.
    structure
        What may lie on the background.

    Returns
    -------
    The model, and in which windows all sources have an image; elsewhere it stands for sources on the axis.
    """
    calibration = camera.calibration
    u_px, v_px, log_range = sources
    count, per_window = u_px.shape
    flat_u, flat_v = u_px.ravel(), v_px.ravel()
    at_1_m_e = flux_at_one_metre_e(flat_u, flat_v, camera.exposure_s, camera.gain, calibration)
    ranged = at_1_m_e > 0.0
    radius_m = calibration.source_radius_m if math.isfinite(calibration.source_radius_m) else 0.0
    radius_rad = angular_radius_rad(np.exp(log_range.ravel()), radius_m)
    imaged = has_image(flat_u, flat_v, radius_rad, calibration)
    nodes = disc_nodes(
        np.where(imaged, flat_u, calibration.cx_px),
        np.where(imaged, flat_v, calibration.cy_px),
        np.where(imaged, radius_rad, 0.0),
        calibration,
    )
    model = WindowModel(
        camera=camera,
        layout=Layout(
            sources=per_window,
            has_slack=camera.tie_spread > 0.0 and radius_m > 0.0,
            has_width=camera.width_spread > 0.0,
            structure=0 if structure is None else structure.columns.shape[1],
        ),
        top=corners[0],
        left=corners[1],
        shape=shape,
        nodes=nodes,
        log_range_at=log_range.ravel(),
        log_flux_at_1_m=np.log(np.where(ranged, at_1_m_e, 1.0)).reshape(count, per_window),
        structure=structure,
    )
    return model, np.asarray(imaged.reshape(count, per_window).all(axis=1))
