"""The part of a camera's film that a walk fills, and the rays through it, on the device."""

from dataclasses import dataclass

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.types import Float, Point, UInt, Vector


@dataclass(frozen=True, eq=False)
class Film:
    """The rays of a camera and the part of its film to fill.

    `corners` holds directions at the corners of the sensor's pixels, `rows` + 1 times `columns` + 1; a pixel
    of the film is `scale` × `scale` of these. `index` are the numbers of the film's pixels to fill, `pixels`
    and `pixel_count` how many.
    """

    origin: Point
    corners: Float
    rows: UInt
    columns: UInt
    scale: UInt
    index: UInt
    pixels: UInt
    pixel_count: int


def camera_direction(film: Film, pixel: UInt, along: Float, down: Float) -> Vector:
    """Return the unit direction at a place in a pixel, between those at the sensor pixel's corners."""
    width = film.columns // film.scale
    row = pixel // width
    u = (mi.Float(pixel - row * width) + along) * mi.Float(film.scale)
    v = (mi.Float(row) + down) * mi.Float(film.scale)
    # In float32 the sum can round up to the next whole number.
    column, line = dr.minimum(mi.UInt32(u), film.columns - 1), dr.minimum(mi.UInt32(v), film.rows - 1)
    corner = line * (film.columns + 1) + column
    above, above_right, below, below_right = (
        dr.gather(mi.Vector3f, film.corners, corner + offset)
        for offset in (0, 1, film.columns + 1, film.columns + 2)
    )
    along, down = u - mi.Float(column), v - mi.Float(line)
    return dr.normalize(dr.lerp(dr.lerp(above, above_right, along), dr.lerp(below, below_right, along), down))
