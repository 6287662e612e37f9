"""Light carried at wavelength nodes, held against a full spectral render by another program.

A room whose walls vary over the spectrum, seen through a filter of 20 nm about 940 nm (OD 4, or leaking at
OD 2), by light of an LED, of a lamp of 2856 K, or of the sun (ASTM G173). Once through `render` and the
responses of its nodes; once under Mitsuba's `path` in a spectral variant, with filter × quantum efficiency × λ
as the one band of a `specfilm`, the spectra and reflectances as tables. Nothing of the choice of nodes, of
hat functions or of responses is in Mitsuba's render.

Expected: the same mean over the frame within 0.5 %, and within 1 % behind a filter that leaks. Both are
means of independent renders, so their difference has a standard error, and what is asserted is that the
whole 95 % interval of the difference (Welch) lies within those bounds: noise cannot pass for agreement.
With standard errors of 0.06 to 0.1 % a difference of 0.1 % passes with a chance above 99 %, one of 0.5 % with
2.5 %. Besides, the difference of the frame and of each third of it is no larger than the error that the
nodes are said to make, plus noise.
"""

import json
import logging
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import constants, stats

import nir_render as nr
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.optics.response import response
from nir_render.scene.emission import emission_spectrum
from nir_render.scene.scene import parse_scene
from nir_render.transport.backend.variant import backend
from nir_render.transport.wavelengths import carried_wavelengths

pytestmark = pytest.mark.mitsuba

COLUMNS, ROWS = 48, 36
SCALE = 1e-17  # keeps electrons per joule within the comfort of float32
SEEDS = 8
Array = NDArray[np.float64]
Points = list[tuple[str, float]]
WALLS: dict[str, Points] = {
    "white": [("300 nm", 0.1), ("450 nm", 0.8), ("800 nm", 0.85), ("925 nm", 0.75), ("945 nm", 0.35), ("975 nm", 0.6), ("1100 nm", 0.5)],
    "red": [("300 nm", 0.05), ("560 nm", 0.08), ("640 nm", 0.6), ("900 nm", 0.7), ("1100 nm", 0.3)],
}  # fmt: skip

_STOCK = """
import json, sys
import numpy as np
import mitsuba as mi
case = json.loads(sys.stdin.read())
mi.set_variant(case["variant"])
nm = case["nm"]
def table(values):
    return {"type": "irregular", "wavelengths": ",".join(map(repr, nm)), "values": ",".join(map(repr, values))}
film = {"type": "specfilm", "width": case["columns"], "height": case["rows"], "component_format": "float32",
        "rfilter": {"type": "box"}, "band": table(case["response"])}
T = mi.ScalarTransform4f
def wall(center, size, normal, up, of):
    at = T().look_at(origin=center, target=[c + n for c, n in zip(center, normal)], up=up)
    return {"type": "rectangle", "to_world": at @ T().scale([size[0] / 2, size[1] / 2, 1]),
            "bsdf": {"type": "twosided", "nested": {"type": "diffuse", "reflectance": table(case["walls"][of])}}}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "path", "max_depth": case["depth"], "rr_depth": 1000},
    "floor": wall([2, 0, 0], [4, 3], [0, 0, 1], [0, 1, 0], "red"),
    "ceiling": wall([2, 0, 2], [4, 3], [0, 0, -1], [0, 1, 0], "white"),
    "front": wall([4, 0, 1], [3, 2], [-1, 0, 0], [0, 0, 1], "white"),
    "back": wall([0, 0, 1], [3, 2], [1, 0, 0], [0, 0, 1], "red"),
    "left": wall([2, 1.5, 1], [4, 2], [0, -1, 0], [0, 0, 1], "red"),
    "right": wall([2, -1.5, 1], [4, 2], [0, 1, 0], [0, 0, 1], "white"),
    "source": {"type": "sphere", "center": [0.4, 0.9, 1.3], "radius": 0.1,
               "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
               "emitter": {"type": "area", "radiance": table(case["radiance"])}},
    "sensor": {"type": "perspective", "fov": case["fov_deg"], "fov_axis": "x", "film": film, "near_clip": 0.01,
               "to_world": T().look_at(origin=[0.6, 0, 1], target=[2, 0, 1], up=[0, 0, 1])}})
means = []
for seed in range(case["seeds"]):
    image = np.array(mi.render(scene, spp=case["samples"], seed=seed), dtype=np.float64)
    means.append(image.reshape(case["rows"], case["columns"]).tolist())
print(json.dumps(means))
"""


