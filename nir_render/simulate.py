"""The clock: poses and exposures over time, and light turned into raw frames.

Light is rendered once for a geometry; exposing it is arithmetic.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.exposure import Beam, beam_window
from nir_render.camera.exposure_control import next_exposure_s
from nir_render.camera.psf import Window
from nir_render.camera.response import response
from nir_render.camera.sensor import read_out
from nir_render.errors import InputError
from nir_render.evaluate.truth import SourceTruth, truth_of
from nir_render.randomness import generator
from nir_render.scene.load import Scene
from nir_render.transport.light import Light
from perception.types import RawFrame

_SETTLING_FRAMES = 8  # steps of at most 4: enough for a factor of 65 000


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame and the truth about the sources in it."""

    frame: RawFrame
    truth: tuple[SourceTruth, ...]


def render(scene: Scene, camera: str, time_s: float = 0.0, seed: int = 0) -> Light:
    """Return the light that reaches a camera, `robot.camera`, with the scene's geometry at `time_s`.

    Raises
    ------
    InputError
        No such camera, a part of the scene that is not rendered yet, a camera inside a body.
    """
    from nir_render.transport import direct  # Mitsuba loads only where light is rendered

    return direct.render(scene, camera, time_s, seed)


def expected_electrons(light: Light, scene: Scene, exposure_s: float | None = None) -> NDArray[np.float64]:
    """Return the noise-free frame: mean photoelectrons per pixel, shape (rows, columns).

    Without `exposure_s` the camera's own exposure is used.
    """
    _, camera = scene.camera(light.camera)
    windows = _windows(light, scene, _exposure(camera.exposure_s, exposure_s))
    return _sum(windows, camera.sensor.rows, camera.sensor.columns)


def expose(
    light: Light, scene: Scene, exposure_s: float | None = None, seed: int = 0, index: int = 0
) -> RawFrame:
    """Return the raw frame that a camera takes of a light, its noise keyed by (seed, camera, index).

    The light's time is mid-exposure; the frame's `time_s` the start of the exposure.
    """
    _, camera = scene.camera(light.camera)
    exposure = _exposure(camera.exposure_s, exposure_s)
    expected_e = expected_electrons(light, scene, exposure)
    return _frame(light, scene, expected_e, exposure, seed, index)


def simulate(scene: Scene, seed: int | None = None) -> Iterator[Shot]:
    """Yield frames with their truth: for each time of the clock, each observing camera.

    `seed` replaces the scene's own. A camera with automatic exposure has settled before its first frame.
    """
    run_seed = scene.document.seed if seed is None else seed
    exposures_s: dict[str, float] = {}
    for index, time_s in enumerate(scene.document.frame_times_s()):
        for name in scene.cameras():
            _, camera = scene.camera(name)
            if name not in exposures_s:
                exposures_s[name] = _settled_exposure(scene, name, time_s, run_seed)
            exposure_s = exposures_s[name]
            light = render(scene, name, time_s + 0.5 * exposure_s, run_seed)
            shot = _shoot(light, scene, exposure_s, run_seed, index)
            yield shot
            if camera.auto_exposure is not None:
                data_dn = shot.frame.data_dn
                exposures_s[name] = next_exposure_s(camera.auto_exposure, camera.sensor, data_dn, exposure_s)


def _settled_exposure(scene: Scene, name: str, time_s: float, seed: int) -> float:
    """Return the exposure that a camera has found before its first frame, by frames that are not kept."""
    _, camera = scene.camera(name)
    if camera.auto_exposure is None:
        return camera.exposure_s
    light = render(scene, name, time_s, seed)
    exposure_s = camera.exposure_s
    for frame in range(_SETTLING_FRAMES):
        data_dn = expose(light, scene, exposure_s, seed, index=-1 - frame).data_dn
        exposure_s = next_exposure_s(camera.auto_exposure, camera.sensor, data_dn, exposure_s)
    return exposure_s


def _shoot(light: Light, scene: Scene, exposure_s: float, seed: int, index: int) -> Shot:
    _, camera = scene.camera(light.camera)
    windows = _windows(light, scene, exposure_s)
    expected_e = _sum(windows, camera.sensor.rows, camera.sensor.columns)
    frame = _frame(light, scene, expected_e, exposure_s, seed, index)
    return Shot(frame, tuple(truth_of(scene, light, windows, expected_e, frame)))


def _exposure(own_s: float, asked_s: float | None) -> float:
    if asked_s is None:
        return own_s
    if not (np.isfinite(asked_s) and asked_s > 0):
        raise InputError(f"exposure_s is {asked_s!r}; wanted seconds greater than 0")
    return asked_s


def _windows(light: Light, scene: Scene, exposure_s: float) -> list[Window]:
    """Return the expected electrons of each row of the direct table."""
    _, camera = scene.camera(light.camera)
    sources = scene.sources()
    table = light.direct
    windows = []
    for row, group in enumerate(table.group):
        source = sources[light.groups[group]][1]
        beam = Beam(
            direction=table.direction[row],
            angular_radius_rad=float(table.angular_radius_rad[row]),
            irradiance_w_per_m2=float(table.irradiance_per_w[row, 0]) * source.flux_w,
            response=response(camera, source),
        )
        windows.append(beam_window(camera, beam, exposure_s))
    return windows


def _sum(windows: list[Window], rows: int, columns: int) -> NDArray[np.float64]:
    image = np.zeros((rows, columns))
    for window in windows:
        window.add_to(image)
    return image


def _frame(
    light: Light, scene: Scene, expected_e: NDArray[np.float64], exposure_s: float, seed: int, index: int
) -> RawFrame:
    _, camera = scene.camera(light.camera)
    return RawFrame(
        camera=light.camera,
        index=index,
        time_s=light.time_s - 0.5 * exposure_s,
        exposure_s=exposure_s,
        data_dn=read_out(expected_e, camera.sensor, generator(seed, "read_out", light.camera, index)),
        black_level_dn=camera.sensor.black_level_dn,
    )
