"""Where a flare lies in the image: the pixels over which its flux is measured."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from nir_render.camera.optics.gaussian_fit import BLUR_SIGMAS, LEAST_RADIUS_PX, gaussian_fit
from nir_render.camera.optics.lens import Intrinsics, intrinsics_of
from nir_render.camera.optics.otf import core_of
from nir_render.light.enlarge import Enlargement, weights_of
from nir_render.light.light import Light
from nir_render.scene.documents.camera import Camera


@dataclass(frozen=True, eq=False)
class Aperture:
    """The pixels of a disc: the rectangle around it, and which of that are inside, shape (rows, columns)."""

    rows: slice
    columns: slice
    inside: NDArray[np.bool_]

    def pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and the columns of the pixels, shape (n,) each."""
        row, column = np.nonzero(self.inside)
        return row + self.rows.start, column + self.columns.start

    def sum(self, image: NDArray[np.float64]) -> float:
        """Return the sum of an image over the pixels."""
        return float(image[self.rows, self.columns][self.inside].sum())


def flare_aperture(
    camera: Camera, direction: NDArray[np.float64], angular_radius_rad: float
) -> Aperture | None:
    """Return the aperture of a flare: its image's radius and three σ of the point spread, at least 3 px.

    Parameters
    ----------
    direction
        Unit vector to the source's centre in camera axes, shape (3,).
    angular_radius_rad
        Half the angle that the source fills.

    Returns
    -------
    None where no pixel's centre lies in it: beyond the sensor, or behind the lens.
    """
    lens = intrinsics_of(camera)
    if direction[2] <= 0.0:
        return None
    u_px, v_px = lens.project(direction)
    image_px = lens.image_radius_px(direction, angular_radius_rad)
    radius_px = max(image_px + BLUR_SIGMAS * gaussian_fit(core_of(camera)).sigma_px, LEAST_RADIUS_PX)
    return _disc(u_px, v_px, radius_px, lens)


def _disc(u_px: float, v_px: float, radius_px: float, lens: Intrinsics) -> Aperture | None:
    """Return the pixels whose centres lie in a disc; None where there are none."""
    rows, columns = (
        slice(
            min(max(math.ceil(middle_px - radius_px), 0), count),
            max(min(math.floor(middle_px + radius_px) + 1, count), 0),
        )
        for middle_px, count in ((v_px, lens.height_px), (u_px, lens.width_px))
    )
    down, across = np.arange(rows.start, rows.stop) - v_px, np.arange(columns.start, columns.stop) - u_px
    inside = down[:, None] ** 2 + across**2 <= radius_px**2
    return Aperture(rows, columns, inside) if inside.any() else None


def aperture_weights(
    apertures: Sequence[Aperture], per_pixel: NDArray[np.float64], scale: int, enlargement: Enlargement
) -> tuple[csr_array, csr_array]:
    """Return what blocks, and the pixels of the patch, count in sums over apertures.

    The sum a'x of a weighted image over pixels x = W b, where b are blocks and W enlarges them, is (a'W) b:
    so its variance is that of a sum over blocks (`light.averages.BlockVariance.of_sums`).

    Parameters
    ----------
    per_pixel
        The weights a of all pixels, shape (rows, columns).
    scale
        Sensor pixels per block, along each axis.

    Returns
    -------
    Shape (apertures, blocks) and (apertures, patch).
    """
    places = [row * enlargement.columns + column for row, column in (one.pixels() for one in apertures)]
    pixel = np.concatenate([np.empty(0, dtype=np.int64), *places])
    number = np.repeat(np.arange(len(places)), [len(place) for place in places])
    weight = per_pixel.ravel()[pixel]
    at = np.minimum(np.searchsorted(enlargement.patch, pixel), max(len(enlargement.patch) - 1, 0))
    alone = enlargement.patch[at] == pixel if len(enlargement.patch) else np.zeros(len(pixel), dtype=bool)
    shape = (len(places), int((~alone).sum()))
    taken = coo_array((weight[~alone], (number[~alone], np.arange(shape[1]))), shape=shape)
    of_blocks = csr_array(taken.tocsr() @ weights_of(pixel[~alone], scale, enlargement))
    shape = (len(places), len(enlargement.patch))
    of_patch = coo_array((weight[alone], (number[alone], at[alone])), shape=shape).tocsr()
    return of_blocks, of_patch


def pixels_around_flares(light: Light, camera: Camera, reach_px: float) -> NDArray[np.int64]:
    """Return the numbers, row by row, of the pixels near where the lens images what shines, shape (n,).

    Within `reach_px` and the least radius of a flare of the image's edge. The point spread has no say: light
    is the same whatever blurs it afterwards.
    """
    table, lens = light.direct, intrinsics_of(camera)
    near = np.zeros((camera.sensor.rows, camera.sensor.columns), dtype=np.bool_)
    for row in table.shining:
        direction = table.direction[row]
        if direction[2] <= 0.0:
            continue
        u_px, v_px = lens.project(direction)
        image_px = lens.image_radius_px(direction, float(table.angular_radius_rad[row]))
        disc = _disc(u_px, v_px, image_px + LEAST_RADIUS_PX + reach_px, lens)
        if disc is not None:
            near[disc.pixels()] = True
    return np.flatnonzero(near)


def flare_apertures(light: Light, camera: Camera) -> list[Aperture]:
    """Return the apertures of what the direct table shows in the frame: sources, the sun, their ghosts."""
    table = light.direct
    shown = (
        flare_aperture(camera, table.direction[row], float(table.angular_radius_rad[row]))
        for row in table.shining
    )
    return [aperture for aperture in shown if aperture is not None]
