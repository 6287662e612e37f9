"""A tiny scene whose answer is known, rendered by Mitsuba's own path tracer."""

import math

import numpy as np

from nir_render.transport.backend.variant import mi

_RADIUS_M = 0.05


def radiance_of_source() -> tuple[float, float]:
    """Return the radiance of a 1 W spherical source as rendered, and as Φ / (4π² r²), in W/(m² sr)."""
    expected = 1.0 / (4.0 * math.pi**2 * _RADIUS_M**2)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "source": {
                "type": "sphere",
                "radius": _RADIUS_M,
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": expected}},
            },
            "sensor": {
                "type": "perspective",
                "fov": 1.0,
                "to_world": mi.ScalarTransform4f().look_at([0.0, 0.0, 0.5], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 4,
                    "height": 4,
                    "pixel_format": "luminance",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
            },
        }
    )
    return float(np.mean(np.array(mi.render(scene, spp=4)))), expected
