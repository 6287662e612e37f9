"""Nodes of sources' images, and the image of a source in points: quadrature over a sphere, through a lens.

A sphere of radius r at distance d fills the cap of directions within asin(r / d) of its centre, at uniform
radiance. Each direction ω of the cap gives light in proportion to cos θ · response(θ) · dΩ, θ the field
angle, and falls on the image where the lens projects it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.lens import project, stretch
from perception.types import Calibration

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

# Quadrature nodes per ratio of image radius to smoothing: the smallest numbers, found by comparison with
# three times as many, that keep the error below 1e-4 of the peak for radii from 0 to 130 px.
_RINGS_BASE, _RINGS_SLOPE = 0.85, 1.2
_AROUND_BASE, _AROUND_SLOPE = 5.0, 4.5
# And along the line of a moving one, per ratio of its length to the smoothing: 2e-5 of the peak, up to 30.
_LINE_BASE, _LINE_SLOPE = 2.0, 1.1


@dataclass(frozen=True, eq=False)
class DiscNodes:
    """Quadrature nodes of some sources' images, one's after another's: points, or strips along u.

    Attributes
    ----------
    first
        Index of the first node of each source, and the number of all, shape (sources + 1,).
    u_px, v_px
        Where their middles are, relative to the source's place, shape (nodes,); infinite beyond the lens's
        fold.
    half_px, tilt, bend
        Half the length of a strip, and how light changes along it: as 1 + tilt t + bend (t² - 1/3), t from -1
        to 1. All 0 for points; same shape.
    along
        By what part of its motion each lies off, -½ to ½, same shape.
    weight
        Share of the light, sum 1 for each source, same shape.
    """

    first: NDArray[np.int64]
    u_px: Array
    v_px: Array
    half_px: Array
    tilt: Array
    bend: Array
    along: Array
    weight: Array

    def of(self, source: int) -> "DiscNodes":
        """Return those of one source."""
        these = slice(int(self.first[source]), int(self.first[source + 1]))
        first = np.array([0, these.stop - these.start])
        return DiscNodes(first, *(of_all[these] for of_all in self._of_nodes))

    @classmethod
    def joined(cls, parts: Sequence["DiscNodes"]) -> "DiscNodes":
        """Return those of the sources of several, one after another's."""
        counts = np.concatenate([np.diff(part.first) for part in parts])
        of_nodes = zip(*(part._of_nodes for part in parts), strict=True)
        return cls(np.cumsum([0, *counts.tolist()]), *(np.concatenate(each) for each in of_nodes))

    @property
    def _of_nodes(self) -> tuple[Array, ...]:
        return self.u_px, self.v_px, self.half_px, self.tilt, self.bend, self.along, self.weight


def disc_nodes(
    u_px: Array,
    v_px: Array,
    direction: Array,
    angular_radius_rad: Array,
    calibration: Calibration,
    moved_px: Array | None = None,
    finer: Array | None = None,
) -> DiscNodes:
    """Return quadrature nodes over the caps of spheres, as many for each as its image needs.

    Parameters
    ----------
    u_px, v_px, direction, angular_radius_rad
        Places, unit directions in camera axes, and sizes, shape (sources,) or (sources, 3); spheres that have
        an image (`flare.has_image`).
    calibration
        Intrinsics, PSF and response.
    moved_px
        How far each moves at most during the exposure, shape (sources,); by default nothing does.
    finer
        By how much nearer together nodes are to lie than a whole image needs, shape (sources,); by default 1.
    """
    smooth_px, fineness = fineness_of(direction, angular_radius_rad, calibration, finer)
    rules = [_cap_rule(each) for each in np.ceil(2.0 * fineness).astype(int).tolist()]
    first = np.cumsum([0, *(rule.shape[1] for rule in rules)])
    omega, weight = _over_caps(
        first,
        np.concatenate(rules, axis=1),
        direction,
        angular_radius_rad,
        np.array(calibration.response_angle_rad, dtype=np.float64),
        np.array(calibration.response_relative, dtype=np.float64),
    )
    # What lies beyond the lens's fold has no image: its light counts, and falls on no pixel.
    at_px = project(omega, calibration)
    at_px[np.isnan(at_px)] = np.inf
    of = np.repeat(np.arange(len(rules)), np.diff(first))
    none = np.zeros(len(weight))
    still = DiscNodes(first, at_px[:, 0] - u_px[of], at_px[:, 1] - v_px[of], none, none, none, none, weight)
    return still if moved_px is None else along_lines(still, moved_px / smooth_px)


def fineness_of(
    direction: Array, angular_radius_rad: Array, calibration: Calibration, finer: Array | None
) -> tuple[float, Array]:
    """Return the width that smooths images, in pixels, and for each the ratio of its radius to that."""
    smooth_px = smoothing_px(calibration)
    radius_px = stretch(direction, calibration) * np.tan(angular_radius_rad)
    return smooth_px, radius_px / smooth_px if finer is None else radius_px / (smooth_px / finer)


def smoothing_px(calibration: Calibration) -> float:
    """Width that smooths images: of the point spread, and of pixels, like a box of variance 1/12 px²."""
    return math.sqrt(calibration.psf_sigma_px**2 + 1.0 / 12.0)


