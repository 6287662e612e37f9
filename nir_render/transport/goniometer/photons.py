"""Photons through a source as it is built: dies on a board, under a cover that is cut from a sphere.

Each photon goes its way by itself, with no weight: it leaves, or something takes it. So energy is kept by
counting, and how many land in a cell is binomial. All surfaces are spheres about one centre and the board's
plane, met in closed form; the region (inside, within the cover's wall, outside) is known at every step, never
guessed from rounded places. The board is z = 0; lengths are in metres, indices are those against air.

Rough faces are walks on a microsurface of GGX slopes and uniform heights (Heitz, Hanika, d'Eon, Dachsbacher
2016, "Multiple-scattering microfacet BSDFs with the Smith model"), which lose no light between the facets, as
a single reflection does; visible facets are drawn by spherical caps (Dupuy, Benyoub 2023).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]
Counts = NDArray[np.int64]
Random = NDArray[np.uint64]
Vector = tuple[float, float, float]

BARE, THIN, WALL = 0, 1, 2
LEFT, IN_COVER, IN_BOARD, LOST = 0, 1, 2, 3

_INSIDE, _WITHIN, _OUTSIDE = 0, 1, 2
_MOST_STEPS = 1_000_000
_MOST_FACETS = 10_000
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_ONE = np.uint64(1)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


class Optics(NamedTuple):
    """Board and cover; `cover` is BARE, THIN (a sheet that scatters evenly to both sides) or WALL."""

    cover: int
    board_radius_m: float
    board_reflectance: float
    center_m: float
    outer_m: float
    inner_m: float
    refractive_index: float
    roughness: float
    scattering_per_m: float
    absorption_per_m: float
    asymmetry: float
    transmittance: float
    reflectance: float


class Dies(NamedTuple):
    """Dies, one per row: share of the flux summed up, centre, axis, radius, and lobe.

    A lobe is cos^n of the polar angle where `exponent` n is not negative; else the cosines in `quantiles`,
    even in probability.
    """

    up_to: Array
    center_m: Array
    axis: Array
    radius_m: Array
    exponent: Array
    quantiles: Array


class Sphere(NamedTuple):
    """Where photons are counted: cells around nodes at even polar angles and azimuths.

    The sphere of radius `distance_m` has its centre on the axis at `origin_m` above the board.
    """

    distance_m: float
    origin_m: float
    polar_steps: int
    azimuths: int


@compiled
def trace(
    key: int, first: int, count: int, optics: Optics, dies: Dies, sphere: Sphere
) -> tuple[Counts, Counts, Counts]:
    """Send `count` photons, from number `first` on; each has its own random numbers of (key, number).

    Returns
    -------
    Where they went, by direction and by where they pass the sphere, shape (polar_steps + 1, azimuths) each;
    and how many left, were taken by cover and board, and were given up, shape (4,).
    """
    far = np.zeros((sphere.polar_steps + 1, sphere.azimuths), dtype=np.int64)
    near = np.zeros((sphere.polar_steps + 1, sphere.azimuths), dtype=np.int64)
    fates = np.zeros(4, dtype=np.int64)
    random = np.zeros(1, dtype=np.uint64)
    for number in range(first, first + count):
        random[0] = _mixed(np.uint64(key) + _mixed(np.uint64(number) * _GOLDEN + _ONE))
        place, way = _emitted(dies, random)
        fate, place, way = _followed(place, way, optics, random)
        fates[fate] += 1
        if fate == LEFT:
            _count(far, way, sphere)
            x, y, z = place[0], place[1], place[2] - sphere.origin_m
            along = x * way[0] + y * way[1] + z * way[2]
            rest = along * along - (x * x + y * y + z * z) + sphere.distance_m * sphere.distance_m
            step = math.sqrt(max(rest, 0.0)) - along
            _count(near, (x + step * way[0], y + step * way[1], z + step * way[2]), sphere)
    return far, near, fates


@compiled
def _followed(place: Vector, way: Vector, optics: Optics, random: Random) -> tuple[int, Vector, Vector]:
    """Follow a photon to its end: its fate, where it was last, where it goes."""
    x, y, z = place
    dx, dy, dz = way
    height = z - optics.center_m
    from_center = math.sqrt(x * x + y * y + height * height)
    region = _OUTSIDE
    if optics.cover != BARE and from_center < optics.outer_m:
        region = _INSIDE if from_center < optics.inner_m else _WITHIN
    extinction_per_m = optics.scattering_per_m + optics.absorption_per_m
    for _ in range(_MOST_STEPS):
        height = z - optics.center_m
        along = x * dx + y * dy + height * dz
        square = x * x + y * y + height * height

        # The next face of the cover: by the region, which one it can be.
        step, face = math.inf, 0
        inner = along * along - square + optics.inner_m * optics.inner_m
        outer = along * along - square + optics.outer_m * optics.outer_m
        if region == _INSIDE:
            step, face = max(math.sqrt(max(inner, 0.0)) - along, 0.0), 1
        elif region == _WITHIN and along < 0.0 and inner > 0.0:
            step, face = max(-along - math.sqrt(inner), 0.0), 1
        elif region == _WITHIN:
            step, face = max(math.sqrt(max(outer, 0.0)) - along, 0.0), 2
        elif along < 0.0 and outer > 0.0 and optics.cover != BARE:
            step, face = max(-along - math.sqrt(outer), 0.0), 2
            if z + step * dz <= 0.0:  # below the board there is no cover
                step, face = math.inf, 0

        # The board, from above or from below.
        down = dz < 0.0 and (z > 0.0 or region != _OUTSIDE)
        if down or (dz > 0.0 and z < 0.0 and region == _OUTSIDE):
            fall = max(-z / dz, 0.0)
            at_x, at_y = x + fall * dx, y + fall * dy
            reached = at_x * at_x + at_y * at_y <= optics.board_radius_m * optics.board_radius_m
            if fall < step and (reached or region != _OUTSIDE):
                step, face = fall, 3

        if region == _WITHIN and extinction_per_m > 0.0:
            free = -math.log(1.0 - _uniform(random)) / extinction_per_m
            if free < step:
                x, y, z = x + free * dx, y + free * dy, z + free * dz
                if _uniform(random) * extinction_per_m < optics.absorption_per_m:
                    return IN_COVER, (x, y, z), (dx, dy, dz)
                dx, dy, dz = _scattered((dx, dy, dz), optics.asymmetry, random)
                continue

        if face == 0:
            return LEFT, (x, y, z), (dx, dy, dz)
        x, y, z = x + step * dx, y + step * dy, z + step * dz
        if face == 3:
            if _uniform(random) >= optics.board_reflectance:
                return IN_BOARD, (x, y, z), (dx, dy, dz)
            z = 0.0
            dx, dy, dz = _even((0.0, 0.0, -1.0 if dz > 0.0 else 1.0), random)
            continue

        # The normal of the face, towards where the photon comes from.
        radius = optics.inner_m if face == 1 else optics.outer_m
        turn = -1.0 if dx * x + dy * y + dz * (z - optics.center_m) > 0.0 else 1.0
        normal = (turn * x / radius, turn * y / radius, turn * (z - optics.center_m) / radius)
        if optics.cover == THIN:
            drawn = _uniform(random)
            if drawn < optics.transmittance:
                region = _OUTSIDE if region == _INSIDE else _INSIDE
                normal = (-normal[0], -normal[1], -normal[2])
            elif drawn >= optics.transmittance + optics.reflectance:
                return IN_COVER, (x, y, z), (dx, dy, dz)
            dx, dy, dz = _even(normal, random)
            continue
        ratio = 1.0 / optics.refractive_index if region == _WITHIN else optics.refractive_index
        (dx, dy, dz), passed = _met((dx, dy, dz), normal, ratio, optics.roughness, random)
        if passed:
            region = _WITHIN if region != _WITHIN else (_INSIDE if face == 1 else _OUTSIDE)
    return LOST, (x, y, z), (dx, dy, dz)


@compiled
def _met(way: Vector, normal: Vector, ratio: float, roughness: float, random: Random) -> tuple[Vector, bool]:
    """Return where light goes from a dielectric face, and whether it has passed it.

    `ratio` is the index beyond it over that on this side. `normal` points to where the light comes from.
    """
    if ratio == 1.0:
        return way, True
    if roughness == 0.0:
        cos_in = -(way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2])
        reflected, cos_out = _fresnel(cos_in, ratio)
        if _uniform(random) < reflected:
            return _sum(way, 1.0, normal, 2.0 * cos_in), False
        return _sum(way, 1.0 / ratio, normal, cos_in / ratio - cos_out), True
    first, second = _axes(normal)
    ray = (_dot(way, first), _dot(way, second), _dot(way, normal))
    level, passed = 1.0, False  # the share of the microsurface that lies below
    for _ in range(_MOST_FACETS):
        slope = roughness * math.sqrt(max(1.0 - ray[2] * ray[2], 0.0)) / max(abs(ray[2]), 1e-12)
        masking = 0.5 * (math.copysign(math.sqrt(1.0 + slope * slope), ray[2]) - 1.0)  # Smith's Λ
        drawn = _uniform(random)
        if ray[2] > 0.0 and drawn >= 1.0 - level**masking:
            break
        level *= (1.0 - drawn) ** (-1.0 / masking)
        view = (-ray[0], -ray[1], -ray[2])
        facet = _facet(view, roughness, random)
        cos_in = max(_dot(view, facet), 0.0)
        reflected, cos_out = _fresnel(cos_in, ratio)
        if _uniform(random) < reflected:
            ray = _sum(ray, 1.0, facet, 2.0 * cos_in)
        else:  # to the other side, and all is turned over about a point, so that up is up again
            through = _sum(ray, 1.0 / ratio, facet, cos_in / ratio - cos_out)
            ray = (-through[0], -through[1], -through[2])
            level, ratio, passed = 1.0 - level, 1.0 / ratio, not passed
    side = -1.0 if passed else 1.0
    flat = _sum(first, side * ray[0], second, side * ray[1])
    return _unit(_sum(flat, 1.0, normal, side * max(ray[2], 1e-12))), passed


@compiled
def _facet(view: Vector, roughness: float, random: Random) -> Vector:
    """Draw the normal of a GGX facet among those that are seen along `view`, from above or from below."""
    x, y, z = _unit((roughness * view[0], roughness * view[1], view[2]))
    turn = 2.0 * math.pi * _uniform(random)
    up = (1.0 - _uniform(random)) * (1.0 + z) - z
    across = math.sqrt(max(1.0 - up * up, 0.0))
    half = (across * math.cos(turn) + x, across * math.sin(turn) + y, up + z)
    return _unit((roughness * half[0], roughness * half[1], max(half[2], 1e-12)))


@compiled
def _fresnel(cos_in: float, ratio: float) -> tuple[float, float]:
    """Return the unpolarised reflectance of a face, and the cosine of the refracted way."""
    square = 1.0 - (1.0 - cos_in * cos_in) / (ratio * ratio)
    if square <= 0.0:
        return 1.0, 0.0
    cos_out = math.sqrt(square)
    across = (cos_in - ratio * cos_out) / (cos_in + ratio * cos_out)
    parallel = (ratio * cos_in - cos_out) / (ratio * cos_in + cos_out)
    return 0.5 * (across * across + parallel * parallel), cos_out


@compiled
def _scattered(way: Vector, asymmetry: float, random: Random) -> Vector:
    """Draw where a volume scatters to: Henyey and Greenstein's phase function."""
    drawn = _uniform(random)
    if abs(asymmetry) < 1e-6:
        cosine = 1.0 - 2.0 * drawn
    else:
        part = (1.0 - asymmetry * asymmetry) / (1.0 - asymmetry + 2.0 * asymmetry * drawn)
        cosine = (1.0 + asymmetry * asymmetry - part * part) / (2.0 * asymmetry)
    return _about(way, cosine, random)


