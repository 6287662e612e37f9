"""A scene's numbers on the device: rays, lights, facets, the guide, fog."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.fog import MOST_HEIGHTS
from nir_render.spectra.skies import CieSky
from nir_render.transport.backend.variant import dr, mi
from nir_render.transport.indirect.guide import Guide
from nir_render.transport.indirect.kernel.nodes import NodeTable
from nir_render.transport.indirect.kernel.sky import SkyTable, upload_sky
from nir_render.transport.indirect.kernel.types import Float, Int, Mask, MitsubaScene, Point, UInt, Vector
from nir_render.transport.world.emitters import RECTANGLE, SKY, SPHERE, SUN, Emitters
from nir_render.transport.world.facets import PANE, Facets
from nir_render.transport.world.fog_depth import HeightProfile
from nir_render.transport.world.medium import Medium
from nir_render.transport.world.pattern import Pattern
from nir_render.transport.world.phase import CELLS

# What a turn adds to the count of a path's turns: the low half counts all, the high half those in fog.
TURN = 1
TURN_IN_FOG = TURN + 2**16
_EDGELESS_M = 1e30  # stands for infinity, whose products with 0 are not numbers
HEIGHTS = MOST_HEIGHTS + 1
_LEVEL = (
    1e-3  # of a profile's height: of less rise, heights that flights are drawn to would lose their digits
)


@dataclass(frozen=True, eq=False)
class Lights:
    """Emitters on the device; see `transport.world.emitters.Emitters`. `has_*`: what a program must hold."""

    count: UInt
    rows: int
    lights: UInt
    group: UInt
    kind: UInt
    center: Float
    radius: Float
    spread: Float  # half the extent of a light: nearer than this fog does not aim at its middle
    half_u: Float
    half_v: Float
    normal: Float
    versine: Float
    radiance: Float
    facet: Int
    image: Int
    power: Float
    tier: UInt
    tiers: int
    by_tier: UInt  # rows, tier by tier
    first_of_tier: UInt  # where those of a tier begin in `by_tier`, and where the last ends
    pattern: Float  # values of all patterns, one after the other
    pattern_first: Int  # where each light's begins, −1 for none
    pattern_azimuths: UInt
    pattern_axes: Float  # world from the source's own axes, 9 numbers for each light
    pattern_polars: int
    sun: int  # row of the sun, −1 for none
    sky: int  # row of the sky, −1 for none
    sky_alone: bool  # in its tier
    sky_table: SkyTable | None
    has_spheres: bool
    has_rectangles: bool
    has_images: bool

    def of_tier(self, tier: UInt | None, active: Mask) -> tuple[UInt, UInt]:
        """Return where the lights of a tier begin in `by_tier`, and how many they are; all of one tier."""
        if tier is None:
            return mi.UInt32(0), self.count
        first, end = (dr.gather(mi.UInt32, self.first_of_tier, tier + k, active) for k in range(2))
        return first, end - first

    def row_of_tier(self, tier: UInt | None, place: UInt, active: Mask) -> UInt:
        """Return the light at a place in `by_tier`."""
        return place if tier is None else dr.gather(mi.UInt32, self.by_tier, place, active)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Facets on the device, and what each of Mitsuba's shapes is, by its number."""

    center: Float
    half_u: Float  # half extents over their squared length: their product with an offset is in [−1, 1] inside
    half_v: Float
    normal: Float
    kind: UInt
    index: Float
    factor: Float
    transmission: Float
    two_sided: Mask
    facet_count: int
    panes: UInt  # facets that are panes
    pane_count: int
    light_of_shape: Int  # the light whose body a shape is, −1 for none
    facet_of_shape: Int  # first facet of a shape, −1 for none
    box_of_shape: Mask  # whether its facets are the faces of a box
    glass_of_shape: Mask  # whether it is a transparent solid
    pane_of_shape: Mask


@dataclass(frozen=True, eq=False)
class Choice:
    """The guide on the device."""

    low: Point
    cells_per_m: Vector
    top: Point
    stride_y: UInt
    stride_z: UInt
    cells: UInt
    cumulative: Float
    chance: Float
    tier_share: Float  # of each tier in each cell


@dataclass(frozen=True, eq=False)
class HeightTable:
    """The density of fog over height, over that of its extinction (`world.fog_depth.HeightProfile`).

    Of each of `HEIGHTS` points; those beyond the highest of the profile are endlessly high. `level` is the
    rise below which a flight counts as level, `below` the density below the lowest point.
    """

    height: Float
    density: Float
    slope: Float  # of the density, up to the next point
    column: Float  # ∫ of the density from the lowest point
    lowest: Float
    below: Float
    level: Float


