"""From a scene to the light that reaches one camera."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.apertures import pixels_around_flares
from nir_render.errors import InputError
from nir_render.light.averages import averages
from nir_render.light.enlarge import Enlargement, part_of, with_patch, without_edges
from nir_render.light.light import DirectTable, Indirect, Light
from nir_render.light.nodes import direct_over_nodes, indirect_over_nodes
from nir_render.scene.bodies import place_of_shape, solid_around
from nir_render.scene.checks import indivisible_sensor
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.nodes import BAND_M
from nir_render.transport.backend.variant import backend
from nir_render.transport.cache import LightCache
from nir_render.transport.cache_key import Sampled, Site, geometry_key, light_key, plan_key, versions
from nir_render.transport.direct.table import bodies_of, direct_table
from nir_render.transport.indirect import groups, sample_plan, stock
from nir_render.transport.indirect.averaging import Averaging, averaging_of
from nir_render.transport.indirect.enlargement import Labels
from nir_render.transport.indirect.guide import group_power
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.indirect.labels import labels_of
from nir_render.transport.indirect.sharpen import enlargement_of, flare_pilot, halo_reach_px, sharpened
from nir_render.transport.wavelengths import carried_wavelengths
from nir_render.transport.world import mitsuba_scene
from nir_render.transport.world.facets import facets

_PILOT = "pilot"

Samples = NDArray[np.int64] | int


def render(
    snapshot: Snapshot,
    camera: str,
    seed: int,
    cache: LightCache | None = None,
    kept: dict[Hashable, Any] | None = None,
) -> Light:
    """Return the light that reaches a camera, `robot.camera`, in the world at one time.

    What `cache` holds is not rendered again. Equal geometry gives equal bits at any time. In `kept`, which is
    the snapshot's, stays what is built of it, for its other cameras.

    Raises
    ------
    InputError
        No such camera, or the camera is inside a body.
    """
    rendering = _rendering(snapshot, camera, seed, cache, kept)
    samples, short_pixels = rendering.samples()
    light = rendering.light(samples)
    return replace(light, time_s=snapshot.time_s, seed=seed, short_pixels=short_pixels)


def direct_light(snapshot: Snapshot, camera: str, seed: int) -> Light:
    """Return the direct light alone that reaches a camera; errors as `render`. It is kept nowhere."""
    return _rendering(snapshot, camera, seed, None).direct_light()


def direct_lights(
    snapshot: Snapshot, cameras: Sequence[str], seed: int, kept: dict[Hashable, Any] | None = None
) -> dict[str, Light]:
    """Return the direct light alone that reaches each camera: the bits of `direct_light`, with less work.

    In `kept`, which is the snapshot's, stays what further cameras of it need too.
    """
    kept = {} if kept is None else kept
    return {name: _rendering(snapshot, name, seed, None, kept).direct_light() for name in cameras}


def mean_samples(snapshot: Snapshot, camera: str, seed: int) -> float:
    """Return how many samples a pixel of the film gets on average; all wavelengths share them.

    0 without indirect light. Errors as `render`.
    """
    rendering = _rendering(snapshot, camera, seed, None)
    samples, _ = rendering.samples()
    return 0.0 if samples is None else float(np.mean(samples))


def geometry_of(snapshot: Snapshot, camera: str) -> str:
    """Return the hash of the geometry that a camera sees; errors as `render`."""
    return geometry_key(_rendering(snapshot, camera, 0, None).site)


@dataclass(frozen=True, eq=False)
class _Rendering:
    """The light of one camera at one time, to be found or rendered; `kept` is built of the snapshot."""

    site: Site
    seed: int
    cache: LightCache
    wavelengths_m: tuple[float, ...]
    kept: dict[Hashable, Any]

    def samples(self) -> tuple[Samples | None, int]:
        """Return the samples in each pixel of the film, None where there is no indirect light.

        And in how many pixels they are cut below what the target for the noise asks for.
        """
        snapshot = self.site.snapshot
        share = snapshot.render.noise
        if not snapshot.has_indirect_light():
            return None, 0
        if share is None or not backend().vectorised:
            return stock.samples_of(snapshot.render.indirect), 0
        key = plan_key(self.site, self._geometry, self.seed, self._made_by)
        given, wanted = self.cache.plan(key, lambda: self._planned(share))
        return given, int((given < wanted).sum())

    def light(self, samples: Samples | None) -> Light:
        """Return the light with so many samples in each pixel."""
        return self._kept(samples, lambda: self._light(self._indirect(samples)), counts=True)

    def direct_light(self) -> Light:
        """Return the light without its indirect part."""
        return self._light(None)

    def _kept(self, samples: Sampled, rendered: Callable[[], Light], *, counts: bool) -> Light:
        made_by = self._made_by
        key = light_key(self.site, self._geometry, self.seed, self._power, samples, made_by)
        light = self.cache.get(key, counts=counts)
        if light is None:
            light = rendered()
            self.cache.put(key, light)
        return light

    def _planned(self, noise_share: float) -> NDArray[np.int64]:
        shape = groups.film_shape(self._rays, self.site.snapshot.render.indirect.scale)
        pilot = self._kept(_PILOT, self._pilot, counts=False)
        pixels = sample_plan.flare_pixels(pilot, self.site.camera)
        flares = self._kept((_PILOT, pixels), lambda: self._flares(pixels), counts=False)
        return sample_plan.samples_map(pilot, flares, self.site.snapshot, noise_share, shape)

    def _pilot(self) -> Light:
        key = groups.light_seed(self.seed, "pilot", self.site.name, self._geometry)
        averaging = self._averaging
        if averaging is not None:  # pixels that are rendered one by one count as they are
            scale = self.site.snapshot.render.indirect.scale
            averaging = averaging.without(self._enlargement.patch, self._enlargement.columns, scale)
        return self._light(groups.pilot(self.site.snapshot, self._built, self._rays, key, averaging))

    def _flares(self, pixels: NDArray[np.int64]) -> Light:
        site = self.site
        key = groups.light_seed(self.seed, "flares", site.name, self._geometry)
        enlargement = part_of(self._enlargement, pixels)
        scale = site.snapshot.render.indirect.scale
        averaging = self._averaging
        around = None if averaging is None else averages(averaging.surface)
        blocks = sample_plan.flare_blocks(self._light(None), site.camera, scale, enlargement, around)
        return self._light(
            flare_pilot(site.snapshot, self._built, self._rays, key, blocks, enlargement, averaging)
        )

    def _indirect(self, samples: Samples | None) -> Indirect | None:
        site = self.site
        if not site.snapshot.has_indirect_light():
            return None
        key = groups.light_seed(self.seed, "indirect", site.name, self._geometry)
        if not backend().vectorised:
            return indirect_over_nodes(
                [stock.indirect(world, site.name, key, self._direct) for world in self._worlds]
            )
        light = groups.indirect(
            site.snapshot,
            self._rays,
            key,
            self._power,
            samples,
            wavelengths_m=self.wavelengths_m,
            built=self._built,
            averaging=self._averaging,
        )
        if light is None:
            return None
        return sharpened(site.snapshot, self._built, self._rays, key, light, self._enlargement)

    def _light(self, indirect: Indirect | None) -> Light:
        site = self.site
        snapshot = site.snapshot
        return Light(
            camera=site.name,
            time_s=snapshot.time_s,
            seed=self.seed,
            groups=snapshot.groups,
            wavelengths_m=self.wavelengths_m,
            direct=self._direct,
            indirect=indirect,
            mirrors=facets(snapshot).name if backend().vectorised else (),
        )

    @cached_property
    def _geometry(self) -> str:
        return geometry_key(self.site)

    @property
    def _made_by(self) -> tuple[str, ...]:
        nodes = () if self.wavelengths_m == (BAND_M,) else (f"{self.wavelengths_m!r} m",)
        return (*versions(backend().variant, backend().compiler), *nodes)

    @cached_property
    def _worlds(self) -> list[Snapshot]:
        """The world as it is at each node."""
        return [self.site.snapshot.at_wavelength(wavelength_m) for wavelength_m in self.wavelengths_m]

    @cached_property
    def _rays(self) -> groups.Rays:
        return groups.rays_of(self.site.camera, self.site.pose)

    @cached_property
    def _power(self) -> NDArray[np.float64]:
        return group_power(self.site.snapshot, self.site.camera)

    @cached_property
    def _built(self) -> DeviceScene:
        key = self._power.tobytes(), self.wavelengths_m
        if key not in self.kept:
            self.kept[key] = groups.world_on_device(self.site.snapshot, self._power, self.wavelengths_m)
        return cast("DeviceScene", self.kept[key])

    @cached_property
    def _labels(self) -> Labels:
        return labels_of(self._built, self._rays.origin_m, self._rays.corners)

    @cached_property
    def _averaging(self) -> Averaging | None:
        snapshot, rays = self.site.snapshot, self._rays
        scale = snapshot.render.indirect.scale
        if snapshot.fog is None or scale == 1:
            return None
        return averaging_of(snapshot, self._labels, rays.origin_m, rays.corners, scale)

    @cached_property
    def _enlargement(self) -> Enlargement:
        site = self.site
        scale = site.snapshot.render.indirect.scale
        if scale == 1:
            return without_edges(*(count - 1 for count in self._rays.corners.shape[:2]))
        enlargement = enlargement_of(site.snapshot, self._labels, self._rays, scale)
        reach_px = halo_reach_px(site.snapshot, self._rays, scale)
        if reach_px == 0.0:
            return enlargement
        return with_patch(enlargement, pixels_around_flares(self._light(None), site.camera, reach_px))

    @cached_property
    def _direct(self) -> DirectTable:
        site = self.site
        snapshot, pose = site.snapshot, site.pose
        what = f"the camera {site.name} at {snapshot.time_s:g} s"
        mitsuba_scene.check_meshes(snapshot, pose.position_m, what)
        specular = backend().vectorised
        if "bodies" not in self.kept:
            self.kept["bodies"] = bodies_of(snapshot, specular=specular)
        bodies = self.kept["bodies"]
        tables = [direct_table(world, pose, specular=specular, bodies=bodies) for world in self._worlds]
        return direct_over_nodes(tables)


def _rendering(
    snapshot: Snapshot,
    camera: str,
    seed: int,
    cache: LightCache | None,
    kept: dict[Hashable, Any] | None = None,
) -> _Rendering:
    """Return the rendering for a camera that stands where it can see; errors as `render`."""
    placed = snapshot.camera(camera)
    inside = solid_around(snapshot.shapes, placed.pose.position_m)
    if inside is not None:
        raise InputError(
            f"{snapshot.origin}: the camera {camera} is inside {place_of_shape(inside)} at "
            f"{snapshot.time_s:g} s; move one"
        )
    if snapshot.has_indirect_light():
        indivisible = indivisible_sensor(camera, placed.camera.sensor, snapshot.render.indirect.scale)
        if indivisible is not None:
            raise InputError(f"{snapshot.origin}: {indivisible}")
    wavelengths_m = carried_wavelengths(snapshot, camera).wavelengths_m
    cache, kept = LightCache() if cache is None else cache, {} if kept is None else kept
    return _Rendering(Site(snapshot, camera), seed, cache, wavelengths_m, kept)
