"""Changes of a raw document at dotted paths: `--set`, `Scene.with_`, the axes of a campaign."""

from collections.abc import Mapping
from typing import Any

from nir_render.errors import InputError, shown
from nir_render.scene.documents.document import SceneDocument
from nir_render.scene.documents.files import without_alternatives
from nir_render.scene.text.units import with_component

# Two ways to say how finely to sample; a change that writes one takes the other away.
_RIVALS = ("render.noise", "render.indirect.samples")


_COMPONENTS = {"x": 0, "y": 1, "z": 2, "0": 0, "1": 1, "2": 2}  # of vectors


def apply_overrides(raw: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a raw document with values set at dotted paths; what they leave is shared with the one given.

    Numbers in a path index lists; x, y, z (or 0, 1, 2) at its end are components of a vector:
    `robots.r2.position.x`.
    A preset's name on the way becomes the ground under the change: `...sensor.read_noise` on
    `sensor: mt9m031` gives `{preset: mt9m031, read_noise: ...}`.
    """
    changed: dict[str, Any] = dict(raw)
    for path, value in overrides.items():
        keys = path.split(".")
        if not all(keys):
            raise InputError(f"--set {path}: a dotted path such as 'robots.r2.position' was wanted")
        if keys[0] not in SceneDocument.model_fields:
            raise InputError(
                f"--set {path}: {shown(keys[0])} is no part of a scene; "
                f"known: {', '.join(SceneDocument.model_fields)}"
            )
        changed = _set(changed, keys, value, path)
    return _without_rivals(changed, overrides)


def _without_rivals(changed: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Drop the fixed count of samples where a target for the noise has been set, and the other way round."""
    set_now = {path for path in _RIVALS if overrides.get(path) is not None}
    if len(set_now) != 1:
        return changed
    (rival,) = set(_RIVALS) - set_now
    found: dict[str, Any] = _without(changed, rival.split("."))
    return found


def _without(node: Any, way: list[str]) -> Any:
    """Return nested data without what lies at the end of a way; all else is shared."""
    if not isinstance(node, dict) or way[0] not in node:
        return node
    if len(way) == 1:
        return {key: value for key, value in node.items() if key != way[0]}
    return {**node, way[0]: _without(node[way[0]], way[1:])}


def _set(node: Any, keys: list[str], value: Any, path: str) -> Any:
    if not keys:
        return value
    if isinstance(node, list):
        numbers = all(isinstance(item, int | float) for item in node)
        known = _COMPONENTS if numbers else {}
        index = int(keys[0]) if keys[0].isdigit() else known.get(keys[0], -1)
        if not 0 <= index < len(node):
            raise InputError(f"--set {path}: {shown(keys[0])} is no index of a list of {len(node)}")
        return [_set(item, keys[1:], value, path) if i == index else item for i, item in enumerate(node)]
    if isinstance(node, str) and node.lstrip().startswith("["):
        if len(keys) != 1 or keys[0] not in _COMPONENTS:
            raise InputError(
                f"--set {path}: {shown(keys[0])} is no component of {shown(node)}; take x, y or z"
            )
        try:
            return with_component(node, _COMPONENTS[keys[0]], value)
        except ValueError as error:
            raise InputError(f"--set {path}: {error}") from None
    if node is None:
        node = {}
    elif isinstance(node, str):
        node = {"preset": node}
    elif not isinstance(node, dict):
        raise InputError(f"--set {path}: {shown(keys[0])} lies inside the value {shown(node)}")
    if len(keys) == 1:
        node = without_alternatives(node, {keys[0]: value})
    return {**node, keys[0]: _set(node.get(keys[0]), keys[1:], value, path)}
