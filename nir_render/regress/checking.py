"""A suite against its references: each stage of each scene, from the reference's own input."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from nir_render.errors import InputError
from nir_render.light.light import Light
from nir_render.light.npz import light_hash
from nir_render.regress.findings import Check, Finding, ImagePair, SceneCheck
from nir_render.regress.following import as_kept, followed_of, is_sequence
from nir_render.regress.make import FrameSetting, detections_of, frame_settings
from nir_render.regress.reference import Reference, changes_of, document_of, made_by
from nir_render.regress.repeatable import check_repeatable
from nir_render.regress.scenes_of import references_folder, scenes_of
from nir_render.regress.stages.camera import compare_calibration, compare_electrons, compare_frame
from nir_render.regress.stages.direct import compare_tables
from nir_render.regress.stages.exposure import compare_choices
from nir_render.regress.stages.following import compare_followed, compare_odometry
from nir_render.regress.stages.light import GroupTests, compare_indirect, finding_of
from nir_render.regress.stages.perception import compare_detections
from nir_render.regress.stages.view import compare_view
from nir_render.regress.statistics import judge
from nir_render.regress.store import names_in, read_reference
from nir_render.scene.scene import Scene
from nir_render.simulation.clock import render
from nir_render.simulation.odometry import odometry_by_robot
from nir_render.transport.cache import LightCache

FALSE_ALARM_RATE = 1e-3
"""The chance that a check of a whole suite with a new seed finds a drift where there is none."""

Progress = Callable[[int, int], None]
Rendered = Callable[[Scene, str, float, int, LightCache], Light]
"""What renders a light: scene, `robot.camera`, time, seed, cache."""


@dataclass(frozen=True, eq=False)
class _SceneCase:
    """A scene that is held against its reference.

    `changes` are those of its document, `now` is what would make a reference here, `seed` that of the light.
    """

    name: str
    scene: Scene
    reference: Reference
    changes: tuple[str, ...]
    settings: Mapping[tuple[str, int], FrameSetting]
    now: Mapping[str, Mapping[str, str]]
    seed: int

    def same_made(self, part: str) -> bool:
        """Tell whether the same scene was made by the same versions here, so that bits must be the same."""
        return not self.changes and dict(self.reference.made_by[part]) == dict(self.now[part])

    @property
    def same_seed(self) -> bool:
        """Whether the light is rendered with the seed of the reference's own render."""
        return self.seed == self.reference.seed


@dataclass(frozen=True, eq=False)
class _LightFindings:
    """What is certain of a case's light, and the tests that are judged with all others'; if bits agree."""

    findings: list[Finding]
    pending: list[tuple[GroupTests, bool | None]]


def check(
    suite: str | Path,
    refs: str | Path | None = None,
    *,
    seed: int | None = None,
    progress: Progress | None = None,
) -> Check:
    """Hold a suite against its references.

    Parameters
    ----------
    suite
        A folder of scene files.
    refs
        The folder of their references, `references` within the suite if none is given.
    seed
        Of the light, in place of each scene's own: another seed is another draw of the render's noise.
    progress
        Called with the number of frames done, and of all.

    Raises
    ------
    InputError
        The suite or its references are missing, incomplete or broken.
    """
    scenes = scenes_of(suite)
    folder = references_folder(suite, refs)
    references = _references(Path(suite), folder, scenes)
    return check_scenes(str(suite), scenes, references, seed=seed, progress=progress)


def check_scenes(
    suite: str,
    scenes: Mapping[str, Scene],
    references: Mapping[str, Reference],
    *,
    seed: int | None = None,
    progress: Progress | None = None,
    rendered: Rendered = render,
) -> Check:
    """Hold scenes against references of the same names; `rendered` makes the light. Errors as `check`."""
    now = made_by()
    total = sum(len(reference.shots) for reference in references.values())
    step = steps(progress, total)
    if progress is not None:
        progress(0, total)
    cases = [_scene_case(name, scenes[name], references[name], seed, now) for name in scenes]
    lights = [_light_findings(case, step, rendered) for case in cases]
    tests = [group for light in lights for group, _ in light.pending]
    judgements = iter(judge([group.parts for group in tests], FALSE_ALARM_RATE))
    results = []
    for case, light in zip(cases, lights, strict=True):
        must_be_same = case.same_seed and case.same_made("transport")
        judged = [
            finding_of(group, next(judgements), same_bits=same_bits, must_be_same=must_be_same)
            for group, same_bits in light.pending
        ]
        later, pairs = _findings_after_light(case)
        pairs += [group.pair for group, _ in light.pending if group.pair is not None]
        findings = (*light.findings, *judged, *later)
        results.append(SceneCheck(case.name, case.changes, findings, tuple(pairs)))
    versions = dict.fromkeys(
        change for reference in references.values() for change in changes_of(reference.made_by, now)
    )
    return Check(suite, FALSE_ALARM_RATE, tuple(versions), tuple(results))


def steps(progress: Progress | None, total: int) -> Callable[[], None]:
    """Return what counts one more of `total` done, and tells `progress`."""
    counted = itertools.count(1)

    def step() -> None:
        done = next(counted)
        if progress is not None:
            progress(done, total)

    return step


def _references(suite: Path, folder: Path, scenes: Mapping[str, Scene]) -> dict[str, Reference]:
    """Return the references of a suite's scenes; all of both must have their counterpart."""
    known = names_in(folder, suite)
    update = f"nir-render regress update {suite} --reason '...'"
    problems = [
        f"{scenes[name].path}: has no reference in {folder}; '{update}' adds it"
        for name in scenes
        if name not in known
    ]
    problems += [
        f"{folder / name}: there is no scene {name}.yaml in {suite} any more; '{update}' removes it"
        for name in known
        if name not in scenes
    ]
    if problems:
        raise InputError(*problems)
    return {name: read_reference(folder, name, suite) for name in scenes}


