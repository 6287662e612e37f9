"""A mesh file (PLY, OBJ, STL, glTF, Mitsuba's XML) becomes parts of one material each, or is refused.

OBJ and XML are read here, as errors name their line and slots are needed without a file of materials; the
others by trimesh. glTF stands with y up by its standard, the others as `up` says.
"""

import io
import logging
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nir_render.scene.meshes.mesh import Array, MeshPart, checked, joined, moved
from nir_render.scene.meshes.mitsuba_xml import files_named, read_mitsuba_xml
from nir_render.scene.meshes.obj import read_obj

SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".xml")
_MOST_BYTES = 256 * 2**20
_UNNAMED = ""

Up = Literal["y", "z"]


def read_mesh(file: str | Path, up: Up | None = None) -> tuple[MeshPart, ...]:
    """Return the parts of a mesh file, a slot each, z up; None is y for glTF, and z for all else.

    Raises
    ------
    ValueError
        It is no such file, it is damaged, or it is too large; it says what is wrong, and where.
    """
    return _read(str(file), up, tuple(map(_state, files_of_mesh(file))))


def files_of_mesh(file: str | Path) -> tuple[Path, ...]:
    """Return the files that a mesh is read from, itself first: a Mitsuba scene names others.

    Raises
    ------
    ValueError
        It cannot be read, or a file that it names is not there.
    """
    path = Path(file)
    if _kind(path) != "xml":
        return (path,)
    _state(path)
    try:
        return files_named(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _state(path: Path) -> tuple[str, int, int]:
    """Return by what a file is known while it does not change."""
    try:
        state = path.stat()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    if state.st_size > _MOST_BYTES:
        raise ValueError(
            f"{path}: has {state.st_size >> 20} MiB, at most {_MOST_BYTES >> 20} are read; simplify it"
        )
    return str(path), state.st_mtime_ns, state.st_size


def _kind(path: Path) -> str:
    return path.suffix.lower().removeprefix(".")


@lru_cache(maxsize=16)
def _read(file: str, up: Up | None, _states: tuple[tuple[str, int, int], ...]) -> tuple[MeshPart, ...]:
    path = Path(file)
    kind = _kind(path)
    try:
        found = read_mitsuba_xml(path, _parts_of) if kind == "xml" else _parts_of(path, kind)
        parts = [checked(part) for part in found]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not parts:
        raise ValueError(f"{path}: holds no triangles; export the surface as a mesh")
    if (up or ("y" if kind in ("glb", "gltf") else "z")) == "y":
        parts = [_stood_up(part) for part in parts]
    return tuple(parts)


def _parts_of(path: Path, kind: str) -> list[MeshPart]:
    data = path.read_bytes()
    if kind == "obj":
        if b"\0" in data:
            raise ValueError("this is no text, and so no OBJ file; export the mesh again")
        return read_obj(data.decode("utf-8-sig", errors="replace"))  # comments may be of any encoding
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("trimesh").setLevel(logging.CRITICAL)
        try:
            return _read_by_trimesh(data, kind)
        except MemoryError:
            raise ValueError(
                f"cannot be read as {kind}: it claims to hold more than fits; export it again"
            ) from None
        except Exception:  # of any kind: what is damaged meets trimesh's parsers anywhere
            other = "; with buffers in files beside it, export as .glb" if kind == "gltf" else ""
            raise ValueError(
                f"cannot be read as {kind}: this is another kind of file, or is damaged; export the mesh "
                f"again{other}"
            ) from None


def _read_by_trimesh(data: bytes, kind: str) -> list[MeshPart]:
    from trimesh.exchange import ply, stl

    if kind in ("glb", "gltf"):
        return _read_gltf(data, kind)
    found = (ply.load_ply if kind == "ply" else stl.load_stl)(io.BytesIO(data))
    if found.get("faces") is None:
        return []
    return [_part(found, _UNNAMED, np.eye(4))]


def _read_gltf(data: bytes, kind: str) -> list[MeshPart]:
    import trimesh
    from trimesh.exchange import gltf

    # The geometry as it is written, and from the scene where each piece of it stands.
    written = (gltf.load_glb if kind == "glb" else gltf.load_gltf)(io.BytesIO(data))["geometry"]
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    slots: dict[str, list[MeshPart]] = {}
    for node in scene.graph.nodes_geometry:
        to_world, name = scene.graph[node]
        found = written[name]
        if found.get("faces") is None:
            continue
        material = getattr(found.get("visual"), "material", None)
        slot = str(getattr(material, "name", None) or _UNNAMED)
        slots.setdefault(slot, []).append(_part(found, slot, np.asarray(to_world, dtype=np.float64)))
    return [joined(slot, parts) for slot, parts in slots.items()]


def _part(found: dict[str, Any], slot: str, to_world: Array) -> MeshPart:
    faces = np.asarray(found["faces"])
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError("its faces are no triangles")
    if faces.size and (faces.min() < 0 or faces.max() >= 2**32):
        raise ValueError(f"a triangle wants vertex {int(faces.min())}")
    vertices = np.asarray(found["vertices"], dtype=np.float64).reshape(-1, 3)
    normals, uvs = found.get("vertex_normals"), getattr(found.get("visual"), "uv", None)
    part = MeshPart(
        slot,
        vertices,
        None if normals is None or len(normals) != len(vertices) else np.asarray(normals, dtype=np.float64),
        faces.astype(np.uint32),
        None if uvs is None or np.shape(uvs) != (len(vertices), 2) else np.asarray(uvs, dtype=np.float64),
    )
    return moved(part, to_world)


def _stood_up(part: MeshPart) -> MeshPart:
    """Return a part whose y is up with z up: x stays."""
    turn = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return moved(part, np.array(turn))
