"""Light to the noise-free frame: the mean number of electrons in each pixel, and whose they are."""

from collections.abc import Hashable
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.apertures import Aperture, flare_aperture
from nir_render.camera.emission import Emitter, emission_units
from nir_render.camera.enlarge import enlarge
from nir_render.camera.exposure import Beam, beam_window, blur, diffuse_electrons
from nir_render.camera.psf import Window
from nir_render.camera.response import response
from nir_render.errors import InputError
from nir_render.geometry import sunflower
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.world import Lamp, Sun
from nir_render.transport.light import Indirect, Light


@dataclass(frozen=True, eq=False)
class Expected:
    """A noise-free frame.

    Attributes
    ----------
    electrons
        Mean photoelectrons per pixel, shape (rows, columns).
    windows
        The part of it that each row of the light's direct table brings.
    """

    light: Light
    exposure_s: float
    electrons: NDArray[np.float64]
    windows: tuple[Window, ...]


def expected_electrons(light: Light, scene: Scene, exposure_s: float | None = None) -> NDArray[np.float64]:
    """Return the noise-free frame: mean photoelectrons per pixel, shape (rows, columns).

    Without `exposure_s` the camera's own exposure is used.
    """
    _, camera = scene.camera(light.camera)
    return expected(light, scene, camera.exposure_s if exposure_s is None else exposure_s).electrons


def expected(light: Light, scene: Scene, exposure_s: float) -> Expected:
    """Return the noise-free frame of an exposure, and what it is made of."""
    if not (np.isfinite(exposure_s) and exposure_s > 0):
        raise InputError(f"exposure_s is {exposure_s!r}; wanted seconds greater than 0")
    _, camera = scene.camera(light.camera)
    electrons = np.zeros((camera.sensor.rows, camera.sensor.columns))
    flux = fluxes(light, scene)
    if light.indirect is not None:
        electrons += blur(camera, diffuse_image(light, light.indirect, scene, flux, exposure_s))
    windows = tuple(_windows(light, scene, camera, exposure_s))
    for window in windows:
        window.add_to(electrons)
    return Expected(light, exposure_s, np.maximum(electrons, 0.0), windows)


def flare_apertures(light: Light, camera: Camera) -> list[Aperture]:
    """Return the apertures of what the direct table shows in the frame: sources, the sun, their ghosts."""
    table = light.direct
    shown = (
        flare_aperture(camera, table.direction[row], float(table.angular_radius_rad[row]))
        for row in np.flatnonzero(table.irradiance_per_w[:, 0] > 0.0)
    )
    return [aperture for aperture in shown if aperture is not None]


def group_electrons(mean: Expected, scene: Scene, group: int) -> NDArray[np.float64]:
    """Return the electrons that one group's indirect light brings, shape (rows, columns)."""
    _, camera = scene.camera(mean.light.camera)
    if mean.light.indirect is None:
        return np.zeros_like(mean.electrons)
    only = np.zeros(len(mean.light.groups))
    only[group] = fluxes(mean.light, scene)[group]
    return blur(camera, diffuse_image(mean.light, mean.light.indirect, scene, only, mean.exposure_s))


def _emitters(light: Light, scene: Scene) -> list[Emitter]:
    """Return what each group of a light is."""
    known = scene.emitters()
    return [known[name] for name in light.groups]


def fluxes(light: Light, scene: Scene) -> NDArray[np.float64]:
    """Return how many units of emission each group sends, shape (groups,)."""
    return np.array([emission_units(emitter) for emitter in _emitters(light, scene)])


def _spectrum_key(emitter: Emitter) -> Hashable:
    if isinstance(emitter, Sun):
        return "sun"
    return emitter.temperature_k if isinstance(emitter, Lamp) else emitter.spectrum


def diffuse_image(
    light: Light, indirect: Indirect, scene: Scene, flux_w: NDArray[np.float64], exposure_s: float
) -> NDArray[np.float64]:
    """Return the electrons of indirect light before the blur; groups of one spectrum are summed first."""
    _, camera = scene.camera(light.camera)
    rows, columns = camera.sensor.rows, camera.sensor.columns
    image = np.zeros((rows, columns))
    edges = indirect.edges
    how = None if edges is None else edges.enlargement
    parts = by_spectrum(light, scene, indirect.radiance_per_w, flux_w)
    patches = [] if edges is None else by_spectrum(light, scene, edges.radiance_per_w, flux_w)
    for (emitter, radiance), patch in zip_longest(parts, (patch for _, patch in patches)):
        whole = enlarge(radiance, rows, columns, how, patch)
        image += diffuse_electrons(camera, whole, emitter, exposure_s)
    return image


def by_spectrum(
    light: Light, scene: Scene, per_group: NDArray[np.float32], weights: NDArray[np.float64]
) -> list[tuple[Emitter, NDArray[np.float64]]]:
    """Return weighted sums of arrays, shape (group, node, …), over the groups of each spectrum."""
    sums: dict[Hashable, tuple[Emitter, NDArray[np.float64]]] = {}
    for group, emitter in enumerate(_emitters(light, scene)):
        if weights[group] == 0.0:
            continue
        key = _spectrum_key(emitter)
        part = weights[group] * per_group[group, 0].astype(np.float64)
        sums[key] = (emitter, sums[key][1] + part if key in sums else part)
    return list(sums.values())


def _windows(light: Light, scene: Scene, camera: Camera, exposure_s: float) -> list[Window]:
    """Return the expected electrons of each row of the direct table."""
    known = _emitters(light, scene)
    table = light.direct
    windows = []
    for row, group in enumerate(table.group):
        emitter = known[group]
        direction, angular_radius_rad = table.direction[row], float(table.angular_radius_rad[row])
        seen = None
        if 0.0 < table.visible_fraction[row] < 1.0:
            seen = sunflower(direction, angular_radius_rad, table.visibility_rays)[table.seen[row]]
        beam = Beam(
            direction=direction,
            angular_radius_rad=angular_radius_rad,
            irradiance_w_per_m2=float(table.irradiance_per_w[row, 0]) * emission_units(emitter),
            response=response(camera, emitter),
            seen=seen,
        )
        windows.append(beam_window(camera, beam, exposure_s))
    return windows
