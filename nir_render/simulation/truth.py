"""What is true about each source in a frame, and about each of its mirror images: made while rendering."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.mean_frame import MeanFrame
from nir_render.camera.motion_blur import STILL_PX, may_move, path_of
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.psf import place_of
from nir_render.camera.sensor.read_out import dark_variance_e2, saturation_dn
from nir_render.camera.timing.drive import drive_of
from nir_render.camera.timing.shutter import on_fractions
from nir_render.scene.pose import camera_mount
from nir_render.simulation.flare_spread import flare_spread
from nir_render.truth.sources import SourceTruth, Vector
from perception.types import RawFrame


def truth_of(mean: MeanFrame, frame: RawFrame) -> Iterator[SourceTruth]:
    """Yield the truth about each source and ghost that is in the image.

    It is there if its centre is, or some of its light. The sun is no source that anyone looks for, nor are
    beacons.
    """
    light, camera, snapshot = mean.light, mean.camera, mean.rates.snapshot
    intrinsics = intrinsics_of(camera)
    mount = camera_mount(camera)
    table = light.direct
    pixels = intrinsics.project(table.direction)
    for row, window in enumerate(mean.windows):
        u_px, v_px = pixels[row]
        lit = float(window.values.sum()) >= 1.0
        if not intrinsics.contains(u_px, v_px) and not (lit and np.isfinite([u_px, v_px]).all()):
            continue
        group, is_ghost = int(table.group[row]), bool(table.facet[row] >= 0)
        if light.groups[group] not in snapshot.carried_sources:
            continue
        robot, _, source = light.groups[group].partition(".")
        direction, distance_m = table.direction[row], float(table.distance_m[row])
        flare = _flare(mean, frame, row)
        on = on_fractions(
            camera, drive_of(snapshot.emitters[light.groups[group]]), mean.time_s, mean.exposure_s
        )
        moved_u_px, moved_v_px = _moved_px(mean, row)
        yield SourceTruth(
            camera=light.camera,
            index=frame.index,
            time_s=frame.time_s,
            source=source,
            robot=robot,
            u_px=float(u_px),
            v_px=float(v_px),
            range_m=distance_m,
            depth_z_m=float(distance_m * direction[2]),
            bearing_camera=_vector(direction),
            bearing_body=_vector(mount.rotation @ direction),
            position_body_m=_vector(mount.rotation @ (distance_m * direction) + mount.position_m),
            visible_fraction=float(table.visible_fraction[row]),
            direct_e=0.0 if is_ghost else window.total,
            mirrored_e=window.total if is_ghost else 0.0,
            scattered_e=flare.scattered_e,
            background_e=flare.background_e,
            peak_snr=flare.peak_snr,
            saturated_px=flare.saturated_px,
            on_fraction=float(on[mean.rates.centre_row[row]]),
            ghost_of=light.groups[group] if is_ghost else None,
            gain=frame.gain,
            dark_e=camera.sensor.dark_rate_e_per_s * mean.exposure_s,
            flare_share=flare_spread(camera, snapshot.sources[light.groups[group]].source).share,
            moved_u_px=moved_u_px,
            moved_v_px=moved_v_px,
        )


def _moved_px(mean: MeanFrame, row: int) -> tuple[float, float]:
    """Return how far a flare moves along u and v over a row's exposure; 0 where it is drawn in one place."""
    light, snapshot = mean.light, mean.rates.snapshot
    group = light.groups[light.direct.group[row]]
    if not may_move(snapshot, light.camera, group):
        return 0.0, 0.0
    ends_s = mean.exposure_s * np.array([-0.5, 0.5])
    path = path_of(snapshot, light.camera, group, light.direct, row, ends_s)
    begin_px, end_px = intrinsics_of(mean.camera).project(path.direction)
    u_px, v_px = (end_px - begin_px).tolist()
    return (u_px, v_px) if math.hypot(u_px, v_px) >= STILL_PX else (0.0, 0.0)


@dataclass(frozen=True)
class _Flare:
    """What the pixels of a flare hold."""

    peak_snr: float = 0.0
    saturated_px: int = 0
    scattered_e: float = 0.0
    background_e: float = 0.0


def _flare(mean: MeanFrame, frame: RawFrame, row: int) -> _Flare:
    """Return what is in the flare: its pixels are those that hold 1 % of its brightest one's own light."""
    window = mean.windows[row]
    own = window.values
    if own.size == 0 or not own.max() > 0.0:
        return _Flare()
    place = place_of(window)
    all_e = mean.electrons[place]
    # A noiseless sensor has no noise where there is no light, and no signal either.
    noise_e = np.sqrt(all_e + dark_variance_e2(mean.camera.sensor, mean.exposure_s))
    snr = np.divide(own, noise_e, out=np.zeros_like(own), where=noise_e > 0.0)
    pixels = own > 0.01 * own.max()
    clipped = (own > 0.5 * all_e) & (frame.data_dn[place] >= saturation_dn(mean.camera.sensor, frame.gain))
    return _Flare(
        peak_snr=float(snr.max()),
        saturated_px=int(clipped.sum()),
        scattered_e=float(mean.scattered(row)[pixels].sum()),
        background_e=float((all_e - own)[pixels].mean()),
    )


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
