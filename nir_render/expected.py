"""Light to the noise-free frame: the mean number of electrons in each pixel, and whose they are.

All that takes long is done once for a light: `rates` are the electrons per second that it brings, everything
that shines fully lit. A frame is their weighted sum: drives and the shutter act on what falls on a row of
pixels, behind lens and point spread, so emitters of one drive share an image.
"""

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.apertures import Aperture, flare_aperture
from nir_render.camera.drive import drive_of
from nir_render.camera.emission import Emitter, emission_units
from nir_render.camera.enlarge import enlarge
from nir_render.camera.exposure import Beam, beam_window, blur, diffuse_electrons
from nir_render.camera.lens import intrinsics_of
from nir_render.camera.psf import Window
from nir_render.camera.response import response
from nir_render.camera.shutter import mid_exposure_s, row_profile
from nir_render.camera.veil import veil
from nir_render.errors import InputError
from nir_render.geometry import sunflower
from nir_render.scene.devices import Camera
from nir_render.scene.drive import FULL_DRIVE, Drive
from nir_render.scene.load import Scene
from nir_render.scene.world import Lamp, Sun
from nir_render.transport.light import Indirect, Light


@dataclass(frozen=True, eq=False)
class Rates:
    """What a light brings in a second, whatever the exposure: everything that is not constant fully lit.

    Attributes
    ----------
    drives
        The unlike drives of all that shines; what is constant is one, its level is in the rates.
    drive
        Index into `drives` of each group, shape (groups,).
    images
        Electrons per second of all but the windows, by drive: float32, which keeps 1e-7 of a sum of eight,
        shape (drives, rows, columns). None where nothing reaches the frame but the windows.
    windows
        Electrons per second that each row of the light's direct table brings.
    centre_row
        The row of pixels of each window's centre, the nearest one where it is outside, shape (n,).
    """

    light: Light
    scene: Scene
    drives: tuple[Drive, ...]
    drive: NDArray[np.int64]
    images: NDArray[np.float32] | None
    windows: tuple[Window, ...]
    centre_row: NDArray[np.int64]

    @property
    def camera(self) -> Camera:
        """The camera that the light reaches."""
        return self.scene.camera(self.light.camera)[1]

    @cached_property
    def scattered(self) -> tuple[NDArray[np.float64], ...]:
        """Electrons per second that each window's own group brings there indirectly, the windows' shapes."""
        found = [np.zeros_like(window.values) for window in self.windows]
        for group in np.unique(self.light.direct.group) if self.light.indirect is not None else ():
            of_group = np.flatnonzero(self.light.direct.group == group)
            rows = [row for row in of_group if self.windows[row].values.any()]
            image = self.group_image(int(group)) if rows else None
            for row in rows:
                assert image is not None  # noqa: S101
                found[row] = image[place_of(self.windows[row])].copy()
        return tuple(found)

    def group_image(self, group: int) -> NDArray[np.float64]:
        """Return the electrons per second that one group's indirect light brings, shape (rows, columns)."""
        only = np.zeros(len(self.light.groups))
        only[group] = fluxes(self.light, self.scene)[group]
        return _blurred(self.light, self.scene, only)


@dataclass(frozen=True, eq=False)
class Expected:
    """A noise-free frame.

    Attributes
    ----------
    time_s
        When row 0 begins its exposure.
    electrons
        Mean photoelectrons per pixel, shape (rows, columns).
    windows
        The part of it that each row of the light's direct table brings.
    profiles
        What each row of pixels collects of each of the rates' drives, relative to the exposure at full drive,
        shape (drives, rows).
    """

    light: Light
    rates: Rates
    exposure_s: float
    time_s: float
    electrons: NDArray[np.float64]
    windows: tuple[Window, ...]
    profiles: NDArray[np.float64]

    @property
    def levels(self) -> NDArray[np.float64]:
        """What the frame collects of each group, relative to the exposure at full drive, shape (groups,)."""
        return np.asarray(self.profiles.mean(axis=1)[self.rates.drive])

    def scattered(self, row: int) -> NDArray[np.float64]:
        """Return the electrons in a window that its own group brings indirectly, the window's shape."""
        return np.asarray(self.rates.scattered[row] * self._weights(row)[:, None])

    def _weights(self, row: int) -> NDArray[np.float64]:
        return _window_weights(self.rates, row, self.profiles * self.exposure_s)


