"""Indirect light as images on the sensor: of each drive, or of several groups that share one."""

from collections.abc import Collection
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.beams import blur, blur_reach_px, diffuse_electrons
from nir_render.camera.by_spectrum import blocks_by_spectrum, by_spectrum, group_fluxes
from nir_render.camera.optics.psf import Window
from nir_render.camera.optics.veil import veil
from nir_render.light.enlarge import enlarge
from nir_render.light.light import Indirect, Light
from nir_render.scene.snapshot import Snapshot

Place = tuple[slice, slice]


def images_of(
    light: Light,
    snapshot: Snapshot,
    drive: NDArray[np.int64],
    drives: int,
    windows: tuple[Window, ...] | None,
) -> NDArray[np.float32] | None:
    """Return the electrons per second on the sensor, all but the windows, by drive; None where none are.

    They are the indirect light, and what glare and ghosts bring of it and of the windows, if these are given.
    """
    camera = snapshot.camera(light.camera).camera
    veiled = camera.point_spread.core_share < 1.0
    if light.indirect is None and not veiled:
        return None
    flux = group_fluxes(light, snapshot)
    images = np.empty((drives, camera.sensor.rows, camera.sensor.columns), dtype=np.float32)
    for number in range(drives):
        image = blurred_image(light, snapshot, np.where(drive == number, flux, 0.0))
        if veiled:
            core = image.copy()
            for row in np.flatnonzero(drive[light.direct.group] == number):
                if windows is not None:
                    windows[row].add_into(core)
            image += veil(camera, core)
        images[number] = image
    return images


def blurred_image(
    light: Light, snapshot: Snapshot, flux: NDArray[np.float64], place: Place | None = None
) -> NDArray[np.float64]:
    """Return the electrons per second of indirect light of groups of given fluxes, never below 0.

    `place` are the rows and columns that are wanted; by default all. What lies beyond is not blurred, where
    the blur does not reach from there.
    """
    camera = snapshot.camera(light.camera).camera
    shape = camera.sensor.rows, camera.sensor.columns
    whole = slice(0, shape[0]), slice(0, shape[1])
    wanted = whole if place is None else place
    if light.indirect is None:
        return np.zeros(shape)[wanted]
    around = whole
    if place is not None and (reach := blur_reach_px(camera)) is not None:
        around = (
            slice(max(place[0].start - reach, 0), min(place[0].stop + reach, shape[0])),
            slice(max(place[1].start - reach, 0), min(place[1].stop + reach, shape[1])),
        )
    image = blur(camera, diffuse_image(light, light.indirect, snapshot, flux)[around])
    inside = tuple(
        slice(own.start - begin.start, own.stop - begin.start)
        for own, begin in zip(wanted, around, strict=True)
    )
    return np.asarray(np.maximum(image[inside], 0.0))  # what is enlarged along edges can dip below


def diffuse_image(
    light: Light, indirect: Indirect, snapshot: Snapshot, fluxes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the electrons per second of indirect light before the blur, groups of given fluxes summed."""
    camera = snapshot.camera(light.camera).camera
    rows, columns = camera.sensor.rows, camera.sensor.columns
    image = np.zeros((rows, columns))
    edges = indirect.edges
    enlargement = None if edges is None else edges.enlargement
    parts = blocks_by_spectrum(light, indirect, snapshot, fluxes)
    patches = [] if edges is None else by_spectrum(light, snapshot, edges.radiance_per_w, fluxes)
    for part, patch in zip_longest(parts, patches):
        whole = enlarge(part.values, rows, columns, enlargement, None if patch is None else patch.values)
        image += diffuse_electrons(camera, whole, part.emitter, 1.0, part.node)
    return image


def images_shared(
    drive: NDArray[np.int64], flux: NDArray[np.float64], shared: Collection[int]
) -> tuple[NDArray[np.int64], NDArray[np.float64] | None]:
    """Return the image of each group where some share one, and what each drive counts in each image.

    Parameters
    ----------
    drive
        The number of each group's drive, shape (groups,).
    flux
        What each group sends, shape (groups,): by that it counts in the mean of drives.
    shared
        The numbers of the groups that share the last image.

    Returns
    -------
    Shape (groups,); and shape (images, drives), None where each drive has an image of its own.
    """
    if not shared:
        return drive, None
    together = np.isin(np.arange(len(drive)), list(shared))
    apart, own = np.unique(drive[~together], return_inverse=True)
    image = np.full(len(drive), len(apart), dtype=np.int64)
    image[~together] = own
    mixed = np.zeros((len(apart) + 1, int(drive.max()) + 1))
    mixed[np.arange(len(apart)), apart] = 1.0
    np.add.at(mixed[-1], drive[together], flux[together] / flux[together].sum())
    return image, mixed
