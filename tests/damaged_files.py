"""Files that scenes name, as broken tools leave them: meshes, curves, pictures, patterns, cut, mixed and mangled."""

import random
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

NUMBERS = (b"0", b"-1", b"1e300", b"nan", b"inf", b"-inf", b"1e999", b"7", b"-7", b"9" * 400, b"x", b"", b"1/2", b"0x10",
           b"4294967295", b"4294967296", b"2147483648", b"1e-300", b"/", b"1//1", b"\xff\xfe", b"1,2,3")  # fmt: skip

_XML = """<scene version="3.0.0"><default name="wide" value="0.3"/><bsdf type="diffuse" id="paint"/>
<shape type="cube"><transform name="to_world"><scale value="$wide"/><rotate z="1" angle="30"/>
<translate x="0.1" y="2"/></transform><ref id="paint"/></shape>
<shape type="sphere"><point name="center" x="1" y="0" z="0.5"/><float name="radius" value="0.2"/></shape>
<shape type="shapegroup" id="g"><shape type="disk"/></shape><shape type="instance"><ref id="g"/>
<transform name="to_world"><lookat origin="0, 0, 1" target="1, 0, 0" up="0, 0, 1"/></transform></shape></scene>
"""


def good_files() -> Mapping[str, bytes]:
    """Return what is whole, by name."""
    import trimesh

    uv = [[0, 0], [1, 0], [1, 1], [0, 1]] * 2
    box = trimesh.creation.box((0.4, 0.4, 0.4))
    box.visual = trimesh.visual.TextureVisuals(uv=uv)
    draw = np.random.default_rng(5)
    grey8 = draw.integers(0, 256, (24, 32)).astype(np.uint8)
    grey16 = draw.integers(0, 65536, (8, 8)).astype(np.uint16)
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in np.asarray(box.vertices))
    obj += "".join(f"vt {u} {v}\n" for u, v in uv) + "vn 0 0 1\nusemtl side\n"
    obj += "".join(f"f {a + 1}/{a + 1} {b + 1}/{b + 1} {c + 1}/{c + 1}\n" for a, b, c in box.faces)
    curve = "# a comment\nwavelength_nm,value\n" + "".join(
        f"{nm},{0.3 + 1e-4 * nm:.4f}\n" for nm in range(300, 1101, 50)
    )
    pattern = "polar_deg,azimuth_deg,value\n" + "".join(
        f"{polar},{azimuth},{max(1 - polar / 90, 0):.3f}\n"
        for polar in range(0, 181, 30)
        for azimuth in (0, 120, 240)
    )
    return {
        "mesh.obj": obj.encode(),
        "mesh.ply": box.export(file_type="ply"),
        "text.ply": trimesh.exchange.ply.export_ply(box, encoding="ascii"),
        "mesh.stl": box.export(file_type="stl"),
        "text.stl": str(trimesh.exchange.stl.export_stl_ascii(box)).encode(),
        "mesh.glb": box.export(file_type="glb"),
        "scene.xml": _XML.encode(),
        "grey8.png": cv2.imencode(".png", grey8)[1].tobytes(),
        "grey16.png": cv2.imencode(".png", grey16)[1].tobytes(),
        "curve.csv": curve.encode(),
        "pattern.csv": pattern.encode(),
    }


def document_of(name: str) -> dict[str, Any]:
    """Return a scene that names a file."""
    document: dict[str, Any] = {
        "format": 1,
        "observe": ["r1.front"],
        "robots": {"r1": {"rig": "infra_swarm"}, "r2": {"rig": "infra_swarm", "position": "[3, 0, 0] m"}},
    }
    wall = {
        "type": "rectangle",
        "center": "[5, 0, 0] m",
        "size": "[1, 1] m",
        "normal": [-1, 0, 0],
        "material": "m",
    }
    if name.endswith(".png"):
        document["materials"] = {"m": {"type": "diffuse", "reflectance": {"texture": name, "of": [0.1, 0.9]}}}
        document["shapes"] = {"wall": wall}
    elif name == "curve.csv":
        document["materials"] = {"m": {"type": "diffuse", "reflectance": {"file": name}}}
        document["shapes"] = {"wall": wall}
    elif name == "pattern.csv":
        document["robots"]["r2"]["rig"] = {
            "preset": "infra_swarm",
            "sources": {"top": {"pattern": {"file": name}}},
        }
    else:
        body = {"type": "mesh", "file": name, "position": "[5, 2, 0] m", "material": "white_paint"}
        document["shapes"] = {"body": body}
    return document


def write_damaged(folder: Path, good: Mapping[str, bytes], draw: random.Random) -> tuple[Path, str]:
    """Write a scene, and the file that it names with one to three damages; return both by path and name."""
    name = draw.choice(sorted(good))
    data = good[name]
    for _ in range(draw.choice((1, 1, 2, 3))):
        data = draw.choice(_DAMAGES)(data, draw, good)
    (folder / name).write_bytes(data)
    scene = folder / "damaged.yaml"
    scene.write_text(yaml.safe_dump(document_of(name)), encoding="utf-8")
    return scene, name


def _cut(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    return data[: draw.randrange(len(data) + 1)]


def _flipped(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    mangled = bytearray(data)
    for _ in range(draw.choice((1, 1, 4, 40)) if data else 0):
        mangled[draw.randrange(len(mangled))] ^= 1 << draw.randrange(8)
    return bytes(mangled)


def _filled(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    at = draw.randrange(len(data) + 1)
    fill = draw.choice((b"\0", b"\xff", b" ", b"\n", b"9", b"f 1 2 3\n", b"\x7f\x80")) * draw.choice(
        (1, 4, 8, 1000)
    )
    return data[:at] + fill + data[at + draw.choice((0, len(fill))) :]


def _left_out(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    at = draw.randrange(len(data) + 1)
    return data[:at] + data[at + draw.choice((1, 4, 12, 100)) :]


def _renumbered(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    return re.sub(rb"-?\d[\d.e+-]*", lambda _: draw.choice(NUMBERS), data, count=draw.choice((1, 1, 5)))


def _renumbered_later(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    at = draw.randrange(len(data) + 1)
    return data[:at] + _renumbered(data[at:], draw, good)


def _exchanged(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    return good[draw.choice(sorted(good))]


def _mixed(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    lines = data.splitlines(keepends=True)
    draw.shuffle(lines)
    return b"".join(lines)


def _repeated(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    at, count = draw.randrange(len(data) + 1), draw.choice((1, 20, 500))
    return data[:at] + data[at : at + 50] * count + data[at:]


def _emptied(data: bytes, draw: random.Random, good: Mapping[str, bytes]) -> bytes:
    return draw.choice((b"", b"\n", b"\xef\xbb\xbf", b"\0" * 100))


Damage = Callable[[bytes, random.Random, Mapping[str, bytes]], bytes]
_DAMAGES: tuple[Damage, ...] = (
    _cut, _flipped, _flipped, _filled, _left_out, _renumbered, _renumbered_later, _exchanged, _mixed, _repeated, _emptied,
)  # fmt: skip
