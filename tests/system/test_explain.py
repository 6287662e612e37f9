"""`nir-render explain`: every scene that there is, the page, and its electrons against a frame that is taken."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from nir_render import calibration, expected_electrons, expose, load_scene, parse_scene, render
from nir_render.budget.budget import photon_budget
from nir_render.budget.page import budget_html
from tests.paths import ROOT, SCENES
from tests.system.command import SCENE, nir_render

ALL_SCENES = sorted([*SCENES.glob("*.yaml"), *(SCENES / "regression").glob("*.yaml")])
QUICK = ("foggy_hall", "one_source", "shutter", "sunlit_yard")
SOME_SCENES = [
    pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.verify)
    for path in ALL_SCENES
]


@pytest.mark.parametrize("path", SOME_SCENES)
def test_every_scene_has_a_budget(path: Path) -> None:
    """At two times: robots move, sources blink; what is printed is one JSON object without NaN."""
    if path.stem == "sunlit_yard":
        pytest.importorskip("pvlib", reason="pvlib is not installed: pip install 'nir-render[sun]'")
    scene = load_scene(path)
    for time_s in (0.0, 0.5):
        record = json.loads(json.dumps(photon_budget(scene, time_s).record(), allow_nan=False))
        assert record["time_s"] == time_s
        for camera in record["cameras"]:
            assert camera["clip_e"][0] > 100.0
            for source in camera["sources"]:
                assert 0.0 < source["in_band_share"] <= 1.0
                assert set(source["drives"]) == set(source["sources"])
                assert all(curve["electrons_e"][0] > 0.0 for curve in source["curves"])


def test_the_command_prints_tables_and_writes_a_page(tmp_path: Path) -> None:
    done = nir_render("explain", SCENE, "-o", str(tmp_path / "out"), "--time", "4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for words in ("r2.top", "What makes a range uncertain", "LED to LED", "Eye safety", "clips nowhere"):
        assert words in done.stdout
    page = (tmp_path / "out" / "explain.html").read_text(encoding="utf-8")
    assert "photon budget" in page
    assert "mathdefault" not in page
    assert "<script" not in page
    record = json.loads((tmp_path / "out" / "explain.json").read_text(encoding="utf-8"))
    assert record["cameras"][0]["in_view"][0]["range_m"] == pytest.approx(5.0996, abs=1e-3)
    again = nir_render("explain", SCENE, "-o", str(tmp_path / "out"), cwd=tmp_path)
    assert again.returncode == 2
    assert "explain.json is there already" in " ".join(again.stderr.split())
    assert json.loads((tmp_path / "out" / "explain.json").read_text(encoding="utf-8")) == record


def test_json_is_one_object(tmp_path: Path) -> None:
    changed = ("--set", "robots.r1.rig.cameras.front.exposure=1 ms", "--assume", "unit_flux=0 %")
    done = nir_render("explain", SCENE, "--json", *changed, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["format"] == 1
    assert record["page"] is None
    assert record["assumptions"]["unit_flux_sigma"] == 0.0
    assert record["cameras"][0]["sources"][0]["curves"][0]["saturation"]["when"] == "nearer"
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_assumption_says_how_to_mend_it(tmp_path: Path) -> None:
    done = nir_render("explain", SCENE, "--assume", "led_temperature=5", cwd=tmp_path)
    assert done.returncode == 2
    assert "--assume led_temperature" in done.stderr


@pytest.mark.mitsuba
@pytest.mark.parametrize("time_s", [0.0, 3.0])
def test_a_frame_has_the_electrons_that_were_told(time_s: float) -> None:
    """Without noise to 0.1 %, in all and in the brightest pixel; in a frame within 4 σ of its shot and read noise."""
    scene = load_scene(ROOT / "scenes" / "one_source.yaml")
    (row,) = photon_budget(scene, time_s).cameras[0].in_view
    light = render(scene, "r1.front", time_s=time_s)
    image_e = expected_electrons(light, scene)
    u, v = round(row.u_px), round(row.v_px)
    box = (slice(v - 20, v + 21), slice(u - 20, u + 21))
    assert float(image_e[box].sum()) == pytest.approx(row.electrons_e, rel=1e-3)
    known, dark_e = calibration(scene, "r1.front"), 20.0 * row.exposure_s
    assert float(image_e.max()) + dark_e == pytest.approx(row.brightest_pixel_e, rel=2e-3)
    frame = expose(light, scene, seed=7)
    counts = frame.data_dn[box].astype(float) - known.black_level_dn
    found_e = float(counts.sum()) / known.system_gain_dn_per_e - dark_e * counts.size
    per_pixel_e2 = (
        known.read_noise_e**2 + known.dsnu_e**2 + 1.0 / (12.0 * known.system_gain_dn_per_e**2) + dark_e
    )
    # Pixels respond unequally: what that does to the sum goes with the light in each.
    unequal_e2 = known.prnu**2 * float(np.square(image_e[box]).sum())
    sigma_e = math.sqrt(row.electrons_e + counts.size * per_pixel_e2 + unequal_e2)
    assert abs(found_e - row.electrons_e) < 4.0 * sigma_e
    assert sigma_e < 0.04 * row.electrons_e


LAMP = {"preset": "halogen", "center": "[1, 0, 3] m"}
FISHEYE = {
    "model": "fisheye",
    "focal_length": "1.2 mm",
    "f_number": 2.0,
    "transmission": 0.9,
    "distortion": [0, 0, 0, 0],
}


@pytest.mark.parametrize(
    ("changes", "when"),
    [
        ({"lamps.top": {**LAMP, "luminous_flux": "1e9 lm"}}, "always"),
        ({"robots.r1.rig.cameras.front.lens": FISHEYE}, "never"),
        ({"robots.r2.rig.sources.top.flux": "500 W"}, "nearer"),
        ({"fog": {"extinction": "3 /m"}}, "never"),
    ],
    ids=["flooded", "fisheye", "blinding", "thick fog"],
)
def test_pages_of_what_is_extreme(changes: dict[str, object], when: str) -> None:
    scene = load_scene(ROOT / "scenes" / "one_source.yaml").with_(changes)
    budget = photon_budget(scene)
    assert budget_html(budget).endswith("</html>")
    axis, edge = budget.cameras[0].sources[0].curves
    assert (axis.saturation.when, edge.place.name) == (when, "edge")
    assert (axis.range_limit_m[-1] is None) == (when == "always")


def test_a_camera_without_sources_has_the_light_about_it() -> None:
    rig = {"cameras": {"front": "infra_swarm"}}
    document = {"format": 1, "observe": ["r1.front"], "robots": {"r1": {"rig": rig}}, "lamps": {"top": LAMP}}
    budget = photon_budget(parse_scene(document))
    assert budget.cameras[0].sources == ()
    assert budget.cameras[0].ambient[0].wall_e_per_s > 0.0
    assert budget_html(budget).count("<h2>") == 3