@dataclass(frozen=True, eq=False)
class FogTable:
    """Fog on the device; `typical` is the mean extinction over the profile, for choices alone."""

    extinction: Float
    typical: Float
    profile: HeightTable | None
    albedo: Float
    low: Point
    high: Point
    versine: Float
    angle: Float
    density: Float
    cumulative: Float
    arc: Float
    halo: Float


@dataclass(frozen=True, eq=False)
class DeviceScene:
    """All that a walk reads. `bodies` is Mitsuba's scene, `opaque` the same without panes.

    `opaque` is None where panes are passed one by one, in `bodies`: Dr.Jit traces one scene alone in a kernel
    on a GPU, and takes all rays into another as unhindered.
    `max_depth` is the longest path, in stretches, as Mitsuba counts; `nodes` is None where light of one
    wavelength alone is carried. `pictures` tells whether any surface has a picture laid on it. With `narrow`
    light that was turned twice or more, by fog at least once, is apart: a turn is where a surface or fog
    scatters light evenly, fog by an angle whose versine, 1 − cos θ, is above that.
    """

    bodies: MitsubaScene
    opaque: MitsubaScene | None
    lights: Lights
    surfaces: Surfaces
    choice: Choice
    fog: FogTable | None
    max_depth: int
    even_shapes: NDArray[np.bool_]  # which of Mitsuba's shapes are flat, matt and of one reflectance
    nodes: NodeTable | None = None
    pictures: bool = False
    narrow: Float | None = None

    @property
    def node_count(self) -> int:
        """How many wavelengths are carried."""
        return 1 if self.nodes is None else self.nodes.count


def upload_lights(
    emitters: Emitters,
    power: NDArray[np.float64],
    patterns: list[Pattern | None],
    axes: NDArray[np.float64],
    sky: CieSky | None = None,
    tier: NDArray[np.int64] | None = None,
) -> Lights:
    """Bring emitters to the device.

    Parameters
    ----------
    power
        What one unit of each group's emission counts in choices, shape (groups,).
    patterns
        The emission pattern of each light, None for the same in all directions.
    axes
        World from the source's own axes, shape (lights, 3, 3).
    sky
        How bright the sky is over directions, None where there is none.
    tier
        The tier of each emitter (`guide.Guide`), shape (emitters,); without, all are of one.
    """
    tier = np.zeros(len(emitters.kind), dtype=np.int64) if tier is None else tier
    values, first, azimuths = [np.ones(1)], [], []
    for pattern in patterns:
        first.append(-1 if pattern is None else sum(map(len, values)))
        azimuths.append(1 if pattern is None else pattern.values.shape[1])
        if pattern is not None:
            values.append(pattern.values.ravel())
    polars = max([2, *(pattern.values.shape[0] for pattern in patterns if pattern is not None)])
    suns = np.flatnonzero((emitters.kind == SUN) & (emitters.facet < 0))
    skies = np.flatnonzero(emitters.kind == SKY)
    half_m = np.linalg.norm(emitters.half_u_m + emitters.half_v_m, axis=1)
    return Lights(
        count=dr.opaque(mi.UInt32, len(emitters.kind)),
        rows=len(emitters.kind),
        lights=dr.opaque(mi.UInt32, emitters.lights),
        group=_whole(emitters.group),
        kind=_whole(emitters.kind),
        center=_real(emitters.center_m),
        radius=_real(emitters.radius_m),
        spread=_real(np.maximum(emitters.radius_m, half_m)),
        half_u=_real(emitters.half_u_m),
        half_v=_real(emitters.half_v_m),
        normal=_real(emitters.normal),
        versine=_real(emitters.versine),
        radiance=_real(emitters.radiance),
        facet=mi.Int32(emitters.facet.astype(np.int32)),
        image=mi.Int32(np.append(emitters.image.ravel(), -1).astype(np.int32)),
        power=_real(power[emitters.group]),
        tier=_whole(tier),
        tiers=int(tier.max(initial=0)) + 1,
        by_tier=_whole(np.argsort(tier, kind="stable")),
        first_of_tier=_whole(np.searchsorted(np.sort(tier), np.arange(int(tier.max(initial=0)) + 2))),
        pattern=_real(np.concatenate(values)),
        pattern_first=mi.Int32(np.array(first, dtype=np.int32)),
        pattern_azimuths=_whole(np.array(azimuths)),
        pattern_axes=_real(axes),
        pattern_polars=0 if all(pattern is None for pattern in patterns) else polars,
        sun=int(suns[0]) if suns.size else -1,
        sky=int(skies[0]) if skies.size else -1,
        sky_alone=bool(skies.size) and int(np.count_nonzero(tier == tier[skies[0]])) == 1,
        sky_table=None if sky is None else upload_sky(sky),
        has_spheres=bool((emitters.kind == SPHERE).any()),
        has_rectangles=bool((emitters.kind == RECTANGLE).any()),
        has_images=bool((emitters.facet >= 0).any()),
    )


