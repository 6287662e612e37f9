"""What a light group sends: its spectrum of unit flux, and how many units of emission."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

from nir_render.scene.documents.ambient.lamps import Infrared, Lamp
from nir_render.scene.documents.ambient.sun import Air, Skylight, Sun
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.spectral.led import SpectrumDocument
from nir_render.spectra.curve import Curve, constant_curve
from nir_render.spectra.illuminants import (
    SILICON_M,
    CieLamp,
    incandescent_flux_w,
    incandescent_spectrum,
    radiant_flux_w,
    table_of,
    with_infrared,
)
from nir_render.spectra.sunlight import Column, Sunlight, sunlight

Emitter = Source | Lamp | Sun | Skylight


def light_groups(
    spheres: Mapping[str, Source], lamps: Mapping[str, Lamp], sun: Sun | None, skylight: Skylight | None
) -> dict[str, Emitter]:
    """Return what each light group is: `robot.source`, `beacons.name`, `lamps.name`, `sun`, `sky`."""
    known: dict[str, Emitter] = dict(spheres)
    known |= {f"lamps.{name}": lamp for name, lamp in lamps.items()}
    known |= {} if sun is None else {"sun": sun}
    return known if skylight is None else known | {"sky": skylight}


def emission_spectrum(emitter: Emitter) -> Curve:
    """Return the spectrum of an emitter, of unit flux, in 1/m."""
    if isinstance(emitter, Lamp):
        return _lamp_spectrum(emitter.temperature_k, emitter.illuminant, emitter.infrared)
    if isinstance(emitter, Sun):
        if emitter.air is None:
            return constant_curve(1.0, *SILICON_M, "the sun's spectrum").normalised()
        return _behind(emitter.air, emitter).direct.normalised()
    if isinstance(emitter, Skylight):
        if emitter.sky.irradiance_w_per_m3 is not None:
            return constant_curve(1.0, *SILICON_M, "the sky's spectrum").normalised()
        assert emitter.sun.air is not None  # a sky has one of both
        return _behind(emitter.sun.air, emitter.sun).diffuse.normalised()
    curve = _source_spectrum(emitter.spectrum)
    offset_m = emitter.unit.wavelength_m
    return replace(curve, wavelength_m=curve.wavelength_m + offset_m) if offset_m else curve


@lru_cache(maxsize=64)
def _source_spectrum(spectrum: SpectrumDocument) -> Curve:
    return spectrum.curve("the source's spectrum").normalised()


def emission_units(emitter: Emitter) -> float:
    """Return how many of its units an emitter sends, over its whole spectrum.

    The unit of a source and of a lamp is 1 W of radiant flux, a lamp's from 300 to 1100 nm; that of the sun
    is 1 W/m² of irradiance across its direction, that of the sky 1 W/m² on a horizontal plane, both from 300
    to 1100 nm too.
    """
    if isinstance(emitter, Lamp):
        return _lamp_flux_w(
            emitter.luminous_flux_lm, emitter.temperature_k, emitter.illuminant, emitter.infrared
        )
    if isinstance(emitter, Sun):
        if emitter.air is not None:
            return emitter.passed * _behind(emitter.air, emitter).direct.integral()
        assert emitter.irradiance_w_per_m3 is not None  # a sun has one of both
        return emitter.passed * emitter.irradiance_w_per_m3 * (SILICON_M[1] - SILICON_M[0])
    if isinstance(emitter, Skylight):
        if emitter.sky.irradiance_w_per_m3 is not None:
            return emitter.sky.clouds * emitter.sky.irradiance_w_per_m3 * (SILICON_M[1] - SILICON_M[0])
        assert emitter.sun.air is not None  # a sky has one of both
        return emitter.sky.clouds * _behind(emitter.sun.air, emitter.sun).diffuse.integral()
    return emitter.sent_flux_w


def _behind(air: Air, sun: Sun) -> Sunlight:
    column = Column(
        air.precipitable_water_m, air.ozone_m, air.turbidity, air.altitude_m, air.ground_reflectance
    )
    return sunlight(column, sun.elevation_rad, sun.day_of_year)


@lru_cache(maxsize=64)
def _lamp_spectrum(
    temperature_k: float | None, illuminant: CieLamp | CurveDocument | None, infrared: Infrared | None
) -> Curve:
    name = "the lamp's spectrum"
    if illuminant is None:
        assert temperature_k is not None  # a lamp has one of both
        return incandescent_spectrum(temperature_k, name)
    table = illuminant.curve(name) if isinstance(illuminant, CurveDocument) else table_of(illuminant)
    return table.normalised() if infrared is None else with_infrared(table, infrared.share)


@lru_cache(maxsize=64)
def _lamp_flux_w(
    luminous_flux_lm: float,
    temperature_k: float | None,
    illuminant: CieLamp | CurveDocument | None,
    infrared: Infrared | None,
) -> float:
    if illuminant is None:
        assert temperature_k is not None  # a lamp has one of both
        return incandescent_flux_w(luminous_flux_lm, temperature_k)
    return radiant_flux_w(luminous_flux_lm, _lamp_spectrum(temperature_k, illuminant, infrared))