@compiled
def _even(normal: Vector, random: Random) -> Vector:
    """Draw where an even diffuser sends light: in proportion to the cosine."""
    return _about(normal, math.sqrt(1.0 - _uniform(random)), random)


@compiled
def _emitted(dies: Dies, random: Random) -> tuple[Vector, Vector]:
    """Draw where a photon comes from, and where it goes."""
    drawn = _uniform(random)
    die = 0
    while die < len(dies.up_to) - 1 and drawn >= dies.up_to[die]:
        die += 1
    axis = (dies.axis[die, 0], dies.axis[die, 1], dies.axis[die, 2])
    first, second = _axes(axis)
    out = dies.radius_m[die] * math.sqrt(_uniform(random))
    turn = 2.0 * math.pi * _uniform(random)
    shift = _sum(first, out * math.cos(turn), second, out * math.sin(turn))
    center = (dies.center_m[die, 0], dies.center_m[die, 1], dies.center_m[die, 2])
    place = _sum(center, 1.0, shift, 1.0)
    drawn = _uniform(random)
    if dies.exponent[die] >= 0.0:
        cosine = (1.0 - drawn) ** (1.0 / (dies.exponent[die] + 1.0))
    else:
        row = drawn * (dies.quantiles.shape[1] - 1)
        low = int(row)
        here, next_ = dies.quantiles[die, low], dies.quantiles[die, low + 1]
        cosine = here + (row - low) * (next_ - here)
    return (place[0], place[1], max(place[2], 0.0)), _about(axis, cosine, random)


