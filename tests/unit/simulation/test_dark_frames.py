"""Scenes that make frames for calibration: the cap, its counting, and a sphere that fills the frame."""

import math
from itertools import islice

import numpy as np
import pytest

import nir_render as nr
from nir_render.camera.beams import Beam, beam_electrons
from nir_render.camera.optics.response import response
from nir_render.errors import InputError
from nir_render.scene.documents.times.clocks import CalibrationFrames
from nir_render.simulation.clock import simulate
from tests.calibration_frames import camera_of
from tests.paths import SCENES

SCENE = SCENES / "calibration.yaml"


def test_frames_are_counted_off_in_order() -> None:
    plan = CalibrationFrames(dark=2, flat=1, rail=3, shared=1)
    counted = ["dark"] * 2 + ["flat"] + ["rail"] * 3 + ["shared"] + ["scene"] * 2
    assert [plan.kind_of(index) for index in range(9)] == counted
    assert plan.count == 7
    assert CalibrationFrames().kind_of(0) == "scene"
    with pytest.raises(InputError, match="320 frames for it are more than the 100 that are taken"):
        nr.load_scene(SCENE, {"clock.frames": 100, "clock.calibration.rail": 288})


def test_under_the_cap_there_is_no_light_and_no_truth() -> None:
    """Before a sphere that would fill the frame with thousands of electrons: the mean is the black level."""
    scene = nr.load_scene(SCENE)
    shots = list(islice(simulate(scene), 3))
    for index, shot in enumerate(shots):
        assert (shot.kind, shot.frame.index, shot.truth, shot.lamps) == ("dark", index, (), ())
        assert not shot.mean.electrons.any()
        assert abs(float(shot.frame.data_dn.mean()) - 64.0) < 0.1  # columns' offsets: 0.8 DN / √1280
        assert shot.frame.exposure_s == scene.camera("r1.front")[1].exposure_s
    assert np.any(shots[0].frame.data_dn != shots[1].frame.data_dn)


def test_a_sphere_that_fills_the_frame_is_even_all_over_it() -> None:
    """A pixel gets L A cos θ · Ω · C(θ), Ω = A_px cos³ θ / f²: the rim, far out of sight, plays no part."""
    camera, (_, source) = camera_of(0.0, "any"), nr.load_scene(SCENE).sources()["r2.top"]
    unit = response(camera, source)
    beam = Beam(np.array([0.0, 0.0, 1.0]), 1.2, 1.0, unit)
    image = beam_electrons(camera, [beam], 1.0)
    rows, columns = image.shape
    v, u = np.mgrid[0:rows, 0:columns]
    focal_px = camera.lens.focal_length_m / camera.sensor.pixel_pitch_m
    theta = np.arctan(np.hypot(u - (columns - 1) / 2, v - (rows - 1) / 2) / focal_px)
    aperture_m2 = math.pi * (camera.lens.focal_length_m / (2.0 * camera.lens.f_number)) ** 2
    radiance = 1.0 / (math.pi * math.sin(1.2) ** 2)  # E = π L sin² α
    by_hand = radiance * aperture_m2 * np.cos(theta) ** 4 / focal_px**2 * unit(theta)
    assert np.abs(image / by_hand - 1.0).max() < 1e-3
