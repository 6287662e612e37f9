"""The direct table: geometry in closed form, visibility by rays."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import InputError, Scene, load_scene, render
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

RADIUS_M = 0.05


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A source of 50 mm radius, 2 m straight ahead of the front camera of r1."""
    base = load_scene(SCENES / "one_source.yaml")
    return base.with_(
        {
            "robots.r2": {"rig": "infra_swarm", "position": "[2.06, 0, -0.08] m"},
            "robots.r2.rig.sources.top.radius": "50 mm",
            "clock.frames": 1,
        }
    )


def _panel(center: str, size: str = "[1, 1] m", **more: Any) -> dict[str, Any]:
    return {
        "type": "rectangle",
        "center": center,
        "size": size,
        "normal": [1, 0, 0],
        "material": "black",
        **more,
    }


def test_a_free_source_has_the_closed_form(scene: Scene) -> None:
    light = render(scene, "r1.front")
    assert [light.groups[group] for group in light.direct.group] == ["r2.top"]  # r1's own source is behind
    np.testing.assert_allclose(light.direct.direction, [[0.0, 0.0, 1.0]], atol=1e-12)
    assert light.direct.distance_m == pytest.approx([2.0])
    assert light.direct.angular_radius_rad == pytest.approx([math.asin(RADIUS_M / 2.0)])
    assert light.direct.visible_fraction == pytest.approx([1.0], abs=0)
    assert light.direct.irradiance_per_w[0, 0] == pytest.approx(1.0 / (4.0 * math.pi * 4.0), rel=1e-12)


@pytest.mark.parametrize("share", [-0.9, -0.5, 0.0, 0.3, 0.8])
@pytest.mark.parametrize("rays", [256, 1024, 4096])
def test_an_edge_hides_the_circular_segment(scene: Scene, share: float, rays: int) -> None:
    """A panel halfway hides the disc up to a height h: its share is (π − acos h + h √(1 − h²))/π.

    The stated resolution is 1.5 / rays^(3/4): 2.3 % for 256 rays, 0.8 % for 1024, 0.3 % for 4096.
    """
    # Tangent rays meet the plane at 1 m at r' = tan(asin(r/d)); the panel reaches from far below up to h r'.
    top_m = 0.2 + share * math.tan(math.asin(RADIUS_M / 2.0))
    panel = _panel(f"[1.06, 0, {top_m - 0.5!r}] m")
    changed = scene.with_({"shapes.panel": panel, "render.visibility_rays": rays})
    seen = float(render(changed, "r1.front").direct.visible_fraction[0])
    hidden = (math.pi - math.acos(share) + share * math.sqrt(1.0 - share**2)) / math.pi
    assert seen == pytest.approx(1.0 - hidden, abs=1.5 / rays**0.75)


BODIES = {
    "rectangle": _panel("[1.06, 0, 0.2] m"),
    "box": {"type": "box", "center": "[1.06, 0, 0.2] m", "size": "[0.2, 0.3, 0.3] m"},
    "sphere": {"type": "sphere", "center": "[1.06, 0, 0.2] m", "radius": "0.2 m"},
    "cylinder from the side": {
        "type": "cylinder", "start": "[1.06, 0, -1] m", "end": "[1.06, 0, 1] m", "radius": "0.2 m",
    },
    "cylinder end on": {"type": "cylinder", "start": "[1, 0, 0.2] m", "end": "[1.5, 0, 0.2] m", "radius": "0.2 m"},
}  # fmt: skip


@pytest.mark.parametrize("kind", BODIES)
def test_bodies_hide_what_is_behind_them_and_nothing_else(scene: Scene, kind: str) -> None:
    body = {**BODIES[kind], "material": "black"}
    hidden = render(scene.with_({"shapes.body": body}), "r1.front").direct
    assert hidden.visible_fraction[0] == 0.0
    assert hidden.irradiance_per_w[0, 0] == 0.0
    behind = {**body, "center": "[2.5, 0, 0.2] m", "start": "[2.3, 0, 0.2] m", "end": "[2.9, 0, 0.2] m"}
    known = {key: behind[key] for key in body}
    assert render(scene.with_({"shapes.body": known}), "r1.front").direct.visible_fraction[0] == 1.0