def _scene_case(
    name: str,
    scene: Scene,
    reference: Reference,
    seed: int | None,
    now: Mapping[str, Mapping[str, str]],
) -> _SceneCase:
    known = {(shot.frame.camera, shot.frame.index): shot.frame for shot in reference.shots}
    settings = {(setting.camera, setting.index): setting for setting in frame_settings(scene, known)}
    changes = changes_of(reference.document, document_of(scene))
    return _SceneCase(
        name, scene, reference, changes, settings, now, reference.seed if seed is None else seed
    )


def _light_findings(case: _SceneCase, step: Callable[[], None], rendered: Rendered) -> _LightFindings:
    """Render the light of each frame, and compare each that is new with the reference's."""
    from nir_render.transport.render import geometry_of

    made = (case.reference.made_by, case.now)
    before, after = (by["transport"]["variant"].startswith("scalar") for by in made)
    scene, lights, cache = case.scene, case.reference.lights, LightCache()
    compared: set[tuple[int, str]] = set()
    found = _LightFindings(_frame_findings(case), [])
    exact = case.same_made("transport")
    for shot in case.reference.shots:
        setting = case.settings.get((shot.frame.camera, shot.frame.index))
        step()
        if setting is None:
            continue
        key = (shot.light, geometry_of(scene.at(setting.middle_s), setting.camera))
        if key in compared:
            continue
        compared.add(key)
        reference = lights[shot.light]
        label = f"{setting.camera} {setting.index} " if len(lights) > 1 else ""
        try:
            if after and not before:
                _check_stock_renders(scene)
            light = rendered(scene, setting.camera, setting.middle_s, case.seed, cache)
        except InputError as error:
            if not after or before:
                raise
            found.findings.append(Finding("transport", f"{label}light", "skipped", str(error)))
            continue
        # Another document may be another sampler of the same random numbers.
        comparable = case.same_seed and not case.changes
        own_samples = case.reference.own_samples(reference) if comparable else 0
        findings, tests = compare_indirect(
            reference, light, label, alike=before == after, own_samples=own_samples
        )
        calibration = case.reference.calibrations[setting.camera]
        if light.indirect is not None and not after:
            found.findings.append(compare_view(scene, setting.middle_s, calibration, label))
        same_bits = light_hash(light) == reference.own_hash if case.same_seed else None
        found.findings.extend([compare_tables(reference.light, light, label, exact=exact), *findings])
        found.pending.extend((group, same_bits) for group in tests)
    return found


def _findings_after_light(case: _SceneCase) -> tuple[list[Finding], list[ImagePair]]:
    """Compare what camera and perception make of the reference's own light, electrons and frames."""
    scene, reference, exact = (
        case.scene,
        case.reference,
        case.same_made("transport") and case.same_made("other"),
    )
    findings = [
        compare_calibration(scene, camera, calibration, exact=exact)
        for camera, calibration in reference.calibrations.items()
        if camera in scene.all_cameras()
    ]
    findings += compare_choices(scene, reference.shots, exact=exact)
    pairs, taken = [], []
    for shot in reference.shots:
        setting = case.settings.get((shot.frame.camera, shot.frame.index))
        if setting is None:
            continue
        label = f"{setting.camera} {setting.index} "
        light = reference.lights[shot.light]
        finding, pair = compare_electrons(scene, setting, shot, light, label, exact=exact)
        frame = compare_frame(scene, setting, shot, reference.seed, label, exact=exact)
        findings.extend([finding, frame])
        if pair is not None:
            pairs.append(pair)
            taken.append((setting, shot))
    found = detections_of([shot.frame for shot in reference.shots], reference.calibrations)
    findings.extend(
        compare_detections(estimator, before, found.get(estimator, ()), exact=exact)
        for estimator, before in reference.detections.items()
    )
    findings.extend(_followed(scene, reference, exact=exact))
    return [*findings, check_repeatable(scene, reference, taken, found)], pairs


def _followed(scene: Scene, reference: Reference, *, exact: bool) -> list[Finding]:
    """Compare what robots know of their way, whom they follow and what they read."""
    frames = [shot.frame for shot in reference.shots]
    if not is_sequence(frames):
        return []
    before = reference.following
    if before is None:
        words = "the reference has none: 'nir-render regress update --all' adds them"
        return [Finding("perception", "tracks and messages", "skipped", words)]
    findings = [compare_odometry(before.odometry, as_kept(odometry_by_robot(scene)), exact=exact)]
    for name, known in before.by_estimator.items():
        detections = reference.detections[name]
        now = followed_of(name, frames, reference.calibrations, detections, before.odometry)
        findings += compare_followed(name, known, now, exact=exact)
    return findings


def _check_stock_renders(scene: Scene) -> None:
    """Raise InputError where the stock path tracer puts light elsewhere than the light-group renderer."""
    from nir_render.transport.world.facets import facets

    if facets(scene.at(0.0)).name:
        raise InputError("without LLVM ghosts and what is behind panes are no part of the direct table")


def _frame_findings(case: _SceneCase) -> list[Finding]:
    """Say which frames the scene does not take any more, and which are new."""
    before = [(shot.frame.camera, shot.frame.index) for shot in case.reference.shots]
    unlike = {
        "gone": [key for key in before if key not in case.settings],
        "new": [key for key in case.settings if key not in before],
    }
    lines = [
        f"{word}: {', '.join(f'{camera} {index}' for camera, index in keys)}"
        for word, keys in unlike.items()
        if keys
    ]
    return [Finding("scene", "frames", "fail", "; ".join(lines))] if lines else []
