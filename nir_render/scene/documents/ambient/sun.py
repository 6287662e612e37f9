"""The model of the sun."""

import math
from typing import Annotated, ClassVar

from pydantic import Field

from nir_render.scene.documents.base import Angle, Direction, Document, Positive, SpectralIrradiance


class Sun(Document):
    """The sun: `azimuth` from world x towards y, `elevation` above the horizon.

    `irradiance` is its spectral irradiance across its direction, at 940 nm: 0.305 W/m²/nm by ASTM G173
    (global), which has 3.05 W/m² from 935 to 945 nm. Over the rest of what silicon sees the spectrum is taken
    as flat; assumed.
    """

    angular_radius_rad: ClassVar[float] = math.radians(0.2666)

    example: ClassVar[str] = "{azimuth: 30 deg, elevation: 40 deg, irradiance: 0.305 W/m^2/nm}"

    azimuth_rad: Angle
    elevation_rad: Annotated[Angle, Field(gt=0, le=math.pi / 2)]
    irradiance_w_per_m3: Annotated[SpectralIrradiance, Positive]

    @property
    def direction(self) -> Direction:
        """Unit vector towards the sun's centre, in the world."""
        flat = math.cos(self.elevation_rad)
        return (
            flat * math.cos(self.azimuth_rad),
            flat * math.sin(self.azimuth_rad),
            math.sin(self.elevation_rad),
        )
