"""From a scene to the light that reaches one camera."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.emission import emission_units
from nir_render.camera.enlarge import Enlargement, part_of
from nir_render.camera.response import response
from nir_render.errors import InputError
from nir_render.scene.checks import indivisible_sensor, solid_around
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose
from nir_render.transport import groups, noise, stock, world
from nir_render.transport.backend import backend
from nir_render.transport.cache import LightCache
from nir_render.transport.direct import direct_table
from nir_render.transport.facets import facets
from nir_render.transport.kernel.tables import World
from nir_render.transport.key import Sampled, Site, geometry_key, light_key, plan_key, versions
from nir_render.transport.light import DirectTable, Indirect, Light
from nir_render.transport.sharpen import enlargement_of, flare_pilot, sharpened

_STEP, _STEPS = 4, 6
_PILOT = "pilot"

Samples = NDArray[np.int64] | int


def render(scene: Scene, camera: str, time_s: float, seed: int, cache: LightCache | None = None) -> Light:
    """Return the light that reaches a camera, `robot.camera`, with the geometry at a time.

    What `cache` holds is not rendered again. Equal geometry gives equal bits at any time.

    Raises
    ------
    InputError
        No such camera, or the camera is inside a body.
    """
    work = _work(scene, camera, time_s, seed, cache)
    samples, short_pixels = work.samples()
    return replace(work.light(samples), time_s=time_s, seed=seed, short_pixels=short_pixels)


def mean_samples(scene: Scene, camera: str, time_s: float, seed: int) -> float:
    """Return how many samples a pixel of the film gets on average; 0 without indirect light.

    Errors as `render`.
    """
    samples, _ = _work(scene, camera, time_s, seed, None).samples()
    return 0.0 if samples is None else float(np.mean(samples))


def geometry_of(scene: Scene, camera: str, time_s: float) -> str:
    """Return the hash of the geometry that a camera sees at a time; errors as `render`."""
    return geometry_key(_work(scene, camera, time_s, 0, None).site)


@dataclass(frozen=True, eq=False)
class _Work:
    """The light of one camera at one time, to be found or rendered."""

    site: Site
    seed: int
    cache: LightCache

    def samples(self) -> tuple[Samples | None, int]:
        """Return the samples in each pixel of the film, None where there is no indirect light.

        And in how many pixels they are cut below what the target for the noise asks for.
        """
        document = self.site.scene.document
        share = document.render.noise
        if not document.has_indirect_light():
            return None, 0
        if share is None or not backend().vectorised:
            return stock.samples_of(self.site.scene), 0
        key = plan_key(self.site, self._geometry, self.seed, _made_by())
        given, wanted = self.cache.plan(key, lambda: self._planned(share))
        return given, int((given < wanted).sum())

    def light(self, samples: Samples | None) -> Light:
        """Return the light with so many samples in each pixel."""
        return self._kept(samples, lambda: self._light(self._indirect(samples)), counts=True)

    def _kept(self, samples: Sampled, rendered: Callable[[], Light], *, counts: bool) -> Light:
        made_by = _made_by()
        key = light_key(self.site, self._geometry, self.seed, self._power, samples, made_by)
        light = self.cache.get(key, counts=counts)
        if light is None:
            light = rendered()
            self.cache.put(key, light)
        return light

    def _planned(self, noise_share: float) -> NDArray[np.int64]:
        shape = groups.film_shape(self._rays, self.site.scene.document.render.indirect.scale)
        pilot = self._kept(_PILOT, self._pilot, counts=False)
        pixels = noise.flare_pixels(pilot, self.site.camera)
        flares = self._kept((_PILOT, pixels), lambda: self._flares(pixels), counts=False)
        return noise.samples_map(pilot, flares, self.site.scene, noise_share, shape)

    def _pilot(self) -> Light:
        site = self.site
        key = groups.light_seed(self.seed, "pilot", site.name, self._geometry)
        return self._light(groups.pilot(site.scene, self._rays, site.time_s, key, self._power))

    def _flares(self, pixels: NDArray[np.int64]) -> Light:
        site = self.site
        key = groups.light_seed(self.seed, "flares", site.name, self._geometry)
        how = part_of(self._enlargement, pixels)
        scale = site.scene.document.render.indirect.scale
        blocks = noise.flare_blocks(self._light(None), site.camera, scale, how)
        return self._light(flare_pilot(site.scene, self._built, self._rays, key, blocks, how))

    def _indirect(self, samples: Samples | None) -> Indirect | None:
        scene, time_s, name = self.site.scene, self.site.time_s, self.site.name
        key = groups.light_seed(self.seed, "indirect", name, self._geometry)
        if not backend().vectorised:
            return stock.indirect(scene, name, self.site.camera, self.site.pose, time_s, key, self._direct)
        light = groups.indirect(scene, self._rays, time_s, key, self._power, samples)
        if light is None:
            return None
        return sharpened(scene, self._built, self._rays, key, light, self._enlargement)

    def _light(self, indirect: Indirect | None) -> Light:
        site = self.site
        mirrors = facets(site.scene).name if backend().vectorised else ()
        groups_of_light = world.groups(site.scene)
        return Light(
            site.name, site.time_s, self.seed, groups_of_light, (940e-9,), self._direct, indirect, mirrors
        )

    @cached_property
    def _geometry(self) -> str:
        return geometry_key(self.site)

    @cached_property
    def _rays(self) -> groups.Rays:
        return groups.rays_of(self.site.camera, self.site.pose)

    @cached_property
    def _power(self) -> NDArray[np.float64]:
        return group_power(self.site.scene, self.site.camera)

    @cached_property
    def _built(self) -> World:
        return groups.world_on_device(self.site.scene, self.site.time_s, self._power)

    @cached_property
    def _enlargement(self) -> Enlargement:
        return enlargement_of(self._built, self._rays, self.site.scene.document.render.indirect.scale)

    @cached_property
    def _direct(self) -> DirectTable:
        site = self.site
        world.check_meshes(site.scene, site.pose.position_m, f"the camera {site.name} at {site.time_s:g} s")
        return direct_table(site.scene, site.pose, site.time_s, specular=backend().vectorised)


def _work(scene: Scene, camera: str, time_s: float, seed: int, cache: LightCache | None) -> _Work:
    """Return the work of a camera that stands where it can see; errors as `render`."""
    robot, device = scene.camera(camera)
    pose = camera_pose(robot, device, time_s)
    inside = solid_around(scene.document, pose.position_m)
    if inside is not None:
        raise InputError(
            f"{scene.path}: the camera {camera} is inside shapes.{inside} at {time_s:g} s; move one"
        )
    indivisible = indivisible_sensor(scene.document, camera)
    if indivisible is not None:
        raise InputError(f"{scene.path}: {indivisible}")
    site = Site(scene, camera, device, pose, time_s)
    return _Work(site, seed, LightCache() if cache is None else cache)


def _made_by() -> tuple[str, ...]:
    return versions(backend().variant, backend().compiler)


def group_power(scene: Scene, camera: Camera) -> NDArray[np.float64]:
    """Return what each group counts when lights are chosen: the electrons that it brings, roughly.

    In steps of 4 below the strongest: so a light is rendered anew seldom when a source's power, the spectrum
    or the filter change, which otherwise matter only afterwards. It moves nothing but noise.
    """
    known = scene.emitters().values()
    brought = np.array([emission_units(one) * float(response(camera, one)(0.0)) for one in known])
    strongest = brought.max() if brought.size else 1.0
    steps = np.round(np.log(np.maximum(brought, 1e-30) / max(strongest, 1e-30)) / np.log(_STEP))
    return np.asarray(float(_STEP) ** np.maximum(steps, -_STEPS))