def document(
    spectrum: str, blocking_od: float, samples: int = 256, depth: int = 6, error: float = 1e-3
) -> dict[str, Any]:
    def wall(center: str, size: str, normal: list[int], material: str) -> dict[str, Any]:
        return {
            "type": "rectangle",
            "center": f"{center} m",
            "size": f"{size} m",
            "normal": normal,
            "material": material,
        }

    curve: dict[str, Any] = {"led": "sfh_4545"}
    if spectrum != "led":
        curve = {"points": [[f"{nm} nm", value] for nm, value in broad(spectrum)]}
    return {
        "format": 1, "observe": ["r1.c"],
        "render": {"indirect": {"scale": 1, "samples": samples, "max_depth": depth}, "wavelengths": {"error": error}},
        "robots": {
            "r1": {"position": "[0.6, 0, 1] m", "rig": {"cameras": {"c": {
                "lens": {"focal_length": "1.8 mm", "f_number": 2.0, "transmission": 1.0},
                "filter": {"placement": "in_front_of_lens", "centre": "940 nm", "fwhm": "20 nm", "peak_transmission": 0.9,
                           "effective_index": 1e9, "blocking_od": blocking_od},
                "sensor": {"columns": COLUMNS, "rows": ROWS, "pixel_pitch": "80 um", "full_well": "1e9 e",
                           "quantum_efficiency": {"points": [("300 nm", 0.2), ("525 nm", 0.76), ("850 nm", 0.2), ("940 nm", 0.077), ("1100 nm", 0.001)]},
                           "read_noise": "1 e", "system_gain": "0.000004 DN/e", "black_level": "10 DN", "bit_depth": "12 bit"},
                "point_spread": {"sigma": "0.3 px"}, "exposure": "1 ms"}}}},
            "r2": {"position": "[0.4, 0.9, 1.3] m", "rig": {"sources": {"s": {"flux": "1 W", "radius": "10 cm", "spectrum": curve}}}},
        },
        "materials": {name: {"type": "diffuse", "reflectance": {"points": points}} for name, points in WALLS.items()},
        "shapes": {
            "floor": wall("[2, 0, 0]", "[4, 3]", [0, 0, 1], "red"), "ceiling": wall("[2, 0, 2]", "[4, 3]", [0, 0, -1], "white"),
            "front": wall("[4, 0, 1]", "[3, 2]", [-1, 0, 0], "white"), "back": wall("[0, 0, 1]", "[3, 2]", [1, 0, 0], "red"),
            "left": wall("[2, 1.5, 1]", "[4, 2]", [0, -1, 0], "red"), "right": wall("[2, -1.5, 1]", "[4, 2]", [0, 1, 0], "white"),
        },
    }  # fmt: skip


def broad(spectrum: str) -> list[tuple[float, float]]:
    """Planck's law at 2856 K, or the sunlight of ASTM G173."""
    if spectrum == "lamp":
        nm = np.arange(300.0, 1101.0, 10.0)
        values = nm**-5.0 / np.expm1(1.438777e7 / (nm * 2856.0))
    else:
        spectra = pytest.importorskip("pvlib", reason="pip install 'nir-render[sun]'").spectrum
        sun = spectra.get_reference_spectra(standard="ASTM G173-03")["global"].loc[300:1100]
        nm, values = sun.index.to_numpy(dtype=np.float64), sun.to_numpy()
    return list(zip(nm.tolist(), (values / values.max()).tolist(), strict=True))


def by_nodes(scene: nr.Scene) -> Array:
    """Return ∫ L τ η λ/hc dλ per watt of the source, by our nodes, shape (SEEDS, rows, columns)."""
    camera, source = scene.camera("r1.c")[1], scene.sources()["r2.s"][1]
    images = []
    for seed in range(SEEDS):
        light = nr.render(scene, camera="r1.c", time_s=0.0, seed=seed)
        assert light.indirect is not None
        electrons_per_j = [response(camera, source, node).electrons_per_j[0] for node in light.nodes]
        images.append(np.einsum("k,krc->rc", electrons_per_j, light.indirect.radiance_per_w[0].astype(float)))
    return np.array(images)


