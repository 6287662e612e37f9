"""The model of an image sensor: EMVA 1288 release 4.0, linear camera model, and what lies beyond it.

A data sheet's saturation capacity is the mean photoelectrons at which the temporal variance is largest. Shot
noise of some pixels is clipped before the mean reaches the clip, so it lies 2 to 4 % below the charge at
which pixels clip; what turns one into the other stands at the end.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from nir_render.scene.documents.base import (
    Bits,
    Counts,
    DarkCurrent,
    Document,
    Electrons,
    Fraction,
    Length,
    NotNegative,
    Positive,
    SystemGain,
    Temperature,
    Unit,
)
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.files import PresetDocument
from nir_render.scene.documents.spectral.efficiency import EfficiencyEnvelope, efficiency_bounds
from nir_render.scene.text.units import Quantity
from nir_render.spectra.curve import Curve

_PIXEL_NODES = 401  # over the pixels' unlike responses
_PIXEL_NODES_BENT = 65  # where the response is not linear: each of them takes all those over shot noise
_CHARGE_NODES = 1601  # over shot noise, where the response is not linear
_REACH_SIGMAS = 8.0
Real = TypeVar("Real", bound=np.floating)

_LEAST_OF_FULL_SCALE = 0.9  # what the full well must reach: an ADC whose upper counts stay empty is a mistake
_CLIP_SLACK = 1.002
SENSOR_TEMPERATURE = Quantity("temperature", "K", "308 K")


SensorTemperature = Annotated[float, Unit(SENSOR_TEMPERATURE), Field(ge=150, le=420)]


class DarkPattern(Document):
    """DSNU: fixed offsets of rows, columns and pixels, standard deviations; one number is the pixels'."""

    example: ClassVar[str] = "{pixel: 3 e, row: 0.5 e, column: 1 e}"

    pixel_e: Annotated[Electrons, NotNegative] = 0.0
    row_e: Annotated[Electrons, NotNegative] = 0.0
    column_e: Annotated[Electrons, NotNegative] = 0.0

    @model_validator(mode="before")
    @classmethod
    def _one_number(cls, data: Any) -> Any:
        return {"pixel": data} if isinstance(data, int | float | str) else data

    @property
    def total_e(self) -> float:
        """The DSNU of a data sheet: the standard deviation over all pixels."""
        return math.hypot(self.pixel_e, self.row_e, self.column_e)


class ResponsePattern(Document):
    """PRNU: relative responses of rows, columns, pixels, standard deviations; one number is the pixels'."""

    example: ClassVar[str] = "{pixel: 0.8 %, row: 0.1 %, column: 0.2 %}"

    pixel: Annotated[Fraction, Field(ge=0, le=0.2)] = 0.0
    row: Annotated[Fraction, Field(ge=0, le=0.2)] = 0.0
    column: Annotated[Fraction, Field(ge=0, le=0.2)] = 0.0

    @model_validator(mode="before")
    @classmethod
    def _one_number(cls, data: Any) -> Any:
        return {"pixel": data} if isinstance(data, int | float | str) else data

    @property
    def total(self) -> float:
        """The PRNU of a data sheet: the standard deviation over all pixels."""
        return math.hypot(self.pixel, self.row, self.column)


class Nonlinearity(Document):
    """A soft non-linearity: q electrons are read as q (1 − `loss` · (q / full well)^`exponent`)."""

    example: ClassVar[str] = "{loss: 2 %, exponent: 4}"

    loss: Annotated[Fraction, Field(ge=0, le=0.2)]
    exponent: Annotated[float, Field(ge=1, le=16)] = 4.0

    @model_validator(mode="after")
    def _increases(self) -> Self:
        if self.loss * (self.exponent + 1.0) >= 1.0:
            raise ValueError(
                f"a loss of {self.loss:g} with exponent {self.exponent:g} makes brighter pixels read darker "
                f"near the full well; the loss must be below {1.0 / (self.exponent + 1.0):.3g}"
            )
        return self


class Defects(Document):
    """Bad pixels, as shares of all; which ones they are belongs to the serial number.

    `dead` pixels do not respond to light, `hot` ones have the dark current `hot_dark_current` besides,
    `stuck` ones always read full scale.
    """

    example: ClassVar[str] = "{dead: 0.001 %, hot: 0.01 %, stuck: 0.0002 %}"

    dead: Annotated[Fraction, Field(ge=0, le=0.5)] = 0.0
    hot: Annotated[Fraction, Field(ge=0, le=0.5)] = 0.0
    hot_dark_current_e_per_s: Annotated[DarkCurrent, Positive] = 5000.0
    stuck: Annotated[Fraction, Field(ge=0, le=0.5)] = 0.0


