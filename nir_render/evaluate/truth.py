"""What is true about each source in a frame, and about each of its mirror images."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.drive import drive_of
from nir_render.camera.lens import intrinsics_of
from nir_render.camera.sensor import dark_variance_e2, saturation_dn
from nir_render.camera.shutter import on_fractions
from nir_render.expected import Expected, place_of
from nir_render.flare_spread import flare_spread
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose_on_robot
from perception.types import RawFrame

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SourceTruth:
    """The truth about one source, or one ghost of it, in one frame, at mid-exposure.

    `u_px, v_px` is the projection of the source's centre; `range_m` the straight distance from the lens to
    it, `depth_z_m` its part along the optical axis; bearings are unit vectors from the camera's centre;
    `position_body_m` counts from the observing robot's origin. `on_fraction` is the mean of the source's
    drive over the exposure of the row of pixels that its centre is in. All electrons are those in the frame,
    with the sources as they were driven: `direct_e` are the expected electrons that came straight, those
    beyond the sensor's edge included; `scattered_e` those of the source's own light that came by way of
    bodies or fog into the pixels of the flare. `background_e` is all light but the flare's, the source's own
    scattered light and the glare and lens ghosts of its light included, as a mean per pixel there; `dark_e`
    the mean dark current's, in every pixel. `peak_snr` is the flare's brightest pixel over the temporal noise
    there, before the ADC: shot noise of light and dark current, read noise. `flare_share` is the share of
    `direct_e` that is in the flare as perception knows it: 1 under a Gaussian point spread, less with glare,
    ghosts and diffraction. `gain` is the frame's, a factor on the calibrated system gain.

    A ghost, the image of a source in one flat smooth surface, has a row of its own: `ghost_of` is the name
    `robot.source` of whom it shows (None for a source itself), place and range are those of the image behind
    the surface, its electrons are `mirrored_e`, and `direct_e` is 0; a source's own `mirrored_e` is 0.
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
    background_e: float
    peak_snr: float
    saturated_px: int
    on_fraction: float
    ghost_of: str | None = None
    gain: float = 1.0
    dark_e: float = 0.0
    flare_share: float = 1.0

    def record(self) -> dict[str, Any]:
        """Return the line of `truth.jsonl`."""
        return {"format": 1, **asdict(self)}


def parse_truth(record: Mapping[str, Any]) -> SourceTruth:
    """Return the truth of a line of `truth.jsonl`.

    `gain`, `dark_e` and `flare_share` may be missing: gain 1, no dark current, all light in the flare.

    Raises
    ------
    KeyError, TypeError
        A field is missing or unknown.
    """
    fields = {name: value for name, value in record.items() if name != "format"}
    for name in ("bearing_camera", "bearing_body", "position_body_m"):
        fields[name] = tuple(fields[name])
    return SourceTruth(**fields)


def truth_of(scene: Scene, mean: Expected, frame: RawFrame) -> Iterator[SourceTruth]:
    """Yield the truth about each source and ghost that is in the image.

    It is there if its centre is, or some of its light. The sun is no source that anyone looks for.
    """
    light = mean.light
    _, camera = scene.camera(light.camera)
    intrinsics = intrinsics_of(camera)
    mount = camera_pose_on_robot(camera)
    table = light.direct
    pixels = intrinsics.project(table.direction)
    emitters, sources = scene.emitters(), scene.sources()
    for row, window in enumerate(mean.windows):
        u_px, v_px = pixels[row]
        lit = float(window.values.sum()) >= 1.0
        if not intrinsics.contains(u_px, v_px) and not (lit and np.isfinite([u_px, v_px]).all()):
            continue
        group, is_ghost = int(table.group[row]), bool(table.facet[row] >= 0)
        if light.groups[group] == "sun":
            continue
        robot, _, source = light.groups[group].partition(".")
        direction, distance_m = table.direction[row], float(table.distance_m[row])
        flare = _flare(camera, mean, frame, row)
        on = on_fractions(camera, drive_of(emitters[light.groups[group]]), mean.time_s, mean.exposure_s)
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
            flare_share=flare_spread(camera, sources[light.groups[group]][1]).share,
        )


@dataclass(frozen=True)
class _Flare:
    """What the pixels of a flare hold."""

    peak_snr: float = 0.0
    saturated_px: int = 0
    scattered_e: float = 0.0
    background_e: float = 0.0


def _flare(camera: Camera, mean: Expected, frame: RawFrame, row: int) -> _Flare:
    """Return what is in the flare: its pixels are those that hold 1 % of its brightest one's own light."""
    window = mean.windows[row]
    own = window.values
    if own.size == 0 or not own.max() > 0.0:
        return _Flare()
    place = place_of(window)
    all_e = mean.electrons[place]
    # A noiseless sensor has no noise where there is no light, and no signal either.
    noise_e = np.sqrt(all_e + dark_variance_e2(camera.sensor, mean.exposure_s))
    snr = np.divide(own, noise_e, out=np.zeros_like(own), where=noise_e > 0.0)
    pixels = own > 0.01 * own.max()
    clipped = (own > 0.5 * all_e) & (frame.data_dn[place] >= saturation_dn(camera.sensor, frame.gain))
    return _Flare(
        peak_snr=float(snr.max()),
        saturated_px=int(clipped.sum()),
        scattered_e=float(mean.scattered(row)[pixels].sum()),
        background_e=float((all_e - own)[pixels].mean()),
    )


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
