"""The shapes of a Mitsuba scene in XML, as parts of a slot each: the id of what reflects there is its name.

Read are OBJ, PLY and STL files, rectangles, cubes, disks, spheres, cylinders, groups and instances, with
their transforms, defaults, and files that are included. Names are those of versions 2 and 3; those of 0.6, in
camel case, are taken too. What is not there for light is left out: shapes of a `null` material, which hold
fog, and those that are nothing but lamps. All else is passed over: what reflects, emitters, sensors, media
are the scene file's.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from nir_render.scene.meshes.mesh import MeshPart, joined, moved, with_flat_normals
from nir_render.scene.meshes.mitsuba_shapes import SHAPES, transform_of
from nir_render.scene.meshes.xml import Element, tree_of

KINDS = ("obj", "ply", "stl")
_MOST_INCLUDED = 64
_PARAMETER = re.compile(r"\$(\w+)")

ReadFile = Callable[[Path, str], list[MeshPart]]


@dataclass
class _Scene:
    """What a scene's files hold: elements in order, parameters filled in, and what has an id."""

    parameters: dict[str, str] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    reading: list[Path] = field(default_factory=list)
    shapes: list[Element] = field(default_factory=list)
    groups: dict[str, Element] = field(default_factory=dict)
    materials: dict[str, Element] = field(default_factory=dict)
    aliases: dict[str, str] = field(default_factory=dict)


def read_mitsuba_xml(path: Path, read_file: ReadFile) -> list[MeshPart]:
    """Return the parts of all shapes of a scene, those of one slot together.

    `read_file` reads a file of a kind ("ply"). Where any part has normals, those that have none get them for
    each triangle: they look as flat as they are.

    Raises
    ------
    ValueError
        It is no such scene, or has a shape that is none of these; it says in which line.
    """
    scene = _scene_of(path)
    parts = [part for shape in scene.shapes for part in _parts(shape, scene, read_file)]
    if any(part.normals is not None for part in parts):
        parts = [part if part.normals is not None else with_flat_normals(part) for part in parts]
    slots: dict[str, list[MeshPart]] = {}
    for part in parts:
        slots.setdefault(part.slot, []).append(part)
    return [joined(slot, those) for slot, those in slots.items()]


def files_named(path: Path) -> tuple[Path, ...]:
    """Return the files that a scene is made of, itself first; raise ValueError as `read_mitsuba_xml`."""
    scene = _scene_of(path)
    grouped = [one for group in scene.groups.values() for one in group.children if one.tag == "shape"]
    named = [one for one in (*scene.shapes, *grouped) if one.named("filename") is not None]
    return tuple(dict.fromkeys([path, *scene.files, *map(_file_of, named)]))


def _scene_of(path: Path) -> _Scene:
    scene = _Scene(folders=[path.parent], reading=[path.resolve()])
    root = tree_of(path.read_bytes())
    if root.tag != "scene":
        raise root.wrong(f"this is <{root.tag}>, not the <scene> of Mitsuba; give that file, or a mesh")
    for one in _filled(root, scene, path).children:
        if one.tag == "shape" and one.attributes.get("type") == "shapegroup":
            scene.groups[one.attributes.get("id", "")] = one
        elif one.tag == "shape":
            scene.shapes.append(one)
        elif one.tag == "alias":
            scene.aliases[one.attributes.get("as", "")] = one.attributes.get("id", "")
    return scene