def test_a_panel_has_the_size_and_turn_of_its_document(scene: Scene) -> None:
    """A panel 6 cm wide and 40 cm high hides the middle of the disc; turned by 90° it lies flat; moved, nothing."""
    tall = _panel("[1.06, 0, 0.2] m", "[6, 40] cm")
    # At 1 m the disc's radius is 25 mm: 30 mm of half width hide it all, 10 mm leave two segments.
    assert render(scene.with_({"shapes.p": tall}), "r1.front").direct.visible_fraction[0] == 0.0
    narrow = _panel("[1.06, 0, 0.2] m", "[2, 40] cm")
    h = 0.010 / math.tan(math.asin(RADIUS_M / 2.0))
    segments = 2.0 * (math.acos(h) - h * math.sqrt(1.0 - h * h)) / math.pi
    for turned in (narrow, {**narrow, "rotation": "90 deg"}):
        seen = render(scene.with_({"shapes.p": turned}), "r1.front").direct.visible_fraction[0]
        assert seen == pytest.approx(segments, abs=2 * 1.5 / 1024**0.75)
    beside = _panel("[1.06, 0, 0.245] m", "[2, 2] cm")  # seen by a tall panel only: its long side is up
    assert render(scene.with_({"shapes.p": beside}), "r1.front").direct.visible_fraction[0] == 1.0
    raised = _panel("[1.06, 0, 0.26] m", "[2, 12] cm")
    assert render(scene.with_({"shapes.p": raised}), "r1.front").direct.visible_fraction[0] < 1.0


def test_sources_hide_each_other(scene: Scene) -> None:
    """A nearer source of the same size, straight in front, hides the farther one wholly."""
    near = {"rig": "infra_swarm", "position": "[1.06, 0, -0.08] m"}
    light = render(scene.with_({"robots.r3": near, "robots.r3.rig.sources.top.radius": "50 mm"}), "r1.front")
    seen = dict(
        zip([light.groups[g] for g in light.direct.group], light.direct.visible_fraction, strict=True)
    )
    assert seen == {"r2.top": 0.0, "r3.top": 1.0}


def _cube_obj(folder: Path) -> None:
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    triangles = [triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in triangles]
    (folder / "cube.obj").write_text("\n".join(lines) + "\n")


def test_meshes_hide_and_a_camera_inside_one_is_refused(scene: Scene, tmp_path: Path) -> None:
    _cube_obj(tmp_path)
    (tmp_path / "scene.yaml").write_text(scene.resolved_yaml())
    here = load_scene(tmp_path / "scene.yaml")

    def cube(position: str) -> Scene:
        mesh = {"type": "mesh", "file": "cube.obj", "scale": 0.4, "position": position, "material": "black"}
        return here.with_({"shapes.cube": mesh})

    assert render(cube("[1.06, 0, 0.2] m"), "r1.front").direct.visible_fraction[0] == 0.0
    assert render(cube("[1.06, 0, 0.5] m"), "r1.front").direct.visible_fraction[0] == 1.0
    with pytest.raises(InputError, match=r"the camera r1\.front at 0 s is inside shapes\.cube"):
        render(cube("[0.1, 0, 0.2] m"), "r1.front")


def test_a_camera_inside_a_source_is_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"the camera is inside the source r2\.top at 0 s"):
        render(scene.with_({"robots.r2.position": "[0.07, 0, -0.08] m"}), "r1.front")


def test_the_scalar_variant_gives_the_same_table(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no LLVM works, rays go one by one; the edge case decides the same for all but a ray or two in 1024."""
    import subprocess
    import sys

    code = (
        "import sys; from nir_render import load_scene, render; "
        "small = {f'robots.r1.rig.cameras.front.sensor.{edge}': 32 for edge in ('columns', 'rows')}; "
        "s = load_scene(sys.argv[1]).with_({'robots.r2.position': '[2.06, 0, -0.08] m', 'robots.r2.motion': [], "
        "'shapes.p': {'type': 'rectangle', 'center': '[1.06, 0, -0.3] m', 'size': '[1, 1] m', 'normal': [1, 0, 0], "
        "'material': 'black'}, **small}); print(render(s, 'r1.front').direct.visible_fraction[0])"
    )
    path = str(SCENES / "one_source.yaml")
    seen = []
    for variant in ("scalar_rgb", None):
        if variant:
            monkeypatch.setenv("NIR_RENDER_VARIANT", variant)
        else:
            monkeypatch.delenv("NIR_RENDER_VARIANT")
        done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
        seen.append(float(done.stdout))
    assert seen[0] == pytest.approx(seen[1], abs=2.5 / 1024)
    assert seen[0] == pytest.approx(0.5, abs=0.01)
