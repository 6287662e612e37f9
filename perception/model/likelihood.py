"""The likelihood of what windows show, given what their sources and backgrounds let expect.

Each pixel counts as x + σ² ~ Poisson(λ + σ²), σ² the variance of a dark pixel (Snyder et al., J. Opt. Soc.
Am. A 12, 272, 1995), widened by the spread of the pixels' responses; its score is (x - λ) / variance. A
clipped pixel says only that x is c or more: its score is φ(z) / (σ Q(z)), z = (c - λ) / σ. Variances come
from the model, not from the data: weights from the data would favour pixels that came out low.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.fisher import censored_weight
from perception.model.sensor import pixel_variance_e2
from perception.model.window import Structure, WindowModel

Array = NDArray[np.float64]

_LOG_RANGE = (-12.0, 12.0)


@dataclass(frozen=True, eq=False)
class Windows:
    """Parts of one size of one frame, in electrons.

    Attributes
    ----------
    top, left
        First row and column of each, shape (windows,); windows may reach beyond the frame.
    image_e
        Shape (windows, rows, columns).
    usable
        Which pixels count, same shape. Clipped ones do.
    clipped
        Which pixels are clipped, same shape.
    floor_e2, clip_e, prnu
        Variance of a dark pixel, shape (windows,), electrons at which one clips, relative spread of the
        pixels' responses.
    """

    top: NDArray[np.intp]
    left: NDArray[np.intp]
    image_e: Array
    usable: NDArray[np.bool_]
    clipped: NDArray[np.bool_]
    floor_e2: Array
    clip_e: float
    prnu: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of each."""
        return self.image_e.shape[1], self.image_e.shape[2]

    def at(self, index: NDArray[np.intp]) -> "Windows":
        """Return some of the windows, or the same more than once."""
        return replace(
            self,
            top=self.top[index],
            left=self.left[index],
            image_e=self.image_e[index],
            usable=self.usable[index],
            clipped=self.clipped[index],
            floor_e2=self.floor_e2[index],
        )


@dataclass(frozen=True, eq=False)
class PixelState:
    """λ, its derivatives and the variance of each pixel, shape (windows, [unknowns,] pixels)."""

    expected: Array
    jacobian: Array
    variance: Array

    def at(self, kept: NDArray[np.bool_]) -> "PixelState":
        """Return those of some windows."""
        return PixelState(self.expected[kept], self.jacobian[kept], self.variance[kept])

    def replaced(self, where: NDArray[np.bool_], by: "PixelState") -> "PixelState":
        """Return another state where that is wanted, and this one elsewhere."""
        if where.all():
            return by
        pick, deep = where[:, None], where[:, None, None]
        return PixelState(
            np.where(pick, by.expected, self.expected),
            np.where(deep, by.jacobian, self.jacobian),
            np.where(pick, by.variance, self.variance),
        )


