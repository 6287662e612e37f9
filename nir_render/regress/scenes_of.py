"""A suite: the scene files of a folder, and the folder of their references."""

from pathlib import Path

from nir_render.errors import InputError
from nir_render.scene.load import load_scene
from nir_render.scene.scene import Scene

REFERENCES = "references"


def scenes_of(suite: str | Path) -> dict[str, Scene]:
    """Return the scenes of a suite by the names of their files, without what follows the dot.

    Raises
    ------
    InputError
        There is no such folder, no scene in it, one that ends in .yml, a broken one, or one whose samples
        follow the noise.
    """
    folder = Path(suite)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give a folder of scene files (*.yaml)")
    unlike = sorted(folder.glob("*.yml"))
    if unlike:
        raise InputError(
            *(f"{file}: scenes of a suite end in .yaml; rename it, or move it away" for file in unlike)
        )
    files = sorted(folder.glob("*.yaml"))
    if not files:
        raise InputError(f"{folder}: holds no scene file (*.yaml); put the scenes of the suite there")
    scenes = {file.stem: load_scene(file) for file in files}
    problems = [
        f"{scene.path}: render: the scenes of a suite fix their samples, so that every render has the same; "
        'write "indirect: {samples: 64}" in place of "noise"'
        for scene in scenes.values()
        if scene.document.has_indirect_light() and scene.document.render.indirect.samples is None
    ]
    if problems:
        raise InputError(*problems)
    return scenes


def references_folder(suite: str | Path, references: str | Path | None) -> Path:
    """Return the folder of a suite's references: `references` within the suite if none is given."""
    return Path(suite) / REFERENCES if references is None else Path(references)
