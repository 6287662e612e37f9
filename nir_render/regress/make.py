"""A reference, made: the scene's light rendered many times, and what camera and perception make of it."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.timing import exposure_control
from nir_render.camera.timing.shutter import mid_exposure_s
from nir_render.errors import InputError
from nir_render.light.light import Light
from nir_render.light.npz import light_hash
from nir_render.randomness import RandomKey, generator
from nir_render.regress.following import following_of
from nir_render.regress.reference import (
    Reference,
    ReferenceLight,
    ReferenceShot,
    by_group_and_node,
    document_of,
    edge_image,
    made_by,
)
from nir_render.regress.statistics import TILE_PX, tile_sums
from nir_render.scene.documents.camera import Camera
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import frame_of as taken
from nir_render.simulation.clock import render, simulate
from perception import ESTIMATORS, Calibration, Detection, RawFrame, detect

FEWEST_RENDERS = 8  # of which a third cumulant says something

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameSetting:
    """When and how a frame is taken; the light is that of `middle_s`."""

    camera: str
    index: int
    time_s: float
    exposure_s: float
    gain: float
    middle_s: float


def frame_settings(
    scene: Scene, known: Mapping[tuple[str, int], RawFrame] | None = None
) -> list[FrameSetting]:
    """Return the frames of a scene.

    What automatic exposure chose is taken from the frames that are `known`, by camera and index; without, it
    is found by rendering them.
    """
    automatic = any(scene.camera(name)[1].auto_exposure is not None for name in scene.cameras())
    if automatic and known is None:
        known = {(shot.frame.camera, shot.frame.index): shot.frame for shot in simulate(scene)}
    found = []
    for index, time_s in enumerate(scene.document.frame_times_s()):
        for name in scene.cameras():
            _, camera = scene.camera(name)
            own = exposure_control.own_setting(camera, index)
            exposure_s, gain = own.exposure_s, own.gain
            chosen = None if camera.auto_exposure is None or known is None else known.get((name, index))
            if chosen is not None:
                exposure_s, gain = chosen.exposure_s, chosen.gain
            middle_s = time_s + mid_exposure_s(camera, exposure_s)
            found.append(FrameSetting(name, index, time_s, exposure_s, gain, middle_s))
    return found


def lights_of(scene: Scene, settings: list[FrameSetting]) -> tuple[list[FrameSetting], list[int]]:
    """Return a setting for each light that differs, by camera and geometry, and which of these each has."""
    from nir_render.transport.render import geometry_of

    keys = [(one.camera, geometry_of(scene.at(one.middle_s), one.camera)) for one in settings]
    unlike = list(dict.fromkeys(keys))
    return [settings[keys.index(key)] for key in unlike], [unlike.index(key) for key in keys]


def make_reference(
    scene: Scene,
    settings: list[FrameSetting],
    renders: int,
    history: tuple[Mapping[str, str], ...],
    step: Callable[[], None],
) -> Reference:
    """Make the reference of a scene's frames; `step` is called after each render.

    Raises
    ------
    InputError
        The scene cannot be rendered, or too few renders are asked for.
    """
    if renders < FEWEST_RENDERS:
        raise InputError(f"--renders {renders}: wanted {FEWEST_RENDERS} or more")
    unlike, number = lights_of(scene, settings)
    lights = tuple(_reference_light(scene, setting, renders, step) for setting in unlike)
    shots = tuple(
        shot_of(scene, setting, lights[light].light, light)
        for setting, light in zip(settings, number, strict=True)
    )
    chosen = choices(scene, [shot.frame for shot in shots])
    shots = tuple(replace(shot, chosen=chosen.get((shot.frame.camera, shot.frame.index))) for shot in shots)
    calibrations = {name: calibration(scene, name) for name in scene.cameras()}
    frames = [shot.frame for shot in shots]
    detections = detections_of(frames, calibrations)
    return Reference(
        document=document_of(scene),
        seed=scene.document.seed,
        renders=renders,
        made_by=made_by(),
        lights=lights,
        shots=shots,
        calibrations=calibrations,
        detections=detections,
        history=history,
        following=following_of(scene, frames, calibrations, detections),
    )


def shot_of(scene: Scene, setting: FrameSetting, light: Light, number: int) -> ReferenceShot:
    """Return a frame of a light, its noise keyed by the scene's seed."""
    electrons = electrons_of(scene, setting, light)
    _, camera = scene.camera(setting.camera)
    return ReferenceShot(number, electrons, frame_of(camera, setting, electrons, scene.document.seed))


def electrons_of(scene: Scene, setting: FrameSetting, light: Light) -> NDArray[np.float32]:
    """Return the expected electrons, shape (rows, columns): float32 is what the sensor begins with."""
    mean = mean_frame(light, scene.at(light.time_s), setting.exposure_s, setting.time_s)
    return mean.electrons.astype(np.float32)


