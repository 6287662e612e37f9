"""What a window of a frame is handed to compiled loops as, and where each of its unknowns stands."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.discs.nodes import DiscNodes

Array = NDArray[np.float64]

UNUSABLE, SEEN, CLIPPED = 0, 1, 2
"""What a pixel may be."""

_MOST_STEP = (1.0, 1.0, 0.5)  # px, px, ln range
_MOST_SLACK, _MOST_MOTION_PX = 3.0, 1.0


@dataclass(frozen=True)
class Layout:
    """Where each unknown of a window stands in its vector.

    For each source u, v, l, its slack if it has one, and how far it moves along u and v if it does; then w if
    the width is not exact, B, and c.
    """

    sources: int
    has_slack: bool
    moves: bool
    has_width: bool
    structure: int

    @cached_property
    def per_source(self) -> int:
        """Unknowns of each source."""
        return 3 + self.has_slack + 2 * self.moves

    @cached_property
    def motion(self) -> int:
        """Index of the first of a source's two unknowns of motion among its own."""
        return 3 + self.has_slack

    @cached_property
    def width(self) -> int:
        """Index of w."""
        return self.sources * self.per_source

    @cached_property
    def background(self) -> int:
        """Index of B."""
        return self.width + self.has_width

    @cached_property
    def size(self) -> int:
        """Number of unknowns."""
        return self.background + 1 + self.structure

    def of_sources(self, values: Array) -> Array:
        """Return the sources' part of unknowns, a view of shape (sources, unknowns of each)."""
        return values[: self.width].reshape(self.sources, self.per_source)

    @cached_property
    def most_step(self) -> Array:
        """How far each unknown may move in one step of a fit that trusts its slopes, shape (unknowns,)."""
        most = np.full(self.size, np.inf)
        of_source = (*_MOST_STEP, *(_MOST_SLACK,) * self.has_slack, *(_MOST_MOTION_PX,) * (2 * self.moves))
        most[: self.width] = of_source * self.sources
        if self.has_width:
            most[self.width] = _MOST_SLACK
        return most

    def prior(self, structure: "Structure", motion_px: float) -> Array:
        """Return the prior precision of the unknowns, shape (unknowns, unknowns); `motion_px` of `Known`."""
        if not self.structure:
            return _prior(self, motion_px)
        precision = _prior(self, motion_px).copy()
        precision[self.background + 1 :, self.background + 1 :] = structure.precision
        return precision


@lru_cache(maxsize=256)
def _prior(layout: Layout, motion_px: float) -> Array:
    """Return the prior precision of unknowns, but for that of a structure's amplitudes."""
    precision = np.zeros((layout.size, layout.size))
    if layout.has_slack:
        slack = np.arange(3, layout.width, layout.per_source)
        precision[slack, slack] = 1.0
    if layout.moves:
        for motion in (layout.motion, layout.motion + 1):
            moved = np.arange(motion, layout.width, layout.per_source)
            precision[moved, moved] = 1.0 / motion_px**2
    if layout.has_width:
        precision[layout.width, layout.width] = 1.0
    return precision


_layout = lru_cache(maxsize=256)(Layout)  # every window asks for one, and most for the same


class Known(NamedTuple):
    """What is known of a camera; which unknowns a window has follows from it.

    `tie_spread`, `width_spread` and `motion_px` are those of `window.Camera`: where they are 0 no source
    has a slack, no window a width, and nothing moves. `clip_e` may be infinite.
    """

    psf_sigma_px: float
    tie_spread: float
    width_spread: float
    motion_px: float
    clip_e: float
    prnu: float

    def layout(self, sources: int, structure: int) -> Layout:
        """Return where the unknowns of so many sources and amplitudes stand."""
        return _layout(
            sources, self.tie_spread > 0.0, self.motion_px > 0.0, self.width_spread > 0.0, structure
        )


