"""The product of transport: how one watt of each light group reaches a camera. Plain numpy."""

import html
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class DirectTable:
    """The light that comes straight from small sources: one row per source in front of the camera.

    Attributes
    ----------
    group
        Index into the light's groups, shape (n,).
    direction
        Unit vectors to the sources' centres in camera axes, shape (n, 3).
    distance_m
        Lens to the source's centre, shape (n,).
    angular_radius_rad
        Half the angle that the source fills, shape (n,).
    visible_fraction
        Share of the source's disc that the lens sees, shape (n,); multiples of 1/`visibility_rays`.
    irradiance_per_w
        Irradiance across the direction at the lens for one watt of the group's flux, hidden parts left out,
        in 1/m², shape (n, nodes).
    visibility_rays
        Rays that sampled each source's visibility: the resolution of `visible_fraction`.
    """

    group: NDArray[np.int64]
    direction: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    angular_radius_rad: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]
    irradiance_per_w: NDArray[np.float64]
    visibility_rays: int


@dataclass(frozen=True, eq=False)
class Indirect:
    """All other light: off walls and floor, in mirrors, through glass, from lamps, seen or not.

    Attributes
    ----------
    radiance_per_w
        Mean radiance over each pixel for one watt of each group, in 1/(m² sr), float32, shape
        (group, node, row, column).
    variance
        Variance of that mean, from batches, same shape.
    scale
        Camera pixels per pixel of these arrays, along each axis.
    samples
        Samples per pixel of these arrays.
    """

    radiance_per_w: NDArray[np.float32]
    variance: NDArray[np.float32]
    scale: int
    samples: int


@dataclass(frozen=True, eq=False)
class Light:
    """The light that reaches one camera with the scene's geometry at one time.

    `groups` are the names of what can be switched apart: `robot.source`, `lamps.name`; `wavelengths_m` the
    nodes. `indirect` is None where nothing reflects and no lamp shines.
    """

    camera: str
    time_s: float
    seed: int
    groups: tuple[str, ...]
    wavelengths_m: tuple[float, ...]
    direct: DirectTable
    indirect: Indirect | None

    def _repr_html_(self) -> str:
        """Show the direct table in a notebook."""
        head = "<tr><th>group</th><th>distance m</th><th>visible</th><th>irradiance per watt 1/m²</th></tr>"
        rows = "".join(
            f"<tr><td>{html.escape(self.groups[group])}</td><td>{distance_m:.3f}</td>"
            f"<td>{fraction:.2f}</td><td>{irradiance[0]:.3g}</td></tr>"
            for group, distance_m, fraction, irradiance in zip(
                self.direct.group,
                self.direct.distance_m,
                self.direct.visible_fraction,
                self.direct.irradiance_per_w,
                strict=True,
            )
        )
        return f"<p>{html.escape(self.camera)} at {self.time_s:.4g} s</p><table>{head}{rows}</table>"