class Likelihood:
    """The likelihood of some of a model's windows."""

    def __init__(self, windows: Windows, model: WindowModel, index: NDArray[np.intp]) -> None:
        self.windows, self.whole, self.index = windows, model, index
        chosen = windows.at(index)
        self.data = chosen.image_e.reshape(len(index), chosen.image_e[0].size if len(index) else 0)
        self.seen = (chosen.usable & ~chosen.clipped).reshape(self.data.shape)
        self.cut = (chosen.usable & chosen.clipped).reshape(self.data.shape)
        self.usable = self.seen | self.cut
        self.any_cut = bool(self.cut.any())
        self.model = _of(model, index)
        self.precision = self.model.precision
        self.top, self.left = chosen.top, chosen.left
        self.floor_e2 = chosen.floor_e2[:, None]

    def at(self, kept: NDArray[np.bool_]) -> "Likelihood":
        """Return that of some of them."""
        return Likelihood(self.windows, self.whole, self.index[kept])

    def state(self, values: Array) -> PixelState:
        """Return what values of the unknowns let pixels expect."""
        expected, jacobian = self.model.expected_e(values)
        return PixelState(expected, jacobian, pixel_variance_e2(expected, self.floor_e2, self.windows.prnu))

    def inside(self, values: Array) -> NDArray[np.bool_]:
        """Tell which values have all flares on their window's pixels, at a range that can be."""
        own = self.model.layout.of_sources(values)
        rows, columns = self.windows.shape
        column, row = own[..., 0] - self.left[:, None], own[..., 1] - self.top[:, None]
        within = (column > -0.5) & (column < columns - 0.5) & (row > -0.5) & (row < rows - 0.5)
        low, high = _LOG_RANGE
        within &= (own[..., 2] > low) & (own[..., 2] < high)
        return np.asarray(within.all(axis=1) & np.isfinite(values).all(axis=1))

    def slopes(self, values: Array, state: PixelState) -> tuple[Array, Array]:
        """Return the gradient of ln L, and the information that these very pixels give, priors included."""
        pull = np.where(self.seen, (self.data - state.expected) / state.variance, 0.0)
        weight = self.usable / state.variance
        if self.any_cut:
            sigma = np.sqrt(state.variance)
            z = (self.windows.clip_e - state.expected) / sigma
            mills, _ = _mills(z)
            pull = np.where(self.cut, mills / sigma, pull)
            weight = np.where(self.cut, weight * np.clip(mills * (mills - z), 0.0, 1.0), weight)
        gradient = np.einsum("gip,gp->gi", state.jacobian, pull)
        gradient -= np.einsum("gij,gj->gi", self.precision, values)
        return gradient, self._information(state, weight)

    def expected_information(self, state: PixelState) -> Array:
        """Return Fisher's information, priors included: what pixels like these give on average."""
        kept = censored_weight(state.expected, state.variance, self.windows.clip_e)
        return self._information(state, self.usable * kept / state.variance)

    def _information(self, state: PixelState, weight: Array) -> Array:
        by_pixels = (state.jacobian * weight[:, None]) @ state.jacobian.transpose(0, 2, 1)
        return np.asarray(by_pixels + self.precision)

    def objective(self, values: Array, state: PixelState, expected: Array) -> Array:
        """Return −2 ln L of an expectation with the variances of a state."""
        chi2 = np.where(self.seen, (self.data - expected) ** 2 / state.variance, 0.0).sum(axis=1)
        if self.any_cut:
            _, log_share = _mills((self.windows.clip_e - expected) / np.sqrt(state.variance))
            chi2 -= 2.0 * np.where(self.cut, log_share, 0.0).sum(axis=1)
        return np.asarray(chi2 + np.einsum("gi,gij,gj->g", values, self.precision, values))

    def deviance(self, values: Array, state: PixelState) -> Array:
        """Return −2 ln L with the variances that belong to the expectation."""
        logs = np.where(self.seen, np.log(state.variance), 0.0).sum(axis=1)
        return np.asarray(self.objective(values, state, state.expected) + logs)


def _of(model: WindowModel, index: NDArray[np.intp]) -> WindowModel:
    """Return the model of some of its windows."""
    if len(index) == len(model.top):
        return model
    sources = model.layout.sources
    flat = (index[:, None] * sources + np.arange(sources)).ravel()
    nodes = replace(
        model.nodes,
        u_px=model.nodes.u_px[flat],
        v_px=model.nodes.v_px[flat],
        weight=model.nodes.weight[flat],
    )
    structure = model.structure
    if structure is not None:
        structure = Structure(structure.columns[index], structure.precision[index])
    return replace(
        model,
        top=model.top[index],
        left=model.left[index],
        nodes=nodes,
        log_range_at=model.log_range_at[flat],
        log_flux_at_1_m=model.log_flux_at_1_m[index],
        structure=structure,
    )


def _mills(z: Array) -> tuple[Array, Array]:
    """Return φ(z) / Q(z) and ln Q(z)."""
    from scipy.special import log_ndtr

    log_share = log_ndtr(-np.clip(z, -38.0, 1e4))
    return np.exp(-0.5 * np.clip(z, -38.0, 1e4) ** 2 - 0.5 * np.log(2.0 * np.pi) - log_share), log_share
