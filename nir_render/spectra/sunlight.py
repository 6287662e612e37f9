"""Sunlight behind the air, straight and scattered: pvlib's SPECTRL2, with a water band of G173's own.

SPECTRL2 (Bird and Riordan, NREL TR-215-2436, 1984) knows the water band about 940 nm by eight nodes, and says
3.31 W/m² of straight light from 935 to 945 nm where ASTM G173 has 2.87. So from 880 to 1000 nm the
absorption of water is taken, nanometre by nanometre, from G173's own columns: what its straight light lacks
of its extraterrestrial one, Rayleigh scattering and aerosol (SPECTRL2's) apart, is water's transmittance at
1.4164 cm and air mass 1.5. It grows with water as Leckner's does (Solar Energy 20, 143, 1978),

    T = exp(−0.2385 k w m / (1 + 20.07 k w m)^0.45),

which gives k at each wavelength.
"""

import math
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.spectra.curve import Curve
from nir_render.spectra.illuminants import SILICON_M

Array = NDArray[np.float64]

_BAND_NM = (880.0, 1000.0)
_G173_WATER_CM, _G173_ZENITH_DEG, _G173_AIR_MASS = 1.4164, 48.19, 1.5
_SPRING_AIR_MASS = 1.8  # at which SPECTRL2 takes what the sky sends back to the ground


@dataclass(frozen=True)
class SunPosition:
    """Where the sun stands: above the horizon, refraction in it, and clockwise from north."""

    elevation_rad: float
    from_north_rad: float


@dataclass(frozen=True, eq=False)
class Sunlight:
    """Spectral irradiance over what silicon sees, in W/m² per metre of wavelength.

    `direct` across the sun's direction, `diffuse` of the sky on a horizontal plane.
    """

    direct: Curve
    diffuse: Curve


@dataclass(frozen=True)
class Column:
    """What light comes through; see `documents.ambient.sun.Air`."""

    precipitable_water_m: float
    ozone_m: float
    turbidity: float
    altitude_m: float
    ground_reflectance: float


def sun_position(latitude_rad: float, longitude_rad: float, time: datetime) -> SunPosition:
    """Return where the sun stands (NREL's SPA, by pvlib); raise InputError without pvlib."""
    pvlib = _pvlib()
    import pandas as pd  # comes with pvlib

    found = pvlib.solarposition.get_solarposition(
        pd.DatetimeIndex([time]), math.degrees(latitude_rad), math.degrees(longitude_rad)
    )
    elevation_deg, azimuth_deg = (float(found[name].iloc[0]) for name in ("apparent_elevation", "azimuth"))
    return SunPosition(math.radians(elevation_deg), math.radians(azimuth_deg))


@lru_cache(maxsize=64)
def sunlight(column: Column, elevation_rad: float, day_of_year: int | None) -> Sunlight:
    """Return the sun's light behind a column of air; without a day at its mean distance.

    Raises
    ------
    InputError
        pvlib is not installed.
    """
    pvlib = _pvlib()
    zenith_deg = 90.0 - math.degrees(elevation_rad)
    air_mass = float(pvlib.atmosphere.get_relative_airmass(zenith_deg))
    pressure_pa = float(pvlib.atmosphere.alt2pres(column.altitude_m))
    water_cm = 100.0 * column.precipitable_water_m

    def bird(water_cm: float, ground: float) -> dict[str, Array]:
        return _spectrl2(zenith_deg, air_mass, pressure_pa, column, water_cm, ground)

    wet, dry = bird(water_cm, column.ground_reflectance), bird(0.0, column.ground_reflectance)
    without_ground = bird(0.0, 0.0)
    band = _water_band()
    # Continuum: what air without water leaves of the light outside it.
    straight, scattered, from_ground = (
        np.interp(band.wavelength_nm, wet["wavelength"], part / dry["dni_extra"])
        for part in (dry["dni"], without_ground["dhi"], dry["dhi"] - without_ground["dhi"])
    )
    passed = _leckner(band.absorption_per_cm * water_cm * air_mass)
    passed_back = _leckner(band.absorption_per_cm * water_cm * _SPRING_AIR_MASS)
    distance = 1.0 if day_of_year is None else _distance_factor(day_of_year)
    direct = _joined(wet["wavelength"], wet["dni"], band, straight * passed)
    diffuse = _joined(wet["wavelength"], wet["dhi"], band, (scattered + from_ground * passed_back) * passed)
    return Sunlight(
        Curve(direct[0], distance * direct[1], "the sun's spectrum"),
        Curve(diffuse[0], distance * diffuse[1], "the sky's spectrum"),
    )


