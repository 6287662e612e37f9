"""Mitsuba scenes as meshes: where shapes stand, held against Mitsuba's own reader; slots; what is refused."""

import math
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from nir_render import InputError, load_scene
from nir_render.scene.meshes.read import files_of_mesh, read_mesh
from nir_render.scene.scene import Scene

SHAPES = """
<scene version="3.0.0">
  <default name="tall" value="1.5"/>
  <bsdf type="twosided" id="paint"><bsdf type="diffuse"/></bsdf>
  <shape type="cube">
    <transform name="to_world">
      <scale x="0.5" y="0.25" z="$tall"/><rotate z="1" angle="30"/><rotate x="0.6" y="0.8" angle="-20"/>
      <translate x="2" y="-1" z="0.5"/>
    </transform>
    <ref id="paint"/>
  </shape>
  <shape type="rectangle"><transform name="to_world"><lookat origin="-2, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform></shape>
  <shape type="disk"><transform name="to_world"><scale value="0.7"/><matrix value="0 0 1 -1  1 0 0 -2  0 1 0 0.3  0 0 0 1"/></transform></shape>
  <shape type="sphere"><point name="center" x="0" y="2.5" z="0"/><float name="radius" value="0.8"/></shape>
  <shape type="cylinder"><point name="p0" x="1" y="1" z="-1"/><point name="p1" x="2" y="2" z="1"/><float name="radius" value="0.4"/></shape>
  <shape type="shapegroup" id="stack">
    <shape type="obj"><string name="filename" value="block.obj"/><boolean name="face_normals" value="true"/><transform name="to_world"><translate z="-1"/></transform></shape>
  </shape>
  <shape type="instance"><ref id="stack"/><transform name="to_world"><rotate y="1" angle="40"/><translate x="-1" y="-3"/></transform></shape>
  <include filename="parts/more.xml"/>
  <sensor type="perspective"/>
  <emitter type="constant"/>
</scene>
"""  # fmt: skip
MORE = """
<scene version="3.0.0">
  <shape type="ply"><string name="filename" value="parts/block.ply"/><boolean name="face_normals" value="true"/>
    <transform name="to_world"><scale x="-1" y="2" z="0.5"/><translate x="3" y="3" z="0"/></transform>
    <bsdf type="diffuse" id="steel"/></shape>
</scene>
"""
SCENE = """
format: 1
name: xml
materials: {paint: {type: diffuse, reflectance: 0.6}, steel: {type: diffuse, reflectance: 0.3}, rest: {type: diffuse, reflectance: 0.1}}
shapes: {all: {type: mesh, file: FILE, material: rest, materials: {paint: paint, steel: steel}}}
observe: [r1.front]
robots: {r1: {rig: infra_swarm, position: "[-9, 0, 0] m"}}
"""


def _write(folder: Path) -> Path:
    (folder / "parts").mkdir()
    body = trimesh.creation.box((0.6, 0.9, 1.2))
    (folder / "block.obj").write_text(body.export(file_type="obj"))
    (folder / "parts" / "block.ply").write_bytes(body.export(file_type="ply"))
    (folder / "parts" / "more.xml").write_text(MORE)
    file = folder / "scene.xml"
    file.write_text(SHAPES)
    return file


def _scene(folder: Path, file: Path) -> Scene:
    (folder / "s.yaml").write_text(SCENE.replace("FILE", file.name))
    return load_scene(folder / "s.yaml")