def upload_surfaces(facets: Facets, shapes: dict[str, NDArray[np.int64]]) -> Surfaces:
    """Bring facets to the device; `shapes` holds the columns `*_of_shape` that `groups` has gathered."""
    panes = np.flatnonzero(facets.kind == PANE)

    def over_square(half_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(half_m / (half_m**2).sum(axis=1, keepdims=True))

    return Surfaces(
        center=_real(facets.center_m),
        half_u=_real(over_square(facets.half_u_m)),
        half_v=_real(over_square(facets.half_v_m)),
        normal=_real(facets.normal),
        kind=_whole(facets.kind),
        index=_real(facets.index),
        factor=_real(facets.factor),
        transmission=_real(facets.transmission),
        two_sided=mi.Bool(np.append(facets.two_sided, False)),
        facet_count=len(facets.kind),
        panes=_whole(panes),
        pane_count=len(panes),
        light_of_shape=mi.Int32(shapes["light"].astype(np.int32)),
        facet_of_shape=mi.Int32(shapes["facet"].astype(np.int32)),
        box_of_shape=mi.Bool(shapes["box"].astype(bool)),
        glass_of_shape=mi.Bool(shapes["glass"].astype(bool)),
        pane_of_shape=mi.Bool(shapes["pane"].astype(bool)),
    )


def upload_guide(guide: Guide) -> Choice:
    """Bring the guide to the device."""
    x, y, _ = (int(count) for count in guide.counts)
    return Choice(
        low=mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in guide.low_m)),
        cells_per_m=mi.Vector3f(*(dr.opaque(mi.Float, float(1.0 / value)) for value in guide.step_m)),
        top=mi.Point3f(*(dr.opaque(mi.Float, float(count) - 0.5) for count in guide.counts)),
        stride_y=dr.opaque(mi.UInt32, x),
        stride_z=dr.opaque(mi.UInt32, x * y),
        cells=dr.opaque(mi.UInt32, int(np.prod(guide.counts))),
        cumulative=mi.Float(guide.cumulative.ravel()),
        chance=mi.Float(guide.chance.ravel()),
        tier_share=_real(guide.tier_share),
    )


def upload_fog(medium: Medium) -> FogTable:
    """Bring fog to the device."""
    low, high = (np.clip(bound, -_EDGELESS_M, _EDGELESS_M) for bound in (medium.low_m, medium.high_m))
    assert len(medium.phase.arc) == CELLS + 1  # the lookups count on it
    return FogTable(
        extinction=dr.opaque(mi.Float, medium.extinction_per_m),
        typical=dr.opaque(mi.Float, medium.mean_extinction_per_m()),
        profile=None if medium.profile is None else _upload_profile(medium.profile),
        albedo=dr.opaque(mi.Float, medium.albedo),
        low=mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in low)),
        high=mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in high)),
        versine=_real(medium.phase.versine),
        angle=_real(medium.phase.angle_rad),
        density=_real(medium.phase.density_per_sr),
        cumulative=_real(medium.phase.cumulative),
        arc=_real(medium.phase.arc),
        halo=_real(medium.phase.halo),
    )


def _upload_profile(profile: HeightProfile) -> HeightTable:
    more = HEIGHTS - len(profile.height_m)
    slope_per_m = np.append(np.diff(profile.density) / np.diff(profile.height_m), np.zeros(more + 1))
    span_m = float(profile.height_m[-1] - profile.height_m[0])
    return HeightTable(
        height=_real(np.append(profile.height_m, np.full(more, _EDGELESS_M))),
        density=_real(np.append(profile.density, np.full(more, profile.density[-1]))),
        slope=_real(slope_per_m),
        column=_real(np.append(profile.column_m, np.full(more, _EDGELESS_M))),
        lowest=dr.opaque(mi.Float, float(profile.height_m[0])),
        below=dr.opaque(mi.Float, float(profile.density[0])),
        level=dr.opaque(mi.Float, _LEVEL * span_m),
    )


def along_table(place: Float, end: float | Point) -> Float:
    """Return a place on a table's axis, kept to 0 … `end`; 0 where it is no number, as in lanes that rest.

    As a whole number NaN is 2³¹ on processors without AVX-512: a gather there reads memory that is not ours.
    """
    return dr.select(place > 0.0, dr.minimum(place, end), 0.0)


def _real(values: NDArray[np.float64]) -> Float:
    """Return an array on the device, never empty, which could not be read from."""
    flat = np.asarray(values, dtype=np.float32).ravel()
    return mi.Float(flat if flat.size else np.zeros(4, dtype=np.float32))


def _whole(values: NDArray[np.int64]) -> UInt:
    flat = np.asarray(values, dtype=np.uint32).ravel()
    return mi.UInt32(flat if flat.size else np.zeros(4, dtype=np.uint32))
