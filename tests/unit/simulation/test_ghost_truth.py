"""The truth about ghosts, worked out by hand: a mirror on a wall to the left of a camera that looks along x.

The lens stands at (0.06, 0, 0.2) m; the source at (3, 0.5, 0.2) m; the mirror at y = 2 m. The image stands at
(3, 3.5, 0.2) m.
"""

import math

import numpy as np
import pytest

from nir_render import Light, Scene, expose, load_scene
from nir_render.camera.mean_frame import mean_frame
from nir_render.simulation.truth import truth_of
from nir_render.transport.direct.table import direct_table
from nir_render.transport.world.facets import facets
from nir_render.truth.sources import SourceTruth
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

EXPOSURE_S = 1e-3


@pytest.fixture(scope="module")
def scene() -> Scene:
    wall = {
        "type": "rectangle", "center": "[2.5, 2, 0.5] m", "size": "[5, 3] m", "normal": [0, -1, 0],
        "material": "silver",
    }  # fmt: skip
    return load_scene(SCENES / "one_source.yaml").with_(
        {
            "clock.frames": 1, "robots.r2": {"rig": "infra_swarm", "position": "[3, 0.5, -0.08] m"},
            "robots.r1.rig.cameras.front.filter": None, "shapes.wall": wall,
            "materials": {"silver": {"type": "mirror", "reflectance": 0.9}},
            "sun": {"azimuth": "20 deg", "elevation": "20 deg", "irradiance": "0.305 W/m^2/nm"},
        }
    )  # fmt: skip


def _truth(scene: Scene) -> list[SourceTruth]:
    table = direct_table(scene.at(0.0), scene.at(0.0).camera("r1.front").pose, specular=True)
    light = Light(
        "r1.front", 0.0, 1, scene.at(0.0).groups, (940e-9,), table, None, facets(scene.at(0.0)).name
    )
    return list(truth_of(mean_frame(light, scene.at(0.0), EXPOSURE_S), expose(light, scene, EXPOSURE_S)))


def test_a_source_and_its_ghost_have_a_row_each(scene: Scene) -> None:
    """The sun, which shines into the same frame, and its ghost have none."""
    source, ghost = _truth(scene)
    assert (source.ghost_of, ghost.ghost_of) == (None, "r2.top")
    assert [(row.robot, row.source) for row in (source, ghost)] == [("r2", "top")] * 2
    way_m = math.hypot(2.94, 3.5)
    assert ghost.range_m == pytest.approx(way_m, rel=1e-12)
    assert ghost.depth_z_m == pytest.approx(2.94, rel=1e-12)
    assert (ghost.u_px, ghost.v_px) == pytest.approx((639.5 - 480.0 * 3.5 / 2.94, 479.5), abs=1e-9)
    assert ghost.bearing_body == pytest.approx((2.94 / way_m, 3.5 / way_m, 0.0), abs=1e-12)
    assert ghost.position_body_m == pytest.approx((3.0, 3.5, 0.2), abs=1e-12)
    assert ghost.visible_fraction == 1.0


def test_their_electrons_are_told_apart(scene: Scene) -> None:
    """The ghost's are mirrored, the source's direct; 0.9 d²/d'² · cos θ'/cos θ = 0.9 d³/d'³ as many at one depth."""
    source, ghost = _truth(scene)
    assert (source.mirrored_e, ghost.direct_e) == (0.0, 0.0)
    ratio = 0.9 * (math.hypot(2.94, 0.5) / math.hypot(2.94, 3.5)) ** 3
    assert ghost.mirrored_e / source.direct_e == pytest.approx(ratio, rel=1e-4)
    electrons_per_j = 0.9 * 0.15 * 940e-9 / (6.62607015e-34 * 299_792_458.0)
    distance_m = math.hypot(2.94, 0.5)
    direct_e = (
        0.2 / (4.0 * math.pi * distance_m**2) * math.pi * 0.9e-3**2 / 4.0 * (2.94 / distance_m)
        * electrons_per_j * EXPOSURE_S
    )  # fmt: skip
    assert source.direct_e == pytest.approx(direct_e, rel=1e-4)
    assert ghost.peak_snr > 5.0


def test_a_ghost_that_is_hidden_has_no_row(scene: Scene) -> None:
    pole = {
        "type": "cylinder", "start": "[0.816, 0.9, -1] m", "end": "[0.816, 0.9, 1] m", "radius": "5 cm", "material": "black",
    }  # fmt: skip
    (source,) = _truth(scene.with_({"shapes.pole": pole}))
    assert source.ghost_of is None
    assert np.isfinite(source.peak_snr)