@pytest.mark.mitsuba
def test_shapes_stand_where_mitsuba_has_them(tmp_path: Path) -> None:
    """4000 rays towards the middle: the same distances, but for 0.5 % of the radii of what is round."""
    from nir_render.transport.backend.variant import dr, mi
    from nir_render.transport.world import mitsuba_scene

    file = _write(tmp_path)
    ours = mitsuba_scene.build(_scene(tmp_path, file).at(0.0))
    theirs = mi.load_file(str(file))
    rng = np.random.default_rng(1)
    origin = rng.normal(size=(4000, 3))
    origin *= 8.0 / np.linalg.norm(origin, axis=1, keepdims=True)
    towards = rng.uniform(-3.0, 3.0, (4000, 3)) - origin
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(towards.T.astype(np.float32)))
    found = [scene.ray_intersect(ray) for scene in (ours, theirs)]
    hits = [np.array(one.is_valid()) for one in found]
    assert (hits[0] != hits[1]).mean() < 0.003  # at the outlines of what is round
    both = hits[0] & hits[1]
    assert both.mean() > 0.2
    off = np.abs(np.array(found[0].t)[both] - np.array(found[1].t)[both])
    assert np.quantile(off, 0.5) < 1e-5
    assert np.quantile(off, 0.99) < 0.01
    cosine = np.abs(np.array(dr.dot(found[0].sh_frame.n, found[1].sh_frame.n)))[both]
    assert np.quantile(cosine, 0.01) > math.cos(math.radians(3.0))


def test_slots_are_what_reflects_and_files_are_all_that_is_read(tmp_path: Path) -> None:
    file = _write(tmp_path)
    parts = {part.slot: part for part in read_mesh(file)}
    assert set(parts) == {"paint", "", "steel"}
    assert len(parts["paint"].faces) == 12
    # Mirrored, it still looks outwards; and is the box of its own times 2 and a half.
    a, b, c = (parts["steel"].vertices[parts["steel"].faces[:, corner]] for corner in range(3))
    assert float((a * np.cross(b, c)).sum()) / 6.0 == pytest.approx(0.6 * 0.9 * 1.2)
    assert {one.name for one in files_of_mesh(file)} >= {"scene.xml", "more.xml", "block.ply"}
    assert np.ptp(read_mesh(file, "y")[0].vertices[:, 2]) == pytest.approx(
        np.ptp(parts["paint"].vertices[:, 1])
    )


