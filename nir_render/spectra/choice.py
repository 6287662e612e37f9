"""How many wavelengths light must be carried at, and which: few that keep what cameras see to a stated error.

Light that has met surfaces of reflectances ρ_i(λ) goes with their products. Carried at nodes and taken as
linear between them (`nodes`), a product f errs, in what a camera sees of an emitter, by

    ∫ W(λ) [f(λ) − Σ_k φ_k(λ) f(λ_k)] dλ / ∫ W(λ) f(λ) dλ

with W = emitter × filter × quantum efficiency × λ. The error stated is the largest over all W, and over all
products of up to three curves, of which some may be the same.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BOUNCES = 3
_PLACES = 24  # that are tried for a new node, of those between two others
_SEARCHED, _EVEN = 48, 9  # products that nodes are searched by, and the nodes that tell which
_OUTSIDE = 1e-4
_LEAST_F = 1e-3  # of a product's largest value: what is darker errs by that much of the largest at most


@dataclass(frozen=True)
class Choice:
    """Nodes, increasing, and the largest error that they make in what a camera sees of a product."""

    wavelengths_m: tuple[float, ...]
    error: float


def choose_nodes(
    wavelength_m: Array, weights: Array, curves: Array, bends_m: Array, *, error: float, most: int
) -> Choice:
    """Return few wavelengths that keep an error, at most so many.

    One where one does. Else the ends of what is seen, and between them one after the other where most is
    missing, by the products' absolute errors, which cannot cancel. Each time all move, in turn, to where the
    error is least; those without which it is kept go again.

    Parameters
    ----------
    wavelength_m
        A fine grid, increasing, shape (n,), on which nodes lie.
    weights
        What a camera sees of each emitter at each point of it, shape (emitters, n).
    curves
        Reflectances and transmittances that vary, shape (curves, n).
    bends_m
        Where curves bend, where nodes often do most. No node lies below the least or above the largest.
    """
    seen = weights[weights.sum(axis=1) > 0.0]
    products = _products(curves)
    if not seen.size or not products.size:  # nothing is seen, or nothing reflects
        return Choice((float(bends_m.min()),), 0.0)
    seen = np.unique(seen / seen.sum(axis=1, keepdims=True), axis=0)
    bends = np.unique(np.searchsorted(wavelength_m, bends_m - 0.5 * (wavelength_m[1] - wavelength_m[0])))
    bends = bends[bends < wavelength_m.size]
    problem = _Problem(wavelength_m, seen, products, bends)
    nodes = problem.alone()
    if problem.error(nodes) > error and most > 1:
        spread, hard = problem.ends(), problem.hardest()
        # More than the most may be had on the way: some of them are needless in the end.
        while problem.error(nodes) > error and len(spread) < 1.5 * most and max(np.diff(spread)) > 1:
            spread = hard.moved(hard.one_more(spread), hard.missed)
            found = hard.moved(spread, hard.error)
            if problem.error(found) <= error:
                found = problem.without_needless(found, error)
            if len(found) <= most:
                nodes = min(nodes, found, key=problem.error)
    return Choice(tuple(np.round(wavelength_m[nodes], 12).tolist()), problem.error(nodes))


def beyond_data(weights: Array, held: Array, outside: NDArray[np.bool_]) -> float:
    """Return the largest relative error that reflectances beyond their data could make, of any product.

    Beyond its data a curve is carried as `held`, and could be anything from 0 to 1, at each bounce.

    Parameters
    ----------
    weights
        What a camera sees of emitters, shape (emitters, n).
    held, outside
        The curves, held at the ends of their data, and where they lie beyond these, each shape (curves, n).
    """
    seen = weights[weights.sum(axis=1) > 0.0]
    if not seen.size or not outside.any():
        return 0.0
    seen = seen / seen.sum(axis=1, keepdims=True)
    largest = 0.0
    for some in _bounces(len(held)):
        product, most = np.prod(held[some], axis=0), np.prod(np.where(outside[some], 1.0, held[some]), axis=0)
        off = np.where(outside[some].any(axis=0), np.maximum(product, most - product), 0.0)
        scale = np.maximum(seen @ product, _LEAST_F * product.max())
        largest = max(largest, float((seen @ off / np.maximum(scale, 1e-300)).max()))
    return largest


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is seen of each emitter, sums of 1, and the products to carry; nodes are indices into the grid."""

    wavelength_m: Array
    seen: Array
    products: Array
    bends: NDArray[np.int64]
    known: dict[tuple[int | None, int | None], tuple[Array, Array]] = field(default_factory=dict)

    @cached_property
    def scale(self) -> Array:
        """What is seen of each emitter by way of each product, shape (emitters, products); never nothing."""
        floor = _LEAST_F * self.products.max(axis=1)
        return np.asarray(np.maximum(self.seen @ self.products.T, floor))

    def alone(self) -> list[int]:
        """Return the best of single nodes."""
        low, high = self.bends[0], self.bends[-1] + 1
        mean = (self.seen @ self.products.T)[:, :, None]
        errors = np.abs(mean - self.products[None, :, low:high]) / self.scale[:, :, None]
        return [int(low + np.argmin(errors.max(axis=(0, 1))))]

    def hardest(self) -> "_Problem":
        """Return the problem of those products that even nodes miss most: it is searched faster."""
        low, high = self.ends()[0], self.ends()[-1]
        even = sorted({int(node) for node in np.linspace(low, high, _EVEN).round()})
        missed = np.sum([part for _, part in self.parts(even)], axis=0) / self.scale
        some = np.argsort(-missed.max(axis=0), kind="stable")[:_SEARCHED]
        return replace(self, products=self.products[some], known={})

    def ends(self) -> list[int]:
        """Return the outermost nodes, between which all is seen but a ten thousandth of any emitter."""
        cumulated = np.cumsum(self.seen, axis=1)
        first = int(np.flatnonzero((cumulated > _OUTSIDE).any(axis=0))[0])
        last = int(np.flatnonzero((cumulated < 1.0 - _OUTSIDE).any(axis=0))[-1])
        first, last = np.clip([first, last], self.bends[0], self.bends[-1])
        return sorted({int(end) for end in (self.bends[[0, -1]] if first == last else (first, last))})

    def error(self, nodes: list[int]) -> float:
        """Return the largest relative error of what is seen of an emitter by way of a product."""
        signed = [part for part, _ in self.parts(nodes)]
        return float((np.abs(np.sum(signed, axis=0)) / self.scale).max())

    def missed(self, nodes: list[int]) -> float:
        """Return the same where nothing that is missed at one wavelength makes up for another."""
        return float((np.sum([part for _, part in self.parts(nodes)], axis=0) / self.scale).max())

    def parts(self, nodes: list[int]) -> list[tuple[Array, Array]]:
        """Return what products miss in each part of the grid, as it is and absolute, (emitters, products)."""
        ends = list(itertools.pairwise([None, *nodes, None]))
        for first, last in ends:
            if (first, last) not in self.known:
                self.known[first, last] = self._part(first, last)
        return [self.known[one] for one in ends]

    def _part(self, first: int | None, last: int | None) -> tuple[Array, Array]:
        part = slice(first, last)
        wavelength_m, products = self.wavelength_m[part], self.products[:, part]
        carried: Array
        if first is None:  # the outermost node stands for all beyond it
            carried = self.products[:, last, None]
        elif last is None:
            carried = self.products[:, first, None]
        else:
            share = (wavelength_m - wavelength_m[0]) / (self.wavelength_m[last] - wavelength_m[0])
            low, high = self.products[:, [first]], self.products[:, [last]]
            carried = low + (high - low) * share
        missed, seen = products - carried, self.seen[:, part]
        return seen @ missed.T, seen @ np.abs(missed).T

    def one_more(self, nodes: list[int]) -> list[int]:
        """Return nodes and one more: where the worst product is missed most, the place that helps."""
        absolute = np.array([part for _, part in self.parts(nodes)])
        worst = np.argmax(absolute.sum(axis=0) / self.scale)
        of_gaps = absolute.reshape(len(absolute), -1)[1:-1, worst]
        gap = int(np.argmax(np.where(np.diff(nodes) > 1, of_gaps, -1.0)))
        places = self._places(nodes[gap], nodes[gap + 1])
        tried = [[*nodes[: gap + 1], place, *nodes[gap + 1 :]] for place in places]
        return min(tried, key=self.missed)

    def moved(self, nodes: list[int], by: Callable[[list[int]], float]) -> list[int]:
        """Return nodes of which each, in turn, has moved between its neighbours if that helps."""
        for number in range(len(nodes)):
            low, *_, high = [self.bends[0] - 1, *nodes, self.bends[-1] + 1][number : number + 3]
            places = self._places(int(low), int(high))
            tried = [nodes, *([*nodes[:number], place, *nodes[number + 1 :]] for place in places)]
            nodes = min(tried, key=by)
        return nodes

    def without_needless(self, nodes: list[int], error: float) -> list[int]:
        """Return nodes less those without which the error is kept."""
        for node in tuple(nodes):
            fewer = [other for other in nodes if other != node]
            if fewer and self.error(fewer) <= error:
                nodes = fewer
        return nodes

    def _places(self, low: int, high: int) -> list[int]:
        """Return some places between two nodes: bends, and even ones."""
        bends = self.bends[(self.bends > low) & (self.bends < high)]
        even = np.linspace(low, high, _PLACES + 2).round().astype(int)[1:-1]
        places = np.unique(np.concatenate([_some(bends, _PLACES), even]))
        return [int(place) for place in places if low < place < high]


def _products(curves: Array) -> Array:
    curves = np.unique(curves, axis=0)
    products = np.array([np.prod(curves[some], axis=0) for some in _bounces(len(curves))])
    return np.asarray(products[products.max(axis=1) > 0.0])


def _bounces(count: int) -> Iterator[list[int]]:
    """Return which of so many curves light meets, in up to three bounces."""
    for order in range(1, _BOUNCES + 1):
        yield from map(list, itertools.combinations_with_replacement(range(count), order))


def _some(places: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return some of many places, evenly."""
    if len(places) <= most:
        return places
    return np.asarray(places[np.linspace(0, len(places) - 1, most).round().astype(int)])
