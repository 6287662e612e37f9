"""Fog on the device: where a ray is in it, how far it gets, and how it turns."""

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.tables import FogTable, along_table
from nir_render.transport.indirect.kernel.types import Float, Point, UInt, Vector
from nir_render.transport.world.phase import CELLS


def fog_interval(fog: FogTable, origin: Point, direction: Vector, reach: Float) -> tuple[Float, Float]:
    """Return where along a ray of unit direction the fog begins and ends; nowhere if end ≤ begin."""
    begin, end = mi.Float(0.0), mi.Float(reach)
    for axis in range(3):
        slope = direction[axis]
        slope = dr.select(dr.abs(slope) < 1e-12, 1e-12, slope)
        at_low = (fog.low[axis] - origin[axis]) / slope
        at_high = (fog.high[axis] - origin[axis]) / slope
        begin = dr.maximum(begin, dr.minimum(at_low, at_high))
        end = dr.minimum(end, dr.maximum(at_low, at_high))
    return begin, end


def transmittance(fog: FogTable, origin: Point, direction: Vector, reach: Float) -> Float:
    """Return what is left of light after a straight way: Beer and Lambert."""
    begin, end = fog_interval(fog, origin, direction, reach)
    return dr.exp(-fog.extinction * dr.maximum(end - begin, 0.0))


def absorbed_share(depth: Float) -> Float:
    """Return 1 − exp(−depth), with its digits where the depth is small."""
    series = depth * (1.0 - depth * (0.5 - depth * (1.0 / 6.0 - depth / 24.0)))
    return dr.select(depth < 0.05, series, 1.0 - dr.exp(-depth))


def phase_function(fog: FogTable, versine: Float) -> Float:
    """Return the phase function, 1/sr, for a turn of which 1 − cos is given."""
    cell = _cell(_angle(versine))
    low = dr.gather(mi.Float, fog.versine, cell)
    high = dr.gather(mi.Float, fog.versine, cell + 1)
    share = dr.clip((versine - low) / (high - low), 0.0, 1.0)
    return dr.lerp(dr.gather(mi.Float, fog.density, cell), dr.gather(mi.Float, fog.density, cell + 1), share)


def draw_scattering(fog: FogTable, direction: Vector, u: Float, v: Float) -> Vector:
    """Return a direction after a scattering, drawn from the phase function.

    In a cell the density is linear in the versine: of p0, p1 and the share s of the cell's light, the place x
    in it solves x (p0 + ½ (p1 − p0) x) = ½ s (p0 + p1).
    """
    cell = dr.binary_search(0, CELLS - 1, lambda k: dr.gather(mi.Float, fog.cumulative, k + 1) <= u)
    before = dr.gather(mi.Float, fog.cumulative, cell)
    after = dr.gather(mi.Float, fog.cumulative, cell + 1)
    share = dr.clip((u - before) / dr.maximum(after - before, 1e-20), 0.0, 1.0)
    p0, p1 = dr.gather(mi.Float, fog.density, cell), dr.gather(mi.Float, fog.density, cell + 1)
    root = dr.safe_sqrt(p0 * p0 + share * (p1 * p1 - p0 * p0))
    place = share * (p0 + p1) / dr.maximum(p0 + root, 1e-30)
    low, high = dr.gather(mi.Float, fog.versine, cell), dr.gather(mi.Float, fog.versine, cell + 1)
    versine = dr.lerp(low, high, dr.clip(place, 0.0, 1.0))
    sine = dr.safe_sqrt(versine * (2.0 - versine))
    sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * v)
    return mi.Frame3f(direction).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, 1.0 - versine))


def arc_integral(fog: FogTable, angle: Float) -> Float:
    """Return ∫ of the phase function over the angle itself, from 0 to `angle`."""
    cell = _cell(angle)
    low, high = dr.gather(mi.Float, fog.angle, cell), dr.gather(mi.Float, fog.angle, cell + 1)
    share = dr.clip((angle - low) / (high - low), 0.0, 1.0)
    return dr.lerp(dr.gather(mi.Float, fog.arc, cell), dr.gather(mi.Float, fog.arc, cell + 1), share)


def table_slope(fog: FogTable, table: Float, angle: Float) -> Float:
    """Return the slope of a table over angles, `arc` or `halo`: the density by which `draw_angle` draws."""
    cell = _cell(angle)
    before, after = dr.gather(mi.Float, table, cell), dr.gather(mi.Float, table, cell + 1)
    low, high = dr.gather(mi.Float, fog.angle, cell), dr.gather(mi.Float, fog.angle, cell + 1)
    return (after - before) / (high - low)


def draw_angle(fog: FogTable, table: Float, value: Float) -> Float:
    """Return the angle up to which a table over angles, `arc` or `halo`, is `value`."""
    cell = dr.binary_search(0, CELLS - 1, lambda k: dr.gather(mi.Float, table, k + 1) <= value)
    before, after = dr.gather(mi.Float, table, cell), dr.gather(mi.Float, table, cell + 1)
    low, high = dr.gather(mi.Float, fog.angle, cell), dr.gather(mi.Float, fog.angle, cell + 1)
    share = dr.clip((value - before) / dr.maximum(after - before, 1e-20), 0.0, 1.0)
    return dr.lerp(low, high, share)


def _angle(versine: Float) -> Float:
    return 2.0 * dr.asin(dr.minimum(dr.safe_sqrt(0.5 * versine), 1.0))


def _cell(angle: Float) -> UInt:
    """Return the cell of the table that holds an angle: angles are π (i / CELLS)²."""
    return mi.UInt32(along_table(CELLS * dr.sqrt(angle / dr.pi), CELLS - 1.0))