def expected_electrons(light: Light, scene: Scene, exposure_s: float | None = None) -> NDArray[np.float64]:
    """Return the noise-free frame: mean photoelectrons per pixel, shape (rows, columns).

    The light's time is mid-exposure. Without `exposure_s` the camera's own exposure is used.
    """
    _, camera = scene.camera(light.camera)
    return expected(light, scene, camera.exposure_s if exposure_s is None else exposure_s).electrons


def expected(light: Light, scene: Scene, exposure_s: float, time_s: float | None = None) -> Expected:
    """Return the noise-free frame of an exposure, and what it is made of.

    `time_s` is when row 0 begins; without it the light's time is mid-exposure.
    """
    return exposed(rates(light, scene), exposure_s, time_s)


def rates(light: Light, scene: Scene) -> Rates:
    """Return what a light brings in a second: all that takes long, once for many exposures.

    Raises
    ------
    InputError
        The light is not finite.
    """
    _, camera = scene.camera(light.camera)
    known = [_drive_of_rates(emitter) for emitter in _emitters(light, scene)]
    drives = tuple(dict.fromkeys(known))
    drive = np.array([drives.index(one) for one in known], dtype=np.int64)
    windows = tuple(_windows(light, scene, camera))
    images = _images(light, scene, drive, len(drives), windows)
    parts = [window.values for window in windows] + ([] if images is None else [images])
    if not all(np.isfinite(part).all() for part in parts):
        raise InputError(
            f"{scene.path}: the light of {light.camera} is not finite; a body or source is degenerate"
        )
    v_px = intrinsics_of(camera).project(light.direct.direction)[:, 1]
    nearest = np.clip(np.nan_to_num(v_px), 0, camera.sensor.rows - 1)
    return Rates(light, scene, drives, drive, images, windows, np.rint(nearest).astype(np.int64))


def exposed(rates: Rates, exposure_s: float, time_s: float | None = None) -> Expected:
    """Return the noise-free frame of one exposure; arguments as of `expected`."""
    camera = rates.camera
    _check(exposure_s)
    if time_s is None:
        time_s = rates.light.time_s - mid_exposure_s(camera, exposure_s)
    if not np.isfinite(time_s):
        raise InputError(f"time_s is {time_s!r}; wanted seconds")
    profiles = [row_profile(camera, drive, time_s, exposure_s) for drive in rates.drives]
    return _summed(rates, exposure_s, time_s, profiles)


def fully_lit(rates: Rates, exposure_s: float) -> Expected:
    """Return the noise-free frame of an exposure in which everything that is not constant is fully lit."""
    _check(exposure_s)
    return _summed(rates, exposure_s, 0.0, [np.ones(rates.camera.sensor.rows) for _ in rates.drives])


def _check(exposure_s: float) -> None:
    if not (np.isfinite(exposure_s) and exposure_s > 0):
        raise InputError(f"exposure_s is {exposure_s!r}; wanted seconds greater than 0")


def _summed(rates: Rates, exposure_s: float, time_s: float, of_drives: list[NDArray[np.float64]]) -> Expected:
    sensor = rates.camera.sensor
    profiles = np.reshape(of_drives, (len(of_drives), sensor.rows))
    weights = exposure_s * profiles
    if rates.images is None:
        electrons = np.zeros((sensor.rows, sensor.columns))
    else:
        summed = np.einsum("dr,drc->rc", weights.astype(np.float32), rates.images)
        electrons = summed.astype(np.float64)
    windows = tuple(_driven(rates, row, weights) for row in range(len(rates.windows)))
    for window in windows:
        window.add_to(electrons)
    return Expected(rates.light, rates, exposure_s, time_s, electrons, windows, profiles)


def _driven(rates: Rates, row: int, weights: NDArray[np.float64]) -> Window:
    """Return a window of rates, weighted; what of its total lies elsewhere counts as its centre's row."""
    window = rates.windows[row]
    values = window.values * _window_weights(rates, row, weights)[:, None]
    beyond = window.total - float(window.values.sum())
    of_centre = float(weights[_drive_of_window(rates, row), rates.centre_row[row]])
    return replace(window, values=values, total=float(values.sum()) + beyond * of_centre)