def test_areas_of_what_is_round_are_right(tmp_path: Path) -> None:
    for shape, area in (
        ("sphere", 4.0 * math.pi),
        ("disk", math.pi),
        ("cylinder", 2.0 * math.pi),
        ("cube", 24.0),
        ("rectangle", 4.0),
    ):
        file = tmp_path / f"{shape}.xml"
        file.write_text(f"<scene version='3.0.0'><shape type='{shape}'/></scene>")
        (part,) = read_mesh(file)
        a, b, c = (part.vertices[part.faces[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(area, rel=1e-6), shape
        if part.normals is not None:
            assert ((part.normals[part.faces[:, 0]] * normal).sum(axis=1) > 0.0).all(), shape


def test_what_a_scene_names_counts_for_its_light(tmp_path: Path) -> None:
    """A body that changes in a file beside the scene is another geometry, and is read anew."""
    file = _write(tmp_path)
    before = _scene(tmp_path, file)
    before_m = np.ptp(read_mesh(file)[2].vertices, axis=0)
    other = trimesh.creation.box((0.6, 0.9, 2.4))
    time.sleep(0.01)
    (tmp_path / "parts" / "block.ply").write_bytes(other.export(file_type="ply"))
    after_m = np.ptp(read_mesh(file)[2].vertices, axis=0)
    assert after_m / before_m == pytest.approx([1.0, 1.0, 2.0])
    pytest.importorskip("mitsuba")
    from nir_render.transport.cache_key import _shape

    assert before.document.shapes["all"].type == "mesh"
    told = _shape(before.document.shapes["all"]).text
    (tmp_path / "parts" / "block.ply").write_bytes(
        trimesh.creation.box((0.6, 0.9, 1.0)).export(file_type="ply")
    )
    assert _shape(before.document.shapes["all"]).text != told


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<scene>\n<shape type='hair'/></scene>", "line 2: a shape of the type 'hair' is not read"),
        ("<scene>\n<shape type='obj'/></scene>", "line 2: the shape names no file"),
        ("<scene>\n\n<shape type='obj'><string name='filename' value='no.obj'/></shape></scene>", "line 3: there is no file 'no.obj'"),
        ("<scene>\n<shape type='cube'><transform name='to_world'><scale value='$k'/></transform></shape></scene>", "line 2: $k has no value"),
        ("<scene><shape type='cube'>\n<transform name='to_world'><scale x='0'/></transform></shape></scene>", "line 2: the transform flattens"),
        ("<scene><shape type='cube'>\n<transform name='to_world'><turn x='0'/></transform></shape></scene>", "line 2: <turn> is no step"),
        ("<scene><shape type='cube'>\n<transform name='to_world'><matrix value='1 2 3'/></transform></shape></scene>", "a matrix has 16 numbers, or 9; this one 3"),
        ("<scene><shape type='cube'>\n<transform name='to_world'><rotate angle='x'/></transform></shape></scene>", "line 2: "),
        ("<scene><shape type='sphere'>\n<float name='radius' value='-1'/></shape></scene>", "line 2: the radius is -1"),
        ("<scene><shape type='instance'/></scene>", "an instance names no"),
        ("<scene>\n<include filename='m.xml'/></scene>", "m.xml includes itself"),
        ("<scene><shape", "line 1: this is no XML"),
        ("", "this is no XML"),
        ("<mesh/>", "line 1: this is <mesh>, not the <scene>"),
        ("<scene/>", "holds no triangles"),
        ("<!DOCTYPE s [<!ENTITY a 'b'>]>\n<scene/>", "line 1: declares an entity"),
        ("<scene>" + "<a>" * 40 + "</a>" * 40 + "</scene>", "elements lie 32 deep"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_told_by_its_line(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "m.xml"
    file.write_text(text)
    with pytest.raises(InputError) as told:
        _scene(tmp_path, file)
    assert said in str(told.value)
    assert "m.xml" in str(told.value)


def _slots(folder: Path, text: str) -> dict[str, int]:
    """Write a scene of some shapes; return how many triangles each slot has."""
    file = folder / "some.xml"
    file.write_text(f"<scene version='3.0.0'>{text}</scene>")
    return {part.slot: len(part.faces) for part in read_mesh(file)}


LAMP = "<shape type='rectangle'><emitter type='area'/>{}</shape>"
CUBE = "<shape type='cube'>{}</shape>"


@pytest.mark.parametrize(
    ("text", "slots"),
    [
        # A lamp and a cloud's hull are nothing to reflect on; a body that shines is.
        (LAMP.format("") + LAMP.format("<bsdf type='null'/>") + CUBE.format(""), {"": 12}),
        ("<bsdf type='null' id='air'/>" + CUBE.format("<ref id='air'/>") + CUBE.format(""), {"": 12}),
        (LAMP.format("<bsdf type='diffuse' id='glow'/>"), {"glow": 2}),
        # What reflects is what has the id, not what else is referred to; before or after the shape.
        (CUBE.format("<ref id='em'/><ref id='m'/>") + "<bsdf type='diffuse' id='m'/><emitter type='point' id='em'/>", {"m": 12}),
        ("<bsdf type='diffuse' id='m'/><alias id='m' as='n'/>" + CUBE.format("<ref id='n'/>"), {"m": 12}),
        (CUBE.format("<bsdf type='twosided'><bsdf type='diffuse' id='in'/></bsdf>"), {"in": 12}),
        (CUBE.format("<bsdf type='blendbsdf'><bsdf type='a' id='x'/><bsdf type='b' id='y'/></bsdf>"), {"": 12}),
        # A group may stand after who stands for it, and be stood for twice.
        ("<shape type='instance'><ref id='g'/></shape>" * 2 + "<shape type='shapegroup' id='g'><shape type='rectangle'/></shape>", {"": 4}),
        # What a shape includes is its own; and a part may be the file.
        (CUBE.format("<include filename='prop.xml'/>") + "<include filename='one.xml'/>", {"z": 12, "": 2}),
    ],
)  # fmt: skip
def test_what_shows_and_what_it_is_of(tmp_path: Path, text: str, slots: dict[str, int]) -> None:
    (tmp_path / "prop.xml").write_text("<scene version='3.0.0'><bsdf type='diffuse' id='z'/></scene>")
    (tmp_path / "one.xml").write_text("<shape type='rectangle'/>")
    assert _slots(tmp_path, text) == slots


def test_the_last_path_is_looked_in_first(tmp_path: Path) -> None:
    for folder, size in ((".", 1.0), ("a", 2.0), ("b", 3.0)):
        (tmp_path / folder).mkdir(exist_ok=True)
        body = trimesh.creation.box((size, size, size))
        (tmp_path / folder / "m.ply").write_bytes(body.export(file_type="ply"))
    file = tmp_path / "some.xml"
    mesh = "<shape type='ply'><string name='filename' value='m.ply'/></shape>"
    for paths, size in (("", 1.0), ("<path value='a'/>", 2.0), ("<path value='a'/><path value='b'/>", 3.0)):
        file.write_text(f"<scene version='3.0.0'>{paths}{mesh}</scene>")
        assert np.ptp(read_mesh(file)[0].vertices[:, 0]) == pytest.approx(size)
    # What is included from there leaves it where it is.
    (tmp_path / "a" / "nothing.xml").write_text("<scene version='3.0.0'/>")
    file.write_text(
        f"<scene version='3.0.0'><path value='a'/><include filename='nothing.xml'/>{mesh}</scene>"
    )
    assert np.ptp(read_mesh(file)[0].vertices[:, 0]) == pytest.approx(2.0)


def test_pictures_lie_as_mitsuba_lays_them(tmp_path: Path) -> None:
    """There v is down a picture: that of OBJ is turned as it is read, that of PLY is as it stands."""
    obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 0.75\nf 1/1 2/2 3/3\n"
    (tmp_path / "t.obj").write_text(obj)
    ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty float s\n"
    ply += "property float t\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "t.ply").write_text(ply + "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 0.75\n3 0 1 2\n")
    for kind, flip, v in (
        ("obj", "", 0.75),
        ("obj", "false", 0.25),
        ("ply", "", 0.25),
        ("ply", "true", 0.75),
    ):
        turned = f"<boolean name='flip_tex_coords' value='{flip}'/>" if flip else ""
        file = tmp_path / "some.xml"
        file.write_text(
            f"<scene version='3.0.0'><shape type='{kind}'><string name='filename' value='t.{kind}'/>{turned}</shape></scene>"
        )
        (part,) = read_mesh(file)
        assert part.uvs is not None
        highest = part.uvs[np.argmax(part.vertices[:, 0] + part.vertices[:, 1])]
        assert highest == pytest.approx([1.0, v]), (kind, flip)


def test_round_shapes_stay_round_beside_flat_ones(tmp_path: Path) -> None:
    """Of another slot, too: what is flat has a normal for each triangle."""
    file = tmp_path / "some.xml"
    file.write_text(
        "<scene version='3.0.0'><shape type='sphere'><bsdf type='diffuse' id='a'/></shape><shape type='cube'/></scene>"
    )
    parts = {part.slot: part for part in read_mesh(file)}
    flat, round_ = parts[""], parts["a"]
    assert flat.normals is not None
    assert round_.normals is not None
    assert np.abs(flat.normals).max(axis=1) == pytest.approx(1.0)
    assert len(np.unique(round_.normals, axis=0)) > 1000


def test_what_is_wrong_with_a_named_file_names_it(tmp_path: Path) -> None:
    (tmp_path / "bad.obj").write_text("v 0 0 0\nf 1 2 9\n")
    text = "<scene>\n\n<shape type='obj'><string name='filename' value='bad.obj'/></shape></scene>"
    (tmp_path / "m.xml").write_text(text)
    with pytest.raises(InputError, match=r"line 3: .*bad\.obj: line 2"):
        _scene(tmp_path, tmp_path / "m.xml")
    for text in (
        "<?xml version='1.0' encoding='foo'?><scene/>",
        f"<scene><shape type='ply'><string name='filename' value='{'x' * 300}'/></shape></scene>",
    ):
        (tmp_path / "m.xml").write_text(text)
        with pytest.raises(InputError, match="line 1"):
            _scene(tmp_path, tmp_path / "m.xml")
