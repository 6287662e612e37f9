"""What is known of a quantum efficiency where no curve is published: two envelopes."""

from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from nir_render.scene.documents.base import Document
from nir_render.scene.documents.curves import CurveDocument
from nir_render.spectra.curve import Curve
from nir_render.spectra.nodes import BAND_M

Array = NDArray[np.float64]

_SLACK = 1e-9
_SLACK_M = 1e-15


class EfficiencyEnvelope(Document):
    """Between what a quantum efficiency lies: `low` and `high`, points or files over wavelength."""

    example: ClassVar[str] = (
        "{low: {points: [[400 nm, 0.1], [1100 nm, 0]]}, high: {points: [[400 nm, 0.8], [1100 nm, 0.02]]}}"
    )

    low: CurveDocument
    high: CurveDocument

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.low.points is None or self.high.points is None:
            raise ValueError(f"wanted 'points' or 'file' for both 'low' and 'high', such as {self.example}")
        low, high = self.low.curve("low"), self.high.curve("high")
        if (low.low_m, low.high_m) != (high.low_m, high.high_m):
            raise ValueError(
                f"'low' covers {low.range_nm()}, 'high' {high.range_nm()}: give both the same range"
            )
        wavelength_m = np.union1d(low.wavelength_m, high.wavelength_m)
        above = low(wavelength_m) > high(wavelength_m)
        if above.any() or high.value.max() > 1.0:
            where = f"'low' is above 'high' at {1e9 * wavelength_m[above][0]:.4g} nm" if above.any() else ""
            raise ValueError(f"{where or 'a quantum efficiency is at most 1'}; check the points")
        return self

    def bounds(self, wavelength_m: Array) -> tuple[Array, Array]:
        """Return both at wavelengths of any shape; beyond their ends 0 and 1: nothing is known there."""
        low, high = self.low.curve("low"), self.high.curve("high")
        known = _covers(low, wavelength_m)
        return np.where(known, _read(low, wavelength_m), 0.0), np.where(known, _read(high, wavelength_m), 1.0)

    @property
    def wavelengths_m(self) -> Array:
        """Where either of them bends."""
        low, high = self.low.curve("low"), self.high.curve("high")
        return np.union1d(low.wavelength_m, high.wavelength_m)

    def check_holds(self, efficiency: CurveDocument) -> None:
        """Raise ValueError where a quantum efficiency lies outside; one number holds at 940 nm alone."""
        known = efficiency.curve("quantum_efficiency")
        at_m = np.array([BAND_M]) if efficiency.constant is not None else known.wavelength_m
        low, high = self.bounds(at_m)
        value = known(at_m)
        outside = np.flatnonzero((value < low * (1.0 - _SLACK)) | (value > high * (1.0 + _SLACK)))
        if outside.size:
            first = int(outside[0])
            raise ValueError(
                f"quantum_efficiency: {value[first]:g} at {1e9 * at_m[first]:.4g} nm lies outside of "
                f"efficiency_envelope, {low[first]:g} to {high[first]:g}; check both, or set "
                "efficiency_envelope to null where a preset has it"
            )


def efficiency_bounds(
    known: CurveDocument, envelope: EfficiencyEnvelope | None, wavelength_m: Array
) -> tuple[Array, Array]:
    """Return between what a quantum efficiency is known to lie, at wavelengths of any shape.

    A measured curve is taken as right; beyond its ends, and of one number that stands for all, nothing is
    known but the envelope, or 0 and 1.
    """
    nothing = np.zeros_like(wavelength_m), np.ones_like(wavelength_m)
    low, high = nothing if envelope is None else envelope.bounds(wavelength_m)
    if known.points is None:
        return low, high
    curve = known.curve("quantum_efficiency")
    measured, value = _covers(curve, wavelength_m), _read(curve, wavelength_m)
    return np.where(measured, value, low), np.where(measured, value, high)


def _covers(curve: Curve, wavelength_m: Array) -> NDArray[np.bool_]:
    """Tell where a curve holds; its ends, written in nanometres, are rounded in their last digit."""
    return (wavelength_m >= curve.low_m - _SLACK_M) & (wavelength_m <= curve.high_m + _SLACK_M)


def _read(curve: Curve, wavelength_m: Array) -> Array:
    return np.interp(wavelength_m, curve.wavelength_m, curve.value)