@dataclass(frozen=True, eq=False)
class _Band:
    """The water band of G173: light outside the air in W/m²/nm, and water's absorption, shape (n,) each."""

    wavelength_nm: Array
    outside: Array
    absorption_per_cm: Array


@lru_cache(maxsize=1)
def _water_band() -> _Band:
    table = _pvlib().spectrum.get_reference_spectra(standard="ASTM G173-03")
    wavelength_nm = table.index.to_numpy(dtype=np.float64)
    within = (wavelength_nm >= _BAND_NM[0]) & (wavelength_nm <= _BAND_NM[1])
    wavelength_nm = wavelength_nm[within]
    outside = table["extraterrestrial"].to_numpy(dtype=np.float64)[within]
    left = table["direct"].to_numpy(dtype=np.float64)[within] / outside
    column = Column(0.0, 0.003438, 0.084, 0.0, 0.0)
    dry = _spectrl2(_G173_ZENITH_DEG, _G173_AIR_MASS, 101325.0, column, 0.0, 0.0)
    continuum = np.interp(wavelength_nm, dry["wavelength"], dry["dni"] / dry["dni_extra"])
    depth = -np.log(np.minimum(left / continuum, 1.0))
    return _Band(wavelength_nm, outside, _leckner_inverse(depth) / (_G173_WATER_CM * _G173_AIR_MASS))


def _leckner(water: Array) -> Array:
    """Return the transmittance of water, k w m."""
    return np.asarray(np.exp(-_leckner_depth(water)))


def _leckner_depth(water: Array) -> Array:
    return np.asarray(0.2385 * water / (1.0 + 20.07 * water) ** 0.45)


def _leckner_inverse(depth: Array) -> Array:
    """Return the k w m of an optical depth, by bisection: the depth grows with it throughout."""
    low, high = np.full(depth.shape, -30.0), np.full(depth.shape, 30.0)
    for _ in range(80):
        middle = 0.5 * (low + high)
        small = _leckner_depth(np.exp(middle)) < depth
        low, high = np.where(small, middle, low), np.where(small, high, middle)
    return np.where(depth > 0.0, np.exp(high), 0.0)


def _spectrl2(
    zenith_deg: float, air_mass: float, pressure_pa: float, column: Column, water_cm: float, ground: float
) -> dict[str, Array]:
    """Return SPECTRL2's columns, W/m²/nm, shape (122,), the sun at its mean distance."""
    day = 1
    found = _pvlib().spectrum.spectrl2(
        apparent_zenith=zenith_deg, aoi=zenith_deg, surface_tilt=0.0, ground_albedo=ground,
        surface_pressure=pressure_pa, relative_airmass=air_mass, precipitable_water=water_cm,
        ozone=100.0 * column.ozone_m, aerosol_turbidity_500nm=column.turbidity, dayofyear=day,
    )  # fmt: skip
    flat = {name: np.asarray(found[name], dtype=np.float64).ravel() for name in ("dni", "dhi", "dni_extra")}
    return {
        "wavelength": np.asarray(found["wavelength"], dtype=np.float64).ravel(),
        **{name: values / _distance_factor(day) for name, values in flat.items()},
    }


def _distance_factor(day_of_year: int) -> float:
    """Return the mean distance of the sun over that of a day, squared (Spencer)."""
    return float(_pvlib().irradiance.get_extra_radiation(day_of_year, method="spencer", solar_constant=1.0))


def _joined(node_nm: Array, at_node_per_nm: Array, band: _Band, left_in_band: Array) -> tuple[Array, Array]:
    """Return wavelengths in metres and irradiance per metre: SPECTRL2's nodes, and the band between them."""
    low_nm, high_nm = (1e9 * end for end in SILICON_M)
    below = (node_nm >= low_nm - 1e-6) & (node_nm < _BAND_NM[0])
    above = (node_nm > _BAND_NM[1]) & (node_nm <= high_nm + 1e-6)
    wavelength_nm = np.concatenate([node_nm[below], band.wavelength_nm, node_nm[above]])
    in_band = band.outside * left_in_band
    per_nm = np.concatenate([at_node_per_nm[below], in_band, at_node_per_nm[above]])
    return wavelength_nm * 1e-9, per_nm * 1e9


def _pvlib() -> Any:
    try:
        import pvlib
    except ImportError:
        raise InputError(
            "the sun's place and its light behind air come from pvlib, which is not installed: "
            "pip install 'nir-render[sun]' (140 MB, most of it pandas), or write the sun's azimuth, "
            "elevation and irradiance"
        ) from None
    return pvlib
