"""The camera's conductor: all of a `Light` to the noise-free frame, and whose electrons are whose.

All that takes long is done once for a light: `rates` are the electrons per second that it brings, everything
that shines fully lit. A frame is their weighted sum: drives and the shutter act on what falls on a row of
pixels, behind lens and point spread, so emitters of one drive share an image.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.beams import Beam, beam_window
from nir_render.camera.by_spectrum import group_emitters, group_fluxes, row_response
from nir_render.camera.diffuse_images import Place, blurred_image, images_of, images_shared
from nir_render.camera.motion_blur import (
    STILL_PX,
    drawn_out,
    instants,
    may_move,
    moved_beam,
    path_of,
)
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.psf import Window, place_of
from nir_render.camera.timing.drive import drive_of
from nir_render.camera.timing.shutter import mid_exposure_s, row_profile
from nir_render.errors import InputError
from nir_render.geometry import sunflower
from nir_render.light.light import Light
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.times.drives import FULL_DRIVE, Drive
from nir_render.scene.emission import Emitter
from nir_render.scene.snapshot import Snapshot


@dataclass(frozen=True, eq=False)
class Rates:
    """What a light brings in a second, whatever the exposure: everything that is not constant fully lit.

    Attributes
    ----------
    snapshot
        The world whose light it is: the camera, and what shines.
    drives
        The unlike drives of all that shines; what is constant is one, its level is in the rates.
    drive
        Index into `drives` of each group, shape (groups,).
    images
        Electrons per second of all but the windows, by drive: float32, which keeps 1e-7 of a sum of eight,
        shape (drives, rows, columns). None where nothing reaches the frame but the windows.
    mixed
        Where groups of unlike drives share an image: what each drive counts in each image, shape
        (images, drives), and `images` are as many. None where each drive has its own.
    windows
        Electrons per second that each row of the light's direct table brings.
    centre_row
        The row of pixels of each window's centre, the nearest one where it is outside, shape (n,).
    between
        Of indirect light that is interpolated: the weights of other rates, of other times, and these.
    kept
        For what follows from the rates and takes long: it goes when they go.
    """

    light: Light
    snapshot: Snapshot
    drives: tuple[Drive, ...]
    drive: NDArray[np.int64]
    images: NDArray[np.float32] | None
    windows: tuple[Window, ...]
    centre_row: NDArray[np.int64]
    mixed: NDArray[np.float64] | None = None
    between: tuple[tuple[float, "Rates"], ...] = ()
    kept: dict[str, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def camera(self) -> Camera:
        """The camera that the light reaches."""
        return self.snapshot.camera(self.light.camera).camera

    @cached_property
    def scattered(self) -> tuple[NDArray[np.float64], ...]:
        """Electrons per second that each window's own group brings there indirectly, the windows' shapes."""
        found = [np.zeros_like(window.values) for window in self.windows]
        for group in np.unique(self.light.direct.group) if self.light.indirect is not None else ():
            of_group = np.flatnonzero(self.light.direct.group == group)
            rows = [row for row in of_group if self.windows[row].values.any()]
            if len(rows) == 1:
                found[rows[0]] = self.group_image(int(group), place_of(self.windows[rows[0]])).copy()
                continue
            image = self.group_image(int(group)) if rows else None
            for row in rows:
                assert image is not None
                found[row] = image[place_of(self.windows[row])].copy()
        return tuple(found)

    def group_image(self, group: int, place: Place | None = None) -> NDArray[np.float64]:
        """Return the electrons per second that a group's indirect light brings to some pixels, or to all."""
        if self.between:
            images = [weight * one.kept_group_image(group) for weight, one in self.between]
            image = np.asarray(np.sum(images, axis=0, dtype=np.float64))
            return image if place is None else image[place]
        only = np.zeros(len(self.light.groups))
        only[group] = group_fluxes(self.light, self.snapshot)[group]
        return blurred_image(self.light, self.snapshot, only, place)

    def kept_group_image(self, group: int) -> NDArray[np.float32]:
        """Return a group's image as float32, kept for the next frame."""
        images: dict[int, NDArray[np.float32]] = self.kept.setdefault("group_images", {})
        if group not in images:
            images[group] = self.group_image(group).astype(np.float32)
        return images[group]


@dataclass(frozen=True, eq=False)
class MeanFrame:
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

    rates: Rates
    exposure_s: float
    time_s: float
    electrons: NDArray[np.float64]
    windows: tuple[Window, ...]
    profiles: NDArray[np.float64]

    @property
    def light(self) -> Light:
        """The light that was exposed."""
        return self.rates.light

    @property
    def camera(self) -> Camera:
        """The camera that exposed it."""
        return self.rates.camera

    @property
    def levels(self) -> NDArray[np.float64]:
        """What the frame collects of each group, relative to the exposure at full drive, shape (groups,)."""
        return np.asarray(self.profiles.mean(axis=1)[self.rates.drive])

    def scattered(self, row: int) -> NDArray[np.float64]:
        """Return the electrons in a window that its own group brings indirectly, the window's shape."""
        window = self.windows[row]
        weights = _window_weights(self.rates, row, window, self.profiles * self.exposure_s)
        if place_of(window) == place_of(self.rates.windows[row]):
            return np.asarray(self.rates.scattered[row] * weights[:, None])
        if self.light.indirect is None:
            return np.zeros_like(window.values)
        image = self.rates.group_image(int(self.light.direct.group[row]))  # it was drawn out by motion
        return np.asarray(image[place_of(window)] * weights[:, None])