def along_lines(still: DiscNodes, length: Array) -> DiscNodes:
    """Return each source's nodes again for each node of its line, of a length relative to the smoothing."""
    rules = [line_rule(one) for one in length.tolist()]
    parts = [slice(first, end) for first, end in zip(still.first[:-1], still.first[1:], strict=True)]
    both = list(zip(parts, rules, strict=True))
    times = [len(along) for along, _ in rules]
    u_px, v_px, half_px, tilt, bend = (
        np.concatenate([np.tile(of_nodes[part], len(along)) for part, (along, _) in both])
        for of_nodes in (still.u_px, still.v_px, still.half_px, still.tilt, still.bend)
    )
    return DiscNodes(
        np.cumsum([0, *(times * np.diff(still.first))]),
        u_px,
        v_px,
        half_px,
        tilt,
        bend,
        np.concatenate([np.repeat(along, part.stop - part.start) for part, (along, _) in both]),
        np.concatenate([np.outer(weight, still.weight[part]).ravel() for part, (_, weight) in both]),
    )


def line_rule(length: float) -> tuple[Array, Array]:
    """Return where on a line, from -½ to ½, images that move so far relative to the smoothing are looked at.

    And the weight of each, of sum 1.
    """
    return _line_rule(math.ceil(_LINE_BASE + _LINE_SLOPE * length))


@lru_cache(maxsize=64)
def _line_rule(nodes: int) -> tuple[Array, Array]:
    """Return nodes along a line from -½ to ½ (Gauss–Legendre), and their weights of sum 1."""
    node, weight = np.polynomial.legendre.leggauss(nodes)
    return 0.5 * node, 0.5 * weight


@compiled
def across_and_down(x: float, y: float, z: float) -> tuple[Vector, Vector]:
    """Return two unit vectors that complete a direction, which is not along x, to an orthonormal frame."""
    norm = math.hypot(y, z)
    down_y, down_z = z / norm, -y / norm
    return (down_y * z - down_z * y, down_z * x, -down_y * x), (0.0, down_y, down_z)


@compiled
def _over_caps(
    first: NDArray[np.int64], rules: Array, direction: Array, angular_radius_rad: Array,
    response_angle_rad: Array, response_relative: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the directions of nodes, shape (nodes, 3), and their share of each cap's light."""
    omega, weight, at = np.empty((rules.shape[1], 3)), np.empty(rules.shape[1]), 0
    for cap in range(len(direction)):
        x, y, z = direction[cap]
        (across_x, across_y, across_z), (_, down_y, down_z) = across_and_down(x, y, z)
        height, total = 2.0 * math.sin(0.5 * angular_radius_rad[cap]) ** 2, 0.0
        for node in range(first[cap], first[cap + 1]):
            # dΩ = dh dφ with h = 1 - cos α: uniform in h.
            h = rules[0, node] * height
            sine = math.sqrt(h * (2.0 - h))
            to_across, to_down = sine * rules[1, node], sine * rules[2, node]
            one = omega[node]
            one[0] = (1.0 - h) * x + to_across * across_x
            one[1] = (1.0 - h) * y + to_across * across_y + to_down * down_y
            one[2] = (1.0 - h) * z + to_across * across_z + to_down * down_z
            theta = math.atan2(math.hypot(one[0], one[1]), one[2])
            # Of a table that is held beyond its ends; the next node lies in the same part of it, or beside.
            while at + 2 < len(response_angle_rad) and theta > response_angle_rad[at + 1]:
                at += 1
            while at > 0 and theta < response_angle_rad[at]:
                at -= 1
            response = response_relative[at]
            if len(response_angle_rad) > 1:
                step = response_angle_rad[at + 1] - response_angle_rad[at]
                share = min(max((theta - response_angle_rad[at]) / step, 0.0), 1.0)
                response += share * (response_relative[at + 1] - response_relative[at])
            weight[node] = rules[3, node] * one[2] * response  # cos θ · response(θ) · dΩ
            total += weight[node]
        weight[first[cap] : first[cap + 1]] /= total
    return omega, weight


@lru_cache(maxsize=256)
def _cap_rule(twice_fineness: int) -> Array:
    """Return nodes over a cap: shares of its height, cosines and sines of the angle around, and weights.

    Shape (4, nodes); the weights have the sum 1. For images of up to half that many times the width of what
    smooths them.
    """
    fineness = 0.5 * twice_fineness
    rings = math.ceil(_RINGS_BASE + _RINGS_SLOPE * fineness)
    node, ring_weight = np.polynomial.legendre.leggauss(rings)
    share_h = 0.5 * (node + 1.0)
    around = np.ceil(_AROUND_BASE + _AROUND_SLOPE * fineness * np.sqrt(share_h)).astype(int)
    ring = np.repeat(np.arange(rings), around)
    step = np.arange(len(ring)) - np.repeat(np.cumsum(around) - around, around)
    # The golden angle turns each ring against the last, so that their errors do not line up.
    phi = 2.0 * math.pi * (step / around[ring]) + ring * 2.399963
    return np.stack([share_h[ring], np.cos(phi), np.sin(phi), (0.5 * ring_weight / around)[ring]])