@compiled
def _about(axis: Vector, cosine: float, random: Random) -> Vector:
    """Draw a unit vector at an angle from an axis, anywhere around it."""
    first, second = _axes(axis)
    turn = 2.0 * math.pi * _uniform(random)
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    flat = _sum(first, sine * math.cos(turn), second, sine * math.sin(turn))
    return _unit(_sum(flat, 1.0, axis, cosine))


@compiled
def _axes(normal: Vector) -> tuple[Vector, Vector]:
    """Return two unit vectors across a third (Duff et al. 2017)."""
    x, y, z = normal
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@compiled
def _sum(first: Vector, a: float, second: Vector, b: float) -> Vector:
    return a * first[0] + b * second[0], a * first[1] + b * second[1], a * first[2] + b * second[2]


@compiled
def _dot(first: Vector, second: Vector) -> float:
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@compiled
def _unit(vector: Vector) -> Vector:
    scale = 1.0 / math.sqrt(_dot(vector, vector))
    return scale * vector[0], scale * vector[1], scale * vector[2]


@compiled
def _count(cells: Counts, toward: Vector, sphere: Sphere) -> None:
    polar = math.atan2(math.hypot(toward[0], toward[1]), toward[2]) / math.pi
    around = math.atan2(toward[1], toward[0]) / (2.0 * math.pi)
    column = math.floor(around * sphere.azimuths + 0.5) % sphere.azimuths
    cells[int(polar * sphere.polar_steps + 0.5), column] += 1


@compiled
def _uniform(random: Random) -> float:
    """Draw from 0 up to less than 1 (SplitMix64)."""
    random[0] += _GOLDEN
    return float(_mixed(random[0]) >> _S11) * 2.0**-53


@compiled
def _mixed(word: np.uint64) -> np.uint64:
    word = (word ^ (word >> _S30)) * _MIX_1
    word = (word ^ (word >> _S27)) * _MIX_2
    return word ^ (word >> _S31)