def mean_frame(light: Light, snapshot: Snapshot, exposure_s: float, time_s: float | None = None) -> MeanFrame:
    """Return the noise-free frame of an exposure, and what it is made of.

    `time_s` is when row 0 begins; without it the light's time is mid-exposure.
    """
    return exposed_frame(electron_rates(light, snapshot), exposure_s, time_s)


def electron_rates(light: Light, snapshot: Snapshot, shared: Collection[int] = ()) -> Rates:
    """Return what a light brings in a second: all that takes long, once for many exposures.

    The indirect light of the groups `shared` is one image, driven by the mean of their drives, each by its
    flux (`shared_light` says which may be, and what that leaves off). Their direct light stays their own.

    Raises
    ------
    InputError
        The light is not finite.
    """
    camera = snapshot.camera(light.camera).camera
    of_groups = [_drive_of_rates(emitter) for emitter in group_emitters(light, snapshot)]
    drives = tuple(dict.fromkeys(of_groups))
    number = {of_drive: index for index, of_drive in enumerate(drives)}
    drive = np.array([number[of_group] for of_group in of_groups], dtype=np.int64)
    windows = tuple(_windows(light, snapshot, camera))
    image, mixed = images_shared(drive, group_fluxes(light, snapshot), shared)
    images = images_of(light, snapshot, image, len(drives) if mixed is None else len(mixed), windows)
    parts: list[tuple[str, NDArray[np.floating]]] = [
        (f"the window of flare {number}", window.values) for number, window in enumerate(windows)
    ]
    parts += [] if images is None else [("the indirect light", images)]
    for what, part in parts:
        wrong = int((~np.isfinite(part)).sum())
        if wrong:
            raise InputError(
                f"{snapshot.origin}: the light of {light.camera} is not finite, {what} in {wrong} of "
                f"{part.size} values; a body or source may be degenerate"
            )
    v_px = intrinsics_of(camera).project(light.direct.direction)[:, 1]
    nearest = np.clip(np.nan_to_num(v_px), 0, camera.sensor.rows - 1)
    return Rates(light, snapshot, drives, drive, images, windows, np.rint(nearest).astype(np.int64), mixed)


def kept_rates(light: Light, snapshot: Snapshot) -> Rates:
    """Return the rates of a light, and keep them with it for its next exposure.

    Kept are those of the last camera and emitters: another flux, spectrum, drive or device is reckoned anew.
    What is kept does not hold the light, so that both go when the light is dropped.
    """
    camera, emitters = snapshot.camera(light.camera).camera, dict(snapshot.emitters)
    known = light.kept.get("rates")
    if known is not None and known[0] == camera and known[1] == emitters:
        return Rates(light, snapshot, **known[2])
    rates = electron_rates(light, snapshot)
    tables = {one.name: getattr(rates, one.name) for one in fields(rates)}
    del tables["light"], tables["snapshot"]
    light.kept["rates"] = (camera, emitters, tables)
    return rates


def exposed_frame(rates: Rates, exposure_s: float, time_s: float | None = None) -> MeanFrame:
    """Return the noise-free frame of one exposure; arguments as of `mean_frame`."""
    camera = rates.camera
    _check_exposure(exposure_s)
    if time_s is None:
        time_s = rates.light.time_s - mid_exposure_s(camera, exposure_s)
    if not np.isfinite(time_s):
        raise InputError(f"time_s is {time_s!r}; wanted seconds")
    profiles = [row_profile(camera, drive, time_s, exposure_s) for drive in rates.drives]
    drawn = _drawn_out(rates, exposure_s, time_s)
    return _weighted_sum(rates, exposure_s, time_s, profiles, drawn)


def fully_lit_frame(rates: Rates, exposure_s: float) -> MeanFrame:
    """Return the noise-free frame of an exposure in which everything that is not constant is fully lit."""
    _check_exposure(exposure_s)
    return _weighted_sum(rates, exposure_s, 0.0, [np.ones(rates.camera.sensor.rows) for _ in rates.drives])


def _check_exposure(exposure_s: float) -> None:
    if not (np.isfinite(exposure_s) and exposure_s > 0):
        raise InputError(f"exposure_s is {exposure_s!r}; wanted seconds greater than 0")


