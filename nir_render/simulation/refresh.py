"""Indirect light while things move: rendered at some times, and interpolated between them.

Direct light is reckoned anew for every frame: it is closed form. Indirect light takes long, and changes
slowly: between two renders it is interpolated linearly, pixel by pixel, as electrons behind the lens. How far
that is off is measured by a render that is held out, near the middle of two others, where it is largest. Not
in the middle: what goes round and round could be in its place there each time.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.diffuse_images import images_of
from nir_render.camera.mean_frame import (
    Rates,
    electron_rates,
    fully_lit_frame,
)
from nir_render.camera.optics.apertures import flare_aperture
from nir_render.camera.render_noise import (
    aperture_variances_e2,
    temporal_variance_e2,
    variance_behind_lens_e2,
)
from nir_render.camera.timing.exposure_control import own_setting
from nir_render.camera.timing.shutter import mid_exposure_s
from nir_render.scene.scene import Scene
from nir_render.transport.cache import LightCache

FLARE_SHARE = 0.002
"""Of any flare's flux, what interpolating may add or take away: a thousandth of its range."""

HELD_OUT = 0.381966
"""Where in an interval, by the golden section: the error there is 0.94 of that in the middle."""

_LONGEST_S = 2.0
_FRAMES = 1.5  # shorter intervals save nothing
_MEASURED_EACH = 8  # of so many intervals of a given length, the error of one is measured
_SIGMAS = 2.0  # render noise in a flare's aperture is not the error of interpolating


@dataclass(frozen=True)
class RefreshError:
    """How far interpolated light was off a render between two others.

    Attributes
    ----------
    apart_s
        From one of the two renders to the other.
    mean_share
        Mean square of the error over the mean temporal variance of the frame, shot plus read noise, the noise
        of rendering taken off: so a share near nothing can come out slightly negative.
    flare_share
        The largest error of the sum over a flare's aperture, over its own flux; 0 where none is seen.
    flare_sigma
        The noise of rendering in that.
    """

    camera: str
    time_s: float
    apart_s: float
    mean_share: float
    flare_share: float
    flare_sigma: float

    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        return asdict(self)

    def keeps(self, share: float) -> bool:
        """Tell whether a share of temporal variance is kept, and `FLARE_SHARE` of every flare."""
        return self.mean_share <= share and self.flare_share <= FLARE_SHARE + _SIGMAS * self.flare_sigma


class Refreshed:
    """The rates of each camera over time, which goes on: what lies before an interval is forgotten.

    With `render.indirect.every` light is rendered so often. With `render.indirect.error` intervals of
    two seconds are parted, by the golden section, until the error held out there is kept, down to the time of
    a frame; then both parts are used.
    """

    def __init__(self, scene: Scene, seed: int, cache: LightCache) -> None:
        """Begin with nothing rendered; `cache` keeps what is."""
        settings, clock = scene.document.render.indirect, scene.document.clock
        self._scene, self._seed, self._cache = scene, seed, cache
        self._every_s, self._share = settings.every_s, settings.error
        self._period_s = 1.0 / clock.frame_rate_hz
        self._longest_s = settings.every_s or max(_LONGEST_S, self._period_s)
        self._begin_s, self._lasts_s = clock.start_s, clock.frames * self._period_s
        self._known: dict[str, dict[float, Rates]] = {}
        self._kept: dict[tuple[str, float, float], bool] = {}
        self._measured: list[RefreshError] = []
        self._built: dict[float, dict[Hashable, Any]] = {}

    def measured(self) -> list[RefreshError]:
        """Return the errors that were measured since this was last asked."""
        measured, self._measured = self._measured, []
        return measured

    def rates_at(self, name: str, time_s: float) -> Rates:
        """Return what the light that reaches a camera at a time brings in a second."""
        begin_s, end_s = self._interval_s(name, time_s)
        if end_s - begin_s < _FRAMES * self._period_s or time_s <= begin_s:
            return self._at(name, time_s)
        part = min((time_s - begin_s) / (end_s - begin_s), 1.0)
        first, last = self._at(name, begin_s), self._at(name, end_s)
        snapshot = self._scene.at(time_s)
        if first is last and self._still(name, begin_s, end_s, time_s):
            return first
        from nir_render.transport.render import direct_light

        direct = electron_rates(direct_light(snapshot, name, self._seed), snapshot)
        return rates_between(direct, ((1.0 - part, first), (part, last)))

    def _interval_s(self, name: str, time_s: float) -> tuple[float, float]:
        """Return the times of the renders around a time; forget what lies before them."""
        _, camera = self._scene.camera(name)
        zero_s = self._begin_s + mid_exposure_s(camera, own_setting(camera, 0).exposure_s)
        number = max(math.floor((time_s - zero_s) / self._longest_s), 0)
        begin_s, end_s = (zero_s + count * self._longest_s for count in (number, number + 1))
        end_s = max(min(end_s, zero_s + self._lasts_s), time_s)
        known = self._known.setdefault(name, {})
        for old_s in [one for one in known if one < begin_s]:
            del known[old_s]
        self._kept = {key: kept for key, kept in self._kept.items() if key[0] != name or key[2] > begin_s}
        if self._share is not None:
            return self._parted_s(name, begin_s, end_s, time_s, self._share)
        if number % _MEASURED_EACH == 0 and end_s - begin_s >= _FRAMES * self._period_s:
            self._keeps(name, begin_s, end_s, 0.0)
        return begin_s, end_s

    def _parted_s(
        self, name: str, begin_s: float, end_s: float, time_s: float, share: float
    ) -> tuple[float, float]:
        """Return the part of an interval, around a time, in which the error is kept."""
        if end_s - begin_s < _FRAMES * self._period_s:
            return begin_s, end_s
        middle_s = 0.5 * (begin_s + end_s)
        half = (begin_s, middle_s) if time_s < middle_s else (middle_s, end_s)
        return (
            half if self._keeps(name, begin_s, end_s, share) else self._parted_s(name, *half, time_s, share)
        )

    def _keeps(self, name: str, begin_s: float, end_s: float, share: float) -> bool:
        """Measure the error within an interval, once, and tell whether it is small enough."""
        key = (name, begin_s, end_s)
        if key not in self._kept:
            held_out_s = begin_s + HELD_OUT * (end_s - begin_s)
            first, held_out, last = (self._at(name, time_s) for time_s in (begin_s, held_out_s, end_s))
            error = interpolation_error(first, last, held_out, (begin_s, held_out_s, end_s))
            self._measured.append(error)
            self._kept[key] = error.keeps(share)
        return self._kept[key]

    def _still(self, name: str, *times_s: float) -> bool:
        from nir_render.transport.render import geometry_of

        return len({geometry_of(self._scene.at(time_s), name) for time_s in times_s}) == 1

    def _at(self, name: str, time_s: float) -> Rates:
        """Return the rates of a light that is rendered, those that are known where it is the same light."""
        known = self._known.setdefault(name, {})
        if time_s not in known:
            from nir_render.transport.render import render  # Mitsuba loads only where light is rendered

            snapshot = self._scene.at(time_s)
            light = render(snapshot, name, self._seed, self._cache, built_at(self._built, time_s))
            same = [
                rates
                for rates in known.values()
                if rates.light.indirect is light.indirect and rates.light.direct is light.direct
            ]
            known[time_s] = same[-1] if same else electron_rates(light, snapshot)
        return known[time_s]


