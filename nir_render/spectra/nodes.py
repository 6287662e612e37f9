"""Wavelength nodes: light is carried at a few wavelengths and taken as linear between them.

Transport knows, for each light group, how one unit of its emission arrives at each node. At a wavelength λ
that is Σ_k φ_k(λ) · light_k with the hat functions φ_k, which are 1 at their own node, 0 at all others, and
add up to 1: so the electrons of a spectrum S are Σ_k light_k ∫ S(λ) φ_k(λ) … dλ, and a single node, where
φ = 1, is exact where nothing on the way depends on the wavelength.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

BAND_M = 940e-9
"""The wavelength about which all of this turns: that of the LEDs, and of the filters' middle."""


@dataclass(frozen=True)
class Node:
    """One of the nodes at `wavelengths_m`, increasing: number `index`."""

    wavelengths_m: tuple[float, ...]
    index: int

    @property
    def is_alone(self) -> bool:
        """Whether there is no other, so that it stands for every wavelength."""
        return len(self.wavelengths_m) == 1

    def weight(self, wavelength_m: ArrayLike) -> NDArray[np.float64]:
        """Return φ at wavelengths of any shape; beyond the first and the last node these stand for all.

        >>> Node((900e-9, 1000e-9), 0).weight([850e-9, 900e-9, 925e-9, 1000e-9])
        array([1.  , 1.  , 0.75, 0.  ])
        """
        values = np.zeros(len(self.wavelengths_m))
        values[self.index] = 1.0
        return np.asarray(np.interp(np.asarray(wavelength_m, dtype=np.float64), self.wavelengths_m, values))


def nodes_at(wavelengths_m: tuple[float, ...]) -> tuple[Node, ...]:
    """Return the nodes at some wavelengths, which must increase; raise ValueError if not."""
    if not wavelengths_m or any(b <= a for a, b in itertools.pairwise(wavelengths_m)):
        raise ValueError(f"wavelengths_m is {wavelengths_m!r}; wanted increasing wavelengths")
    return tuple(Node(wavelengths_m, index) for index in range(len(wavelengths_m)))


ONE_NODE = Node((BAND_M,), 0)
"""The node of light that has but one."""
