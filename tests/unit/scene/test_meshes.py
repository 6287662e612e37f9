"""Mesh files: what is read of them, and what is told of those that are damaged."""

import io
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from nir_render import InputError, parse_scene
from nir_render.scene.meshes.mesh import lies_open
from nir_render.scene.meshes.read import read_mesh
from nir_render.scene.scene import Scene
from tests.unit.perception.simulation import random

CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 3)]
QUADS = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
BOX = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
CLOSED = BOX + "".join(f"f {a} {b} {c} {d}\n" for a, b, c, d in QUADS)


def _write(folder: Path, text: str | bytes, name: str = "m.obj") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def _volume_and_area(path: Path, up: str | None = None) -> tuple[float, float]:
    volume = area = 0.0
    for part in read_mesh(path, up):  # type: ignore[arg-type]
        a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
        volume += float((a * np.cross(b, c)).sum()) / 6.0
        area += 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return volume, area


def _glb(factor: NDArray[np.float64]) -> bytes:
    """Two boxes of 1 × 2 × 3, y up: one as it is, one by a transform."""
    scene = trimesh.Scene()
    for slot, matrix in (("Wood", np.eye(4)), ("Steel", factor)):
        body = trimesh.creation.box((1.0, 2.0, 3.0))
        body.visual = TextureVisuals(uv=np.zeros((8, 2)), material=PBRMaterial(name=slot))
        scene.add_geometry(body, transform=matrix)
    return bytes(scene.export(file_type="glb"))


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb"])
def test_every_format_has_the_same_body(tmp_path: Path, kind: str) -> None:
    body = trimesh.creation.box((1.0, 2.0, 3.0))
    data = body.export(file_type=kind)
    path = _write(tmp_path, data, f"m.{kind}")
    assert _volume_and_area(path) == pytest.approx((6.0, 22.0), rel=1e-6)
    (part,) = read_mesh(path)
    upright = 1 if kind == "glb" else 2  # glTF stands with y up
    assert np.ptp(part.vertices, axis=0) == pytest.approx(
        [1.0, 3.0, 2.0] if upright == 1 else [1.0, 2.0, 3.0]
    )
    assert lies_open((part,)) is None


def test_y_up_becomes_z_up_and_x_stays(tmp_path: Path) -> None:
    path = _write(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 2 3\nf 1 3 4\n")
    (part,) = read_mesh(path, "y")
    assert part.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 0, 2], [0, -3, 0]]


def test_polygons_of_any_outline_keep_their_area(tmp_path: Path) -> None:
    """An L of 3 square units: a fan about its first corner would turn over a triangle."""
    outline = [(1, 1), (1, 2), (0, 2), (0, 0), (2, 0), (2, 1)]
    path = _write(tmp_path, "".join(f"v {x} {y} 0\n" for x, y in outline) + "f 1 2 3 4 5 6\n")
    assert _volume_and_area(path)[1] == pytest.approx(3.0)
    comb = [(0, 0), (3, 0), (3, 1), (2.5, 0.2), (2, 1), (1.5, 0.2), (1, 1), (0.5, 0.2), (0, 1)]
    path = _write(tmp_path, "".join(f"v {x} {y} 0\n" for x, y in comb) + "f 1 2 3 4 5 6 7 8 9\n")
    with pytest.raises(
        ValueError, match=r"line 10: 'f 1 2 3 .*' an outline|line 10: .* outline that turns inwards"
    ):
        read_mesh(path)


def test_a_box_of_quads_is_closed_and_what_lacks_a_face_is_open(tmp_path: Path) -> None:
    assert lies_open(read_mesh(_write(tmp_path, CLOSED))) is None
    assert "4 edges" in str(lies_open(read_mesh(_write(tmp_path, CLOSED.rsplit("f ", 1)[0], "open.obj"))))
    inwards = BOX + "".join(f"f {d} {c} {b} {a}\n" for a, b, c, d in QUADS)
    assert "look inwards" in str(lies_open(read_mesh(_write(tmp_path, inwards, "in.obj"))))


def test_slots_and_transforms_of_gltf(tmp_path: Path) -> None:
    """The second box is mirrored, stretched twofold along x and moved: its volume is 12, its faces look out."""
    factor = np.diag([-2.0, 1.0, 1.0, 1.0])
    factor[:3, 3] = (10.0, 0.0, 0.0)
    parts = {part.slot: part for part in read_mesh(_write(tmp_path, _glb(factor), "m.glb"))}
    assert set(parts) == {"Wood", "Steel"}
    assert _volume_and_area(tmp_path / "m.glb")[0] == pytest.approx(6.0 + 12.0)
    assert lies_open((parts["Steel"],)) is None
    assert parts["Steel"].vertices.mean(axis=0) == pytest.approx([10.0, 0.0, 0.0])


