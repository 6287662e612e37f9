"""Indirect light by Mitsuba's own path tracer, one light group at a time.

The first renderer of this program, its fallback without LLVM, and later its independent check. The light
that the direct table holds (eye – small source) is left out: the same samples are rendered once at full depth
and once at depth 1, where a camera sees nothing but emission, and the difference taken; the bodies of the
sources hide what is behind them in both.
"""

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.lens import intrinsics_of
from nir_render.errors import InputError
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.motion import Pose
from nir_render.transport import world
from nir_render.transport.backend import backend
from nir_render.transport.light import DirectTable, Indirect

_BATCHES = 8
# The scalar variants are 4 to 6 times slower; they get by with fewer samples, and the noise says so.
_SCALAR_SAMPLES = 4
# Mitsuba's camera looks along z with x to the left and y up; ours has x right and y down.
_CAMERA_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0])


def indirect(
    scene: Scene, name: str, camera: Camera, pose: Pose, time_s: float, seed: int, direct: DirectTable
) -> Indirect | None:
    """Return the indirect light of all groups, or None where nothing reflects and no lamp shines.

    Parameters
    ----------
    name, camera, pose
        The observing camera, `robot.camera`, and the pose of its axes in the world.
    direct
        The direct light of the same camera: it tells which sources the camera sees.
    """
    if not world.has_indirect_light(scene):
        return None
    settings = scene.document.render.indirect
    samples = samples_of(scene)
    batches = min(_BATCHES, samples)
    columns, rows = camera.sensor.columns, camera.sensor.rows
    if columns % settings.scale or rows % settings.scale:
        raise InputError(
            f"{scene.path}: render.indirect.scale: {settings.scale} does not divide the sensor of {name}, "
            f"{columns} × {rows} pixels; take a divisor of both"
        )
    groups = world.groups(scene)
    sensor = _sensor(camera, pose, settings.scale)
    seen = {
        int(group) for group, share in zip(direct.group, direct.visible_fraction, strict=True) if share > 0
    }
    means, variances = [], []
    for group, emitter in enumerate(groups):
        bodies = world.build(scene, time_s, emitting=emitter)
        renders = np.stack(
            [
                _batch(bodies, sensor, samples // batches, settings.max_depth, key, straight=group in seen)
                for key in (_seed(seed, name, time_s, emitter, batch) for batch in range(batches))
            ]
        )
        means.append(renders.mean(axis=0))
        variances.append(renders.var(axis=0, ddof=1) / batches)
    return Indirect(
        radiance_per_w=np.stack(means)[:, None].astype(np.float32),
        variance=np.stack(variances)[:, None].astype(np.float32),
        scale=settings.scale,
        samples=samples,
    )


def samples_of(scene: Scene) -> int:
    """Return the samples per pixel that this machine renders a scene with: fewer without LLVM."""
    asked = scene.document.render.indirect.samples
    return asked if backend().vectorised else min(asked, _SCALAR_SAMPLES)


def _batch(
    bodies: Any, sensor: Any, samples: int, max_depth: int, seed: int, *, straight: bool
) -> NDArray[np.float64]:
    """Return one estimate of the radiance without straight emission, shape (rows, columns)."""
    mi = backend().mi
    whole = mi.load_dict({"type": "path", "max_depth": max_depth})
    image = np.array(
        mi.render(bodies, sensor=sensor, integrator=whole, spp=samples, seed=seed), dtype=np.float64
    )
    if straight:
        emission = mi.load_dict({"type": "path", "max_depth": 1})
        shown = mi.render(bodies, sensor=sensor, integrator=emission, spp=samples, seed=seed)
        # The same seed draws the same places in each pixel, so the emission cancels sample by sample.
        image -= np.array(shown, dtype=np.float64)
    return image.reshape(image.shape[:2])


def _sensor(camera: Camera, pose: Pose, scale: int) -> Any:
    mi = backend().mi
    lens = intrinsics_of(camera)
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation @ _CAMERA_FROM_MITSUBA
    matrix[:3, 3] = pose.position_m
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * lens.width_px / lens.fx_px))),
            "fov_axis": "x",
            "near_clip": 1e-4,
            "to_world": mi.ScalarTransform4f(matrix),
            "film": {
                "type": "hdrfilm",
                "width": lens.width_px // scale,
                "height": lens.height_px // scale,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent"},
        }
    )


def _seed(*key: object) -> int:
    """Return a seed of 32 bits for one batch of one group."""
    text = "|".join(repr(part) for part in ("indirect", *key))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "little")