def frame_of(camera: Camera, setting: FrameSetting, electrons: NDArray[np.float32], seed: int) -> RawFrame:
    """Return the raw frame of expected electrons, its noise keyed as that of a run."""
    key = RandomKey(seed, "read_out", setting.camera, setting.index)
    chosen = exposure_control.Setting(setting.exposure_s, setting.gain)
    return taken(electrons, camera, chosen, setting.time_s, key)


def choices(scene: Scene, frames: Iterable[RawFrame]) -> dict[tuple[str, int], exposure_control.Setting]:
    """Return what automatic exposure chooses after each frame, by camera and index.

    From these frames alone, in their order, each taken as its camera's first choice: what frames before them
    have told a camera that has settled does not count.
    """
    found: dict[tuple[str, int], exposure_control.Setting] = {}
    states: dict[str, exposure_control.ExposureState] = {}
    for frame in frames:
        camera = scene.camera(frame.camera)[1]
        control = camera.auto_exposure
        if control is None:
            continue
        taken_with = (exposure_control.Setting(frame.exposure_s, frame.gain),)
        state = states.get(frame.camera, exposure_control.ExposureState(taken_with * control.latency))
        states[frame.camera] = exposure_control.next_state(state, control, camera, frame)
        found[frame.camera, frame.index] = states[frame.camera].upcoming[-1]
    return found


def detections_of(
    frames: list[RawFrame], calibrations: Mapping[str, Calibration]
) -> dict[str, tuple[Detection, ...]]:
    """Return what each estimator finds in frames."""
    return {
        name: tuple(hit for frame in frames for hit in detect(frame, calibrations[frame.camera], name))
        for name in ESTIMATORS
    }


def _reference_light(
    scene: Scene, setting: FrameSetting, renders: int, step: Callable[[], None]
) -> ReferenceLight:
    """Render a light often; its own, which a check renders again, is none of those in the mean."""
    own = render(scene, setting.camera, setting.middle_s)
    step()
    film, edges, turned, shared = (_Moments() for _ in range(4))
    for number in range(renders):
        seed = int(generator(scene.document.seed, "regress", setting.camera, number).integers(2**62))
        indirect = render(scene, setting.camera, setting.middle_s, seed).indirect
        step()
        if indirect is None:
            return ReferenceLight(own, None, None, light_hash(own))
        film.add(indirect.radiance_per_w, indirect.variance)
        if indirect.edges is not None:
            edges.add(indirect.edges.radiance_per_w, indirect.edges.variance)
        if indirect.multiple is not None:
            turned.add(indirect.multiple.radiance_per_w, indirect.multiple.variance)
            shared.add(indirect.multiple.radiance_per_w, indirect.multiple.covariance)
    assert own.indirect is not None  # or it would be None above too
    samples = own.indirect.samples
    many = replace(
        own.indirect, radiance_per_w=film.mean(), variance=film.variance(), samples=renders * samples
    )
    third_multiple = None
    if own.indirect.multiple is not None:
        many = replace(
            many,
            multiple=replace(
                own.indirect.multiple,
                radiance_per_w=turned.mean(),
                variance=turned.variance(),
                covariance=shared.variance(),
            ),
        )
        third_multiple = tile_sums(by_group_and_node(turned.third()), TILE_PX) * samples**2
    third_edges = None
    if own.indirect.edges is not None:
        many = replace(
            many,
            edges=replace(own.indirect.edges, radiance_per_w=edges.mean(), variance=edges.variance()),
        )
        third_edges = tile_sums(edge_image(by_group_and_node(edges.third())), TILE_PX) * samples**2
    third = tile_sums(by_group_and_node(film.third()), TILE_PX) * samples**2
    radiance = own.indirect.radiance_per_w
    light = replace(own, indirect=many)
    return ReferenceLight(light, third, third_edges, light_hash(own), radiance, third_multiple)


class _Moments:
    """Sums over renders, of differences from the first one: float64 keeps their digits."""

    def __init__(self) -> None:
        self._count = 0
        self._first = self._variance = np.zeros(())
        self._powers: list[Array] = []

    def add(self, mean: NDArray[np.float32], variance: NDArray[np.float32]) -> None:
        if not self._count:
            self._first = mean.astype(np.float64)
            self._variance = np.zeros(mean.shape)
            self._powers = [np.zeros(mean.shape) for _ in range(3)]
        self._count += 1
        self._variance = self._variance + variance
        difference = mean - self._first
        for power, total in enumerate(self._powers, 1):
            total += difference**power

    def mean(self) -> NDArray[np.float32]:
        return np.asarray(self._first + self._powers[0] / self._count, dtype=np.float32)

    def variance(self) -> NDArray[np.float32]:
        """Return the variance of the mean, by what each render says of itself."""
        return np.asarray(self._variance / self._count**2, dtype=np.float32)

    def third(self) -> Array:
        """Return the third cumulant of one render: Fisher's k-statistic, which is unbiased."""
        n, (one, two, three) = self._count, self._powers
        return np.asarray((2 * one**3 - 3 * n * one * two + n**2 * three) / (n * (n - 1) * (n - 2)))
