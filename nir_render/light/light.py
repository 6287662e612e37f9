"""The product of transport: how one watt of each light group reaches a camera. Plain numpy, read-only."""

import html
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.light.averages import Averages, averages
from nir_render.light.enlarge import Enlargement
from nir_render.spectra.nodes import Node, nodes_at

MAY_BE_MISSING = {"may_be_missing": True}
"""Metadata of a field that files leave out where it is None: lights without it keep their hash."""


class _ReadOnly:
    """Makes the arrays of a dataclass read-only."""

    def __post_init__(self) -> None:
        for known in fields(self):  # type: ignore[arg-type]
            array = getattr(self, known.name)
            if isinstance(array, np.ndarray):
                array.setflags(write=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()


@dataclass(frozen=True, eq=False)
class DirectTable(_ReadOnly):
    """The light of small sources, the sun among them, that is seen straight or in one flat smooth surface.

    One row per source in front of the camera, hidden or not, then one per ghost of which a part is seen: the
    image of a source in a mirror, a pane, a smooth coat. A ghost stands at the mirrored place of its source;
    that is where its row says it is.

    Attributes
    ----------
    group
        Index into the light's groups, shape (n,).
    facet
        Index into the light's `mirrors` of the surface that shows a ghost, −1 where the source itself is
        seen, shape (n,).
    direction
        Unit vectors to the centres in camera axes, shape (n, 3).
    distance_m
        Lens to the centre, shape (n,); infinite for the sun.
    angular_radius_rad
        Half the angle that the disc fills, shape (n,).
    seen
        Which of the rays that cover the disc (`geometry.sunflower`) arrive, shape (n, `visibility_rays`).
    visible_fraction
        Share of the disc that the lens sees, the mean of `seen`, shape (n,).
    irradiance_per_w
        Irradiance across the direction at the lens for one unit of the group's emission (1 W; of the sun
        1 W/m² across its own direction), in 1/m² (of the sun: 1), shape (n, nodes). Hidden parts are left
        out; emission pattern, fog, panes and the ghost's reflectance are in it.
    visibility_rays
        Rays that sampled each disc: the resolution of `visible_fraction`.
    """

    group: NDArray[np.int64]
    facet: NDArray[np.int64]
    direction: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    angular_radius_rad: NDArray[np.float64]
    seen: NDArray[np.bool_]
    visible_fraction: NDArray[np.float64]
    irradiance_per_w: NDArray[np.float64]
    visibility_rays: int

    @property
    def shining(self) -> NDArray[np.int64]:
        """The rows that bring light at any node, shape (n,)."""
        return np.flatnonzero((self.irradiance_per_w > 0.0).any(axis=1))


NO_SOURCES = DirectTable(
    group=np.empty(0, dtype=np.int64),
    facet=np.empty(0, dtype=np.int64),
    direction=np.empty((0, 3)),
    distance_m=np.empty(0),
    angular_radius_rad=np.empty(0),
    seen=np.empty((0, 0), dtype=bool),
    visible_fraction=np.empty(0),
    irradiance_per_w=np.empty((0, 1)),
    visibility_rays=0,
)
"""The table of a camera that no small source shines on."""


@dataclass(frozen=True, eq=False)
class Edges(_ReadOnly):
    """What keeps the edges of light that was rendered in blocks sharp.

    `radiance_per_w` and `variance`, shape (group, node, pixel), are those of the pixels
    `enlargement.patch`, which are rendered one by one.
    """

    enlargement: Enlargement
    radiance_per_w: NDArray[np.float32]
    variance: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Multiple(_ReadOnly):
    """Light in fog that was turned twice or more, by fog at least once: it changes slowly in the image.

    Frames are made of its averages over blocks around, of the same surface (`light.averages`): inside a large
    surface these have a nineteenth of its variance.

    Attributes
    ----------
    radiance_per_w, variance
        Of this part alone, as those of `Indirect`, which contain it.
    covariance
        Of the means of this part and of the rest, same shape.
    surface
        A number for the surface in each block of the film, shape (row, column); −1 where one stands alone.
    """

    radiance_per_w: NDArray[np.float32]
    variance: NDArray[np.float32]
    covariance: NDArray[np.float32]
    surface: NDArray[np.int32]

    @property
    def averages(self) -> Averages:
        """How blocks are averaged."""
        return averages(self.surface)


@dataclass(frozen=True, eq=False)
class Indirect(_ReadOnly):
    """All other light: off walls and floor, mirrored more than once, through glass, from lamps, off fog.

    Attributes
    ----------
    radiance_per_w
        Mean radiance over each pixel for one watt of each group, in 1/(m² sr), float32, shape
        (group, node, row, column). Noise of pixels is independent here; see `in_frames`.
    variance
        Variance of that mean, from batches, same shape.
    scale
        Camera pixels per pixel of these arrays, along each axis.
    samples
        Samples per pixel of these arrays; where they differ, their median.
    counts
        Samples in each pixel, shape (row, column); None where all have the same.
    edges
        How these arrays are enlarged where surfaces meet; None where the scale is 1 and where they are not
        known, and everything is interpolated.
    multiple
        What of this light is averaged over blocks, in fog; None where nothing is.
    """

    radiance_per_w: NDArray[np.float32]
    variance: NDArray[np.float32]
    scale: int
    samples: int
    counts: NDArray[np.int32] | None = None
    edges: Edges | None = None
    multiple: Multiple | None = field(default=None, metadata=MAY_BE_MISSING)

    def in_frames(self, group: int, node: int) -> NDArray[np.float32]:
        """Return a group's mean radiance per watt as frames have it, averaged where it is, (row, column)."""
        whole: NDArray[np.float32] = self.radiance_per_w[group, node]
        if self.multiple is None:
            return whole
        part = self.multiple.radiance_per_w[group, node]
        return np.asarray(whole + (self.multiple.averages.of(part) - part), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Light:
    """The light that reaches one camera with the scene's geometry at one time.

    `groups` are the names of what can be switched apart: `robot.source`, `lamps.name`, `sun`;
    `wavelengths_m` the nodes. `indirect` is None where nothing reflects or scatters and no lamp shines.
    `mirrors` names the flat smooth surfaces that the rows of `direct` speak of, as `shapes.mirror`.
    `short_pixels` is in how many pixels of the film a bound cut the samples below what a target for the noise
    asks for. `kept` is for what follows from a light and takes long: it goes when the light goes.
    """

    camera: str
    time_s: float
    seed: int
    groups: tuple[str, ...]
    wavelengths_m: tuple[float, ...]
    direct: DirectTable
    indirect: Indirect | None
    mirrors: tuple[str, ...] = ()
    short_pixels: int = 0
    kept: dict[str, Any] = field(init=False, default_factory=dict, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "kept": {}}  # what follows from it is found again where it arrives

    @property
    def nodes(self) -> tuple[Node, ...]:
        """The wavelength nodes."""
        return nodes_at(self.wavelengths_m)

    def _repr_html_(self) -> str:
        """Show the direct table in a notebook."""
        titles = ("group", "seen in", "distance m", "visible", "irradiance per watt 1/m²")
        head = f"<tr>{''.join(f'<th>{title}</th>' for title in titles)}</tr>"
        rows = "".join(
            f"<tr><td>{html.escape(self.groups[group])}</td>"
            f"<td>{html.escape(self.mirrors[facet]) if facet >= 0 else ''}</td><td>{distance_m:.3f}</td>"
            f"<td>{fraction:.2f}</td><td>{irradiance.mean():.3g}</td></tr>"
            for group, facet, distance_m, fraction, irradiance in zip(
                self.direct.group,
                self.direct.facet,
                self.direct.distance_m,
                self.direct.visible_fraction,
                self.direct.irradiance_per_w,
                strict=True,
            )
        )
        return f"<p>{html.escape(self.camera)} at {self.time_s:.4g} s</p><table>{head}{rows}</table>"
