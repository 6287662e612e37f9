"""Indirect light by Mitsuba's own path tracer, one light group at a time.

The first renderer of this program, its fallback without LLVM, and later its independent check. The light
that the direct table holds (eye – small source) is left out: the same samples are rendered once at full depth
and once at depth 1, where a camera sees nothing but emission, and the difference taken; the bodies of the
sources hide what is behind them in both.

Mitsuba samples a sphere by the cone that it fills, of solid angle 2π (1 − cos α) in float32. That difference
loses its digits where the sphere is small and far: the light of a source of 10 mm is wrong by 1 % at 5 m and
by 7 % at 10 m. So sources that are small in their scene light it as points, which for a uniform sphere in
full view is exact at any distance. Sources that a body comes close to stay spheres, and so do all where
smooth surfaces show images of them; these keep that error.
"""

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.lens import intrinsics_of
from nir_render.errors import InputError
from nir_render.light.light import DirectTable, Indirect
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.document import CLEAR_DEPTH, IndirectSettings
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.materials import MaterialDocument, Retroreflector
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.backend.variant import backend, blocked, mi
from nir_render.transport.world import mitsuba_scene

_BATCHES = 8
# Radius over the scene's diagonal from which on a sphere's solid angle keeps three digits in float32.
_SMALLEST_SPHERE = 0.01
_CLEARANCE_RAYS = 256
# The scalar variants are 4 to 6 times slower; they get by with fewer samples, and the noise says so.
_SCALAR_SAMPLES = 4
_DEFAULT_SAMPLES = 16
# Mitsuba's camera looks along z with x to the left and y up; ours has x right and y down.
_CAMERA_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0])