def _window_weights(rates: Rates, row: int, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights, shape (drives, rows), that hold for the rows of a window."""
    return weights[_drive_of_window(rates, row), place_of(rates.windows[row])[0]]


def place_of(window: Window) -> tuple[slice, slice]:
    """Return the rows and the columns of pixels that a window lies on."""
    rows, columns = window.values.shape
    return slice(window.row, window.row + rows), slice(window.column, window.column + columns)


def _drive_of_window(rates: Rates, row: int) -> int:
    return int(rates.drive[rates.light.direct.group[row]])


def _drive_of_rates(emitter: Emitter) -> Drive:
    drive = drive_of(emitter)
    return drive if drive.constant is None else FULL_DRIVE


def flare_apertures(light: Light, camera: Camera) -> list[Aperture]:
    """Return the apertures of what the direct table shows in the frame: sources, the sun, their ghosts."""
    table = light.direct
    shown = (
        flare_aperture(camera, table.direction[row], float(table.angular_radius_rad[row]))
        for row in np.flatnonzero(table.irradiance_per_w[:, 0] > 0.0)
    )
    return [aperture for aperture in shown if aperture is not None]


def _emitters(light: Light, scene: Scene) -> list[Emitter]:
    """Return what each group of a light is."""
    known = scene.emitters()
    return [known[name] for name in light.groups]


def fluxes(light: Light, scene: Scene) -> NDArray[np.float64]:
    """Return how many units of emission each group sends, shape (groups,).

    A constant one at its level, any other fully lit.
    """
    return np.array([_lit_units(emitter) for emitter in _emitters(light, scene)])


def _lit_units(emitter: Emitter) -> float:
    level = drive_of(emitter).constant
    return emission_units(emitter) * (1.0 if level is None else level)


def _spectrum_key(emitter: Emitter) -> Hashable:
    if isinstance(emitter, Sun):
        return "sun"
    return emitter.temperature_k if isinstance(emitter, Lamp) else emitter.spectrum


def _images(
    light: Light, scene: Scene, drive: NDArray[np.int64], drives: int, windows: tuple[Window, ...]
) -> NDArray[np.float32] | None:
    """Return the electrons per second on the sensor, all but the windows, by drive; None where none are.

    They are the indirect light, and what glare and ghosts bring of it and of the windows.
    """
    _, camera = scene.camera(light.camera)
    veiled = camera.point_spread.core_share < 1.0
    if light.indirect is None and not veiled:
        return None
    flux = fluxes(light, scene)
    images = np.empty((drives, camera.sensor.rows, camera.sensor.columns), dtype=np.float32)
    for number in range(drives):
        image = _blurred(light, scene, np.where(drive == number, flux, 0.0))
        if veiled:
            core = image.copy()
            for row in np.flatnonzero(drive[light.direct.group] == number):
                windows[row].add_to(core)
            image += veil(camera, core)
        images[number] = image
    return images


def _blurred(light: Light, scene: Scene, flux: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the electrons per second of indirect light of groups of given fluxes, never below 0."""
    _, camera = scene.camera(light.camera)
    if light.indirect is None:
        return np.zeros((camera.sensor.rows, camera.sensor.columns))
    image = blur(camera, diffuse_image(light, light.indirect, scene, flux, 1.0))
    return np.asarray(np.maximum(image, 0.0))  # what is enlarged along edges can dip below


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


def _windows(light: Light, scene: Scene, camera: Camera) -> list[Window]:
    """Return the electrons per second of each row of the direct table."""
    known, flux = _emitters(light, scene), fluxes(light, scene)
    table = light.direct
    windows = []
    for row, group in enumerate(table.group):
        direction, angular_radius_rad = table.direction[row], float(table.angular_radius_rad[row])
        seen = None
        if 0.0 < table.visible_fraction[row] < 1.0:
            seen = sunflower(direction, angular_radius_rad, table.visibility_rays)[table.seen[row]]
        beam = Beam(
            direction=direction,
            angular_radius_rad=angular_radius_rad,
            irradiance_w_per_m2=float(table.irradiance_per_w[row, 0]) * float(flux[group]),
            response=response(camera, known[group]),
            seen=seen,
            distance_m=float(table.distance_m[row]),
        )
        windows.append(beam_window(camera, beam, 1.0))
    return windows