def built_at(built: dict[float, dict[Hashable, Any]], time_s: float) -> dict[Hashable, Any]:
    """Return what is built of the world at a time, for all cameras; what is of another time goes."""
    if time_s not in built:
        built.clear()
    return built.setdefault(time_s, {})


def interpolation_error(
    first: Rates, last: Rates, held_out: Rates, times_s: tuple[float, float, float]
) -> RefreshError:
    """Return how far what is interpolated between two lights is off a third one, all fully lit.

    Their times are those of the first, of the one held out, and of the last. It counts for the camera's own
    exposure.
    """
    camera, light = held_out.camera, held_out.light
    exposure_s = own_setting(camera, 0).exposure_s
    begin_s, time_s, end_s = times_s
    part = (time_s - begin_s) / (end_s - begin_s)
    of = ((1.0 - part, first), (part, last), (-1.0, held_out))
    frame = fully_lit_frame(held_out, exposure_s)
    error_e = np.zeros(frame.electrons.shape)
    noise_e2 = 0.0
    for weight, rates in of:
        images = indirect_images(rates)
        if images is not None:
            error_e += weight * exposure_s * images.sum(axis=0, dtype=np.float64)
            noise_e2 += (weight * exposure_s) ** 2 * float(variance_behind_lens_e2(rates).sum())
    worst, sigma = 0.0, 0.0
    for row in light.direct.shining:
        aperture = flare_aperture(
            camera, light.direct.direction[row], float(light.direct.angular_radius_rad[row])
        )
        flux_e = frame.windows[row].total
        if aperture is None or not flux_e > 0.0:
            continue
        share = abs(aperture.sum(error_e)) / flux_e
        if share >= worst:
            variance_e2 = [
                weight**2 * aperture_variances_e2(one.light, one.snapshot, exposure_s, [aperture])[0]
                for weight, one in of
            ]
            worst, sigma = share, math.sqrt(sum(variance_e2)) / flux_e
    return RefreshError(
        camera=light.camera,
        time_s=time_s,
        apart_s=end_s - begin_s,
        mean_share=float(((error_e**2).sum() - noise_e2) / temporal_variance_e2(frame).sum()),
        flare_share=float(worst),
        flare_sigma=sigma,
    )


def rates_between(direct: Rates, ends: Sequence[tuple[float, Rates]]) -> Rates:
    """Return rates with the windows of some, without indirect light, and the indirect light of others.

    The others' weights add up to 1; the light is said to hold the indirect part of the heaviest.
    """
    images = None if direct.images is None else direct.images.copy()
    for weight, rates in ends:
        of_end = indirect_images(rates)
        if of_end is not None:
            part = of_end * np.float32(weight)
            images = part if images is None else np.add(images, part, out=images)
    nearest = max(ends, key=lambda end: end[0])[1].light
    light = replace(direct.light, indirect=nearest.indirect, short_pixels=nearest.short_pixels)
    return replace(direct, light=light, images=images, between=tuple(ends), kept={})


def indirect_images(rates: Rates) -> NDArray[np.float32] | None:
    """Return the part of the images that is indirect light, with its glare; None where there is none."""
    if rates.light.indirect is None or rates.camera.point_spread.core_share == 1.0:
        return rates.images
    if "indirect_images" not in rates.kept:
        light, snapshot, drives = rates.light, rates.snapshot, len(rates.drives)
        rates.kept["indirect_images"] = images_of(light, snapshot, rates.drive, drives, None)
    kept: NDArray[np.float32] | None = rates.kept["indirect_images"]
    return kept
