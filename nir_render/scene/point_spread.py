"""The model of how far a camera spreads the light of a point."""

from typing import Annotated

from pydantic import Field

from nir_render.scene.base import Document
from nir_render.scene.units import Pixels


class PointSpread(Document):
    """A Gaussian point spread function in the image, without the pixel's own aperture."""

    sigma_px: Annotated[Pixels, Field(ge=0.3, le=20)]
