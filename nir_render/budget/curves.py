"""A source against range: electrons, those of the brightest pixel, and the σ of its range by cause."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from nir_render.budget.assumptions import Assumptions
from nir_render.budget.causes import Flare, range_error
from nir_render.budget.exposures import Exposure, clip_e
from nir_render.budget.flares import (
    RANGES_M,
    Place,
    Saturation,
    brightest_e_per_s,
    flux_e_per_s,
    largest_relative_intensity,
    saturation,
)
from nir_render.camera.timing.exposure_control import Setting
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.simulation.flare_spread import flare_spread
from perception.types import Calibration

_NEAREST_RADII = 2.0


@dataclass(frozen=True)
class Curve:
    """A source against range in one direction, at one exposure; lists are along `range_m`.

    Electrons are those of a source that is fully lit, of its mean intensity Φ/4π, through the scene's fog all
    the way, and so is `saturation`; a robot that turns its brightest side to the camera clips from
    `saturation_at_largest_intensity` on. `brightest_pixel_e` holds the background and the dark current too.
    None is what cannot be ranged.
    """

    exposure: str
    place: Place
    saturation: Saturation
    saturation_at_largest_intensity: Saturation
    range_m: tuple[float, ...]
    exposure_s: tuple[float, ...]
    gain: tuple[float, ...]
    electrons_e: tuple[float, ...]
    brightest_pixel_e: tuple[float, ...]
    saturated: tuple[bool, ...]
    range_limit_m: tuple[float | None, ...]
    range_sigma_m: tuple[float | None, ...]
    causes_m: Mapping[str, tuple[float | None, ...]]


def curve_of(
    camera: Camera,
    source: Source,
    known: Calibration,
    exposure: Exposure,
    place: Place,
    background_e_per_s: float,
    extinction_per_m: float,
    assumed: Assumptions,
) -> Curve:
    """Return a source at `RANGES_M`, from twice its radius on, in one direction and at one exposure."""
    dark_e_per_s = camera.sensor.dark_rate_e_per_s
    others_e_per_s = background_e_per_s + dark_e_per_s
    share = flare_spread(camera, source.of_its_type).share
    ranges_m = [range_m for range_m in RANGES_M if range_m >= _NEAREST_RADII * source.radius_m]
    settings: list[Setting] = []
    electrons_e, brightest_e, errors = [], [], []
    for range_m in ranges_m:
        passed = math.exp(-extinction_per_m * range_m)
        peak = passed * brightest_e_per_s(camera, source, place.u_px, place.v_px, range_m) + others_e_per_s
        setting = exposure.setting(camera, peak)
        flux_e = passed * flux_e_per_s(camera, source, place.field_angle_rad, range_m) * setting.exposure_s
        flare = Flare(
            place.u_px,
            place.v_px,
            place.field_angle_rad,
            range_m,
            share * flux_e,
            background_e_per_s * setting.exposure_s,
            dark_e_per_s * setting.exposure_s,
        )
        settings.append(setting)
        electrons_e.append(flux_e)
        brightest_e.append(peak * setting.exposure_s)
        errors.append(range_error(camera, source, known, setting.gain, flare, assumed))
    clipping = partial(
        saturation, camera, source, place, exposure.shortest(camera), others_e_per_s, extinction_per_m
    )
    causes = next((list(error.causes_m) for error in errors if error is not None), [])
    return Curve(
        exposure=exposure.name,
        place=place,
        saturation=clipping(),
        saturation_at_largest_intensity=clipping(largest_relative_intensity(source)),
        range_m=tuple(ranges_m),
        exposure_s=tuple(setting.exposure_s for setting in settings),
        gain=tuple(setting.gain for setting in settings),
        electrons_e=tuple(electrons_e),
        brightest_pixel_e=tuple(brightest_e),
        saturated=tuple(
            light_e >= clip_e(camera, setting.gain)
            for light_e, setting in zip(brightest_e, settings, strict=True)
        ),
        range_limit_m=tuple(None if error is None else error.limit_m for error in errors),
        range_sigma_m=tuple(None if error is None else error.sigma_m for error in errors),
        causes_m={
            cause: tuple(None if error is None else error.causes_m[cause] for error in errors)
            for cause in causes
        },
    )
