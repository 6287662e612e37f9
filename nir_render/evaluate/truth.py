"""What is true about each source in a frame."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.lens import intrinsics_of
from nir_render.camera.psf import Window
from nir_render.camera.sensor import saturation_dn
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose_on_robot
from nir_render.transport.light import Light
from perception.types import RawFrame

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SourceTruth:
    """The truth about one source in one frame, at mid-exposure.

    `u_px, v_px` is the projection of the source's centre; `range_m` the straight distance from the lens to
    it, `depth_z_m` its part along the optical axis; bearings are unit vectors from the camera's centre;
    `position_body_m` counts from the observing robot's origin. `direct_e` are the expected electrons on the
    sensor that came straight; `mirrored_e` and `scattered_e` are 0 in scenes that reflect nothing.
    `peak_snr` is the source's brightest pixel over the noise there.
    """

    camera: str
    index: int
    time_s: float
    source: str
    robot: str
    u_px: float
    v_px: float
    range_m: float
    depth_z_m: float
    bearing_camera: Vector
    bearing_body: Vector
    position_body_m: Vector
    visible_fraction: float
    direct_e: float
    mirrored_e: float
    scattered_e: float
    peak_snr: float
    saturated_px: int
    on_fraction: float

    def record(self) -> dict[str, Any]:
        """Return the line of `truth.jsonl`."""
        return {"format": 1, **asdict(self)}


def parse_truth(record: Mapping[str, Any]) -> SourceTruth:
    """Return the truth of a line of `truth.jsonl`; raise ValueError where a field is missing or unknown."""
    fields = {name: value for name, value in record.items() if name != "format"}
    for name in ("bearing_camera", "bearing_body", "position_body_m"):
        fields[name] = tuple(fields[name])
    return SourceTruth(**fields)


def truth_of(
    scene: Scene, light: Light, windows: Sequence[Window], expected_e: NDArray[np.float64], frame: RawFrame
) -> Iterator[SourceTruth]:
    """Yield the truth about each source whose centre is in the image, or of whose light some falls on it.

    Parameters
    ----------
    windows
        Expected electrons of each row of the light's direct table.
    expected_e
        Expected electrons of the whole frame, shape (rows, columns).
    """
    _, camera = scene.camera(light.camera)
    intrinsics = intrinsics_of(camera)
    mount = camera_pose_on_robot(camera)
    table = light.direct
    pixels = intrinsics.project(table.direction)
    for row, window in enumerate(windows):
        u_px, v_px = pixels[row]
        in_image = intrinsics.contains(u_px, v_px)
        direct_e = float(window.values.sum())
        if not in_image and not direct_e >= 1.0:
            continue
        robot, _, source = light.groups[table.group[row]].partition(".")
        direction, distance_m = table.direction[row], float(table.distance_m[row])
        peak_snr, saturated_px = _signal(
            window, expected_e, frame, camera.sensor.read_noise_e, saturation_dn(camera.sensor)
        )
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
            direct_e=direct_e,
            mirrored_e=0.0,
            scattered_e=0.0,
            peak_snr=peak_snr,
            saturated_px=saturated_px,
            on_fraction=1.0,
        )


def _signal(
    window: Window, expected_e: NDArray[np.float64], frame: RawFrame, read_noise_e: float, clipped_dn: int
) -> tuple[float, int]:
    """Return the peak signal-to-noise ratio, and how many clipped pixels owe most of their light to it."""
    if window.values.size == 0:
        return 0.0, 0
    rows, columns = window.values.shape
    place = np.s_[window.row : window.row + rows, window.column : window.column + columns]
    noise_e = np.sqrt(expected_e[place] + read_noise_e**2)
    # A noiseless sensor has no noise where there is no light, and no signal either.
    snr = np.divide(window.values, noise_e, out=np.zeros_like(noise_e), where=noise_e > 0.0)
    own = window.values > 0.5 * expected_e[place]
    return float(snr.max()), int((own & (frame.data_dn[place] >= clipped_dn)).sum())


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
