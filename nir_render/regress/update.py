"""References of a whole suite: made, and made anew where something has changed on purpose."""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from nir_render.errors import InputError
from nir_render.regress.checking import Progress, check_scenes, steps
from nir_render.regress.findings import Update
from nir_render.regress.make import frame_settings, lights_of, make_reference
from nir_render.regress.reference import Reference
from nir_render.regress.scenes_of import references_folder, scenes_of
from nir_render.regress.store import names_in, read_reference, write_references
from nir_render.run import folder as run_folder
from nir_render.scene.scene import Scene

RENDERS = 16
"""Renders that a reference is the mean of: its own noise is a quarter of that of what is held against it."""


def create(
    suite: str | Path,
    refs: str | Path | None = None,
    *,
    renders: int = RENDERS,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Make the references of a suite that has none; return its scenes.

    Parameters
    ----------
    suite
        A folder of scene files.
    refs
        Where the references go, `references` within the suite if not given.
    renders
        Renders that each light is the mean of, 8 or more.
    progress
        Called with the number of renders done, and of all.

    Raises
    ------
    InputError
        There are references already, or a scene cannot be rendered.
    """
    scenes = scenes_of(suite)
    folder = references_folder(suite, refs)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder}: is there already and is not overwritten; 'nir-render regress update {suite} "
            "--reason '...'' makes references anew where something changed"
        )
    made = _make_references(
        scenes, dict.fromkeys(scenes, renders), dict.fromkeys(scenes, ()), "created", progress
    )
    write_references(folder, made, [], lambda: None)
    return tuple(scenes)


def update(
    suite: str | Path,
    reason: str,
    refs: str | Path | None = None,
    *,
    every: bool = False,
    page: str | Path | None = None,
    renders: int | None = None,
    progress: Progress | None = None,
) -> Update:
    """Make references anew where a check finds a drift, or the scene has changed; the others are kept.

    What passes keeps its reference: so no drift creeps in by steps too small to see.

    Parameters
    ----------
    reason
        Why, for those who come after; kept with each reference.
    every
        Make all anew.
    page
        Where a page that shows old, new and their difference goes, if anywhere.
    renders
        Renders that each light is the mean of; without, as many as it was before.

    Raises
    ------
    InputError
        No reason is given, or the suite or its references are missing or broken.
    """
    if not reason.strip():
        raise InputError("--reason is empty; say why the references change, for those who come after")
    scenes = scenes_of(suite)
    folder = references_folder(suite, refs)
    known = names_in(folder, Path(suite))
    old = {name: read_reference(folder, name, Path(suite)) for name in known if name in scenes}
    before = check_scenes(str(suite), {name: scenes[name] for name in old}, old)
    stands = {one.name for one in before.scenes if one.holds and not one.changes and not every}
    anew = {name: scene for name, scene in scenes.items() if name not in stands}
    history = {name: old[name].history if name in old else () for name in anew}
    before_count = {name: old[name].renders if name in old else RENDERS for name in anew}
    counts = before_count if renders is None else dict.fromkeys(anew, renders)
    made = _make_references(anew, counts, history, reason.strip(), progress)
    done = Update(
        reason.strip(),
        tuple(made),
        tuple(name for name in scenes if name in stands),
        tuple(name for name in known if name not in scenes),
        before,
        {name: old[name] for name in made if name in old},
        made,
    )
    if done.changed:
        write_references(folder, made, done.kept, lambda: _write_page(done, page))
    return done


def _write_page(done: Update, page: str | Path | None) -> None:
    if page is not None:
        from nir_render.regress.page import update_page

        run_folder.write_file(Path(page), update_page(done).encode())


def _make_references(
    scenes: Mapping[str, Scene],
    renders: Mapping[str, int],
    history: Mapping[str, tuple[Mapping[str, str], ...]],
    reason: str,
    progress: Progress | None,
) -> dict[str, Reference]:
    settings = {name: frame_settings(scene) for name, scene in scenes.items()}
    total = sum(
        len(lights_of(scene, settings[name])[0]) * (renders[name] + 1) for name, scene in scenes.items()
    )
    step = steps(progress, total)
    entry = {"time": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), "reason": reason}
    return {
        name: make_reference(scene, settings[name], renders[name], (*history[name], entry), step)
        for name, scene in scenes.items()
    }
