"""Models of the sun, of the air that its light comes through, and of the sky."""

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Angle,
    Direction,
    Document,
    Fraction,
    Length,
    NotNegative,
    Positive,
    SpectralIrradiance,
)
from nir_render.scene.documents.files import PresetDocument
from nir_render.spectra.illuminants import SUN_RADIUS_RAD, sunlight_ceiling
from nir_render.spectra.nodes import BAND_M
from nir_render.spectra.sunlight import sun_position


def _of_a_sun(irradiance_w_per_m3: float) -> float:
    most = float(sunlight_ceiling(np.array([BAND_M]))[0])
    if irradiance_w_per_m3 > most:
        raise ValueError(
            f"{1e-9 * irradiance_w_per_m3:.4g} W/m^2/nm is more than the sun sends at 940 nm, which is 0.84 "
            "W/m^2/nm above the air; of ASTM G173's direct sun it is 0.287"
        )
    return irradiance_w_per_m3


_Irradiance = Annotated[SpectralIrradiance, Positive, AfterValidator(_of_a_sun)]


class Air(PresetDocument):
    """What sunlight comes through: `turbidity` is the optical depth of aerosol at 500 nm.

    `precipitable_water` and `ozone` are depths of what the column holds. Light that the ground reflects comes
    back from the sky: `ground_reflectance` is that of the land around, not of the scene's bodies.
    """

    preset_folder: ClassVar[str] = "air"

    precipitable_water_m: Annotated[Length, Field(ge=0, le=0.1)]
    ozone_m: Annotated[Length, Field(ge=0, le=0.01)] = 0.003438
    turbidity: Annotated[Fraction, Field(ge=0, le=2)]
    altitude_m: Annotated[Length, Field(ge=-500, le=9000)] = 0.0
    ground_reflectance: Annotated[Fraction, Field(ge=0, le=1)] = 0.2


class Place(Document):
    """A place on earth, north and east positive; `north` is the azimuth, in the world, that points north."""

    example: ClassVar[str] = "{latitude: 51.05 deg, longitude: 3.72 deg}"

    latitude_rad: Annotated[Angle, Field(ge=-math.pi / 2, le=math.pi / 2)]
    longitude_rad: Annotated[Angle, Field(ge=-math.pi, le=math.pi)]
    north_rad: Angle = math.pi / 2


class Sun(Document):
    """The sun: `azimuth` from world x towards y, `elevation` above the horizon; or a `place` and a `time`.

    Its light comes through `air`, or is an `irradiance`, the spectral one across its direction at 940 nm,
    taken as flat over what silicon sees: 0.287 W/m²/nm is 2.87 W/m² from 935 to 945 nm, as ASTM G173 has it
    of the direct sun (with the sky, on its tilted plane, 3.05). `clouds` is the share of its light that these
    let through. `day_of_year` sets its distance, without it the mean one.
    """

    angular_radius_rad: ClassVar[float] = SUN_RADIUS_RAD
    read_keys: ClassVar[tuple[str, ...]] = ("place", "time")

    example: ClassVar[str] = "{azimuth: 30 deg, elevation: 40 deg, irradiance: 0.287 W/m^2/nm}"

    azimuth_rad: Angle
    elevation_rad: Annotated[Angle, Field(gt=0, le=math.pi / 2)]
    irradiance_w_per_m3: _Irradiance | None = None
    air: Air | None = None
    day_of_year: Annotated[int, Field(ge=1, le=366)] | None = None
    clouds: Annotated[Fraction, Field(ge=0, le=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _stand(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or (data.get("place") is None and data.get("time") is None):
            return data
        cls.check_keys(data)
        if data.get("place") is None or data.get("time") is None:
            raise ValueError(f"'place' and 'time' go together, such as place: {Place.example}")
        known = [key for key in ("azimuth", "elevation", "day_of_year") if data.get(key) is not None]
        if known:
            raise ValueError(f"{shown(known[0])} follows from 'place' and 'time'; write it or these")
        place, time = Place.model_validate(data["place"]), _time(data["time"])
        position = sun_position(place.latitude_rad, place.longitude_rad, time)
        if position.elevation_rad <= 0.0:
            raise ValueError(
                f"at {time.isoformat()} the sun stands {math.degrees(-position.elevation_rad):.1f} deg below "
                "the horizon there; take another time, or leave 'sun' out"
            )
        others = {key: value for key, value in data.items() if key not in ("place", "time")}
        azimuth_rad = place.north_rad - position.from_north_rad
        return {
            **others,
            "azimuth": f"{azimuth_rad!r} rad",
            "elevation": f"{position.elevation_rad!r} rad",
            "day_of_year": time.timetuple().tm_yday,
        }

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        if (self.irradiance_w_per_m3 is None) == (self.air is None):
            raise ValueError(
                "wanted one of 'irradiance', such as 0.287 W/m^2/nm, and 'air', such as g173, which gives it"
            )
        return self

    @property
    def direction(self) -> Direction:
        """Unit vector towards the sun's centre, in the world."""
        flat = math.cos(self.elevation_rad)
        return (
            flat * math.cos(self.azimuth_rad),
            flat * math.sin(self.azimuth_rad),
            math.sin(self.elevation_rad),
        )

    @property
    def passed(self) -> float:
        """The share of its light that clouds let through."""
        return 1.0 if self.clouds is None else self.clouds


class Sky(Document):
    """The sky, bright over directions as one of the fifteen of CIE S 011, by its number.

    1 overcast, 5 even, 8 partly cloudy, 12 clear, 13 clear over a town, 15 hazy white-blue; the sun says
    where it is brightest. What it brings to a horizontal plane is what the sun's `air` scatters, or an
    `irradiance`, the spectral one at 940 nm, taken as flat; times `clouds`, a factor of one's own.
    """

    example: ClassVar[str] = "{cie: 12}"

    cie: Annotated[int, Field(ge=1, le=15)] = 12
    irradiance_w_per_m3: _Irradiance | None = None
    clouds: Annotated[Fraction, NotNegative] = 1.0


class Skylight(Document):
    """A sky under its sun: what its light follows from."""

    sky: Sky
    sun: Sun


def _time(text: Any) -> datetime:
    example = "'2026-06-21T12:00:00+02:00'"
    try:
        time = text if isinstance(text, datetime) else datetime.fromisoformat(str(text))
    except ValueError:
        raise ValueError(f"{shown(text)} is no time; write it such as {example}") from None
    if time.tzinfo is None:
        raise ValueError(f"{shown(str(text))} names no time zone; write it such as {example}")
    return time