@dataclass(frozen=True)
class Compression:
    """A soft non-linearity: of q electrons, q (1 − loss · (q / full well)^exponent) are read."""

    loss: float
    exponent: float

    def __call__(self, charge_e: NDArray[Real], full_well_e: float) -> NDArray[Real]:
        """Return the electrons that are read of a charge, same shape and type."""
        return charge_e * (1.0 - self.loss * (charge_e / full_well_e) ** self.exponent)


class Sensor(PresetDocument):
    """An image sensor after EMVA 1288 release 4.0.

    How much it holds is written as data sheets do: `saturation_capacity`, the mean photoelectrons at which
    the temporal variance is largest, or as `full_well`, the charge at which a pixel clips; the other follows.
    `dark_current` holds at `reference_temperature` and doubles every `dark_current_doubling`. `blooming` is
    the share of the charge beyond the full well that spills to the neighbours in the column; the rest drains.
    `efficiency_envelope` is between what the quantum efficiency lies where it is not published; frames are
    made with `quantum_efficiency`, or with that end of the envelope which `efficiency_taken` says.
    """

    preset_folder: ClassVar[str] = "sensors"

    columns: Annotated[int, Field(ge=1, le=65536)]
    rows: Annotated[int, Field(ge=1, le=65536)]
    pixel_pitch_m: Annotated[Length, Positive]
    quantum_efficiency: CurveDocument
    saturation_capacity_e: Annotated[Electrons, Positive] | None = None
    full_well_e: Annotated[Electrons, Positive] | None = None
    read_noise_e: Annotated[Electrons, NotNegative]
    dark_current_e_per_s: Annotated[DarkCurrent, NotNegative] = 0.0
    dark_current_doubling_k: Annotated[Temperature, Field(ge=1, le=50)] = 7.0
    reference_temperature_k: SensorTemperature = 298.15
    temperature_k: SensorTemperature = 298.15
    dsnu: DarkPattern = DarkPattern()
    prnu: ResponsePattern = ResponsePattern()
    system_gain_dn_per_e: Annotated[SystemGain, Positive]
    black_level_dn: Annotated[Counts, NotNegative]
    bit_depth_bit: Annotated[Bits, Field(ge=8, le=16)]
    nonlinearity: Nonlinearity | None = None
    blooming: Annotated[Fraction, Field(ge=0, le=1)] = 0.0
    defects: Defects = Defects()
    efficiency_envelope: EfficiencyEnvelope | None = None
    efficiency_taken: Literal["nominal", "low", "high"] = "nominal"

    @field_validator("quantum_efficiency")
    @classmethod
    def _at_most_one(cls, curve: CurveDocument) -> CurveDocument:
        values = [value for _, value in curve.points or ()]
        if max([curve.constant or 0.0, *values]) > 1:
            raise ValueError("a quantum efficiency is at most 1")
        if curve.gaussian is None and max([curve.constant or 0.0, *values]) == 0:
            raise ValueError("a quantum efficiency of 0 everywhere sees nothing")
        if curve.gaussian is not None:
            raise ValueError("wanted a number, 'points' or 'file'")
        return curve

    @field_validator("bit_depth_bit")
    @classmethod
    def _whole_bits(cls, bits: float) -> float:
        if bits != int(bits):
            raise ValueError(f"{bits} is not a whole number of bits")
        return bits

    @model_validator(mode="after")
    def _one_capacity(self) -> Self:
        if (self.saturation_capacity_e is None) == (self.full_well_e is None):
            raise ValueError(
                "wanted one of 'saturation_capacity' (EMVA 1288, as data sheets have it) and 'full_well' "
                "(the charge at which a pixel clips)"
            )
        return self

    @model_validator(mode="after")
    def _reaches_full_scale(self) -> Self:
        if self.black_level_dn >= self.full_scale_dn:
            raise ValueError(
                f"black_level {self.black_level_dn:g} DN is not below full scale, {self.full_scale_dn} DN"
            )
        noise_e = math.hypot(self.read_noise_e, self.dsnu.total_e)
        if self._surely_reaches_full_scale(noise_e):
            return self
        well_e = self.well_e
        if well_e < 10.0 * noise_e:
            raise ValueError(
                f"read_noise {self.read_noise_e:g} e and dsnu {self.dsnu.total_e:g} e leave less than ten "
                f"steps of noise below the full well of {well_e:.5g} e"
            )
        gain, black_dn = self.system_gain_dn_per_e, self.black_level_dn
        reached_dn = black_dn + gain * self.read_e(well_e)
        if reached_dn < _LEAST_OF_FULL_SCALE * self.full_scale_dn:
            wanted = (self.full_scale_dn - black_dn) / self.read_e(well_e)
            raise ValueError(
                f"system_gain {gain:g} DN/e takes a full well of {well_e:.5g} e only to {reached_dn:.0f} of "
                f"{self.full_scale_dn} DN, so full scale is never reached; it takes {wanted:.3g} DN/e; "
                "check system_gain, the full well and bit_depth"
            )
        full_scale_e = self.full_scale_e
        if self.saturation_capacity_e is not None and full_scale_e * _CLIP_SLACK < self.read_e(well_e):
            raise ValueError(
                f"system_gain {gain:g} DN/e takes the ADC to full scale at {full_scale_e:.5g} e, before the "
                f"{self.read_e(well_e):.5g} e at which pixels of a saturation_capacity of "
                f"{self.saturation_capacity_e:g} e clip (as prnu and nonlinearity have it), so that capacity "
                "could not have been measured; take at most "
                f"{(self.full_scale_dn - black_dn) / self.read_e(well_e):.3g} DN/e, or write 'full_well' in "
                "its place"
            )
        return self

    def _surely_reaches_full_scale(self, noise_e: float) -> bool:
        """Tell whether a saturation capacity shows, without its full well, that gain and noise are right.

        The full well is no less than the capacity; and it is less than a charge for which, were that the full
        well, the variance would still grow at the capacity. To solve for it takes half a second of loading.
        """
        capacity_e = self.saturation_capacity_e
        if capacity_e is None or self.compression is not None:
            return False
        least_dn = self.black_level_dn + self.system_gain_dn_per_e * capacity_e
        return (
            capacity_e >= 10.0 * noise_e
            and least_dn >= _LEAST_OF_FULL_SCALE * self.full_scale_dn
            and self.full_scale_e > capacity_e
            and _variance_grows(capacity_e, self.full_scale_e, self.prnu.total)
        )

    @model_validator(mode="after")
    def _envelope_holds_the_efficiency(self) -> Self:
        if self.efficiency_envelope is not None:
            self.efficiency_envelope.check_holds(self.quantum_efficiency)
        elif self.efficiency_taken != "nominal":
            raise ValueError(
                f"efficiency_taken: there is no 'efficiency_envelope' with a {self.efficiency_taken!r} end; "
                "give it, or take 'nominal'"
            )
        return self

    def efficiency(self) -> Curve:
        """Return the quantum efficiency against wavelength that frames are made with."""
        envelope, taken = self.efficiency_envelope, self.quantum_efficiency
        if envelope is not None and self.efficiency_taken != "nominal":
            taken = envelope.low if self.efficiency_taken == "low" else envelope.high
        return taken.curve("quantum_efficiency")

    def efficiency_bounds(
        self, wavelength_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return between what the quantum efficiency is known to lie, at wavelengths of any shape."""
        return efficiency_bounds(self.quantum_efficiency, self.efficiency_envelope, wavelength_m)

    @property
    def full_scale_dn(self) -> int:
        """The largest count of the ADC."""
        return int(2**self.bit_depth_bit) - 1

    @property
    def full_scale_e(self) -> float:
        """The electrons at which the ADC reaches its largest count, at gain 1."""
        return (self.full_scale_dn - self.black_level_dn) / self.system_gain_dn_per_e

    @property
    def compression(self) -> Compression | None:
        """The soft non-linearity; None for a linear sensor."""
        if self.nonlinearity is None or self.nonlinearity.loss == 0.0:
            return None
        return Compression(self.nonlinearity.loss, self.nonlinearity.exponent)

    @property
    def well_e(self) -> float:
        """The charge at which a pixel clips, in electrons."""
        if self.full_well_e is not None:
            return self.full_well_e
        assert self.saturation_capacity_e is not None  # one of both is there
        return full_well_e(self.saturation_capacity_e, self.prnu.total, self.compression)

    def read_e(self, charge_e: float) -> float:
        """Return the electrons that are read of a charge: the soft non-linearity's own curve."""
        compression = self.compression
        return charge_e if compression is None else float(compression(np.array(charge_e), self.well_e))

    @property
    def dark_rate_e_per_s(self) -> float:
        """The dark current at the sensor's temperature, in electrons per second."""
        return self.at_temperature_e_per_s(self.dark_current_e_per_s)

    def at_temperature_e_per_s(self, current_e_per_s: float) -> float:
        """Return what a dark current at the reference temperature is at the sensor's temperature."""
        warmer_k = self.temperature_k - self.reference_temperature_k
        return float(current_e_per_s * 2.0 ** (warmer_k / self.dark_current_doubling_k))


def _variance_grows(mean_e: float, full_well_e: float, prnu: float) -> bool:
    """Tell whether the temporal variance grows with the mean where the mean is `mean_e`."""
    below, above = (
        temporal_variance_e2(mean_e * share, full_well_e, prnu, cdf=_erfc_cdf) for share in (0.999, 1.001)
    )
    return below < above


def _erfc_cdf(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normal distribution's Φ, to its last digits, without scipy."""
    return np.array([0.5 * math.erfc(-one / math.sqrt(2.0)) for one in z])


def temporal_variance_e2(
    mean_e: float,
    full_well_e: float,
    prnu: float = 0.0,
    compression: Compression | None = None,
    cdf: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> float:
    """Return the mean over pixels of the variance of shot noise that a full well clips.

    Charge is Gaussian of variance equal to its mean, which it is to 1e-3 at the hundreds of electrons that
    any full well holds; the means of pixels spread by `prnu`, the standard deviation of their responses.
    `cdf` is the normal distribution's, by default scipy's.
    """
    if cdf is None:
        from scipy.special import ndtr  # takes half a second to load

        cdf = ndtr

    # An even grid: a clip is a corner, which Gauss–Hermite nodes would step over.
    count = _PIXEL_NODES if compression is None else _PIXEL_NODES_BENT
    nodes = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, count) if prnu else np.zeros(1)
    weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    means_e = np.maximum(mean_e * (1.0 + prnu * nodes), 1e-9)
    sigma_e = np.sqrt(means_e)
    clip = (full_well_e - means_e) / sigma_e
    if compression is None:
        # Moments of min(z, c), z standard normal: E = c (1 − Φ) − φ, E² = Φ − c φ + c² (1 − Φ).
        phi, below = np.exp(-0.5 * clip**2) / math.sqrt(2.0 * math.pi), cdf(clip)
        first = clip * (1.0 - below) - phi
        second = below - clip * phi + clip**2 * (1.0 - below)
        return float(weights @ (means_e * (second - first**2)))
    z = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, _CHARGE_NODES)
    density = np.exp(-0.5 * z**2)
    density /= density.sum()
    charge_e = np.clip(means_e[:, None] + sigma_e[:, None] * z, 0.0, full_well_e)
    read_e = compression(charge_e, full_well_e)
    first = read_e @ density
    return float(weights @ (((read_e - first[:, None]) ** 2) @ density))


@lru_cache(maxsize=256)
def saturation_capacity_e(
    full_well_e: float, prnu: float = 0.0, compression: Compression | None = None
) -> float:
    """Return the mean photoelectrons at which the temporal variance is largest (EMVA 1288, section 6.6)."""
    from scipy.optimize import minimize_scalar

    def darkness(mean_e: float) -> float:
        return -temporal_variance_e2(mean_e, full_well_e, prnu, compression)

    # The variance has one peak; a coarse search brackets it, so that flat tails beyond cannot mislead.
    places = np.linspace(0.3 * full_well_e, full_well_e, 71)
    best = int(np.argmin([darkness(float(place)) for place in places]))
    low, high = places[max(best - 1, 0)], places[min(best + 1, len(places) - 1)]
    found = minimize_scalar(darkness, bounds=(low, high), method="bounded", options={"xatol": 1e-5 * high})
    return float(found.x)


@lru_cache(maxsize=256)
def full_well_e(capacity_e: float, prnu: float = 0.0, compression: Compression | None = None) -> float:
    """Return the charge at which pixels of a saturation capacity clip."""
    from scipy.optimize import brentq

    def beyond(well_e: float) -> float:
        return saturation_capacity_e(well_e, prnu, compression) - capacity_e

    return float(brentq(beyond, capacity_e, 3.0 * capacity_e + 100.0, xtol=1e-6 * capacity_e, rtol=1e-9))