def _weighted_sum(
    rates: Rates,
    exposure_s: float,
    time_s: float,
    drive_profiles: list[NDArray[np.float64]],
    drawn: Mapping[int, Window] = MappingProxyType({}),
) -> MeanFrame:
    """Return the frame of profiles; windows that motion has `drawn` out stand in place of the rates'."""
    sensor = rates.camera.sensor
    profiles = np.reshape(drive_profiles, (len(drive_profiles), sensor.rows))
    weights = exposure_s * profiles
    if rates.images is None:
        electrons = np.zeros((sensor.rows, sensor.columns))
    else:
        of_images = weights if rates.mixed is None else rates.mixed @ weights
        electrons = np.einsum("dr,drc->rc", of_images.astype(np.float32), rates.images).astype(np.float64)
    windows = tuple(
        drawn[row] if row in drawn else _weighted_window(rates, row, weights)
        for row in range(len(rates.windows))
    )
    for window in windows:
        window.add_into(electrons)
    return MeanFrame(rates, exposure_s, time_s, electrons, windows, profiles)


def _weighted_window(rates: Rates, row: int, weights: NDArray[np.float64]) -> Window:
    """Return a window of rates, weighted; what of its total lies elsewhere counts as its centre's row."""
    window = rates.windows[row]
    values = window.values * _window_weights(rates, row, window, weights)[:, None]
    beyond = window.total - float(window.values.sum())
    of_centre = float(weights[_drive_of_window(rates, row), rates.centre_row[row]])
    return replace(window, values=values, total=float(values.sum()) + beyond * of_centre)


def _window_weights(
    rates: Rates, row: int, window: Window, weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weights, shape (drives, rows), that hold for the rows of a window."""
    return weights[_drive_of_window(rates, row), place_of(window)[0]]


def _drawn_out(rates: Rates, exposure_s: float, time_s: float) -> dict[int, Window]:
    """Return the windows of the exposure, by row of the direct table, of flares that move while it lasts."""
    light, snapshot, camera = rates.light, rates.snapshot, rates.camera
    table, lens = light.direct, intrinsics_of(camera)
    drawn = {}
    for row in table.shining:
        group = light.groups[table.group[row]]
        if not may_move(snapshot, light.camera, group):
            continue
        ends = path_of(snapshot, light.camera, group, table, row, exposure_s * np.array([-0.5, 0.0, 0.5]))
        ends_px = lens.project(ends.direction)
        length_px = float(np.linalg.norm(np.diff(ends_px, axis=0), axis=1).sum())
        shown = rates.windows[row].values.any() or any(lens.contains(*end) for end in ends_px)
        if not shown or length_px < STILL_PX:
            continue
        drive = rates.drives[_drive_of_window(rates, row)]
        length_px = length_px if np.isfinite(length_px) else 0.0
        chosen = instants(camera, drive, time_s, exposure_s, length_px, int(rates.centre_row[row]))
        if not chosen.weight_s.any():
            continue
        path = path_of(snapshot, light.camera, group, table, row, chosen.offset_s)
        beam = _beam(light, snapshot, camera, row, group_fluxes(light, snapshot))
        seen = None if beam.seen is None else table.seen[row]
        windows = [
            beam_window(camera, moved_beam(beam, direction, float(distance_m), seen), 1.0)
            for direction, distance_m in zip(path.direction, path.distance_m, strict=True)
        ]
        drawn[int(row)] = drawn_out(windows, chosen.weight_s)
    return drawn


def _drive_of_window(rates: Rates, row: int) -> int:
    return int(rates.drive[rates.light.direct.group[row]])


def _drive_of_rates(emitter: Emitter) -> Drive:
    drive = drive_of(emitter)
    return drive if drive.constant is None else FULL_DRIVE


def _windows(light: Light, snapshot: Snapshot, camera: Camera) -> list[Window]:
    """Return the electrons per second of each row of the direct table."""
    rows, flux = range(len(light.direct.group)), group_fluxes(light, snapshot)
    return [beam_window(camera, _beam(light, snapshot, camera, row, flux), 1.0) for row in rows]


def _beam(light: Light, snapshot: Snapshot, camera: Camera, row: int, flux: NDArray[np.float64]) -> Beam:
    """Return the beam of a row of the direct table, fully lit where its drive is not constant."""
    table, group = light.direct, light.direct.group[row]
    direction, angular_radius_rad = table.direction[row], float(table.angular_radius_rad[row])
    seen = None
    if 0.0 < table.visible_fraction[row] < 1.0:
        seen = sunflower(direction, angular_radius_rad, table.visibility_rays)[table.seen[row]]
    emitter = snapshot.emitters[light.groups[group]]
    irradiance_per_unit, response = row_response(camera, light, row, emitter)
    return Beam(
        direction=direction,
        angular_radius_rad=angular_radius_rad,
        irradiance_w_per_m2=irradiance_per_unit * float(flux[group]),
        response=response,
        seen=seen,
        distance_m=float(table.distance_m[row]),
    )
