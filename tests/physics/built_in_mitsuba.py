"""A source as it is built, as a scene of Mitsuba's own shapes, media and path tracer: it shares no code with ours."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.built.cover import Translucent
from nir_render.scene.documents.built.source import BuiltSource
from nir_render.transport.backend.variant import mi

# Mitsuba lifts rays off surfaces by 9e-5 (1 + the largest coordinate): in units of 0.1 mm that is little.
_PER_M = 1e4
_RINGS, _AROUND = 256, 512
_WIDER = 1.35  # than the cover: the board beside it shines too


def mitsuba_scene(built: BuiltSource) -> Any:
    """Return a source with one die on the axis and a smooth translucent cover, of a flux of 1."""
    cover, board, (die,) = built.cover, built.board, built.dies
    assert cover is not None
    assert board is not None
    material = cover.material
    assert isinstance(material, Translucent)
    assert material.scattering_length_m is not None
    wall = mi.load_dict(
        {
            "type": "homogeneous",
            "albedo": material.albedo,
            "sigma_t": 1.0 / (material.albedo * material.scattering_length_m * _PER_M),
            "phase": {"type": "hg", "g": material.g},
        }
    )
    into = {"type": "dielectric", "int_ior": material.index, "ext_ior": 1.0}
    out_of = {"type": "dielectric", "int_ior": 1.0, "ext_ior": material.index}
    place = mi.ScalarTransform4f
    paint = {
        "type": "twosided",
        "one": {"type": "diffuse", "reflectance": {"type": "uniform", "value": board.reflectance}},
    }
    radiance = 1.0 / (math.pi**2 * die.radius_m**2)
    return mi.load_dict(
        {
            "type": "scene",
            "outer": _cap(cover.radius_m, cover.height_m, {"bsdf": mi.load_dict(into), "interior": wall}),
            "inner": _cap(
                cover.radius_m - cover.thickness_m,
                cover.height_m,
                {"bsdf": mi.load_dict(out_of), "exterior": wall},
            ),
            "board": {"type": "disk", "to_world": place().scale(board.radius_m * _PER_M), "bsdf": paint},
            "die": {
                "type": "disk",
                "to_world": place().translate([0, 0, 0.03]).scale(die.radius_m * _PER_M),
                "bsdf": paint,
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": radiance}},
            },
        }
    )


def intensity_at(
    scene: Any, built: BuiltSource, polar_rad: float, samples: int, seed: int, distance_m: float = 1.0
) -> float:
    """Return E d² at a camera that looks at the middle of the source: all the radiance in its picture, summed."""
    cover = built.cover
    assert cover is not None
    half = _WIDER * cover.radius_m / distance_m
    middle = np.array([0.0, 0.0, cover.height_m * _PER_M])
    away = distance_m * _PER_M * np.array([math.sin(polar_rad), 0.0, math.cos(polar_rad)])
    camera = mi.load_dict(
        {
            "type": "perspective",
            "fov": 2.0 * math.degrees(math.atan(half)),
            "near_clip": 1.0,
            "far_clip": 1e6,
            "to_world": mi.ScalarTransform4f().look_at((middle + away).tolist(), middle.tolist(), [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": 32,
                "height": 32,
                "rfilter": {"type": "box"},
                "component_format": "float32",
                "pixel_format": "luminance",
            },
            "sampler": {"type": "independent"},
        }
    )
    # No roulette: where nothing absorbs, it makes the weights of long ways grow.
    paths = mi.load_dict({"type": "volpath", "max_depth": -1, "rr_depth": 1_000_000})
    image = np.array(mi.render(scene, sensor=camera, integrator=paths, spp=samples, seed=seed))
    return float(image[..., 0].mean()) * 4.0 * half**2 * distance_m**2


def _cap(radius_m: float, height_m: float, more: dict[str, Any]) -> Any:
    """Return what of a sphere is above z = 0, as a mesh with the sphere's normals."""
    polar = np.linspace(0.0, math.acos(-height_m / radius_m), _RINGS + 1)[1:, None]
    around = (2.0 * np.pi * np.arange(_AROUND) / _AROUND)[None, :]
    ring = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)], axis=-1)
    ring = np.concatenate([ring, np.broadcast_to(np.cos(polar)[..., None], (*ring.shape[:2], 1))], axis=-1)
    normal = np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3)])
    position = (normal * radius_m + [0.0, 0.0, height_m]) * _PER_M
    faces = _faces()
    fields = mi.Properties()
    for key, value in more.items():
        fields[key] = value
    mesh = mi.Mesh("cap", len(position), len(faces), has_vertex_normals=True, props=fields)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = position.astype(np.float32).ravel()
    parameters["vertex_normals"] = normal.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _faces() -> NDArray[np.int64]:
    here = np.arange(_AROUND)
    after = (here + 1) % _AROUND
    found = [np.stack([np.zeros_like(here), 1 + here, 1 + after], axis=1)]
    for ring in range(_RINGS - 1):
        upper, lower = 1 + ring * _AROUND, 1 + (ring + 1) * _AROUND
        found.append(np.stack([upper + here, lower + here, lower + after], axis=1))
        found.append(np.stack([upper + here, lower + after, upper + after], axis=1))
    return np.concatenate(found)
