"""What shines, as arrays for next-event estimation: each light, and its images in flat smooth surfaces."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.geometry import cone_versine, rectangle_frame
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.world.facets import Facets, reflectance

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SPHERE, RECTANGLE, SUN, SKY = 0, 1, 2, 3


@dataclass(frozen=True, eq=False)
class Emitters:
    """One row per light, in the order of the scene's groups, then one per image of a light in a facet.

    Attributes
    ----------
    group
        Light group, shape (n,).
    kind
        SPHERE, RECTANGLE, SUN or SKY, shape (n,).
    center_m
        Centre, shape (n, 3); of an image, the mirrored centre. Zero for sun and sky.
    half_u_m, half_v_m
        From the centre to the edges of a rectangle, shape (n, 3).
    normal
        Where a rectangle shines, or where the sun stands, unit vectors, shape (n, 3).
    radius_m
        Radius of a sphere, shape (n,).
    versine
        1 − cos of the sun's angular radius, shape (n,).
    radiance
        Radiance per unit of the group's emission, on average over directions, shape (n,).
    facet
        The facet that shows this image, −1 for the lights themselves, shape (n,).
    image
        Row of the image of each light in each facet, −1 where there is none, shape (facets, lights).
    """

    group: Index
    kind: Index
    center_m: Array
    half_u_m: Array
    half_v_m: Array
    normal: Array
    radius_m: Array
    versine: Array
    radiance: Array
    facet: Index
    image: Index

    @property
    def lights(self) -> int:
        """The number of lights without their images."""
        return int(self.image.shape[1])


def emitters(snapshot: Snapshot, facets: Facets) -> Emitters:
    """Return the lights of a scene at a time and their images in its facets."""
    rows = _lights(snapshot)
    lights = len(rows["kind"])
    image = np.full((len(facets.kind), lights), -1, dtype=np.int64)
    parts = [rows]
    for facet in range(len(facets.kind)):
        chosen = _shown(rows, facets, facet)
        image[facet, chosen] = sum(len(part["kind"]) for part in parts) + np.arange(len(chosen))
        parts.append(_mirrored({name: column[chosen] for name, column in rows.items()}, facets, facet))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in rows}
    return Emitters(**columns, image=image)


def _lights(snapshot: Snapshot) -> dict[str, NDArray[Any]]:
    names = snapshot.groups
    count = len(names)
    rows: dict[str, NDArray[Any]] = {
        "group": np.arange(count),
        "kind": np.zeros(count, dtype=np.int64),
        **{name: np.zeros((count, 3)) for name in ("center_m", "half_u_m", "half_v_m", "normal")},
        **{name: np.zeros(count) for name in ("radius_m", "versine", "radiance")},
        "facet": np.full(count, -1),
    }
    for row, name in enumerate(names):
        if name in snapshot.sources:
            placed = snapshot.sources[name]
            radius_m = placed.source.radius_m
            rows["center_m"][row] = placed.pose.position_m
            rows["radius_m"][row] = radius_m
            rows["radiance"][row] = 1.0 / (4.0 * np.pi**2 * radius_m**2)  # one watt from the whole sphere
        elif name.startswith("lamps."):
            lamp = snapshot.lamps[name.removeprefix("lamps.")]
            frame = rectangle_frame(lamp.normal, lamp.size_m, 0.0)
            rows["kind"][row] = RECTANGLE
            rows["center_m"][row] = lamp.center_m
            rows["half_u_m"][row], rows["half_v_m"][row], rows["normal"][row] = frame.T
            rows["radiance"][row] = 1.0 / (np.pi * lamp.size_m[0] * lamp.size_m[1])  # one watt from one side
        elif name == "sky":
            rows["kind"][row] = SKY
            rows["radiance"][row] = 1.0 / np.pi  # 1 W/m² on a horizontal plane, on the mean over it
        else:
            sun = snapshot.sun
            assert sun is not None  # the group is there because the sun is
            rows["kind"][row] = SUN
            rows["normal"][row] = sun.direction
            rows["versine"][row] = cone_versine(sun.angular_radius_rad)
            # 1 W/m² across its direction: L = 1 / (π sin² α).
            rows["radiance"][row] = 1.0 / (np.pi * np.sin(sun.angular_radius_rad) ** 2)
    return rows


def _shown(rows: dict[str, NDArray[Any]], facets: Facets, facet: int) -> Index:
    """Return the lights that stand before a facet, so that it can show them.

    Of the sky there are no images: it is large, and paths meet it by themselves.
    """
    normal = facets.normal[facet]
    height_m = (rows["center_m"] - facets.center_m[facet]) @ normal
    reach_m = rows["radius_m"] + np.abs(rows["half_u_m"] @ normal) + np.abs(rows["half_v_m"] @ normal)
    sun = rows["kind"] == SUN
    height_m = np.where(sun, rows["normal"] @ normal, height_m)
    before = facets.two_sided[facet] | (height_m + reach_m > 0.0)
    reflects = float(reflectance(facets, facet, 0.0)) > 0.0
    return np.flatnonzero(before & reflects & (rows["kind"] != SKY))


def _mirrored(rows: dict[str, NDArray[Any]], facets: Facets, facet: int) -> dict[str, NDArray[Any]]:
    normal = facets.normal[facet]

    def turned(vectors: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(vectors - 2.0 * np.outer(vectors @ normal, normal))

    sun = (rows["kind"] == SUN)[:, None]
    center_m = facets.center_m[facet] + turned(rows["center_m"] - facets.center_m[facet])
    return {
        **rows,
        "center_m": np.where(sun, 0.0, center_m),
        "half_u_m": turned(rows["half_u_m"]),
        "half_v_m": turned(rows["half_v_m"]),
        "normal": turned(rows["normal"]),
        "facet": np.full(len(rows["kind"]), facet),
    }