def by_mitsuba(scene: nr.Scene, samples: int) -> Array:
    """Return the same by Mitsuba alone."""
    camera, source = scene.camera("r1.c")[1], scene.sources()["r2.s"][1]
    nm = np.arange(300.0, 1100.5, 0.5)
    metres = nm * 1e-9
    spectrum = emission_spectrum(source)
    density_per_nm = np.interp(metres, spectrum.wavelength_m, spectrum.value, 0.0, 0.0) * 1e-9
    assert camera.filter is not None
    known = camera.sensor.efficiency()
    efficiency = np.interp(metres, known.wavelength_m, known.value)
    response = camera.filter.transmission(metres, 1.0) * efficiency * metres / (constants.h * constants.c)
    case = {
        "variant": "llvm_ad_spectral" if backend().vectorised else "scalar_spectral",
        "nm": nm.tolist(), "response": (SCALE * response).tolist(),
        "radiance": (density_per_nm / (4.0 * np.pi**2 * 0.1**2)).tolist(),
        "walls": {name: curve(points, nm).tolist() for name, points in WALLS.items()},
        "columns": COLUMNS, "rows": ROWS, "depth": scene.document.render.indirect.max_depth,
        "samples": samples, "seeds": SEEDS,
        "fov_deg": float(np.degrees(2.0 * np.arctan(COLUMNS * 80e-6 / 2.0 / 1.8e-3))),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", _STOCK], input=json.dumps(case), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return np.array(json.loads(done.stdout)) / SCALE


def curve(points: Points, nm: Array) -> Array:
    return np.interp(nm, [float(place[:-3]) for place, _ in points], [value for _, value in points])


@dataclass(frozen=True)
class Difference:
    """The relative difference of two means, its standard error, and half its 95 % interval (Welch)."""

    value: float
    error: float
    half_interval: float


def difference(ours: Array, theirs: Array) -> Difference:
    """Compare independent estimates of one mean, shape (n,) each."""
    squares = np.array([one.var(ddof=1) / one.size / one.mean() ** 2 for one in (ours, theirs)])
    freedom = squares.sum() ** 2 / (squares**2 / (ours.size - 1)).sum()
    error = float(np.sqrt(squares.sum()))
    value = float(ours.mean() / theirs.mean() - 1.0)
    return Difference(value, error, float(stats.t.ppf(0.975, freedom)) * error)


def held_against_mitsuba(scene: nr.Scene, samples: int, most_off: float) -> None:
    stated = carried_wavelengths(scene.at(0.0), "r1.c")
    assert len(stated.wavelengths_m) > 1
    ours, theirs = by_nodes(scene), by_mitsuba(scene, samples)
    frame = difference(ours.mean(axis=(1, 2)), theirs.mean(axis=(1, 2)))
    told = f"{len(stated.wavelengths_m)} nodes: {frame.value:+.3%} ± {frame.error:.3%}"
    logging.getLogger(__name__).info(told)  # pytest --log-cli-level=INFO shows it
    assert abs(frame.value) + frame.half_interval <= most_off, told
    thirds = [np.s_[:, :, first : first + COLUMNS // 3] for first in range(0, COLUMNS, COLUMNS // 3)]
    for part in thirds:
        found = difference(ours[part].mean(axis=(1, 2)), theirs[part].mean(axis=(1, 2)))
        # Twice the half of a 95 % interval: four standard errors, for three parts of six scenes.
        assert abs(found.value) <= stated.error + 2.0 * found.half_interval


@pytest.mark.verify
@pytest.mark.vectorised
def test_nodes_agree_with_a_full_spectral_render_of_fewer_bounces() -> None:
    held_against_mitsuba(parse_scene(document("led", 4.0, 256, depth=3, error=2e-3)), 1024, 0.005)


@pytest.mark.verify
@pytest.mark.parametrize(
    ("spectrum", "blocking_od", "most_off"),
    [
        pytest.param("led", 4.0, 0.005, marks=pytest.mark.at_length),  # as above, of fewer bounces
        ("lamp", 4.0, 0.005),
        ("sun", 2.0, 0.01),
        pytest.param("led", 2.0, 0.01, marks=pytest.mark.at_length),
        pytest.param("lamp", 2.0, 0.01, marks=pytest.mark.at_length),
        pytest.param("sun", 4.0, 0.005, marks=pytest.mark.at_length),
    ],
)
def test_nodes_agree_with_a_full_spectral_render(spectrum: str, blocking_od: float, most_off: float) -> None:
    held_against_mitsuba(parse_scene(document(spectrum, blocking_od)), 2048, most_off)


@pytest.mark.vectorised
@pytest.mark.parametrize(
    ("spectrum", "blocking_od"), [("led", 4.0), pytest.param("lamp", 2.0, marks=pytest.mark.verify)]
)
def test_nodes_keep_in_a_frame_the_error_that_they_state(spectrum: str, blocking_od: float) -> None:
    """Along the same paths noise is the same: few nodes against three times as many, in the frame and its parts."""
    electrons = {}
    for error in (3e-3, 3e-4):
        scene = parse_scene(document(spectrum, blocking_od, 16, error=error))
        scene = scene.with_({"render.wavelengths.most": 64})
        light = nr.render(scene, camera="r1.c", time_s=0.0, seed=1)
        electrons[error] = mean_frame(light, scene.at(0.0), 1e-3).electrons
    frames = [one.reshape(3, 12, 3, 16).sum(axis=(1, 3)) for one in electrons.values()]
    assert np.abs(frames[0] / frames[1] - 1.0).max() <= 3.3e-3


@pytest.mark.vectorised
def test_one_node_at_940_nm_would_be_wrong() -> None:
    """So that the agreement says something: the same room at 940 nm alone is off by far more."""
    scene = parse_scene(document("lamp", 2.0, 16))
    alone = scene.with_({"render.wavelengths": {"error": 1.0, "most": 1}})
    frames = [
        mean_frame(nr.render(one, camera="r1.c", time_s=0.0, seed=1), one.at(0.0), 1e-3).electrons.mean()
        for one in (scene, alone)
    ]
    assert abs(frames[1] / frames[0] - 1.0) > 0.02
