"""The stage `render`: a scene becomes a run folder of raw frames, truth and calibration."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nir_render.camera.render_noise import RenderNoise
from nir_render.errors import InputError
from nir_render.light.exr import direct_document, write_light
from nir_render.light.light import Light
from nir_render.run import folder as run_folder
from nir_render.run.manifest import enlarging_facts, noise_facts, noise_warning, sample_facts, versions
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import Shot, simulate
from nir_render.simulation.frame_times import frame_times
from nir_render.simulation.odometry import observers_astir, odometry_of, pose_records
from nir_render.transport.cache import LightCache
from perception import Calibration, calibration_document, encode_png16, frame_record, odometry_record
from perception.files.tracks import ODOMETRY

Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all."""


def render_run(
    scene: Scene,
    folder: Path,
    *,
    overwrite: bool,
    progress: Progress,
    keep_light: bool = False,
    cache: LightCache | None = None,
    calibrations: Sequence[Calibration] | None = None,
) -> list[str]:
    """Render the frames of a scene with their truth and calibration into a new run folder.

    `keep_light` adds the light of each frame, as spectral EXR and direct table. `cache` keeps light from run
    to run, which saves rendering it and changes nothing else. `calibrations` are those of `calibrations_of`,
    which are found here without a word if they are not given. Returns what the user should be warned of.

    Raises
    ------
    InputError
        The scene cannot be rendered, the folder is taken, the disk is full.
    """
    run_folder.check_free(folder, overwrite)
    started = time.perf_counter()
    times = frame_times(scene, scene.document.seed).values()
    total = sum(int((~one.dropped).sum()) for one in times)
    if calibrations is None:
        calibrations = calibrations_of(scene)
    cache = LightCache() if cache is None else cache
    missed, reused = cache.missed, cache.reused
    with run_folder.new_run_folder(folder, overwrite) as aside:
        writer = _FrameWriter(aside, keep_light)
        for done, shot in enumerate(simulate(scene, cache=cache)):
            writer.add(shot)
            progress(done + 1, total)
        writer.finish()
        _write_motion(scene, aside)
        run_folder.write_json(aside / run_folder.CALIBRATION, calibration_document(calibrations))
        run_folder.write_file(aside / run_folder.SCENE, scene.resolved_yaml().encode())
        noise = noise_facts(scene.document.render.noise, writer.noises)
        lights = {"rendered": cache.missed - missed, "reused": cache.reused - reused}
        seconds = time.perf_counter() - started
        run_folder.write_manifest(aside, _facts(scene, writer, noise, lights, seconds))
    warning = noise_warning(noise, len(writer.noises))
    return [] if warning is None else [warning]


def _write_motion(scene: Scene, folder: Path) -> None:
    """Write where robots were, and what those that take frames believe of it, where anything moves."""
    if any(robot.moves for robot in scene.document.robots.values()):
        run_folder.write_lines(folder / run_folder.POSES, pose_records(scene))
    believed = [
        line for robot in observers_astir(scene) for line in odometry_of(scene, robot, scene.document.seed)
    ]
    if believed:
        run_folder.write_lines(folder / ODOMETRY, map(odometry_record, believed))


def calibrations_of(scene: Scene, progress: Progress = lambda *_: None) -> list[Calibration]:
    """Return the calibration of each camera that takes frames; `progress` is called where one takes long.

    That is where a point spread is no Gaussian and is measured on a rail, once for each make of camera.
    """
    return [calibration(scene, name, progress) for name in scene.cameras()]


