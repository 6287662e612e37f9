"""The stage `render`: a scene becomes a run folder of raw frames, truth and calibration."""

import itertools
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import perception
from nir_render.camera.render_noise import RenderNoise
from nir_render.errors import InputError
from nir_render.light.exr import direct_document, write_light
from nir_render.light.light import Light
from nir_render.run import folder as run_folder
from nir_render.run.journal import Entry, Journal
from nir_render.run.manifest import (
    ambient_facts,
    enlarging_facts,
    group_noise_facts,
    group_noise_warning,
    material_facts,
    noise_facts,
    noise_warning,
    refresh_facts,
    sample_facts,
    spectral_facts,
    truncation_facts,
    truncation_warning,
    versions,
    wavelength_facts,
)
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import Begun, Shot, simulate
from nir_render.simulation.frame_times import frame_times
from nir_render.simulation.odometry import odometry_by_robot, true_poses
from nir_render.simulation.sent import sent_packets
from nir_render.transport.cache import LightCache
from nir_render.transport.cache_key import digest as digest_of
from nir_render.transport.fingerprint import code_hash, matching
from perception import Calibration, calibration_document, encode_png16, frame_record, odometry_record
from perception.files.tracks import ODOMETRY

Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all."""

_WAITING_FRAMES = 2  # that wait for the disk while the next is rendered
_CODE = ("**/*.py", "**/*.csv")  # what decides the bits of a run


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
    if total == 0:
        raise InputError(
            "every frame of every camera is dropped: there is nothing to render; lower clock.dropped of a "
            "camera, or take more frames"
        )
    if calibrations is None:
        calibrations = calibrations_of(scene)
    cache = LightCache() if cache is None else cache
    missed, reused = cache.missed, cache.reused
    # Files of light speak of each other: they are always begun anew.
    digest = run_digest(scene, uuid.uuid4().hex if keep_light else "")
    with run_folder.resumed_run_folder(folder, overwrite, digest) as (aside, found):
        with _FrameWriter(aside, keep_light) as writer:
            begun = writer.begun
            for done, shot in enumerate(simulate(scene, cache=cache, begun=begun), start=begun.frames):
                lights = (cache.missed - missed, cache.reused - reused)
                writer.add(shot, lights)
                progress(done + 1, total)
        writer.finish()
        _write_times(scene, aside)
        run_folder.write_json(aside / run_folder.CALIBRATION, calibration_document(calibrations))
        run_folder.write_file(aside / run_folder.SCENE, scene.resolved_yaml().encode())
        noise = noise_facts(scene.document.render.noise, writer.noises)
        seconds = time.perf_counter() - started
        run_folder.write_manifest(aside, _facts(scene, writer, noise, seconds))
    warnings = (
        noise_warning(noise, len(writer.noises)),
        group_noise_warning(writer.groups_by_camera),
        truncation_warning(writer.truncation_by_camera),
    )
    return _found_words(folder, found, begun.frames) + [one for one in warnings if one is not None]


def _found_words(folder: Path, found: str, frames: int) -> list[str]:
    """Return what to tell of an earlier render that was killed."""
    if found == "goes on" and frames:
        return [f"{folder}: went on from an unfinished render, of which {frames} frames were there"]
    if found == "anew":
        return [f"{folder}: an unfinished render of another scene or version lay there; this one began anew"]
    return []


def run_digest(scene: Scene, more: str) -> str:
    """Return the hash of all that decides the files of a run, and of `more`; two of one are the same bits.

    The resolved scene names meshes and pictures; what these hold is in the geometry.
    """
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.render import geometry_of

    packages = Path(__file__).parents[1], Path(perception.__file__).parent
    code = code_hash(*(matching(package, _CODE) for package in packages))
    made_by = [f"{name} {version}" for name, version in versions().items()]
    start = scene.at(scene.document.clock.start_s)
    geometry = [geometry_of(start, camera) for camera in scene.cameras()[:1]]
    computed_by = (backend().variant, backend().compiler, made_by, code)
    return digest_of((scene.resolved_yaml(), geometry, *computed_by, more))


def _write_times(scene: Scene, folder: Path) -> None:
    """Write what is true over time, poses and packets, and what robots believe of their motion."""
    robots = scene.document.robots.values()
    # Where robots stand still, poses are of use where their headings show.
    if any(robot.moves or len(robot.rig.sources) > 1 for robot in robots):
        run_folder.write_lines(folder / run_folder.POSES, (pose.record() for pose in true_poses(scene)))
    believed = [line for records in odometry_by_robot(scene).values() for line in records]
    if believed:
        run_folder.write_lines(folder / ODOMETRY, map(odometry_record, believed))
    sent = [packet.record() for packet in sent_packets(scene)]
    if sent:
        run_folder.write_lines(folder / run_folder.SENT, sent)


def calibrations_of(scene: Scene, progress: Progress = lambda *_: None) -> list[Calibration]:
    """Return the calibration of each camera that takes frames; `progress` is called where one takes long.

    That is where a point spread is no Gaussian and is measured on a rail, once for each make of camera.
    """
    return [calibration(scene, name, progress) for name in scene.cameras()]


class _FrameWriter:
    """Writes frames into a folder as they come, in a thread of its own, and their lines into the journal."""

    def __init__(self, folder: Path, keep_light: bool) -> None:
        self.noises: dict[str, RenderNoise] = {}
        self.samples_by_camera: dict[str, dict[str, Any]] = {}
        self.enlarging_by_camera: dict[str, dict[str, Any]] = {}
        self.truncation_by_camera: dict[str, dict[str, Any]] = {}
        self.groups_by_camera: dict[str, dict[str, Any]] = {}
        self.refresh: list[dict[str, Any]] = []
        self.lights = (0, 0)
        self._folder = folder
        self._keep_light = keep_light
        self._light_files: dict[str, tuple[str, Light]] = {}
        self._journal = Journal(folder)
        self._pool = ThreadPoolExecutor(1)
        self._writing: deque[Future[None]] = deque()
        self._cameras = set[str]()
        self.begun = self._begun()
        self._lights_before = self.lights

    def __enter__(self) -> Self:
        """Write until the block ends: then everything is written."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait for what is being written; raise what went wrong with it."""
        self._pool.shutdown(cancel_futures=kind is not None)
        self._journal.close()
        if kind is None:
            self._wait(0)

    def add(self, shot: Shot, lights: tuple[int, int]) -> None:
        """Write a frame, and its light where it is to be kept.

        `lights` is how many this process has rendered and reused.
        """
        frame, light, first = shot.frame, shot.light, None
        file = f"frames/{frame.camera}/{frame.index:06d}.png"
        if frame.camera not in self._cameras and shot.kind != "dark":
            self._cameras.add(frame.camera)
            samples = None if light.indirect is None else sample_facts(light)
            first = {
                "samples": samples,
                "enlarging": enlarging_facts(shot),
                "truncation": truncation_facts(shot),
                "groups": None if light.indirect is None else group_noise_facts(light),
            }
        if self._keep_light:
            stem = self._folder / "light" / frame.camera / f"{frame.index:06d}"
            self._light_files[frame.camera] = _write_light(stem, light, self._light_files.get(frame.camera))
        before = self._lights_before
        entry = Entry(
            camera=frame.camera,
            index=frame.index,
            lines={
                run_folder.FRAMES: [frame_record(frame, file, shot.kind)],
                run_folder.TRUTH: [row.record() for row in shot.truth],
                run_folder.LAMPS: [row.record() for row in shot.lamps],
            },
            noise=shot.noise,
            exposure=shot.exposure,
            lights=(before[0] + lights[0], before[1] + lights[1]),
            first=first,
            refresh=[error.record() for error in shot.refresh],
        )
        self._writing.append(self._pool.submit(self._write, entry, file, frame.data_dn))
        self._wait(_WAITING_FRAMES)

    def finish(self) -> None:
        """Write the lines about all frames; of lamps only where there are any. The journal goes."""
        for entry in self._journal.entries():
            self.noises[entry.name] = entry.noise
            self.lights = entry.lights
            self.refresh += entry.refresh
            if entry.first is not None:
                self.enlarging_by_camera[entry.camera] = entry.first["enlarging"]
                self.truncation_by_camera[entry.camera] = entry.first["truncation"]
                if entry.first["samples"] is not None:
                    self.samples_by_camera[entry.camera] = entry.first["samples"]
                    self.groups_by_camera[entry.camera] = entry.first["groups"]
        for name in (run_folder.FRAMES, run_folder.TRUTH, run_folder.LAMPS):
            of_frames = (record for entry in self._journal.entries() for record in entry.lines[name])
            first = next(of_frames, None)
            if first is not None or name != run_folder.LAMPS:
                run_folder.write_lines(
                    self._folder / name, () if first is None else itertools.chain((first,), of_frames)
                )
        self._journal.remove()

    def _begun(self) -> Begun:
        """Return what an earlier process has done of this run."""
        frames, exposures = 0, {}
        for entry in self._journal.entries():
            frames += 1
            if entry.first is not None:
                self._cameras.add(entry.camera)
            self.lights = entry.lights
            if entry.exposure is not None:
                exposures[entry.camera] = entry.exposure
        return Begun(frames, exposures)

    def _write(self, entry: Entry, file: str, data_dn: NDArray[np.uint16]) -> None:
        run_folder.write_file(self._folder / file, encode_png16(data_dn))
        self._journal.add(entry)

    def _wait(self, most: int) -> None:
        """Wait until at most so many frames are being written; raise what went wrong with the others."""
        while len(self._writing) > most:
            self._writing.popleft().result()


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


