"""Documents of small scenes, and the rays and pictures of their cameras."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render import Scene, render

Array = NDArray[np.float64]

FOCAL_PX = 80.0
SPECTRUM = {"gaussian": {"centroid": "940 nm", "fwhm": "42 nm"}}


def camera_document(columns: int, rows: int, focal_px: float = FOCAL_PX, **pose: Any) -> dict[str, Any]:
    """Return a camera without a filter."""
    return {
        "lens": {"focal_length": f"{focal_px * 22.5e-3!r} mm", "f_number": 2.0, "transmission": 0.9},
        "sensor": {
            "columns": columns, "rows": rows, "pixel_pitch": "22.5 um", "quantum_efficiency": 0.15, "full_well": "1e+7 e",
            "read_noise": "1 e", "system_gain": "0.0004 DN/e", "black_level": "10 DN", "bit_depth": "12 bit",
        },
        "point_spread": {"sigma": "0.7 px"}, "exposure": "1 ms", **pose,
    }  # fmt: skip


def source_document(place_m: tuple[float, ...], radius_m: float) -> dict[str, Any]:
    """Return a robot that carries one source, `s`, at its origin."""
    source = {"flux": "1 W", "radius": f"{radius_m!r} m", "spectrum": SPECTRUM}
    return {"rig": {"sources": {"s": source}}, "position": f"{list(place_m)!r} m"}


def scene_document(
    cameras: dict[str, Any], sources: dict[str, Any], *, samples: int, max_depth: int, **more: Any
) -> dict[str, Any]:
    """Return a scene that one robot, `eye`, observes from the origin, looking along x."""
    return {
        "format": 1,
        "observe": ["eye"],
        "render": {"indirect": {"scale": 1, "samples": samples, "max_depth": max_depth}},
        "robots": {"eye": {"rig": {"cameras": cameras}}, **sources},
        **more,
    }


def rectangle_document(
    center_m: tuple[float, ...], size_m: tuple[float, float], normal: tuple[float, ...], material: str
) -> dict[str, Any]:
    """Return a rectangle."""
    return {
        "type": "rectangle", "center": f"{list(center_m)!r} m", "size": f"{list(size_m)!r} m", "normal": list(normal),
        "material": material,
    }  # fmt: skip


def pixel_rays(columns: int, rows: int, focal_px: float = FOCAL_PX, parts: int = 1) -> Array:
    """Return directions in world axes, x ahead, shape (rows, columns, 3), through the centres of pixels.

    With `parts`, through the centres of parts × parts pieces of each, shape (parts rows, parts columns, 3).
    """
    x = ((np.arange(parts * columns) + 0.5) / parts - 0.5 * columns) / focal_px
    y = ((np.arange(parts * rows) + 0.5) / parts - 0.5 * rows) / focal_px
    across, down = np.meshgrid(x, y)
    rays = np.stack([np.ones_like(across), -across, -down], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def group_radiance(scene: Scene, seed: int = 1, camera: str = "eye.c") -> Array:
    """Return the indirect radiance per unit of each group, shape (groups, rows, columns)."""
    light = render(scene, camera, seed=seed)
    assert light.indirect is not None
    return light.indirect.radiance_per_w[:, 0].astype(np.float64)


def tile_means(image: Array, size_px: int = 16) -> Array:
    """Return the means of square tiles of an image, shape (rows, columns), which they fill."""
    rows, columns = (length // size_px for length in image.shape)
    return np.asarray(image.reshape(rows, size_px, columns, size_px).mean(axis=(1, 3)))
