"""Fog on the device: where a ray is in it, how far it gets, and how it turns."""

from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.kernel.tables import HEIGHTS, FogTable, HeightTable, along_table
from nir_render.transport.indirect.kernel.types import Float, Mask, Point, UInt, Vector
from nir_render.transport.world.phase import CELLS

_FIRST = 8.0  # typical free paths, over which a flight counts as level or not


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
    return dr.exp(-optical_depth(fog, origin, direction, begin, end))


def optical_depth(fog: FogTable, origin: Point, direction: Vector, begin: Float, end: Float) -> Float:
    """Return the optical depth along a ray between two distances in the fog; 0 if end ≤ begin."""
    depth = fog.extinction * dr.maximum(end - begin, 0.0)
    if fog.profile is None:
        return depth
    return depth * _mean_density(fog.profile, origin.z + direction.z * begin, origin.z + direction.z * end)


def extinction_at(fog: FogTable, place: Point) -> Float:
    """Return the extinction at a place in the fog."""
    if fog.profile is None:
        return fog.extinction
    return fog.extinction * _density(fog.profile, place.z)


def draw_flight(fog: FogTable, origin: Point, direction: Vector, begin: Float, end: Float, u: Float) -> Float:
    """Return a distance in the fog on a stretch of a ray, drawn by the extinction, never beyond its end."""
    if fog.profile is None:
        whole = absorbed_share(optical_depth(fog, origin, direction, begin, end))
        return dr.minimum(begin - dr.log(1.0 - u * whole) / fog.extinction, end)
    profile, (level, rate, depth) = fog.profile, _flight(fog, origin, direction, begin, end)
    flown = -dr.log(1.0 - u * absorbed_share(depth))
    column = _column(profile, origin.z + direction.z * begin) + direction.z * flown / fog.extinction
    rising = (_height_of(profile, column) - origin.z) / dr.select(level, 1.0, direction.z)
    return dr.clip(dr.select(level, begin + flown / rate, rising), begin, end)


def flight_density(
    fog: FogTable, origin: Point, direction: Vector, begin: Float, end: Float, distance: Float
) -> Float:
    """Return the density per metre with which `draw_flight` draws a distance."""
    if fog.profile is None:
        whole = absorbed_share(optical_depth(fog, origin, direction, begin, end))
        return fog.extinction * dr.exp(-fog.extinction * (distance - begin)) / whole
    level, rate, depth = _flight(fog, origin, direction, begin, end)
    here = dr.select(level, rate, extinction_at(fog, origin + direction * distance))
    before = optical_depth(fog, origin, direction, begin, distance)
    before = dr.select(level, rate * (distance - begin), before)
    whole = absorbed_share(depth)
    return dr.select(whole > 0.0, here * dr.exp(-before) / dr.maximum(whole, 1e-30), 0.0)


def _flight(
    fog: FogTable, origin: Point, direction: Vector, begin: Float, end: Float
) -> tuple[Mask, Float, Float]:
    """Return whether a stretch counts as level, the even extinction for it, and the depth to draw by.

    On level ones, whose heights would lose their digits, flights are drawn as in even fog of the extinction
    over the first metres: weights, which are by the true one, make up for it.
    """
    profile = fog.profile
    assert profile is not None  # else fog is even
    first = dr.minimum(end - begin, _FIRST / fog.typical)
    level = dr.abs(direction.z) * first <= profile.level
    near = optical_depth(fog, origin, direction, begin, begin + first) / dr.maximum(first, 1e-30)
    rate = dr.maximum(near, 1e-3 * fog.typical)
    even = rate * dr.maximum(end - begin, 0.0)
    return level, rate, dr.select(level, even, optical_depth(fog, origin, direction, begin, end))


def _density(profile: HeightTable, height: Float) -> Float:
    cell, step = _place_in_cell(profile, dr.maximum(height, profile.lowest))
    return _density_in_cell(profile, cell, step)


