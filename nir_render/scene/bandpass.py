"""The model of a narrowband filter."""

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nir_render.scene.base import PresetDocument
from nir_render.scene.fields import Positive
from nir_render.scene.units import Angle, Fraction, Length


class Bandpass(PresetDocument):
    """An interference filter, in front of the lens or behind it.

    `centre` and `fwhm` hold at normal incidence, `effective_index` sets the blue shift with the angle
    (PHYSICS: λ_c(θ) = λ_0 √(1 − (sin θ / n_eff)²)), `cavities` how steep its flanks are (1: Lorentzian),
    `blocking_od` the optical density out of band. Behind the lens the angle is that of the chief ray, linear
    in image height up to `chief_ray_angle_at_corner`, averaged over the lens's cone; in front of it, the
    field angle.
    """

    preset_folder: ClassVar[str] = "filters"

    placement: Literal["behind_lens", "in_front_of_lens"]
    centre_m: Annotated[Length, Positive]
    fwhm_m: Annotated[Length, Positive]
    peak_transmission: Annotated[Fraction, Field(gt=0, le=1)]
    effective_index: Annotated[float, Field(ge=1)]
    cavities: Annotated[int, Field(ge=1, le=10)] = 3
    blocking_od: Annotated[float, Positive]
    chief_ray_angle_at_corner_rad: Annotated[Angle, Field(ge=0, lt=math.pi / 2)] = 0.0
