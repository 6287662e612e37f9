"""A camera behind a distorted lens, its calibration, and the estimator that goes by it: without Mitsuba."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import nir_render as nr
from nir_render import load_scene
from nir_render.camera.beams import Beam, beam_electrons
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.response import response
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from perception import calibration_document, detect, parse_calibration_document
from perception.types import Calibration, RawFrame
from tests.paths import SCENES

LENSES: dict[str, dict[str, Any]] = {
    "barrel": {"model": "brown_conrady", "distortion": [-0.1, 0.012, 2e-4, 3e-4, -5e-4]},
    "rational": {
        "model": "brown_conrady", "distortion": [0.5, 0.08, 4e-4, -2e-4, 2e-3, 0.8, 0.2, 0.012],
        "principal_point": "[652.3, 471.8] px", "vignetting": [["0 deg", 1], ["35 deg", 0.9], ["90 deg", 0.6]],
    },
    "fisheye": {
        "model": "fisheye", "distortion": [-0.03, 0.005, -0.004, 4e-4], "focal_length": "2.2 mm",
        "vignetting": [["0 deg", 1], ["50 deg", 0.9], ["90 deg", 0.5]],
    },
}  # fmt: skip
# Columns, rows and ranges: from the middle to within 40 px of a corner, discs of 10 mm of 0.5 to 15 px.
PLACES = [
    (640.2, 470.9, 5.0), (200.4, 300.1, 2.0), (1240.3, 40.6, 3.0), (60.7, 900.2, 1.0), (900.9, 700.4, 0.4),
    (1100.1, 480.5, 7.0), (400.8, 80.3, 1.5), (640.6, 900.7, 0.8), (420.5, 640.3, 9.0), (1000.3, 150.8, 4.0),
]  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_sources_are_found_where_they_are_within_their_sigma(name: str) -> None:
    """Ten sources over the field, flux and noise of a real exposure: errors of place and range over the sigmas that
    the robust estimator claims have the mean square of a normal deviate, and bearings lead to the sources."""
    lens = {f"robots.r1.rig.cameras.front.lens.{key}": value for key, value in LENSES[name].items()}
    scene = load_scene(SCENES / "one_source.yaml", lens)
    _, camera = scene.camera("r1.front")
    source = scene.sources()["r2.top"][1]
    exact = nr.calibration(scene, "r1.front")
    known = parse_calibration_document(calibration_document([exact]))["r1.front"]
    directions = intrinsics_of(camera).unproject(np.array(PLACES)[:, :2])
    errors = []
    for seed in range(3):
        frame = _frame(camera, source, known, directions, seed)
        found = detect(frame, known)
        for (u, v, range_m), direction in zip(PLACES, directions, strict=True):
            (near,) = [one for one in found if abs(one.u_px - u) < 3.0 and abs(one.v_px - v) < 3.0]
            errors.append(
                [
                    (near.u_px - u) / near.u_sigma_px,
                    (near.v_px - v) / near.v_sigma_px,
                    (near.range_m - range_m) / near.range_sigma_m,
                ]
            )
            bearing = known.rotation_body_camera @ direction
            assert math.acos(min(1.0, float(np.dot(near.bearing_body, bearing)))) < 5e-4
            assert near.range_sigma_m < 0.1 * range_m
    scores = np.array(errors)
    assert np.abs(scores).max() < 4.5
    # 30 errors each: the mean square is 1 ± 0.26, the mean 0 ± 0.18.
    assert ((scores**2).mean(axis=0) < 1.9).all()
    assert ((scores**2).mean(axis=0) > 0.45).all()
    assert (np.abs(scores.mean(axis=0)) < 0.65).all()


def _frame(
    camera: Camera, source: Source, known: Calibration, directions: NDArray[np.float64], seed: int
) -> RawFrame:
    """A frame in which no source is clipped, with noise of its own making."""
    exposure_s = 0.2e-3
    unit = response(camera, source)
    beams = [
        Beam(
            direction,
            math.asin(source.radius_m / range_m),
            source.flux_w / (4.0 * math.pi * range_m**2),
            unit,
            distance_m=range_m,
        )
        for direction, (_, _, range_m) in zip(directions, PLACES, strict=True)
    ]
    mean_e = beam_electrons(camera, beams, exposure_s)
    random = np.random.Generator(np.random.Philox(seed))
    noisy_e = random.poisson(mean_e + 2.0) + random.normal(0.0, known.read_noise_e, mean_e.shape)
    counts = np.rint(known.system_gain_dn_per_e * noisy_e + known.black_level_dn)
    data_dn = np.clip(counts, 0, known.saturation_dn).astype(np.uint16)
    return RawFrame(known.camera, 0, 0.0, exposure_s, data_dn, known.black_level_dn)