class Sources(NamedTuple):
    """The sources of a window, laid out as nodes: strips, or points.

    Attributes
    ----------
    first_node
        Index of the first node of each, and the number of all, shape (sources + 1,).
    node_u_px, node_v_px, half_px, tilt, bend, weight
        Where nodes are, relative to the source's place, how long and how shaded they are where they are
        strips (`discs.nodes.DiscNodes`), and their share of its light, shape (nodes,). Infinite where there
        is no image: that light falls on no pixel.
    node_along
        By what part of its motion during the exposure each lies off, -½ to ½, same shape; 0 where none moves.
    log_range_at
        ln of the range for whose size they are laid out, shape (sources,).
    log_flux_at_1_m
        ln F₁ in electrons, shape (sources,); 0 where no range can be had.
    swept_u_px, swept_v_px
        How far each is swept along u and v during the exposure as the camera turns, shape (sources,).
    """

    first_node: NDArray[np.int64]
    node_u_px: Array
    node_v_px: Array
    half_px: Array
    tilt: Array
    bend: Array
    node_along: Array
    weight: Array
    log_range_at: Array
    log_flux_at_1_m: Array
    swept_u_px: Array
    swept_v_px: Array

    @classmethod
    def of(
        cls, nodes: DiscNodes, log_range_at: Array, log_flux_at_1_m: Array, swept_px: Array | None = None
    ) -> "Sources":
        """Return sources with such images, swept by so much, shape (sources, 2); by default by nothing."""
        swept_u_px, swept_v_px = np.zeros((2, len(log_range_at))) if swept_px is None else swept_px.T.copy()
        return cls(
            nodes.first, nodes.u_px, nodes.v_px, nodes.half_px, nodes.tilt, nodes.bend, nodes.along,
            nodes.weight, log_range_at, log_flux_at_1_m, swept_u_px, swept_v_px,
        )  # fmt: skip

    @property
    def reach_px(self) -> Array:
        """Radius of each source's image before the point spread, as laid out."""
        reach_px = np.hypot(abs(self.node_u_px) + self.half_px, self.node_v_px)
        return np.maximum.reduceat(np.where(np.isfinite(reach_px), reach_px, 0.0), self.first_node[:-1])

    @property
    def middle_px(self) -> Array:
        """How far the middle of each source's light lies from its place, as laid out."""
        seen = np.isfinite(self.node_u_px) & np.isfinite(self.node_v_px)
        weight = np.where(seen, self.weight, 0.0)
        u_px = np.where(seen, self.node_u_px + self.tilt * self.half_px / 3.0, 0.0)
        v_px = np.where(seen, self.node_v_px, 0.0)
        first = self.first_node[:-1]
        return np.asarray(
            np.hypot(np.add.reduceat(weight * u_px, first), np.add.reduceat(weight * v_px, first))
        )

    @property
    def swept(self) -> NDArray[np.complex128]:
        """How far each is swept, u + iv: motions draw images out by the squares of these, which add."""
        return np.asarray(self.swept_u_px + 1j * self.swept_v_px)


@compiled
def part_of(sources: Sources, first: int, end: int) -> Sources:
    """Return some of the sources."""
    a, b = sources.first_node[first], sources.first_node[end]
    return Sources(
        sources.first_node[first : end + 1] - a, sources.node_u_px[a:b], sources.node_v_px[a:b],
        sources.half_px[a:b], sources.tilt[a:b], sources.bend[a:b], sources.node_along[a:b],
        sources.weight[a:b], sources.log_range_at[first:end], sources.log_flux_at_1_m[first:end],
        sources.swept_u_px[first:end], sources.swept_v_px[first:end],
    )  # fmt: skip


class View(NamedTuple):
    """A window of a frame: its corner, its pixels in electrons, what each is, and the dark variance.

    `image_e` and `state` have the shape (rows, columns), `state` one of `UNUSABLE`, `SEEN` and `CLIPPED`.
    `known_e`, of the same shape, is light that is there whatever the unknowns are.
    """

    top: int
    left: int
    image_e: Array
    state: NDArray[np.uint8]
    floor_e2: float
    known_e: Array


class Structure(NamedTuple):
    """What may lie on an even background: columns φ, and the precision of their amplitudes c.

    The first are products of a cosine along the rows of a square window and one along its columns, which
    sums over pixels make use of (`likelihood.cosines`); the others are any.

    Attributes
    ----------
    cosines
        cos(π k (i + ½) / side) for k = 0, 1, ..., shape (cosines, side): so many, a multiple of four, that
        two that `order` names never add up to more.
    order
        Of which of them along columns and along rows each is the product, shape (waves, 2).
    columns
        The others, shape (amplitudes - waves, pixels).
    precision
        Shape (amplitudes, amplitudes).
    """

    cosines: Array
    order: NDArray[np.int64]
    columns: Array
    precision: Array

    @property
    def amplitudes(self) -> int:
        """How many there are."""
        return len(self.precision)

    @property
    def waves(self) -> Array:
        """The products of cosines, shape (waves, pixels)."""
        down, across = self.cosines[self.order.T]
        return np.asarray(down[:, :, None] * across[:, None, :]).reshape(len(self.order), down.shape[1] ** 2)

    def light(self, amplitudes: Array) -> Array:
        """Return Σ c φ, shape (pixels,)."""
        waves = len(self.order)
        light = np.asarray(amplitudes[waves:] @ self.columns)
        if not waves:
            return light
        most = self.order.max() + 1
        of_waves, cosines = np.zeros((most, most)), self.cosines[:most]
        of_waves[tuple(self.order.T)] = amplitudes[:waves]
        return np.asarray(light + (cosines.T @ of_waves @ cosines).ravel())

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the precision."""
        return float(np.linalg.slogdet(self.precision)[1]) if self.amplitudes else 0.0


def any_of(columns: Array, precision: Array) -> Structure:
    """Return a structure of any columns."""
    return Structure(np.empty((0, 0)), np.empty((0, 2), dtype=np.int64), columns, precision)


def even(pixels: int) -> Structure:
    """Return the structure of a background that has none."""
    return any_of(np.empty((0, pixels)), np.empty((0, 0)))