def _mean_density(profile: HeightTable, one: Float, other: Float) -> Float:
    """Return the mean density between two heights.

    What lies in the cells of both is reckoned apart from whole cells between them: in differences of columns,
    as those of a thin layer under a high one, float32 would lose its digits.
    """
    low, high = dr.minimum(one, other), dr.maximum(one, other)
    inner_low, inner_high = dr.maximum(low, profile.lowest), dr.maximum(high, profile.lowest)
    (first, low_step), (last, high_step) = (
        _place_in_cell(profile, height) for height in (inner_low, inner_high)
    )
    at_low = _density_in_cell(profile, first, low_step)
    at_high = _density_in_cell(profile, last, high_step)
    after = dr.gather(mi.Float, profile.height, first + 1)
    at_after, at_before = (dr.gather(mi.Float, profile.density, cell) for cell in (first + 1, last))
    columns = (dr.gather(mi.Float, profile.column, cell) for cell in (last, first + 1))
    parts = 0.5 * ((after - inner_low) * (at_low + at_after) + high_step * (at_before + at_high))
    within = 0.5 * (inner_high - inner_low) * (at_low + at_high)
    total = dr.select(first == last, within, parts + next(columns) - next(columns))
    total = total + (inner_low - low - (inner_high - high)) * profile.below
    return dr.select(high > low, total / dr.maximum(high - low, 1e-30), at_low)


def _column(profile: HeightTable, height: Float) -> Float:
    """Return ∫ of the density from the lowest point to a height, below it negative."""
    within = dr.maximum(height, profile.lowest)
    cell, step = _place_in_cell(profile, within)
    mean = _density_in_cell(profile, cell, 0.5 * step)
    return dr.gather(mi.Float, profile.column, cell) + step * mean + (height - within) * profile.below


def _height_of(profile: HeightTable, column: Float) -> Float:
    """Return the height up to which `_column` is a value: in a cell ρ δ + ½ s δ² is what is left of it."""
    within = dr.maximum(column, 0.0)
    cell = _cell_below(profile.column, within)
    left = within - dr.gather(mi.Float, profile.column, cell)
    density, slope = (dr.gather(mi.Float, table, cell) for table in (profile.density, profile.slope))
    root = dr.safe_sqrt(density * density + 2.0 * slope * left)
    height = dr.gather(mi.Float, profile.height, cell) + 2.0 * left / dr.maximum(density + root, 1e-30)
    return height + dr.minimum(column, 0.0) / dr.maximum(profile.below, 1e-30)


def _place_in_cell(profile: HeightTable, height: Float) -> tuple[UInt, Float]:
    """Return the cell of a height, not below the lowest, and how far above its begin that is."""
    cell = _cell_below(profile.height, height)
    return cell, height - dr.gather(mi.Float, profile.height, cell)


def _density_in_cell(profile: HeightTable, cell: UInt, step: Float) -> Float:
    return dr.gather(mi.Float, profile.density, cell) + step * dr.gather(mi.Float, profile.slope, cell)


def _cell_below(table: Float, value: Float) -> UInt:
    """Return the last cell of a profile's table that begins at or below a value."""
    return dr.binary_search(0, HEIGHTS - 2, lambda k: dr.gather(mi.Float, table, k + 1) <= value)


def absorbed_share(depth: Float) -> Float:
    """Return 1 − exp(−depth), with its digits where the depth is small."""
    series = depth * (1.0 - depth * (0.5 - depth * (1.0 / 6.0 - depth / 24.0)))
    return dr.select(depth < 0.05, series, 1.0 - dr.exp(-depth))


def versine(one: Vector, other: Vector) -> Float:
    """Return 1 − cos θ of two unit directions, with its digits where θ is small."""
    return 0.5 * dr.squared_norm(other - one)


def phase_function(fog: FogTable, turn: Float) -> Float:
    """Return the phase function, 1/sr, for a turn of which 1 − cos is given."""
    cell = _cell(_angle(turn))
    low = dr.gather(mi.Float, fog.versine, cell)
    high = dr.gather(mi.Float, fog.versine, cell + 1)
    share = dr.clip((turn - low) / (high - low), 0.0, 1.0)
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
    turn = dr.lerp(low, high, dr.clip(place, 0.0, 1.0))
    sine = dr.safe_sqrt(turn * (2.0 - turn))
    sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * v)
    return mi.Frame3f(direction).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, 1.0 - turn))


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


def _angle(turn: Float) -> Float:
    return 2.0 * dr.asin(dr.minimum(dr.safe_sqrt(0.5 * turn), 1.0))


def _cell(angle: Float) -> UInt:
    """Return the cell of the table that holds an angle: angles are π (i / CELLS)²."""
    return mi.UInt32(along_table(CELLS * dr.sqrt(angle / dr.pi), CELLS - 1.0))
