"""Materials by name: evidence, deviation, retroreflectors and pictures; what is wrong with them is told."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from nir_render import InputError, Scene, load_scene, parse_scene
from nir_render.regress.reference import changes_of, document_of
from nir_render.run.manifest import material_facts
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.files import preset_names
from nir_render.scene.documents.materials import Dielectric, Diffuse, Retroreflector, realised, texture_of
from nir_render.scene.meshes.read import read_mesh
from nir_render.stress.campaign import load_campaign
from nir_render.transport.cache_key import Site, geometry_key
from tests.paths import SCENES

WALL = {
    "type": "rectangle",
    "center": "[3, 0, 0] m",
    "size": "[1, 1] m",
    "normal": [-1, 0, 0],
    "material": "m",
}
TAPE = {
    "type": "retroreflector", "observation": "[0.2, 1] deg", "entrance": "[5, 40] deg",
    "coefficients": [[330, 65], [25, 10]],
}  # fmt: skip


def _scene(material: Any, folder: Path = Path(), **changes: Any) -> Scene:
    base = {
        "format": 1,
        "observe": ["r1.front"],
        "robots": {"r1": {"rig": "infra_swarm"}},
        "materials": {"m": material},
        "shapes": {"wall": WALL},
    }
    return parse_scene({**base, **changes}, folder)


def _picture(path: Path, values: Any, kind: type[np.unsignedinteger[Any]] = np.uint8) -> Path:
    assert cv2.imwrite(str(path), np.asarray(values, dtype=kind))
    return path


@pytest.mark.parametrize("name", [name for name in preset_names("materials") if name != "black"])
def test_every_material_of_the_library_tells_how_it_is_known(name: str) -> None:
    material = _scene(name, shapes={}).document.materials["m"]
    evidence = material.evidence
    assert evidence is not None
    assert len(evidence.source) > 40
    assert evidence.uncertainty > 0.0
    assert evidence.basis == "assumed" or any(word in evidence.source for word in ("doi:", "Acta Phys"))
    if isinstance(material, Diffuse):
        assert evidence.least is not None
        assert evidence.most is not None
        value = material.reflectance
        at_940 = value if isinstance(value, float) else float(value.curve("r")(940e-9))  # type: ignore[union-attr]
        assert evidence.least < at_940 < evidence.most
        # Two standard deviations lie about within the range, and the range is not much wider.
        assert evidence.most - evidence.least > 1.2 * evidence.uncertainty * at_940
    elif not isinstance(material, Dielectric):
        assert material.deviates


def test_materials_stand_on_presets_as_other_parts_do() -> None:
    concrete = _scene("concrete").document.materials["m"]
    assert _scene({"preset": "concrete"}).document.materials["m"] == concrete
    changed = _scene({"preset": "concrete", "deviation": 1.5}).document.materials["m"]
    assert changed == concrete.model_copy(update={"deviation": 1.5})
    wall = {**WALL, "material": "concrete"}
    own = _scene("black", materials={"concrete": {"deviation": 1.5}}, shapes={"wall": wall})
    assert own.document.materials["concrete"] == changed
    later = _scene("black", materials={}, shapes={"wall": wall}).with_({"materials.concrete.deviation": 1.5})
    assert later.document.materials["concrete"] == changed
    assert parse_scene(yaml.safe_load(own.resolved_yaml())).document == own.document


def test_a_campaign_draws_surfaces_by_their_uncertainty() -> None:
    """Six surfaces of each of eight walls: another factor for each, the same for all walls in σ."""
    campaign = load_campaign(SCENES / "campaigns" / "materials.yaml")
    surface = next(axis for axis in campaign.axes if axis.name == "surface")
    assert surface.units is not None
    drawn = [unit["materials.wall.deviation"] for unit in surface.units]
    assert len(set(drawn)) == 6
    assert max(map(abs, drawn)) <= 2.0


@pytest.mark.parametrize(
    ("material", "told"),
    [
        ("concret", "materials.m: there is no preset 'concret' in materials; did you mean 'concrete'?"),
        ({"preset": "concrete", "deviation": 9}, "materials.m.deviation: input should be less than or equal to 5"),
        ({"type": "diffuse", "reflectance": 0.5, "deviation": 1}, "1 standard deviations of what? write 'evidence'"),
        ({"preset": "water", "deviation": 1}, "no figure of such a material varies; leave it out"),
        ({**TAPE, "coefficients": [[330, 65], [340, 10]]}, "each row below the one before"),
        ({**TAPE, "coefficients": [[330, 65]]}, "wanted 2 rows of 2 values"),
        ({**TAPE, "coefficients": [[330, 65], [25, -1]]}, "wanted numbers above 0"),
        ({**TAPE, "coefficients": [["a", 65], [25, 1]]}, "wanted numbers in each row, such as [330, 180]"),
        ({**TAPE, "coefficients": 330}, "wanted a list of rows of numbers, such as [[330, 180], [25, 12]]"),
        ({**TAPE, "coefficients": [[9e4, 65], [9e3, 10]]}, "of the light would go back and 0 % off the ground"),
        ({**TAPE, "reflectance": 0.95}, "more than falls in; lower them"),
        ({**TAPE, "entrance": "[0.5, 40] deg"}, "wanted angles of at least 1 deg, the largest of 'observation'"),
        ({**TAPE, "entrance": "[40, 5] deg"}, "wanted increasing angles"),
        ({**TAPE, "entrance": "[5, 89] deg"}, "wanted angles from 0 to 85 deg"),
        ({**TAPE, "observation": "[0.2, 30] deg"}, "wanted angles from 0 to 10 deg"),
        ({"type": "tape"}, "did you mean 'retroreflector'?"),
        ({"type": "mirror", "reflectance": {"texture": "a.png", "of": [0, 1]}}, "diffuse or plastic alone"),
        ({"type": "diffuse", "reflectance": {"texture": "a.jpg", "of": [0, 1]}}, "'a.jpg' is no .png"),
        ({"type": "diffuse", "reflectance": {"texture": "no.png", "of": [0, 1]}}, "there is no file 'no.png'"),
        ({"type": "diffuse", "reflectance": {"texture": "a.png"}}, "materials.m.reflectance.of: this key is missing"),
        ({"type": "diffuse", "reflectance": {"texture": "a.png", "of": [0, 1.5]}}, "less than or equal to 1"),
        ({"type": "diffuse", "reflectance": {"texture": "a.png", "of": 1}}, "materials.m.reflectance.of"),
        ({"preset": "concrete", "evidence": {"basis": "guessed"}}, "materials.m.evidence.basis"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_material_is_told(material: Any, told: str, tmp_path: Path) -> None:
    _picture(tmp_path / "a.png", [[0, 255]])
    with pytest.raises(InputError, match=r".") as error:
        _scene(material, tmp_path)
    assert told in str(error.value)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _flipped(data: bytes) -> bytes:
    at = data.index(b"IDAT") + 6
    return data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]


def _starved(data: bytes) -> bytes:
    """All checksums right, too few pixels: OpenCV would fill them up without a word."""
    head = data[: data.index(b"IDAT") - 4]
    return head + _chunk(b"IDAT", zlib.compress(b"\0" * 5)) + _chunk(b"IEND", b"")


def _huge(data: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", 2**30, 2**30, 8, 0, 0, 0, 0)
    return data[:8] + _chunk(b"IHDR", header) + data[33:]


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (_cut, "ends in the middle; export it again, as grey PNG"),
        (_flipped, "is damaged: the checksum is another"),
        (_starved, "holds 5 of the 272 bytes of its pixels"),
        (_huge, "pixels; wanted at least one and at most"),
        (lambda data: b"", "this is no PNG file"),
        (lambda data: b"v 0 0 0\n" * 9, "this is no PNG file"),
    ],
)
def test_damaged_pictures_are_refused(damage: Callable[[bytes], bytes], told: str, tmp_path: Path) -> None:
    draw = np.random.default_rng(1)
    path = _picture(tmp_path / "a.png", draw.integers(0, 256, (16, 16)))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError) as error:
        _scene({"type": "diffuse", "reflectance": {"texture": "a.png", "of": [0, 1]}}, tmp_path)
    assert told in str(error.value)
    assert "materials.m.reflectance" in str(error.value)
    assert "a.png" in str(error.value)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (np.zeros((4, 4, 3)), "holds RGB colours, which mean nothing at 940 nm"),
        (np.zeros((4, 4, 4)), "holds RGB colours and transparency, which mean nothing at 940 nm"),
    ],
)
def test_colours_are_refused(values: Any, told: str, tmp_path: Path) -> None:
    _picture(tmp_path / "a.png", values)
    with pytest.raises(InputError) as error:
        _scene({"type": "diffuse", "reflectance": {"texture": "a.png", "of": [0, 1]}}, tmp_path)
    assert told in str(error.value)


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_a_picture_maps_black_and_white_to_what_is_said(kind: Any, white: int, tmp_path: Path) -> None:
    """0, ⅕ and all of white from 0.1 to 0.6: 0.1, 0.2, 0.6, of 8 and of 16 bit."""
    _picture(tmp_path / "a.png", [[0, white // 5, white]], kind)
    scene = _scene({"type": "diffuse", "reflectance": {"texture": "a.png", "of": [0.1, "60 %"]}}, tmp_path)
    texture = texture_of(scene.document.materials["m"])
    assert texture is not None
    np.testing.assert_allclose(texture.reflectance(), [[0.1, 0.2, 0.6]], rtol=1e-12)


def test_pictures_lie_on_rectangles_and_meshes_with_uvs(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png", [[0, 255]])
    laid = {"type": "diffuse", "reflectance": {"texture": "a.png", "of": [0, 1]}}
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    (tmp_path / "bare.obj").write_text(square + "f 1 2 3 4\n")
    (tmp_path / "laid.obj").write_text(square + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n")
    mesh = {"type": "mesh", "file": "laid.obj", "position": "[3, 0, 0] m", "material": "m"}
    _scene(laid, tmp_path, shapes={"square": mesh})
    ball = {"type": "sphere", "center": "[3, 0, 0] m", "radius": "0.1 m", "material": "m"}
    for shape, told in (
        ({**mesh, "file": "bare.obj"}, "bare.obj has no uv coordinates: unwrap it"),
        (ball, "not a sphere: unwrap it, or take another material"),
    ):
        with pytest.raises(InputError) as error:
            _scene(laid, tmp_path, shapes={"square": shape})
        assert told in str(error.value)


def test_uvs_are_read_from_obj_and_gltf(tmp_path: Path) -> None:
    """A quad whose uvs are its x and y; a corner without one leaves all without."""
    import trimesh

    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(square + "f 1/1 2/2 3/3 4/4\n")
    (tmp_path / "b.obj").write_text(square + "f 1/1 2/2 3/3 4\n")
    visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    quad = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    (tmp_path / "c.glb").write_bytes(quad.export(file_type="glb"))
    for name in ("a.obj", "c.glb"):
        (part,) = read_mesh(tmp_path / name, "z")
        assert part.uvs is not None
        np.testing.assert_allclose(part.uvs, part.vertices[:, :2], atol=1e-7)
    assert read_mesh(tmp_path / "b.obj")[0].uvs is None
    (tmp_path / "d.obj").write_text(square + "f 1/9 2/2 3/3\n")
    with pytest.raises(ValueError, match=r"line 9: .*there is no uv 9: 4 uvs stand above this line"):
        read_mesh(tmp_path / "d.obj")


def test_what_a_picture_holds_is_in_the_key_and_the_reference(tmp_path: Path) -> None:
    """Another pixel is another geometry, and a change that the regression check tells; a new name is not."""
    told = {"type": "diffuse", "reflectance": {"texture": "a.png", "of": [0, 1]}}

    def key(scene: Scene) -> str:
        return geometry_key(Site(scene.at(0.0), "r1.front"))

    _picture(tmp_path / "a.png", [[0, 255]])
    before = _scene(told, tmp_path)
    first, document = key(before), document_of(before)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes())
    renamed = _scene({**told, "reflectance": {"texture": "b.png", "of": [0, 1]}}, tmp_path)
    assert key(renamed) == first
    assert key(_scene({**told, "reflectance": {"texture": "a.png", "of": [0, 0.9]}}, tmp_path)) != first
    _picture(tmp_path / "a.png", [[0, 254, 9]])
    after = _scene(told, tmp_path)
    assert key(after) != first
    changed = changes_of(document, document_of(after))
    assert len(changed) == 1
    assert "materials.m.reflectance.sha256" in changed[0]
    assert document["materials"]["m"]["reflectance"]["texture"] == "a.png"


@pytest.mark.parametrize(
    "name", [name for name in preset_names("materials") if name not in ("black", "water")]
)
def test_deviations_are_sigmas_far_from_a_bound_and_never_reach_it(name: str) -> None:
    material = _scene(name).document.materials["m"]
    assert material.evidence is not None
    retro = isinstance(material, Retroreflector)

    def share(deviation: float) -> float:
        changed = realised(material.model_copy(update={"deviation": deviation}))
        if isinstance(changed, Retroreflector):
            return changed.coefficients[0][0]
        value = getattr(changed, changed.deviates)
        if isinstance(value, CurveDocument):
            value = value.curve("it")(940e-9)
        return float(1.0 if value is None else value)

    plain, evidence = share(0.0), material.evidence
    shares = [share(step) for step in (-5.0, -2.0, -0.001, 0.0, 0.001, 2.0, 5.0)]
    assert shares == sorted(shares)
    assert all(np.isfinite(shares))
    slope = (share(-0.001) - plain) / (-0.001 * plain)
    assert slope == pytest.approx(evidence.uncertainty, rel=2e-3)
    if retro:
        assert shares[0] > 0.0
        return
    low = 0.0 if evidence.least is None else evidence.least
    high = 1.0 if evidence.most is None else max(evidence.most, plain)
    assert low <= shares[0] < plain <= shares[-1] <= high * (1.0 + 1e-12)


def test_evidence_is_no_part_of_the_key_and_a_deviation_is() -> None:
    """Random numbers of a scene follow from its key: what is only said of a material leaves them alone."""
    keys = {
        name: geometry_key(Site(_scene(material).at(0.0), "r1.front"))
        for name, material in {
            "bare": {"type": "diffuse", "reflectance": 0.8},
            "known": {"preset": "white_paint"},
            "off": {"preset": "white_paint", "deviation": 1},
        }.items()
    }
    assert keys["bare"] == keys["known"] != keys["off"]


def test_the_manifest_tells_slots_and_how_materials_are_known(tmp_path: Path) -> None:
    scene = load_scene(SCENES / "greenhouse.yaml")
    facts = material_facts(scene)
    assert facts["slots"]["shapes.plant_l1"] == {"stem": "stem", "leaf": "leaf"}
    assert facts["known"]["stem"]["deviation"] == -1.0
    assert facts["known"]["leaf"]["basis"] == "measured"
    assert facts["known"]["bed"]["basis"] is None
    pallets = material_facts(load_scene(SCENES / "warehouse.yaml"))["slots"]["shapes.pallet1"]
    assert set(pallets.values()) == {"board", "block"}
