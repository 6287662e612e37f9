"""The shapes of a Mitsuba scene in XML, as parts of a slot each: the id of what reflects there is its name.

Read are OBJ, PLY and STL files, rectangles, cubes, disks, spheres, cylinders, groups and instances, with
their transforms, defaults, and files that are included. Names are those of versions 2 and 3; those of 0.6, in
camel case, are taken too. All else is passed over: materials, emitters, sensors, media are the scene file's.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from nir_render.scene.meshes.mesh import MeshPart, joined, moved, with_flat_normals
from nir_render.scene.meshes.mitsuba_shapes import SHAPES, transform_of
from nir_render.scene.meshes.xml import Element, tree_of

FILES = (".obj", ".ply", ".stl")
_MOST_INCLUDED = 16
_PARAMETER = re.compile(r"\$(\w+)")

ReadFile = Callable[[Path], list[MeshPart]]


def read_mitsuba_xml(path: Path, read_file: ReadFile) -> list[MeshPart]:
    """Return the parts of all shapes of a scene, those of one slot together; `read_file` reads their files.

    Raises
    ------
    ValueError
        It is no such scene, or has a shape that is none of these; it says in which line.
    """
    slots: dict[str, list[MeshPart]] = {}
    groups: dict[str, Element] = {}
    for shape in scene_shapes(path):
        kind = shape.attributes.get("type", "")
        if kind == "shapegroup":
            groups[shape.attributes.get("id", "")] = shape
            continue
        for part in _parts(shape, kind, groups, read_file):
            slots.setdefault(part.slot, []).append(part)
    return [joined(slot, _alike(parts)) for slot, parts in slots.items()]


def _alike(parts: list[MeshPart]) -> list[MeshPart]:
    """Return parts of which all have normals where any has: flat triangles get corners of their own."""
    if all(part.normals is None for part in parts):
        return parts
    return [part if part.normals is not None else with_flat_normals(part) for part in parts]


def files_named(path: Path) -> tuple[Path, ...]:
    """Return the files that a scene is made of, itself first; raise ValueError as `read_mitsuba_xml`."""
    files = [path]
    for shape in scene_shapes(path, files):
        inner = [one for one in shape.children if one.tag == "shape"]
        files += [_file_of(one) for one in (shape, *inner) if one.named("filename") is not None]
    return tuple(dict.fromkeys(files))


def scene_shapes(path: Path, files: list[Path] | None = None) -> Iterator[Element]:
    """Yield the shapes of a scene in order, parameters filled in; `files` takes those that are included."""
    yield from _shapes_in(path, {}, [path.parent], files if files is not None else [], 0)


def _shapes_in(
    path: Path, parameters: dict[str, str], folders: list[Path], files: list[Path], depth: int
) -> Iterator[Element]:
    root = tree_of(path.read_bytes())
    if root.tag != "scene":
        raise root.wrong(f"this is <{root.tag}>, not the <scene> of Mitsuba; give that file, or a mesh")
    for raw in root.children:
        one = _filled(raw, parameters, tuple(folders))
        if one.tag == "default":
            parameters.setdefault(one.attributes.get("name", ""), one.attributes.get("value", ""))
        elif one.tag == "path":
            folders.append(path.parent / one.attributes.get("value", ""))
        elif one.tag == "include":
            if depth == _MOST_INCLUDED:
                raise one.wrong(f"files are included {_MOST_INCLUDED} deep; does one include itself?")
            found = _found(one, one.attributes.get("filename", ""))
            files.append(found)
            try:
                yield from _shapes_in(found, parameters, [*folders, found.parent], files, depth + 1)
            except ValueError as error:
                raise one.wrong(f"{found}: {error}") from None
        elif one.tag == "shape":
            yield one


def _filled(raw: Element, parameters: dict[str, str], folders: tuple[Path, ...]) -> Element:
    """Return an element with the values of $parameters."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in parameters:
            raise raw.wrong(
                f"${match[1]} has no value; give it one by <default name='{match[1]}' value='…'/>"
            )
        return parameters[match[1]]

    attributes = {name: _PARAMETER.sub(value, text) for name, text in raw.attributes.items()}
    children = [_filled(child, parameters, folders) for child in raw.children]
    return replace(raw, attributes=attributes, folders=folders, children=children)


def _parts(shape: Element, kind: str, groups: dict[str, Element], read_file: ReadFile) -> Iterator[MeshPart]:
    """Yield the parts of one shape, where it stands."""
    to_world = transform_of(shape)
    if kind == "instance":
        ref = next((one for one in shape.children if one.tag == "ref"), None)
        group = None if ref is None else groups.get(ref.attributes.get("id", ""))
        if group is None:
            raise shape.wrong("an instance names no <shape type='shapegroup'> that stands before it")
        for one in group.children:
            if one.tag == "shape":
                for part in _parts(one, one.attributes.get("type", ""), {}, read_file):
                    yield moved(part, to_world)
        return
    if kind in SHAPES:
        parts = [SHAPES[kind](shape)]
    elif "." + kind in FILES:
        parts = read_file(_file_of(shape))
    else:
        known = ", ".join([*(name[1:] for name in FILES), *SHAPES, "shapegroup", "instance"])
        raise shape.wrong(f"a shape of the type {kind!r} is not read; export it as a mesh (known: {known})")
    slot = _slot(shape)
    for part in parts:
        whole = replace(part, slot=slot)
        if _is_true(shape, "face_normals"):
            whole = replace(whole, normals=None)
        if _is_true(shape, "flip_normals"):
            turned = None if whole.normals is None else -whole.normals
            whole = replace(whole, normals=turned, faces=whole.faces[:, ::-1])
        yield moved(whole, to_world)


def _slot(shape: Element) -> str:
    """Return the id of what reflects on a shape, or of what that is made of; empty where it has none."""
    for one in shape.children:
        side = one.attributes.get("name", "")
        if one.tag == "ref" and side not in ("interior", "exterior"):
            return one.attributes.get("id", "")
        if one.tag == "bsdf":
            inner = next((child for child in one.children if child.tag in ("bsdf", "ref")), one)
            return one.attributes.get("id") or inner.attributes.get("id", "")
    return ""


def _is_true(shape: Element, name: str) -> bool:
    given = shape.named(name)
    return given is not None and given.attributes.get("value", "").strip().lower() == "true"


def _file_of(shape: Element) -> Path:
    given = shape.named("filename")
    if given is None or not given.attributes.get("value"):
        raise shape.wrong("the shape names no file; add <string name='filename' value='…'/>")
    return _found(given, given.attributes["value"])


def _found(element: Element, name: str) -> Path:
    for folder in element.folders:
        if (folder / name).is_file():
            return folder / name
    looked = ", ".join(dict.fromkeys(map(str, element.folders)))
    raise element.wrong(f"there is no file {name!r} (looked in {looked}); check its name and folder")
