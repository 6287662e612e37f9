"""Meshes shine like the bodies that they copy.

A white crate beside a source, once as a `box` and once as an OBJ file of six quads without normals, turned by
30° about z. Both must throw the same light: per tile and over the frame, by the variance that each render states.
Where normals are made up at the corners of such a file, as Mitsuba's readers do, its faces shine like a ball's.
"""

from pathlib import Path

import numpy as np
import pytest

import nir_render as nr
from nir_render.light.light import Indirect
from tests.unit.scene.test_meshes import QUADS

SIDE_M = 0.6
CORNERS = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]


def _crate(shape: dict[str, object], folder: Path) -> Indirect:
    """A floor, a crate 2 m ahead, a source at its side: what r1.front sees of that source's light."""
    floor = {"type": "rectangle", "center": "[2, 0, -0.3] m", "size": "[4, 4] m", "material": "white"}
    document = {
        "format": 1,
        "observe": ["r1.front"],
        "render": {"indirect": {"samples": 128, "scale": 8}},
        "robots": {"r1": {"rig": "infra_swarm"}, "r2": {"rig": "infra_swarm", "position": "[1.5, 0.8, 0] m"}},
        "materials": {"white": {"type": "diffuse", "reflectance": 0.8}},
        "shapes": {"crate": {**shape, "material": "white", "orientation": {"yaw": "30 deg"}}, "floor": floor},
    }
    light = nr.render(nr.parse_scene(document, folder), camera="r1.front", time_s=0.0, seed=1)
    assert light.indirect is not None
    return light.indirect


@pytest.mark.mitsuba
def test_a_mesh_without_normals_shines_like_the_box_that_it_is(tmp_path: Path) -> None:
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
    text += "".join(
        f"usemtl side{index % 2}\nf {a} {b} {c} {d}\n" for index, (a, b, c, d) in enumerate(QUADS)
    )
    (tmp_path / "crate.obj").write_text(text)
    place = "[2, -0.2, 0] m"
    box = _crate({"type": "box", "center": place, "size": f"[{SIDE_M}, {SIDE_M}, {SIDE_M}] m"}, tmp_path)
    of_file = {"type": "mesh", "file": "crate.obj", "scale": SIDE_M, "position": place}
    for mesh in (of_file, {**of_file, "materials": {"side1": "white"}}):
        other = _crate(mesh, tmp_path)
        ours, theirs = (one.radiance_per_w[1, 0].astype(float) for one in (box, other))
        variance = (box.variance + other.variance)[1, 0].astype(float)
        assert ours.sum() == pytest.approx(theirs.sum(), abs=4.0 * np.sqrt(variance.sum()))
        assert np.sqrt(variance.sum()) < 6e-4 * ours.sum()
        z = [
            (ours[place] - theirs[place]).sum() / np.sqrt(variance[place].sum())
            for place in (
                np.s_[row : row + 12, column : column + 16]
                for row in range(0, 120, 12)
                for column in range(0, 160, 16)
            )
            if variance[place].sum() > 0.0
        ]
        assert np.abs(z).max() < 4.5
        assert np.sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.mitsuba
def test_slots_of_any_name_are_all_there(tmp_path: Path) -> None:
    """Two slots, `a.b` and `a:b`: none of them takes the other's place."""
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
    text += "".join(
        f"usemtl {'a.b' if index < 3 else 'a:b'}\nf {a} {b} {c} {d}\n"
        for index, (a, b, c, d) in enumerate(QUADS)
    )
    (tmp_path / "crate.obj").write_text(text)
    mesh = {"type": "mesh", "file": "crate.obj", "scale": SIDE_M, "position": "[2, -0.2, 0] m"}
    one = _crate(mesh, tmp_path)
    two = _crate({**mesh, "materials": {"a.b": "white", "a:b": "white"}}, tmp_path)
    ours, theirs = (each.radiance_per_w[1, 0].astype(float) for each in (one, two))
    assert ours.sum() == pytest.approx(theirs.sum(), rel=4e-3)


@pytest.mark.mitsuba
def test_one_can_stand_under_a_roof_and_in_a_room_but_not_in_a_solid(tmp_path: Path) -> None:
    """A ray upwards crosses a roof once, and a room's wall once: neither makes them solids around the camera."""
    corners = "".join(f"v {8 * x} {8 * y} {8 * z}\n" for x, y, z in CORNERS)
    (tmp_path / "roof.obj").write_text("v -5 -5 3\nv 5 -5 3\nv 5 5 3\nv -5 5 3\nf 1 2 3 4\n")
    (tmp_path / "solid.obj").write_text(corners + "".join(f"f {a} {b} {c} {d}\n" for a, b, c, d in QUADS))
    (tmp_path / "room.obj").write_text(corners + "".join(f"f {d} {c} {b} {a}\n" for a, b, c, d in QUADS))
    for name in ("roof", "room"):
        assert _crate({"type": "mesh", "file": f"{name}.obj"}, tmp_path)
    with pytest.raises(nr.InputError, match=r"is inside shapes\.crate"):
        _crate({"type": "mesh", "file": "solid.obj"}, tmp_path)