def _facts(scene: Scene, writer: _FrameWriter, noise: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Return what the manifest states of a render.

    Its `render_noise` is the variance of the Monte Carlo part over shot and read noise: the median over the
    pixels of each frame that it reaches, and the largest of the sums over flares' apertures; the direct part
    is closed form and carries none.
    """
    from nir_render.transport.backend.variant import backend

    by_camera = {
        "samples_by_camera": writer.samples_by_camera,
        "upsampling_error_share_of_temporal_variance": writer.enlarging_by_camera,
        "truncation_by_camera": writer.truncation_by_camera,
    }
    return {
        "scene": scene.document.name,
        "seed": scene.document.seed,
        "versions": versions(),
        "variant": backend().variant,
        "variant_reason": backend().reason,
        "seconds": {"render": round(seconds, 3)},
        "indirect": _indirect_facts(scene) | by_camera | refresh_facts(scene, writer.refresh),
        "render_noise": noise | {"groups_by_camera": writer.groups_by_camera},
        "ambient": ambient_facts(scene),
        "materials": material_facts(scene),
        "fog": None if scene.document.fog is None else scene.document.fog.facts(),
        "spectral": spectral_facts(scene),
        "wavelengths": wavelength_facts(scene),
        "lights": {"rendered": writer.lights[0], "reused": writer.lights[1]},
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