def indirect(snapshot: Snapshot, name: str, seed: int, direct: DirectTable) -> Indirect | None:
    """Return the indirect light of all groups, or None where nothing reflects and no lamp shines.

    Parameters
    ----------
    name
        The observing camera, `robot.camera`.
    direct
        The direct light of the same camera: it tells which sources the camera sees.
    """
    if not snapshot.has_indirect_light():
        return None
    placed, settings = snapshot.camera(name), snapshot.render.indirect
    _refuse_what_only_groups_render(snapshot, placed.camera)
    samples = samples_of(settings)
    batches = min(_BATCHES, samples)
    sensor = mitsuba_camera(placed.camera, placed.pose, settings.scale)
    seen = {
        int(group) for group, share in zip(direct.group, direct.visible_fraction, strict=True) if share > 0
    }
    small_m = _SMALLEST_SPHERE * mitsuba_scene.extent_m(snapshot)
    sources = snapshot.sources
    smooth = mitsuba_scene.has_smooth_surface(snapshot)
    means, variances = [], []
    for group, emitter in enumerate(snapshot.groups):
        small = emitter in sources and sources[emitter].source.radius_m < small_m
        view = _view(snapshot, emitter, small=small and not smooth, seen=group in seen)
        keys = [_seed(seed, name, emitter, batch) for batch in range(batches)]
        renders = np.stack(
            [_batch(view, sensor, samples // batches, settings.max_depth or CLEAR_DEPTH, key) for key in keys]
        )
        means.append(renders.mean(axis=0))
        variances.append(renders.var(axis=0, ddof=1) / batches)
    return Indirect(
        radiance_per_w=np.stack(means)[:, None].astype(np.float32),
        variance=np.stack(variances)[:, None].astype(np.float32),
        scale=settings.scale,
        samples=samples,
    )


def _refuse_what_only_groups_render(snapshot: Snapshot, camera: Camera) -> None:
    """Raise InputError where there is what Mitsuba's own path tracer and camera, as used here, leave out."""
    lens = intrinsics_of(camera)
    middle_px = ((lens.width_px - 1) / 2, (lens.height_px - 1) / 2)
    parts = [
        ("fog", snapshot.fog is not None),
        ("the sun", snapshot.sun is not None),
        ("the sky", snapshot.skylight is not None),
        ("emission patterns", any(placed.source.pattern is not None for placed in snapshot.sources.values())),
        (f"a {camera.lens.model} lens", camera.lens.model != "rectilinear"),
        ("retroreflectors", any(isinstance(m, Retroreflector) for m in _used(snapshot))),
        ("a principal point off the sensor's middle", (lens.cx_px, lens.cy_px) != middle_px),
    ]
    asked = [name for name, is_there in parts if is_there]
    if asked:
        raise InputError(
            f"{snapshot.origin}: {' and '.join(asked)} in a scene whose bodies reflect or scatter needs the "
            "light-group renderer, which needs LLVM: nir-render doctor"
        )


def _used(snapshot: Snapshot) -> list[MaterialDocument]:
    return [snapshot.materials[shape.material] for shape in snapshot.shapes.values()]


def samples_of(settings: IndirectSettings) -> int:
    """Return the samples per pixel that this machine renders a scene with: fewer without LLVM.

    A target for the noise is nothing that this renderer knows.
    """
    asked = settings.samples or _DEFAULT_SAMPLES
    return asked if backend().vectorised else min(asked, _SCALAR_SAMPLES)


@dataclass(frozen=True, eq=False)
class _View:
    """One light group to render.

    `bodies` is the scene that is lit by it. `body` is the scene with the source as a sphere, where the camera
    sees it; `body_radiance` that sphere's radiance where `bodies` holds a point in its stead.
    """

    bodies: Any
    body: Any | None
    body_radiance: float | None


def _view(snapshot: Snapshot, emitter: str, *, small: bool, seen: bool) -> _View:
    """Return what to render of a group: a point if it is small and stands clear, its body if it is seen."""
    point = None
    if small:
        placed = snapshot.sources[emitter]
        point = mitsuba_scene.build(snapshot, emitting=emitter, as_point=True)
        if not _stands_clear(point, placed.pose.position_m, placed.source.radius_m):
            point = None
    whole = mitsuba_scene.build(snapshot, emitting=emitter) if seen or point is None else None
    return _View(
        bodies=whole if point is None else point,
        body=whole if seen else None,
        body_radiance=None if point is None else _radiance_of(placed.source),
    )


def _batch(view: _View, sensor: Any, samples: int, max_depth: int, seed: int) -> NDArray[np.float64]:
    """Return one estimate of the radiance without straight emission, shape (rows, columns).

    The same seed draws the same places in each pixel for both renders, so that emission cancels sample by
    sample, and a point's missing body hides what is behind it by the share of samples that would have hit it.
    """
    image = _render(view.bodies, sensor, max_depth, samples, seed)
    if view.body is None:
        return image
    straight = _render(view.body, sensor, 1, samples, seed)
    if view.body_radiance is None:
        return image - straight
    return image * (1.0 - straight / view.body_radiance)


def _stands_clear(bodies: Any, centre_m: NDArray[np.float64], radius_m: float) -> bool:
    """Tell whether no body comes within three radii of a source; only then a point lights as it does."""
    turn = np.arange(_CLEARANCE_RAYS)
    height = 1.0 - 2.0 * (turn + 0.5) / _CLEARANCE_RAYS
    flat = np.sqrt(1.0 - height**2)
    directions = np.stack([flat * np.cos(2.399963 * turn), flat * np.sin(2.399963 * turn), height], axis=1)
    origins_m = np.broadcast_to(centre_m, directions.shape)
    return not blocked(bodies, origins_m, directions, np.full(_CLEARANCE_RAYS, 3.0 * radius_m)).any()


def _render(bodies: Any, sensor: Any, max_depth: int, samples: int, seed: int) -> NDArray[np.float64]:
    path = mi.load_dict({"type": "path", "max_depth": max_depth})
    image = np.array(mi.render(bodies, sensor=sensor, integrator=path, spp=samples, seed=seed), np.float64)
    return image.reshape(image.shape[:2])


def _radiance_of(source: Source) -> float:
    """Return the radiance of a source of one watt, Φ / (4π² r²)."""
    return 1.0 / (4.0 * np.pi**2 * source.radius_m**2)


def mitsuba_camera(camera: Camera, pose: Pose, scale: int, medium: Any = None) -> Any:
    """Return a camera as Mitsuba has it, with pixels of scale × scale of its own, in a medium."""
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
            **({} if medium is None else {"medium": medium}),
        }
    )


def _seed(*key: object) -> int:
    """Return a seed of 32 bits for one batch of one group."""
    text = "|".join(repr(part) for part in ("indirect", *key))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "little")