class _FrameWriter:
    """Writes frames into a folder as they come, and keeps what is said of all of them at the end."""

    def __init__(self, folder: Path, keep_light: bool) -> None:
        self.noises: dict[str, RenderNoise] = {}
        self.samples_by_camera: dict[str, dict[str, Any]] = {}
        self.enlarging_by_camera: dict[str, dict[str, Any]] = {}
        self._folder = folder
        self._keep_light = keep_light
        self._lines: dict[str, list[dict[str, Any]]] = {
            name: [] for name in (run_folder.FRAMES, run_folder.TRUTH, run_folder.LAMPS)
        }
        self._light_files: dict[str, tuple[str, Light]] = {}

    def add(self, shot: Shot) -> None:
        """Write a frame, and its light where it is to be kept."""
        frame, light = shot.frame, shot.light
        file = f"frames/{frame.camera}/{frame.index:06d}.png"
        run_folder.write_file(self._folder / file, encode_png16(frame.data_dn))
        self._lines[run_folder.FRAMES].append(frame_record(frame, file))
        self._lines[run_folder.TRUTH] += [row.record() for row in shot.truth]
        self._lines[run_folder.LAMPS] += [row.record() for row in shot.lamps]
        self.noises[f"{frame.camera} {frame.index}"] = shot.noise
        if frame.camera not in self.enlarging_by_camera:
            self.enlarging_by_camera[frame.camera] = enlarging_facts(shot)
            if light.indirect is not None:
                self.samples_by_camera[frame.camera] = sample_facts(light)
        if self._keep_light:
            stem = self._folder / "light" / frame.camera / f"{frame.index:06d}"
            self._light_files[frame.camera] = _write_light(stem, light, self._light_files.get(frame.camera))

    def finish(self) -> None:
        """Write the lines about all frames; of lamps only where there are any."""
        for name, records in self._lines.items():
            if records or name != run_folder.LAMPS:
                run_folder.write_lines(self._folder / name, records)


def _write_light(stem: Path, light: Light, last: tuple[str, Light] | None) -> tuple[str, Light]:
    """Write a light; its arrays only where they are not those of the last one. Returns their file, and it."""
    same = last is not None and last[1].indirect is light.indirect
    file = last[0] if last is not None and same else f"{stem.name}.exr"
    held = {"indirect": file if light.indirect is not None else None}
    run_folder.write_json(stem.with_suffix(".direct.json"), direct_document(light) | held)
    try:
        if not same:
            write_light(stem.with_suffix(".exr"), light)
    except RuntimeError as error:  # how OpenEXR says that the disk is full
        raise InputError(f"{stem}.exr: cannot be written ({error})") from None
    return file, light


def _facts(
    scene: Scene, writer: _FrameWriter, noise: dict[str, Any], lights: dict[str, int], seconds: float
) -> dict[str, Any]:
    """Return what the manifest states of a render.

    Its `render_noise` is the variance of the Monte Carlo part over shot and read noise: the median over the
    pixels of each frame that it reaches, and the largest of the sums over flares' apertures; the direct part
    is closed form and carries none.
    """
    from nir_render.transport.backend.variant import backend

    by_camera = {
        "samples_by_camera": writer.samples_by_camera,
        "upsampling_error_share_of_temporal_variance": writer.enlarging_by_camera,
    }
    return {
        "scene": scene.document.name,
        "seed": scene.document.seed,
        "versions": versions(),
        "variant": backend().variant,
        "variant_reason": backend().reason,
        "seconds": {"render": round(seconds, 3)},
        "indirect": _indirect_facts(scene) | by_camera,
        "render_noise": noise,
        "lights": lights,
    }


def _indirect_facts(scene: Scene) -> dict[str, Any]:
    """Return how the indirect light of a run was asked for; `samples` is null where a target ruled."""
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.indirect.stock import samples_of

    settings = scene.document.render
    used = None if backend().vectorised and settings.noise is not None else samples_of(settings.indirect)
    asked = settings.indirect.samples
    wanted = "a target for the noise was" if asked is None else f"{asked}"
    note = "" if used == asked else f"{wanted} asked for; no usable LLVM"
    rendered = scene.document.has_indirect_light()
    return {"rendered": rendered, "scale": settings.indirect.scale, "samples": used, "note": note}