def _filled(raw: Element, scene: _Scene, path: Path) -> Element:
    """Return an element with the values of $parameters, and with what it includes."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in scene.parameters:
            raise raw.wrong(f"${match[1]} has no value; write <default name='{match[1]}' value='…'/>")
        return scene.parameters[match[1]]

    attributes = {name: _PARAMETER.sub(value, text) for name, text in raw.attributes.items()}
    filled = Element(raw.tag, attributes, raw.line, tuple(scene.folders))
    for child in raw.children:
        one = _filled(child, scene, path)
        if one.tag == "default":
            scene.parameters.setdefault(one.attributes.get("name", ""), one.attributes.get("value", ""))
        elif one.tag == "path":
            scene.folders.insert(0, path.parent / one.attributes.get("value", ""))
        elif one.tag == "include":
            filled.children.extend(_included(one, scene))
        else:
            filled.children.append(one)
    if filled.tag == "bsdf" and "id" in attributes:
        scene.materials[attributes["id"]] = filled
    return filled


def _included(include: Element, scene: _Scene) -> list[Element]:
    """Return what an included file has: the elements of its scene, or one element."""
    path = _found(include, include.attributes.get("filename", ""))
    scene.files.append(path)
    if path.resolve() in scene.reading or len(scene.files) > _MOST_INCLUDED:
        raise include.wrong(f"{path.name} includes itself, or too many others; take the <include> out")
    scene.reading.append(path.resolve())
    scene.folders.append(path.parent)
    try:
        root = _filled(tree_of(path.read_bytes()), scene, path)
    except (ValueError, OSError) as error:
        raise include.wrong(f"{path}: {error}") from None
    finally:
        scene.folders.pop()
        scene.reading.pop()
    return root.children if root.tag == "scene" else [root]


def _parts(shape: Element, scene: _Scene, read_file: ReadFile) -> Iterator[MeshPart]:
    """Yield the parts of one shape, where it stands."""
    kind, to_world = shape.attributes.get("type", ""), transform_of(shape)
    if kind == "instance":
        for one in _group_of(shape, scene).children:
            if one.tag == "ref":
                raise one.wrong("a group refers to a shape; write the shape into the group")
            if one.tag == "shape" and one.attributes.get("type") == "instance":
                raise one.wrong("a group holds an instance; write the shapes that it stands for")
            if one.tag == "shape":
                for part in _parts(one, scene, read_file):
                    yield moved(part, to_world)
        return
    material, slot = _material_of(shape, scene)
    is_lamp = any(one.tag == "emitter" for one in shape.children)
    if (material is None and is_lamp) or (material is not None and material.attributes.get("type") == "null"):
        return
    for part in _own_parts(shape, kind, read_file):
        whole = replace(part, slot=slot)
        if _is_true(shape, "face_normals"):
            whole = replace(whole, normals=None)
        if _is_true(shape, "flip_normals"):
            turned = None if whole.normals is None else -whole.normals
            whole = replace(whole, normals=turned, faces=whole.faces[:, ::-1])
        yield moved(whole, to_world)


def _own_parts(shape: Element, kind: str, read_file: ReadFile) -> list[MeshPart]:
    """Return the parts of a shape as it is by itself. Mitsuba's pictures have their first row at v = 0."""
    if kind in SHAPES:
        return [SHAPES[kind](shape)]
    if kind not in KINDS:
        known = ", ".join([*KINDS, *SHAPES, "shapegroup", "instance"])
        raise shape.wrong(f"a shape of the type {kind!r} is not read; export it as a mesh (known: {known})")
    file = _file_of(shape)
    try:
        parts = read_file(file, kind)
    except (ValueError, OSError) as error:
        raise shape.wrong(f"{file}: {error}") from None
    if _is_true(shape, "flip_tex_coords", default=kind == "obj"):
        return parts
    return [part if part.uvs is None else replace(part, uvs=part.uvs * (1, -1) + (0, 1)) for part in parts]


def _group_of(instance: Element, scene: _Scene) -> Element:
    for one in instance.children:
        name = one.attributes.get("id", "")
        name = scene.aliases.get(name, name)
        if one.tag == "ref" and name in scene.groups:
            return scene.groups[name]
    raise instance.wrong("an instance names no <shape type='shapegroup'>; write a <ref id='…'/> of one")


def _material_of(shape: Element, scene: _Scene) -> tuple[Element | None, str]:
    """Return what reflects on a shape, None for the default, and its id or that of what it is made of."""
    for one in shape.children:
        if one.tag == "bsdf":
            inner = [
                child for child in one.children if child.tag in ("bsdf", "ref") and "id" in child.attributes
            ]
            only = inner[0].attributes["id"] if len(inner) == 1 else ""
            return one, one.attributes.get("id") or only
        if one.tag == "ref":
            name = one.attributes.get("id", "")
            name = scene.aliases.get(name, name)
            if name in scene.materials:
                return scene.materials[name], name
            if one.attributes.get("name") == "bsdf":
                raise one.wrong(f"there is no <bsdf id={name!r}> in the scene; add it, or take another id")
    return None, ""


def _is_true(shape: Element, name: str, *, default: bool = False) -> bool:
    given = shape.named(name)
    return default if given is None else given.attributes.get("value", "").strip().lower() == "true"


def _file_of(shape: Element) -> Path:
    given = shape.named("filename")
    if given is None or not given.attributes.get("value"):
        raise shape.wrong("the shape names no file; add <string name='filename' value='…'/>")
    return _found(given, given.attributes["value"])


def _found(element: Element, name: str) -> Path:
    for folder in element.folders:
        for one in (folder / name, folder / name.replace("\\", "/")):
            try:
                if one.is_file():
                    return one
            except OSError:  # too long a name
                continue
    looked = ", ".join(dict.fromkeys(map(str, element.folders)))
    raise element.wrong(f"there is no file {name[:200]!r} (looked in {looked}); check its name and folder")
