"""How many wavelengths light must be carried at, and which: few that keep what cameras see to a stated error.

Light that has met surfaces of reflectances ρ_i(λ) goes with their products. Carried at nodes and taken as
linear between them (`nodes`), a product f errs, in what a camera sees of an emitter, by

    ∫ W(λ) [f(λ) − Σ_k φ_k(λ) f(λ_k)] dλ / ∫ W(λ) f(λ) dλ

with W = emitter × filter × quantum efficiency × λ. The error stated is the largest over all W, and over each
curve, the products of each two, and powers up to the third.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POWERS = 3
_QUANTILES = 24
_OUTSIDE = 1e-4
_ROUNDED_M = 1e-12
_LEAST_F = 1e-3  # of a product's largest value: what is darker errs by that much of the largest at most


@dataclass(frozen=True)
class Choice:
    """Nodes, increasing, and the largest error that they make in what a camera sees of a product."""

    wavelengths_m: tuple[float, ...]
    error: float


def choose_nodes(
    wavelength_m: Array, weights: Array, curves: Array, candidates_m: Array, *, error: float, most: int
) -> Choice:
    """Return few wavelengths that keep an error, at most so many.

    One where one does. Else the ends of what is seen, and between them one after the other where most is
    missing, by the products' absolute errors, which cannot cancel; those that are not needed go again.

    Parameters
    ----------
    wavelength_m
        A fine grid, increasing, shape (n,).
    weights
        What a camera sees of each emitter at each point of it, shape (emitters, n).
    curves
        Reflectances and transmittances that vary, shape (curves, n).
    candidates_m
        Where nodes may lie, beside the quantiles of the weights: between the least and the largest of these.
    """
    seen = weights[weights.sum(axis=1) > 0.0]
    seen = seen / seen.sum(axis=1, keepdims=True)
    problem = _Problem(wavelength_m, seen, _products(curves))
    quantiles_m = [_quantiles(wavelength_m, one) for one in seen]
    places_m = np.unique(np.concatenate([candidates_m, *quantiles_m]).round(12))
    places_m = places_m[
        (places_m >= candidates_m.min() - _ROUNDED_M) & (places_m <= candidates_m.max() + _ROUNDED_M)
    ]
    alone = [problem.error(np.array([place])) for place in places_m]
    best = int(np.argmin(alone))
    if alone[best] <= error or most == 1:
        return Choice((float(places_m[best]),), alone[best])
    nodes_m = _ends(places_m, seen, wavelength_m)
    while problem.error(nodes_m) > error and len(nodes_m) < most:
        nodes_m = _one_more(problem, nodes_m, places_m)
    for node in nodes_m.copy():
        fewer = nodes_m[nodes_m != node]
        if len(nodes_m) > 1 and problem.error(fewer) <= max(error, problem.error(nodes_m)):
            nodes_m = fewer
    return Choice(tuple(float(node) for node in nodes_m), problem.error(nodes_m))


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is seen of each emitter, sums of 1, and the products that are to be carried."""

    wavelength_m: Array
    seen: Array
    products: Array

    def residual(self, nodes_m: Array) -> Array:
        """Return how far products lie off what nodes make of them, shape (products, n)."""
        at_nodes = np.array([np.interp(nodes_m, self.wavelength_m, one) for one in self.products])
        carried = np.array([np.interp(self.wavelength_m, nodes_m, one) for one in at_nodes])
        return np.asarray(self.products - carried)

    def error(self, nodes_m: Array) -> float:
        """Return the largest relative error of what is seen of an emitter by way of a product."""
        return float((np.abs(self.seen @ self.residual(nodes_m).T) / self.scale).max())

    @cached_property
    def scale(self) -> Array:
        """What is seen of each emitter by way of each product, shape (emitters, products); never nothing."""
        floor = _LEAST_F * self.products.max(axis=1)
        return np.asarray(np.maximum(self.seen @ self.products.T, floor))


def _ends(places_m: Array, seen: Array, wavelength_m: Array) -> Array:
    """Return the outermost places between which all is seen but a ten thousandth of any emitter."""
    cumulated = np.cumsum(seen, axis=1)
    first = wavelength_m[(cumulated > _OUTSIDE).any(axis=0)][0]
    last = wavelength_m[(cumulated < 1.0 - _OUTSIDE).any(axis=0)][-1]
    low = places_m[max(int(np.searchsorted(places_m, first)) - 1, 0)]
    high = places_m[min(int(np.searchsorted(places_m, last)), len(places_m) - 1)]
    return np.array([low] if low == high else [low, high])


def _one_more(problem: _Problem, nodes_m: Array, places_m: Array) -> Array:
    """Return nodes and one more: where the worst product is missed most, the place that helps."""
    missed = np.abs(problem.residual(nodes_m))
    emitter, product = np.unravel_index(
        np.argmax((problem.seen @ missed.T) / problem.scale), problem.scale.shape
    )
    interval = np.searchsorted(nodes_m, problem.wavelength_m)
    parts = np.bincount(interval, problem.seen[emitter] * missed[product], minlength=len(nodes_m) + 1)
    for worst in np.argsort(-parts):
        low = nodes_m[worst - 1] if worst > 0 else -np.inf
        high = nodes_m[worst] if worst < len(nodes_m) else np.inf
        within = places_m[(places_m > low) & (places_m < high)]
        if within.size:
            tried = [np.sort(np.append(nodes_m, place)) for place in within]
            left = [((problem.seen @ np.abs(problem.residual(one)).T) / problem.scale).max() for one in tried]
            return tried[int(np.argmin(left))]
    return nodes_m


def _products(curves: Array) -> Array:
    powers = [curve**power for curve in curves for power in range(1, _POWERS + 1)]
    pairs = [one * other for one, other in itertools.combinations(curves, 2)]
    products = np.array([*powers, *pairs])
    return np.asarray(products[products.max(axis=1) > 0.0])


def _quantiles(wavelength_m: Array, seen: Array) -> Array:
    cumulated = np.cumsum(seen)
    middles = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    shares = np.concatenate([[_OUTSIDE], middles, [1.0 - _OUTSIDE]])
    return np.asarray(np.interp(shares, cumulated, wavelength_m))
