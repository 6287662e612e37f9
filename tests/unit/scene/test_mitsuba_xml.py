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
        ("<scene>\n<include filename='m.xml'/></scene>", "included 16 deep; does one include itself?"),
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