def test_normals_of_a_file_are_kept_and_made_up_nowhere(tmp_path: Path) -> None:
    flat = read_mesh(_write(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"))[0]
    assert flat.normals is None
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 2\nvn 0 1 1\nf 1//1 2//1 3//2\n"
    normals = read_mesh(_write(tmp_path, text, "n.obj"))[0].normals
    assert normals is not None
    assert normals.tolist() == [[0, 0, 1], [0, 0, 1], pytest.approx([0, 0.5**0.5, 0.5**0.5])]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no triangles"),
        ("v 0 0 0\nv 1 0 0\n", "holds no triangles"),
        ("f 1 2 3\n", "line 1: 'f 1 2 3': there is no vertex 1: 0 vertices stand above this line"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "line 4: 'f 1 2 9': there is no vertex 9"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "there is no vertex -4"),
        ("v 0 0 nan\n", "line 1: 'v 0 0 nan': the numbers must be finite"),
        ("v 0 0\n", "three numbers are wanted"),
        ("v 0 0 zero\n", "'zero' is no number; export the mesh again"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangle with an area"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "a face has three corners or more"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 0\nf 1//1 2//1 3//1\n", "normal 1 has no direction"),
    ],
)
def test_damaged_obj_files_are_told_by_their_line(tmp_path: Path, text: str, said: str) -> None:
    path = _write(tmp_path, text)
    with pytest.raises(ValueError, match=r"m\.obj: ") as caught:
        read_mesh(path)
    assert said in str(caught.value)


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb"])
def test_no_damage_ends_in_a_traceback(tmp_path: Path, kind: str) -> None:
    """Bytes changed, cut out and cut off, and files of another kind: a mesh, or a ValueError, within seconds."""
    body = trimesh.creation.box()
    data = body.export(file_type=kind)
    data = data.encode() if isinstance(data, str) else bytes(data)
    draw = random(3, 17)
    refused = 0
    for index in range(150):
        changed = bytearray(data)
        for _ in range(int(draw.integers(1, 4))):
            at = int(draw.integers(len(changed)))
            match int(draw.integers(3)):
                case 0:
                    changed[at] = int(draw.integers(256))
                case 1:
                    del changed[at : at + int(draw.integers(1, 40))]
                case 2:
                    changed[at:at] = bytes(draw.integers(256, size=5, dtype=np.uint8))
        path = _write(tmp_path, bytes(changed), f"{index}.{kind}")
        started = time.monotonic()
        try:
            read_mesh(path)
        except ValueError as error:
            told = str(error)
            refused += told.startswith(f"{path}: ")
        else:
            told = str(path)
        assert str(path) in told
        assert time.monotonic() - started < 5.0
    assert refused > 20


def _scene(folder: Path, mesh: dict[str, object], material: dict[str, object] | None = None) -> Scene:
    document = {
        "format": 1,
        "observe": ["r1"],
        "robots": {"r1": {"rig": "infra_swarm"}},
        "materials": {
            "wood": {"type": "diffuse", "reflectance": 0.6},
            "glass": {"type": "dielectric", "index": 1.5},
        },
        "shapes": {"crate": {"type": "mesh", "material": "black", **mesh}},
    }
    return parse_scene(document, folder)


def test_slots_take_materials_and_the_rest_the_mesh_s_own(tmp_path: Path) -> None:
    text = BOX + "f 1 2 4 3\nusemtl Deck\nf 5 7 8 6\nusemtl Block.1\nf 1 5 6 2\n"
    _write(tmp_path, text)
    scene = _scene(tmp_path, {"file": "m.obj", "materials": {"Deck": "wood"}})
    shapes = scene.at(0.0).shapes
    assert {name: shape.material for name, shape in shapes.items()} == {
        "crate": "black",
        "crate.Deck": "wood",
        "crate.Block.1": "black",
    }
    with pytest.raises(InputError, match=r"has no slot 'Dek'; known: 'Deck', 'Block\.1'"):
        _scene(tmp_path, {"file": "m.obj", "materials": {"Dek": "wood"}})
    with pytest.raises(InputError, match="there is no material 'plywod'"):
        _scene(tmp_path, {"file": "m.obj", "materials": {"Deck": "plywod"}})


def test_what_is_wrong_with_a_mesh_is_told_when_the_scene_is_loaded(tmp_path: Path) -> None:
    _write(tmp_path, CLOSED)
    _write(tmp_path, "v 0 0 0\n", "empty.obj")
    _write(tmp_path, CLOSED.rsplit("f ", 1)[0], "open.obj")
    _write(tmp_path, io.BytesIO(b"solid nothing").getvalue(), "no.stl")
    assert _scene(tmp_path, {"file": "m.obj", "material": "glass"})
    refused: tuple[tuple[dict[str, object], str], ...] = (
        ({"file": "empty.obj"}, "holds no triangles"),
        ({"file": "no.stl"}, "stl"),
        ({"file": "m.obj", "scale": 5000.0}, "write 'scale: 0.001' for one in millimetres"),
        ({"file": "open.obj", "material": "glass"}, "has no inside: it is not closed"),
        ({"file": "m.dae"}, r"none of \.ply, \.obj, \.stl, \.glb, \.gltf"),
    )
    for mesh, said in refused:
        with pytest.raises(InputError, match=said):
            _scene(tmp_path, mesh)


def test_names_of_slots_are_any_text_and_comments_are_passed_over(tmp_path: Path) -> None:
    text = "\ufeffv 0 0 0 # für\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl Wood#1\nf 1 2 3\nusemtl Wood#2\nf 1 2 4\n"
    assert [part.slot for part in read_mesh(_write(tmp_path, text))] == ["Wood#1", "Wood#2"]
    latin = _write(tmp_path, text.lstrip("\ufeff").encode("latin-1"), "latin.obj")
    assert len(read_mesh(latin)) == 2


def test_a_file_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        read_mesh(tmp_path / "gone.obj")


def test_one_slot_alone_takes_its_own_of_the_materials(tmp_path: Path) -> None:
    _write(tmp_path, BOX + "usemtl Deck\nf 5 7 8 6\nusemtl Block\nf 1 5 6 2\n")
    scene = _scene(tmp_path, {"file": "m.obj", "slot": "Deck", "materials": {"Deck": "wood"}})
    assert {name: shape.material for name, shape in scene.at(0.0).shapes.items()} == {"crate": "wood"}
